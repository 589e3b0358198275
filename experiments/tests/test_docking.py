"""A robot goes to its dock on an operator's word, charges, and leaves it for a goal: all cores together."""

import importlib.util
import math
from pathlib import Path

import msgspec
import pytest

from fog_contracts import channels as ch
from fog_contracts.messages import Pose, RectangleShape, RobotGoal, SimObstacle, Zone
from fog_runtime.site import LoadedSite
from fognav_experiments.rigs import System, moment

_spec = importlib.util.spec_from_file_location("ring_site", Path(__file__).parent / "ring_site.py")
ring = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(ring)

DOCK = Pose(x=0.78, y=1.5, theta=math.pi)  # its wall is 11 cm behind the body's front


def site_with_dock(start=None):
    """Return the site; without a `start` the robot begins in front of its dock."""
    loaded = ring.ring_site()
    robot = msgspec.structs.replace(loaded.site.robots[0], dock=DOCK)
    robot = msgspec.structs.replace(robot, start=start or robot.staging)
    return LoadedSite(msgspec.structs.replace(loaded.site, robots=[robot]), loaded.map, loaded.directory)


class Run:
    """The whole system, with an enabled robot in NORMAL; every mode and wheel speed is recorded."""

    def __init__(self, *, site=None):
        site = site or site_with_dock()
        self.system = System(site, site.site.robots[0], 3)
        self.state, self.modes, self.fastest = None, [], {}
        self.system.bus.subscribe({ch.ROBOT_STATE: self._on_state})
        self.until(lambda: self.state and self.state.reasons == ["waiting for an operator to enable"], 12.0)
        assert self.system.robot.command("enable").accepted
        self.until(lambda: self.state.mode == "NORMAL", 5.0)

    def _on_state(self, _ids, state, _at):
        self.state = state
        if not self.modes or self.modes[-1] != state.mode:
            self.modes.append(state.mode)
        return ()

    @property
    def base(self):
        return self.system.robot.hardware.base

    @property
    def wheels(self):
        return self.base.wheel_speeds_m_s

    def until(self, condition, seconds):
        end = self.system.now + seconds
        while not condition():
            assert self.system.now < end, self.state
            self.system.step()

    def run(self, seconds):
        for _ in range(round(seconds * 100)):
            self.system.step()

    def away(self):
        x, y, _ = self.system.world.pose
        return math.dist((x, y), (DOCK.x, DOCK.y))

    def until_seeking(self):
        assert self.system.robot.command("dock").accepted
        self.until(lambda: self.base.seeking_dock, 60.0)
        self.until(lambda: self.wheels != (0.0, 0.0) and self.away() < 0.6, 10.0)


def test_robot_docks_charges_and_leaves_its_dock_for_a_goal():
    run = Run(site=site_with_dock(Pose(x=1.5, y=2.6, theta=-math.pi / 2)))
    assert run.system.robot.command("dock").accepted
    run.until(lambda: run.state.mode == "DOCK", 60.0)
    assert run.away() < 1.0
    run.until(lambda: run.state.docked and run.state.mode == "HOLD", 30.0)
    assert "NORMAL" in run.modes
    assert set(run.modes[run.modes.index("DOCK") :]) == {"DOCK", "HOLD"}
    assert run.state.enabled
    assert not run.state.wants_dock
    run.run(3.0)
    assert run.state.reasons == ["the robot is on its dock: a goal or `fognav robot undock` takes it off"]
    assert run.state.power.charging in {"bulk", "trickle"}
    pose = run.system.robot.agent.pose(moment(run.system.now))
    x, y, theta = run.system.world.pose
    assert math.dist((pose.x, pose.y), (x, y)) < 0.05
    assert abs(math.remainder(pose.theta - theta, math.tau)) < 0.06

    goal = RobotGoal(goal_id="g", pose=Pose(x=1.5, y=2.6, theta=0.0), stamp=0.0)
    run.system.fog.planner.set_goal("r1", goal, any_heading=True)
    run.until(lambda: run.state.goal_reached, 60.0)
    assert run.modes[-3:] == ["HOLD", "DOCK", "NORMAL"]
    assert run.system.world.contacts == 0


def test_operator_takes_a_disabled_robot_off_its_dock_and_it_stays_disabled():
    run = Run()
    run.until_seeking()
    run.until(lambda: run.state.docked and run.state.mode == "HOLD", 30.0)
    assert run.system.robot.command("disable").accepted
    run.run(1.0)
    assert run.system.robot.command("undock").accepted
    run.until(lambda: run.state.mode == "DOCK", 1.0)
    run.until(lambda: run.state.mode != "DOCK", 12.0)
    assert run.state.mode == "INIT"
    assert "the undocking ended: it is done" in run.state.reasons
    assert 0.27 < run.away() < 0.33
    run.run(1.0)
    assert run.wheels == (0.0, 0.0)


def bump(run):
    run.base.world.bump_left = True
    run.base.set_sensors = lambda **_: None


def stop(run):
    assert run.system.robot.command("disable").accepted


def zone(run):
    x, y, _ = run.system.world.pose
    shape = RectangleShape(corner=(x - 0.5, y - 0.5), opposite=(x + 0.5, y + 0.5))
    run.system.fog.map.put_zone(Zone(id="wet", kind="BLOCKED", shape=shape, reason="wet"), moment(run.system.now))


def blind(run):
    run.system.robot.hardware.lidar.blind_sector_rad = (-1.05, 1.05)


def obstacle(run):
    # 1 cm between the body and something that stands beside the robot's way, which it turns against.
    x, y, _ = run.system.world.pose
    near = x - 0.17 - 0.06
    run.system.world.place(SimObstacle(id="leg", polygon=[(near - 0.05, y - 0.03), (near, y - 0.03), (near, y + 0.03),
                                                          (near - 0.05, y + 0.03)]))  # fmt: skip


def cliff(run):
    run.base.world.cliff_left = True
    run.base.set_sensors = lambda **_: None


def wheel_drop(run):
    run.base.world.wheel_drop_left = True


STOPS = [
    (bump, "FAULT", 0.1), (cliff, "FAULT", 0.1), (wheel_drop, "FAULT", 0.1), (stop, "INIT", 0.15), (zone, "INIT", 0.3),
    (blind, "INIT", 0.8), (obstacle, "INIT", 0.5),
]  # fmt: skip


@pytest.mark.parametrize(("cause", "mode", "within"), STOPS, ids=[cause.__name__ for cause, _, _ in STOPS])
def test_every_stop_condition_ends_the_bases_own_drive(cause, mode, within):
    run = Run()
    run.until_seeking()
    cause(run)
    run.until(lambda: run.wheels == (0.0, 0.0), within)
    run.run(0.4)
    assert run.state.mode == mode
    assert not run.base.seeking_dock
    run.run(3.0)
    assert run.wheels == (0.0, 0.0)
    assert run.away() > 0.1


def test_robot_that_something_separates_from_its_dock_does_not_let_its_base_look_for_it():
    run = Run()
    x, y = DOCK.x + 0.3, DOCK.y
    box = [(x - 0.04, y - 0.04), (x + 0.04, y - 0.04), (x + 0.04, y + 0.04), (x - 0.04, y + 0.04)]
    run.system.world.place(SimObstacle(id="leg", polygon=box))
    run.run(0.5)
    assert run.system.robot.command("dock").accepted
    run.until(lambda: any("docking given up" in reason for reason in run.state.reasons), 60.0)
    assert "DOCK" not in run.modes
    assert run.system.world.contacts == 0


@pytest.mark.parametrize(("kind", "words"), [("disable", None), ("cancel", "its goal was cancelled")])
def test_robot_goes_to_its_dock_by_no_older_word(kind, words):
    run = Run(site=site_with_dock(Pose(x=1.5, y=2.6, theta=-math.pi / 2)))
    assert run.system.robot.command("dock").accepted
    run.run(2.0)
    assert run.state.wants_dock
    assert run.system.robot.command(kind).accepted
    run.run(0.5)
    assert not run.state.wants_dock
    if words:
        assert f"docking given up: {words}" in run.state.reasons
    run.system.robot.command("enable")
    run.run(3.0)
    assert not run.state.wants_dock


def test_site_without_a_dock_and_a_robot_that_is_not_enabled_refuse():
    run = Run(site=ring.ring_site())
    assert "no dock" in run.system.robot.command("dock").reason
    run = Run()
    run.system.robot.command("disable")
    assert "enable it first" in run.system.robot.command("dock").reason
