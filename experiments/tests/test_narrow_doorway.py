"""A doorway that is narrower than the map says, and than the robot: it holds and says so, and the planner gives way."""

import dataclasses

import numpy as np
import pytest
import ring_site as ring

from fog_contracts import channels as ch
from fog_contracts.grid import StaticMap
from fog_contracts.messages import SimObstacle

DOOR_X, DOOR_Y = (5.0, 5.2), (1.2, 1.8)
FRAME_M = 0.15
"""How much narrower the doorway is on each side: so little that the lidar's points still fit the map's walls."""
SENTENCE = "no progress along the path for 10 s: the lidar sees an obstacle"


def site_with_doorway(*, north_open):
    """Return the ring with a doorway of 0.6 m in its southern corridor, and a wall across the northern one or not."""
    site = ring.ring_site()
    cells = site.map.cells.copy()
    columns = slice(round(DOOR_X[0] / ring.RESOLUTION), round(DOOR_X[1] / ring.RESOLUTION))
    bottom, top = (round(y / ring.RESOLUTION) for y in DOOR_Y)
    cells[10:bottom, columns] = cells[top:50, columns] = 254
    if not north_open:
        cells[110:150, 180:184] = 254
    return dataclasses.replace(site, map=StaticMap(site.map.geometry, cells))


class Run(ring.Run):
    """The whole system, whose robot is sent through the doorway, which is 0.3 m wide."""

    def __init__(self, *, north_open):
        super().__init__(site_with_doorway(north_open=north_open))
        self.plans, self.reported = {}, set()
        self.system.bus.subscribe({ch.ROBOT_PATH: self._on_path, ch.ROBOT_OBSTACLES: self._on_obstacles})
        (left, right), (bottom, top) = DOOR_X, DOOR_Y
        for name, low, high in (("right", bottom, bottom + FRAME_M), ("left", top - FRAME_M, top)):
            frame = [(left, low), (right, low), (right, high), (left, high)]
            self.world.place(SimObstacle(id=name, polygon=frame))
        self.enable()
        self.until(lambda: self.state.mode == "NORMAL", 5.0)
        self.send()

    def _on_path(self, _ids, path, _at):
        self.plans[path.plan_id] = path
        return ()

    def _on_obstacles(self, _ids, seen, _at):
        self.reported.update(seen.points)
        return ()

    @property
    def plan(self):
        return self.plans[max(self.plans)]

    def drive_to_the_doorway(self):
        """Drive until the robot holds before the doorway, which the planner's first path leads through."""
        self.until(lambda: any(SENTENCE in reason for reason in self.state.reasons), 60.0)
        first = np.array(self.plans[min(self.plans)].points)
        assert np.interp(DOOR_X[0], first[:, 0], first[:, 1]) == pytest.approx(1.5, abs=0.1)
        assert self.state.mode == "HOLD"
        x, y, _ = self.world.pose
        assert 4.4 < x < DOOR_X[0]
        assert y == pytest.approx(1.5, abs=0.2)


@pytest.mark.drive
def test_robot_before_a_doorway_too_narrow_for_it_holds_and_is_led_round_to_its_goal():
    run = Run(north_open=True)
    run.drive_to_the_doorway()
    run.until(lambda: max(y for _, y in run.plan.points) > 5.5, 5.0)
    x, y, _ = run.world.pose
    assert any(0.3 < px - x < 0.6 and abs(py - y) < 0.4 for px, py in run.reported)
    run.until(lambda: run.state.goal_reached, 150.0)
    assert run.world.contacts == 0


def test_robot_before_a_doorway_too_narrow_for_it_gets_a_refusal_if_there_is_no_other_way():
    run = Run(north_open=False)
    run.drive_to_the_doorway()
    run.until(lambda: run.plan.refusal is not None, 5.0)
    run.until(lambda: any(run.plan.refusal.reason in reason for reason in run.state.reasons), 5.0)
    assert run.state.mode == "HOLD"
    assert run.world.contacts == 0
