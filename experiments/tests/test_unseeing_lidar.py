"""A robot whose lidar does not see drives into no box: blind sector, missing returns, and replayed buffers."""

import importlib.util
from pathlib import Path

import pytest

from fog_contracts import channels as ch
from fog_contracts.messages import Pose, RobotGoal, SimObstacle
from fognav_experiments.rigs import System

_spec = importlib.util.spec_from_file_location("ring_site", Path(__file__).parent / "ring_site.py")
ring = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(ring)

AHEAD = (-1.05, 1.05)


class Run:
    """The whole system, driving along the southern corridor, until the fault begins."""

    def __init__(self, seed):
        site = ring.ring_site()
        self.system = System(site, site.site.robots[0], seed)
        self.states = []
        self.system.bus.subscribe({ch.ROBOT_STATE: self._on_state})
        self.until(lambda: self.states and self.states[-1].reasons == ["waiting for an operator to enable"], 12.0)
        assert self.system.robot.command("enable").accepted
        self.until(lambda: self.states[-1].mode == "NORMAL", 5.0)
        goal = RobotGoal(goal_id="g1", pose=Pose(x=ring.GOAL.x, y=ring.GOAL.y, theta=0.0))
        self.system.fog.planner.set_goal("r1", goal, any_heading=True)
        self.until(lambda: self.world.pose[0] > 3.5, 30.0)

    @property
    def world(self):
        return self.system.world

    def _on_state(self, _ids, state, _at):
        self.states.append(state)
        return ()

    def until(self, condition, seconds):
        end = self.system.now + seconds
        while not condition():
            assert self.system.now < end, self.states[-1:]
            self.system.step()

    def drive_on(self, seconds):
        """Put a box 1.2 m ahead, and go on; return the reasons that were told."""
        x, y, _ = self.world.pose
        box = [(x + 1.2, y - 0.3), (x + 1.6, y - 0.3), (x + 1.6, y + 0.3), (x + 1.2, y + 0.3)]
        self.world.place(SimObstacle(id="box", polygon=box))
        told, end = len(self.states), self.system.now + seconds
        while self.system.now < end:
            self.system.step()
        return "; ".join(reason for state in self.states[told:] for reason in state.reasons)


@pytest.mark.parametrize("fault", ["no returns", "blind sector", "buffer of 2", "buffer of 5"])
def test_robot_whose_lidar_does_not_see_the_box_stops_and_says_why(fault):
    run = Run(3)
    lidar = run.system.robot.hardware.lidar
    if fault == "no returns":
        run.world.no_return_rad = AHEAD
        expected = "the lidar sees nothing ahead"
    elif fault == "blind sector":
        lidar.blind_sector_rad = AHEAD
        expected = "no complete scan of the lidar"
    else:
        lidar.frozen, lidar.frozen_revolutions = True, int(fault[-1])
        expected = "the lidar repeats itself"
    reasons = run.drive_on(8.0)
    assert expected in reasons
    assert run.world.contacts == 0
    assert run.system.robot.agent.safety.cap == 0.0 or run.world.truth(0.0).left == 0.0
