"""Half a corridor: a box stands in one half, sonars hear the far wall along the other, and the robot passes there."""

from pathlib import Path

import numpy as np
import pytest
import ring_site as ring

from fog_contracts import channels as ch
from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.messages import HazardArea, Pose, RobotGoal, SimObstacle
from fog_contracts.site import AreaSite, NodeSite, RobotSite, Site, Sonar
from fog_runtime.configuration.site import LoadedSite

RESOLUTION = 0.05
FREE = [(0.5, 0.5, 9.5, 3.0), (0.5, 3.0, 1.5, 6.5), (7.0, 3.0, 8.0, 3.8)]  # left, bottom, right, top (m)
START, GOAL = Pose(x=7.5, y=1.75, theta=3.1415927), Pose(x=1.0, y=5.8, theta=1.5707963)
AREA = [(1.6, 0.5), (3.0, 0.5), (3.0, 3.0), (1.6, 3.0)]
BOX = [(2.1, 1.9), (2.6, 1.9), (2.6, 2.7), (2.1, 2.7)]
"""It leaves 1.4 m of the hall's 2.5 m."""


def hall(free_width):
    """Return a hall that ends at a wall, with two nodes that look along it to that wall, one in each half."""
    geometry = GridGeometry(200, 140, RESOLUTION, 0.0, 0.0)
    cells = np.full(geometry.shape, 254, np.uint8)
    for box in FREE:
        left, bottom, right, top = (round(value / RESOLUTION) for value in box)
        cells[bottom:top, left:right] = 0
    sonars = [Sonar(angle=angle, range_limit=3.5, range_max=4.0) for angle in (-0.12, 0.12)]
    nodes = [
        NodeSite(id=f"n{number}", area="end", x=4.3, y=y, theta=3.1415927, sonars=sonars)
        for number, y in ((1, 1.1), (2, 2.4))
    ]
    area = AreaSite(id="end", label="End of the hall", polygon=AREA, free_width=free_width)
    robots = [RobotSite(id="r1", start=START, radius=0.17)]
    return LoadedSite(Site(id="hall", areas=[area], nodes=nodes, robots=robots), StaticMap(geometry, cells), Path())


class Run(ring.Run):
    """The whole system; the robot has its goal behind the box, and the area is blocked."""

    def __init__(self, free_width):
        super().__init__(hall(free_width))
        self.hazards, self.paths = [], []
        self.system.bus.subscribe({ch.HAZARD: self._on_hazard, ch.ROBOT_PATH: self._on_path})
        self.enable()
        self.world.place(SimObstacle(id="box", polygon=BOX))
        self.until(lambda: self.hazard is not None and self.hazard.state == "blocked", 10.0)

    def _on_hazard(self, _ids, area: HazardArea, _at):
        self.hazards.append(area.hazard)
        return ()

    def _on_path(self, _ids, path, _at):
        self.paths.append(path)
        return ()

    @property
    def hazard(self):
        return self.hazards[-1] if self.hazards else None

    def send(self):
        goal = RobotGoal(goal_id="g1", pose=GOAL)
        self.system.fog.planner.set_goal("r1", goal, any_heading=True)

    def refused(self):
        return bool(self.paths) and self.paths[-1].refusal is not None


@pytest.mark.drive
def test_robot_passes_slowly_through_the_half_that_two_sonars_show_free():
    run = Run(0.5)
    run.until(lambda: len(run.hazard.free) == 2, 8.0)
    run.send()
    entered = []

    def arrived():
        x, y, _ = run.world.pose
        if AREA[0][0] < x < AREA[1][0] and y < AREA[2][1]:
            entered.append((run.system.now, x, y))
        return run.state.goal_reached

    run.until(arrived, 70.0)
    assert run.world.contacts == 0
    assert max(y for _, _, y in entered) < BOX[0][1] - 0.17, "beside the box"
    seconds, metres = entered[-1][0] - entered[0][0], entered[0][1] - entered[-1][1]
    assert metres / seconds <= 0.16, "slowly"
    assert run.hazard.state == "blocked"


def test_whole_area_is_closed_by_default_and_as_soon_as_something_stands_in_the_other_half_too():
    run = Run(None)
    run.send()
    run.until(run.refused, 5.0)
    run.until(lambda: run.system.now > 10.0, 12.0)
    assert run.refused()
    assert not any(hazard.free for hazard in run.hazards)

    run = Run(0.5)
    run.until(lambda: len(run.hazard.free) == 2, 8.0)
    run.send()
    run.until(lambda: run.paths and not run.refused(), 5.0)
    placed = run.system.now
    run.world.place(SimObstacle(id="bag", polygon=[(2.1, 1.0), (2.4, 1.0), (2.4, 1.3), (2.1, 1.3)]))
    run.until(lambda: not run.hazard.free, 1.0)
    run.until(run.refused, 2.0)
    run.until(lambda: run.system.now > placed + 15.0, 16.0)
    assert run.refused()
    assert not run.hazard.free


def test_strip_that_is_too_narrow_for_the_width_that_is_wanted_stays_closed():
    run = Run(1.2)
    run.until(lambda: len(run.hazard.free) == 2, 8.0)
    run.send()
    run.until(run.refused, 5.0)
