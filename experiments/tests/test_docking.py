"""A robot goes to its dock on an operator's command, charges, and leaves it for a goal: all cores together."""

import itertools
import math
from dataclasses import replace

import msgspec
import pytest
import ring_site as ring

from fog_contracts.messages import Pose, RectangleShape, RobotGoal, SimObstacle, Zone
from fog_runtime.configuration.site import LoadedSite
from fognav_experiments.rigs import moment
from robot_agent.agent import power
from robot_agent.agent.core import AgentCore

DOCK = Pose(x=0.78, y=1.5, theta=math.pi)  # its wall is 11 cm behind the body's front


def site_with_dock(start=None):
    """Return the site; without a `start` the robot begins in front of its dock."""
    loaded = ring.ring_site()
    robot = msgspec.structs.replace(loaded.site.robots[0], dock=DOCK)
    robot = msgspec.structs.replace(robot, start=start or robot.staging)
    return LoadedSite(msgspec.structs.replace(loaded.site, robots=[robot]), loaded.map, loaded.directory)


class Run(ring.Run):
    """The whole system, with an enabled robot in NORMAL; every mode is recorded."""

    def __init__(self, *, site=None, charge=0.9, dock_below=0.0):
        def make_agent(config, seed):
            return AgentCore(replace(config, dock_below=dock_below), seed)

        super().__init__(site or site_with_dock(), make_agent=make_agent)
        self.base.battery.charge_mah = charge * self.base.battery.capacity_mah
        self.enable()
        self.until(lambda: self.state.mode == "NORMAL", 5.0)

    @property
    def modes(self):
        return [mode for mode, _ in itertools.groupby(state.mode for state in self.states)]

    @property
    def base(self):
        return self.robot.hardware.base

    @property
    def wheels(self):
        return self.base.wheel_speeds_m_s

    def run(self, seconds):
        for _ in range(round(seconds * 100)):
            self.system.step()

    def away(self):
        x, y, _ = self.world.pose
        return math.dist((x, y), (DOCK.x, DOCK.y))

    def until_seeking(self):
        assert self.robot.command("dock").accepted
        self.until(lambda: self.base.seeking_dock, 60.0)
        self.until(lambda: self.wheels != (0.0, 0.0) and self.away() < 0.6, 10.0)


def test_robot_docks_charges_and_leaves_its_dock_for_a_goal():
    run = Run(site=site_with_dock(Pose(x=1.5, y=2.6, theta=-math.pi / 2)))
    assert run.robot.command("dock").accepted
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
    pose = run.robot.agent.pose(moment(run.system.now))
    x, y, theta = run.world.pose
    assert math.dist((pose.x, pose.y), (x, y)) < 0.05
    assert abs(math.remainder(pose.theta - theta, math.tau)) < 0.06

    goal = RobotGoal(goal_id="g", pose=Pose(x=1.5, y=2.6, theta=0.0), stamp=0.0)
    run.system.fog.planner.set_goal("r1", goal, any_heading=True)
    run.until(lambda: run.state.goal_reached, 60.0)
    assert "DOCK" in run.modes[-3:]
    assert run.modes[-1] == "NORMAL"
    assert run.world.contacts == 0


def test_operator_takes_a_disabled_robot_off_its_dock_and_it_stays_disabled():
    run = Run()
    run.until_seeking()
    run.until(lambda: run.state.docked and run.state.mode == "HOLD", 30.0)
    assert run.robot.command("disable").accepted
    run.run(1.0)
    assert run.robot.command("undock").accepted
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
    assert run.robot.command("disable").accepted


def zone(run):
    x, y, _ = run.world.pose
    shape = RectangleShape(corner=(x - 0.5, y - 0.5), opposite=(x + 0.5, y + 0.5))
    run.system.fog.map.put_zone(Zone(id="wet", kind="BLOCKED", shape=shape, reason="wet"), moment(run.system.now))


def blind(run):
    run.robot.hardware.lidar.blind_sector_rad = (-1.05, 1.05)


def obstacle(run):
    # 1 cm between the body and something that stands beside the robot's way, which it turns against.
    x, y, _ = run.world.pose
    near = x - 0.17 - 0.06
    run.world.place(SimObstacle(id="leg", polygon=[(near - 0.05, y - 0.03), (near, y - 0.03), (near, y + 0.03),
                                                          (near - 0.05, y + 0.03)]))  # fmt: skip


def cliff(run):
    run.base.world.cliff_left = True
    run.base.set_sensors = lambda **_: None


def wheel_drop(run):
    run.base.world.wheel_drop_left = True


def cancel(run):
    assert run.robot.command("cancel").reason == "its way to its dock is cancelled on the robot"


STOPS = [
    (bump, "FAULT", 0.1), (cliff, "FAULT", 0.1), (wheel_drop, "FAULT", 0.1), (stop, "INIT", 0.15),
    (zone, "PROTECTIVE_STOP", 0.3), (blind, "PROTECTIVE_STOP", 0.8), (obstacle, "NORMAL", 0.5),
    (cancel, "NORMAL", 0.15),
]  # fmt: skip


@pytest.mark.parametrize(("cause", "mode", "within"), STOPS, ids=[cause.__name__ for cause, _, _ in STOPS])
def test_every_stop_condition_and_a_cancel_end_the_bases_own_drive(cause, mode, within):
    run = Run()
    run.until_seeking()
    cause(run)
    run.until(lambda: run.wheels == (0.0, 0.0), within)
    run.run(0.4)
    assert not run.base.seeking_dock
    run.run(3.0)
    assert (run.state.mode, run.state.enabled) == (mode, mode not in {"FAULT", "INIT"})
    assert run.wheels == (0.0, 0.0)
    assert run.away() > 0.1


def test_another_goal_ends_the_bases_own_drive_and_nothing_else_is_done_to_a_robot_meanwhile():
    run = Run()
    run.until_seeking()
    for command, more in (("initial_pose", {"pose": DOCK}), ("profile_fog", {})):
        assert run.robot.command(command, **more).code == "driving"
    run.send(Pose(x=1.5, y=2.2, theta=0.0))
    run.until(lambda: not run.base.seeking_dock, 1.0)
    run.until(lambda: run.state.goal_reached, 30.0)
    assert not any(state.docked for state in run.states)
    assert run.world.contacts == 0


def test_robot_that_something_separates_from_its_dock_does_not_let_its_base_look_for_it():
    run = Run()
    x, y = DOCK.x + 0.3, DOCK.y
    box = [(x - 0.04, y - 0.04), (x + 0.04, y - 0.04), (x + 0.04, y + 0.04), (x - 0.04, y + 0.04)]
    run.world.place(SimObstacle(id="leg", polygon=box))
    run.run(0.5)
    assert run.robot.command("dock").accepted
    run.until(lambda: "docking_given_up" in run.state.codes, 60.0)
    assert "DOCK" not in run.modes
    assert run.world.contacts == 0


@pytest.mark.parametrize(("kind", "words"), [("disable", None), ("cancel", "its goal was cancelled")])
def test_robot_goes_to_its_dock_by_no_older_command(kind, words):
    run = Run(site=site_with_dock(Pose(x=1.5, y=2.6, theta=-math.pi / 2)))
    assert run.robot.command("dock").accepted
    run.run(2.0)
    assert run.state.wants_dock
    assert run.robot.command(kind).accepted
    run.run(0.5)
    assert not run.state.wants_dock
    if words:
        assert f"docking given up: {words}" in run.state.reasons
    run.robot.command("enable")
    run.run(3.0)
    assert not run.state.wants_dock


# --- a low battery ---


def test_enabled_robot_with_a_low_battery_goes_to_its_dock_once_if_its_settings_say_so():
    run = Run(charge=0.25, dock_below=0.3)
    run.until(lambda: run.state.docked and run.state.mode == "HOLD", 30.0)
    assert run.state.enabled
    goal = RobotGoal(goal_id="g", pose=Pose(x=1.5, y=2.2, theta=0.0), stamp=0.0)
    run.system.fog.planner.set_goal("r1", goal, any_heading=True)
    run.until(lambda: run.state.goal_reached, 30.0)
    run.until(lambda: run.state.docked, 40.0)  # it was on its dock, so it may go there again


@pytest.mark.parametrize(("charge", "dock_below"), [(0.25, 0.0), (0.35, 0.3)])
def test_robot_stays_where_it_is_with_a_charge_above_the_limit_or_without_one(charge, dock_below):
    run = Run(charge=charge, dock_below=dock_below)
    run.run(2.0)
    assert not run.state.wants_dock
    assert (run.state.mode, run.wheels) == ("NORMAL", (0.0, 0.0))


def test_robot_with_a_low_battery_tries_once_and_waits_for_people_then():
    run = Run(site=site_with_dock(Pose(x=1.5, y=2.6, theta=-math.pi / 2)), charge=0.25, dock_below=0.3)
    run.until(lambda: run.state.wants_dock and run.state.goal_id, 1.0)
    assert run.robot.command("cancel").accepted
    run.run(3.0)
    assert not run.state.wants_dock
    assert "docking given up: its goal was cancelled" in run.state.reasons
    run.robot.command("disable")
    run.run(0.5)
    run.robot.command("enable")
    run.until(lambda: run.state.wants_dock, 1.0)


def test_robot_with_a_low_battery_tries_again_when_somebody_who_kept_it_from_its_dock_has_gone(monkeypatch):
    monkeypatch.setattr(power, "AGAIN_S", 5.0)
    run = Run(charge=0.25, dock_below=0.3)
    run.until(lambda: run.base.seeking_dock and run.away() < 0.6, 30.0)
    obstacle(run)
    run.until(lambda: "docking_given_up" in run.state.codes, 1.0)
    assert run.state.enabled
    run.world.remove("leg")
    run.until(lambda: run.state.docked and run.state.mode == "HOLD", 60.0)
    assert run.world.contacts == 0


# --- backing off from a bump ---


def test_robot_backs_off_from_a_bump_by_ten_centimetres_at_most_and_keeps_its_fault():
    run = Run()
    before, bumped = run.away(), list(run.world.pose)
    bump(run)
    run.until(lambda: run.state.mode == "FAULT", 1.0)
    assert "the cause is still there" in run.robot.command("reset").reason
    assert run.robot.command("back_off").accepted
    run.until(lambda: run.state.mode == "EGRESS", 0.5)
    fastest, end = 0.0, run.system.now + 10.0
    while run.state.mode == "EGRESS":
        assert run.system.now < end, f"the back-off has not ended after 10 s: {run.state}"
        run.system.step()
        fastest = max(fastest, -min(run.wheels))
        if math.dist(run.world.pose[:2], bumped[:2]) > 0.03:
            run.base.world.bump_left = False
    assert 0.07 < run.away() - before <= 0.10
    assert fastest <= 0.051
    assert run.state.mode == "FAULT"
    run.run(1.0)
    assert run.wheels == (0.0, 0.0)
    assert run.robot.command("back_off").accepted is True
    run.run(0.3)
    assert run.robot.command("disable").accepted
    run.run(0.3)
    assert (run.wheels, run.state.mode) == ((0.0, 0.0), "FAULT")
    assert run.robot.command("reset").accepted
    run.until(lambda: run.state.mode == "INIT", 0.5)


@pytest.mark.parametrize(("later_s", "ordered_after_s"), [(0.0, 0.06), (0.04, 0.0)])
def test_robot_that_drove_into_something_a_moment_ago_backs_off_by_nine_to_ten_centimetres(later_s, ordered_after_s):
    # In the first case it stands, and its last frame is old; in the second it still rolls on.
    run = Run(site=site_with_dock(Pose(x=1.5, y=2.6, theta=-math.pi / 2)))
    goal = RobotGoal(goal_id="g", pose=Pose(x=1.5, y=1.5, theta=0.0), stamp=0.0)
    run.system.fog.planner.set_goal("r1", goal, any_heading=True)
    run.until(lambda: min(run.wheels) > 0.28, 20.0)
    run.run(later_s)
    heading = run.world.pose[2]
    bump(run)
    run.until(lambda: run.state.mode == "FAULT", 1.0)
    run.run(ordered_after_s)
    assert run.robot.command("back_off").accepted
    along = []
    for _ in range(300):
        run.system.step()
        x, y, _ = run.world.pose
        along.append(x * math.cos(heading) + y * math.sin(heading))
        if along[-1] < max(along) - 0.03:
            run.base.world.bump_left = False
    assert run.state.mode == "FAULT"
    assert 0.09 <= max(along) - along[-1] <= 0.10


def test_robot_does_not_back_off_into_what_its_lidar_sees_behind_it():
    run = Run()
    x, y, _ = run.world.pose
    behind = x + 0.17 + 0.05
    run.world.place(SimObstacle(id="box", polygon=[(behind, y - 0.2), (behind + 0.2, y - 0.2),
                                                          (behind + 0.2, y + 0.2), (behind, y + 0.2)]))  # fmt: skip
    bump(run)
    run.until(lambda: run.state.mode == "FAULT", 1.0)
    assert run.robot.command("back_off").accepted
    run.until(lambda: run.state.mode == "EGRESS", 0.5)
    run.until(lambda: run.state.mode == "FAULT", 6.0)
    assert run.world.contacts == 0
    assert run.world.clearance() > 0.01
