"""What other systems report is on the map until nobody reports it any more."""

from collections.abc import Sequence

import numpy as np
import pytest

from fog_contracts import channels as ch
from fog_contracts.costs import LETHAL
from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.handlers import Moment, RefusedMessageError
from fog_contracts.messages import CircleShape, PolygonShape, RectangleShape, Reported, RobotObstacles, RobotPose
from map_service.core import MapCore
from map_service.layers.reported import MAX_THINGS
from map_service.registry import make_layers

ROBOT = CircleShape(centre=(2.0, 1.5), radius=0.2)


class Rig:
    """A map of 4 x 3 m without a wall, and a clock."""

    def __init__(self, layers: Sequence[str] = ()) -> None:
        plan = StaticMap(GridGeometry(80, 60, 0.05, 0.0, 0.0), np.zeros((60, 80), np.uint8))
        self.core = MapCore("test", plan, layers=make_layers(plan, layers))
        self.now = 0.0
        self.core.load_zones([], Moment(0.0, 0.0))
        self.pass_s(0.0)

    def pass_s(self, seconds: float) -> None:
        self.now += seconds
        self.core.tick(Moment(self.now, self.now))

    def report(self, thing: str, shape, ttl: float = 3.0, kind="robot") -> None:
        told = Reported(kind=kind, shape=shape, ttl=ttl)
        self.core.handlers()[ch.REPORTED]({"thing": thing}, told, Moment(self.now, self.now))

    def lethal(self, x: float, y: float) -> bool:
        return bool(self.core.costmap.cost[round(y / 0.05), round(x / 0.05)] == LETHAL)

    @property
    def seq(self) -> int:
        return self.core.costmap.version.seq


def test_robot_of_others_is_an_obstacle_where_it_is_until_it_is_silent():
    rig = Rig()
    rig.report("tb4", ROBOT)
    assert rig.lethal(2.0, 1.5)
    rig.report("tb4", CircleShape(centre=(3.0, 1.5), radius=0.2))
    assert (rig.lethal(2.0, 1.5), rig.lethal(3.0, 1.5)) == (False, True)
    rig.pass_s(2.9)
    assert rig.lethal(3.0, 1.5)
    rig.pass_s(0.2)
    assert not rig.lethal(3.0, 1.5)
    rig.report("box", RectangleShape(corner=(1.0, 1.0), opposite=(1.4, 1.4)), kind="obstacle")
    assert rig.lethal(1.2, 1.2)
    rig.report("box", None, kind="obstacle")
    assert not rig.lethal(1.2, 1.2)


def test_site_that_lists_its_layers_shows_robots_of_others_all_the_same():
    rig = Rig(["static", "hazards", "zones", "obstacles"])
    rig.report("tb4", ROBOT)
    assert rig.lethal(2.0, 1.5), "its lidars' cells and echoes there count for nothing, so it must be on the map"


def test_robot_of_others_that_hardly_moves_makes_no_new_version_of_the_map():
    rig = Rig()
    rig.report("tb4", ROBOT)
    before = rig.seq
    rig.pass_s(2.0)
    rig.report("tb4", CircleShape(centre=(2.05, 1.5), radius=0.2))
    rig.pass_s(2.0)
    assert rig.lethal(2.0, 1.5)
    assert rig.seq == before


def test_report_that_would_close_a_floor_or_cross_itself_is_refused():
    wide = StaticMap(GridGeometry(600, 20, 0.05, 0.0, 0.0), np.zeros((20, 600), np.uint8))
    core = MapCore("test", wide, layers=make_layers(wide))
    at = Moment(0.0, 0.0)
    for shape in (
        RectangleShape(corner=(0.0, 0.0), opposite=(29.0, 0.5)),
        PolygonShape(points=[(0.0, 0.0), (1.0, 0.5), (1.0, 0.0), (0.0, 0.5)]),
    ):
        with pytest.raises(RefusedMessageError, match="what is reported as box"):
            core.handlers()[ch.REPORTED]({"thing": "box"}, Reported(kind="obstacle", shape=shape, ttl=3.0), at)
    for number in range(MAX_THINGS + 5):
        core.handlers()[ch.REPORTED]({"thing": f"t{number}"}, Reported(kind="robot", shape=ROBOT, ttl=3.0), at)
    assert core.refused_cells == 5


def test_robot_of_others_that_a_lidar_sees_leaves_nothing_behind_where_it_was():
    rig = Rig()
    at = Moment(rig.now, rig.now)
    own = RobotPose(x=0.5, y=1.5, theta=0.0, v=0.0, w=0.0, covariance=[0.0] * 9, stamp=0.0, height=0.3, radius=0.17)
    rig.report("tb4", ROBOT)
    rig.core.handlers()[ch.ROBOT_POSE]({"robot": "r1"}, own, at)
    seen = RobotObstacles(points=[(1.8, 1.5), (1.85, 1.4)], stamp=0.0, ttl=600.0)
    rig.core.handlers()[ch.ROBOT_OBSTACLES]({"robot": "r1"}, seen, at)
    rig.report("tb4", None)
    assert not rig.core.costmap.cost[28:32, 30:50].any()
