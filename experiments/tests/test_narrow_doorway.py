"""A doorway that is narrower than the map says, and than the robot: it holds and says so, and the planner gives way."""

import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest

from fog_contracts import channels as ch
from fog_contracts.grid import StaticMap
from fog_contracts.messages import Pose, RobotGoal, SimObstacle
from fognav_experiments.rigs import System

_spec = importlib.util.spec_from_file_location("ring_site", Path(__file__).parent / "ring_site.py")
ring = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(ring)

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


class Run:
    """The whole system, whose robot is sent through the doorway, which is 0.3 m wide."""

    def __init__(self, *, north_open):
        site = site_with_doorway(north_open=north_open)
        self.system = System(site, site.site.robots[0], 3)
        self.states, self.plans, self.reported = [], {}, set()
        self.system.bus.subscribe(
            {ch.ROBOT_STATE: self._on_state, ch.ROBOT_PATH: self._on_path, ch.ROBOT_OBSTACLES: self._on_obstacles}
        )
        (left, right), (bottom, top) = DOOR_X, DOOR_Y
        for name, low, high in (("right", bottom, bottom + FRAME_M), ("left", top - FRAME_M, top)):
            frame = [(left, low), (right, low), (right, high), (left, high)]
            self.system.world.place(SimObstacle(id=name, polygon=frame))
        self.until(lambda: self.states and self.states[-1].reasons == ["waiting for an operator to enable"], 12.0)
        assert self.system.robot.command("enable").accepted
        self.until(lambda: self.states[-1].mode == "NORMAL", 5.0)
        goal = RobotGoal(goal_id="g1", pose=Pose(x=ring.GOAL.x, y=ring.GOAL.y, theta=0.0))
        self.system.fog.planner.set_goal("r1", goal, any_heading=True)

    def _on_state(self, _ids, state, _at):
        self.states.append(state)
        return ()

    def _on_path(self, _ids, path, _at):
        self.plans[path.plan_id] = path
        return ()

    def _on_obstacles(self, _ids, seen, _at):
        self.reported.update(seen.points)
        return ()

    @property
    def plan(self):
        return self.plans[max(self.plans)]

    def until(self, condition, seconds):
        end = self.system.now + seconds
        while not condition():
            assert self.system.now < end, self.states[-1:]
            self.system.step()

    def drive_to_the_doorway(self):
        """Drive until the robot holds before the doorway, which the planner's first path leads through."""
        self.until(lambda: any(SENTENCE in reason for reason in self.states[-1].reasons), 60.0)
        first = np.array(self.plans[min(self.plans)].points)
        assert np.interp(DOOR_X[0], first[:, 0], first[:, 1]) == pytest.approx(1.5, abs=0.1)
        assert self.states[-1].mode == "HOLD"
        x, y, _ = self.system.world.pose
        assert 4.4 < x < DOOR_X[0]
        assert y == pytest.approx(1.5, abs=0.2)


@pytest.mark.drive
def test_robot_before_a_doorway_too_narrow_for_it_holds_and_is_led_round_to_its_goal():
    run = Run(north_open=True)
    run.drive_to_the_doorway()
    run.until(lambda: max(y for _, y in run.plan.points) > 5.5, 5.0)
    x, y, _ = run.system.world.pose
    assert any(0.3 < px - x < 0.6 and abs(py - y) < 0.4 for px, py in run.reported)
    run.until(lambda: run.states[-1].goal_reached, 150.0)
    assert run.system.world.contacts == 0


def test_robot_before_a_doorway_too_narrow_for_it_gets_a_refusal_if_there_is_no_other_way():
    run = Run(north_open=False)
    run.drive_to_the_doorway()
    run.until(lambda: run.plan.refusal is not None, 5.0)
    run.until(lambda: any(run.plan.refusal.reason in reason for reason in run.states[-1].reasons), 5.0)
    assert run.states[-1].mode == "HOLD"
    assert run.system.world.contacts == 0
