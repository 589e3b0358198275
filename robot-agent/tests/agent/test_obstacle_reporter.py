from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from fog_contracts import channels as ch
from fog_contracts.grid import GridGeometry
from fog_contracts.handlers import Moment
from fog_contracts.messages import (
    REACH_UNIT_M,
    AreaHazard,
    CircleShape,
    CorridorShape,
    HazardArea,
    RectangleShape,
    Zone,
    ZoneSet,
)
from robot_agent.agent.blocked_places import BlockedPlaces
from robot_agent.agent.obstacle_reporter import ObstacleReporter, view
from robot_agent.localization.localizer import Pose2
from robot_agent.localization.pose import Uncertainty

GEOMETRY = GridGeometry(100, 100, 0.1, 0.0, 0.0)
HERE = Pose2(5.0, 5.0, 0.0)


class FakeLocalizer:
    def __init__(self, points):
        self.points = np.array(points, dtype=np.float64).reshape(-1, 2)
        self.status = "good"
        self.turning = 0.0
        self.scan = SimpleNamespace(points=self.points - (HERE.x, HERE.y), timestamp=0.0)
        self.uncertainty = Uncertainty(0.02, 0.02, 0.013)

    def points_in_map(self):
        return self.points

    def pose(self, _now):
        return HERE

    def scan_pose(self):
        return HERE

    def twist(self):
        return 0.0, self.turning

    def wall_distance(self, points):
        return np.abs(points[:, 0] - 9.0)  # a wall at x = 9


def replica():
    return SimpleNamespace(
        geometry=GEOMETRY, static=np.zeros(GEOMETRY.shape, np.uint8), cost=np.zeros(GEOMETRY.shape, np.uint8)
    )


def report(points, *, copy=None, reporter=None, scan_age=0.1, now=0.0, **changes):
    localizer = FakeLocalizer(points)
    for name, value in changes.items():
        setattr(localizer, name, value)
    reporter = reporter or ObstacleReporter(600.0, 3, 0.17)
    return reporter.report(localizer, copy or replica(), scan_age, Moment(now, 1_000.0 + now))


TWO = [(6.03, 5.02), (6.06, 5.04)]


def test_cells_with_two_points_or_more_are_reported_once_each():
    reported = report([*TWO, (7.05, 5.05)])
    assert reported.points == [pytest.approx((6.05, 5.05))]
    assert (reported.stamp, reported.ttl) == (1_000.0, 600.0)


@pytest.mark.parametrize(
    ("x", "y"), [(8.9, 5.05), (-0.5, 5.0), (5.0, 12.0)], ids=["wall of the map", "left of the map", "above the map"]
)
def test_points_that_the_map_explains_or_does_not_have_are_not_reported(x, y):
    assert report([(x, y), (x, y + 0.01)]).points == []


def test_only_the_nearest_cells_are_reported():
    far = [point for x in (5.5, 6.5, 7.5, 8.5, 4.0) for point in [(x + 0.02, 5.02), (x + 0.04, 5.04)]]
    assert [x for x, _ in report(far).points] == pytest.approx([5.55, 4.05, 6.55])


@pytest.mark.parametrize("change", [{"status": "weak"}, {"turning": 0.6}, {"scan_age": 0.6}, {"scan": None}])
def test_no_report_while_the_pose_or_scan_is_not_good_enough(change):
    assert report(TWO) is not None
    assert report(TWO, **change) is None


def test_place_that_the_robot_could_not_pass_is_reported_although_the_lidar_sees_nothing_there():
    localizer, reporter = FakeLocalizer(TWO), ObstacleReporter(600.0, 1, 0.17)
    bar = np.array([(5.45, 4.81), (5.45, 4.9), (5.45, 5.0)])
    reported = reporter.report(localizer, replica(), 0.1, Moment(0.0, 1_000.0), bar)
    assert reported.points == [pytest.approx(p) for p in ((6.05, 5.05), (5.45, 4.85), (5.45, 4.95), (5.45, 5.05))]
    assert reporter.is_self_reported(bar, 601.9).all()


def test_obstacles_of_others_are_left_out_and_own_ones_repeated_until_forgotten():
    reporter, blocked = ObstacleReporter(10.0, 3, 0.17), replica()
    blocked.cost[45:56, 55:66] = 254
    assert report(TWO, copy=blocked).points == []
    assert len(report(TWO, reporter=reporter).points) == 1
    assert len(report(TWO, copy=blocked, reporter=reporter, now=11.9).points) == 1
    assert report(TWO, copy=blocked, reporter=reporter, now=24.0).points == []


def test_view_gives_the_nearest_return_of_each_sector_and_zero_without_one():
    points = np.array([(7.0, 5.01), (6.04, 5.01), (5.01, 8.0)])
    seen = view(HERE, points, GEOMETRY)
    assert (seen.x, seen.y) == (5.0, 5.0)
    assert [seen.reach[0] * REACH_UNIT_M, seen.reach[44] * REACH_UNIT_M] == pytest.approx([1.0, 3.0])
    assert sum(reach > 0 for reach in seen.reach) == 2
    (far,) = np.flatnonzero(list(view(HERE, np.array([(25.0, 5.01)]), GEOMETRY).reach))
    assert (far, view(HERE, np.array([(25.0, 5.01)]), GEOMETRY).reach[far]) == (0, 255)
    assert view(Pose2(-1.0, 5.0, 0.0), points, GEOMETRY) is None
    assert view(None, points, GEOMETRY) is None


# --- blocked places ---


def places(hazards=(), zones=(), off=()):
    found = BlockedPlaces()
    at = Moment(0.0, 0.0)
    for state, polygon in hazards:
        area = AreaHazard(
            area="z4", state=state, severity=1, penalty=254, since=0.0, seq=1, epoch=1, cause="", nodes={}
        )
        found.handlers()[ch.HAZARD]({}, HazardArea(hazard=area, polygon=polygon, label="Z4"), at)
    active = [zone.id for zone in zones if zone.enabled and zone.id not in off]
    found.handlers()[ch.ZONES]({}, ZoneSet(epoch=1, seq=1, zones=list(zones), active=active), at)
    return found


def lethal():
    copy = replica()
    copy.cost[50, 50] = 254
    return copy


SQUARE = [(4.0, 4.0), (6.0, 4.0), (6.0, 6.0), (4.0, 6.0)]


@pytest.mark.parametrize(
    ("shape", "inside"),
    [
        (CircleShape(centre=(5.0, 5.5), radius=0.6), True),
        (CircleShape(centre=(5.0, 5.7), radius=0.6), False),
        (RectangleShape(corner=(6.0, 6.0), opposite=(4.0, 4.0)), True),
        (RectangleShape(corner=(6.0, 6.0), opposite=(5.5, 4.0)), False),
        (CorridorShape(line=[(0.0, 5.4), (9.0, 5.4)], width=1.0), True),
        (CorridorShape(line=[(0.0, 5.6), (9.0, 5.6)], width=1.0), False),
    ],
)
def test_a_zone_of_any_shape_is_named_only_by_a_robot_inside_it(shape, inside):
    zone = Zone(id="wet", kind="BLOCKED", shape=shape, reason="mopped")
    description = places(zones=[zone]).containing(HERE, lethal(), ObstacleReporter(10.0, 3, 0.17), 0.0)
    assert description == ("the no-go zone wet (mopped)" if inside else "a blocked part of the map")


@pytest.mark.parametrize("changes", [{"enabled": False}, {"kind": "PENALTY", "factor": 2.0}])
def test_only_zones_that_block_are_named(changes):
    zone = Zone(**{"id": "wet", "kind": "BLOCKED", "shape": CircleShape(centre=(5.0, 5.0), radius=1.0), **changes})
    assert (
        places(zones=[zone]).containing(HERE, lethal(), ObstacleReporter(10.0, 3, 0.17), 0.0)
        == "a blocked part of the map"
    )


@pytest.mark.parametrize(
    ("state", "description", "caution"),
    [("blocked", "the blocked area Z4", False), ("unknown", "the unknown area Z4", True), ("clear", None, False)],
)
def test_an_area_is_named_by_its_label_unless_it_is_clear(state, description, caution):
    found = places(hazards=[(state, SQUARE)])
    assert found.containing(HERE, lethal(), ObstacleReporter(10.0, 3, 0.17), 0.0) == (
        description or "a blocked part of the map"
    )
    assert (found.caution(HERE) is not None) == caution
    assert found.caution(Pose2(1.0, 1.0, 0.0)) is None


def test_only_the_map_decides_whether_a_place_is_blocked():
    found, reporter = places(hazards=[("blocked", SQUARE)]), ObstacleReporter(10.0, 3, 0.17)
    assert found.containing(HERE, replica(), reporter, 0.0) is None
    beside_a_wall = lethal()
    beside_a_wall.static[50, 50] = 254
    assert found.containing(HERE, beside_a_wall, reporter, 0.0) is None
    assert found.containing(Pose2(-5.0, math.pi, 0.0), lethal(), reporter, 0.0) is None


def test_robot_does_not_stop_for_an_obstacle_that_it_reported_under_itself():
    reporter = ObstacleReporter(10.0, 3, 0.17)
    assert report([(5.02, 5.02), (5.04, 5.04)], reporter=reporter).points
    assert places().containing(HERE, lethal(), reporter, 0.0) is None
    assert places().containing(HERE, lethal(), reporter, 13.0) == "a blocked part of the map"


def test_zone_that_is_not_in_force_is_no_reason_to_stop_for_an_own_obstacle():
    reporter = ObstacleReporter(10.0, 3, 0.17)
    assert report([(5.02, 5.02), (5.04, 5.04)], reporter=reporter).points
    zone = Zone(id="nights", kind="BLOCKED", shape=CircleShape(centre=(5.0, 5.0), radius=1.0))
    assert places(zones=[zone]).containing(HERE, lethal(), reporter, 0.0) == "the no-go zone nights"
    assert places(zones=[zone], off=["nights"]).containing(HERE, lethal(), reporter, 0.0) is None
