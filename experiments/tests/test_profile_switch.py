"""An operator switches a robot's profile on its way: it never drives by a path of the profile before."""

import importlib.util
import math
from pathlib import Path

import pytest

from fog_contracts import channels as ch
from fog_contracts.messages import Pose, RobotGoal
from fognav_experiments.rigs import System, moment

_spec = importlib.util.spec_from_file_location("ring_site", Path(__file__).parent / "ring_site.py")
ring = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(ring)

pytestmark = pytest.mark.timeout(900)
LEG_M = 1.2
"""How far the robot drives by each profile."""


class Run:
    """The whole system with a robot on a mission; states, plans, releases and moments of motion are recorded."""

    def __init__(self):
        site = ring.ring_site()
        self.system = System(site, site.site.robots[0], 3)
        self.states, self.paths, self.releases, self.moved = [], [], [], []
        self.system.bus.subscribe(
            {ch.ROBOT_STATE: self._on_state, ch.ROBOT_PATH: self._on_path, ch.ROBOT_RELEASE: self._on_release}
        )
        self.until(lambda: self.states and self.state.reasons == ["waiting for an operator to enable"], 12.0)
        assert self.system.robot.command("enable").accepted
        pose = Pose(x=ring.GOAL.x, y=ring.GOAL.y, theta=0.0)
        self.system.fog.planner.set_goal("r1", RobotGoal(goal_id="g1", pose=pose), any_heading=True)

    def _on_state(self, _ids, state, _at):
        self.states.append(state)
        return ()

    def _on_path(self, _ids, path, _at):
        self.paths.append(path)
        return ()

    def _on_release(self, _ids, release, _at):
        self.releases.append(release)
        return ()

    @property
    def state(self):
        return self.states[-1]

    def step(self):
        before = self.system.world.distance
        self.system.step()
        if self.system.world.distance > before:
            state = self.agent_state()
            self.moved.append((state.profile, state.planner_epoch, state.plan_id))

    def agent_state(self):
        return self.system.robot.agent.state(moment(self.system.now))

    def until(self, condition, seconds):
        end = self.system.now + seconds
        while not condition():
            assert self.system.now < end, self.states[-1:]
            self.step()

    def drive(self):
        """Drive a leg of the mission, or to its end."""
        end = self.system.world.distance + LEG_M
        self.until(lambda: self.system.world.distance > end or self.state.goal_reached, 40.0)

    def switch(self, profile):
        """Switch the profile as an operator has to, and enable the robot again."""
        command = self.system.robot.command
        assert "disable it first" in command(f"profile_{profile}").reason
        assert command("disable").accepted
        self.until(lambda: self.system.robot.hardware.base.wheel_speeds_m_s == (0.0, 0.0), 1.0)
        self.until(lambda: command(f"profile_{profile}").accepted, 1.0)
        state = self.agent_state()
        assert (state.profile, state.plan_id) == (profile, None), "it has dropped the path of the profile before"
        self.until(lambda: command("enable").accepted, 5.0)


def test_robot_whose_profile_is_switched_on_its_way_drives_by_paths_of_its_present_profile_only():
    run = Run()
    run.drive()
    for profile in ("full", "default", "fog", "full", "fog"):
        run.switch(profile)
        run.drive()
    run.until(lambda: run.state.goal_reached, 120.0)
    assert run.system.world.contacts == 0

    by_profile = {}
    for profile, epoch, plan in run.moved:
        by_profile.setdefault(profile, set()).add((epoch, plan))
    assert set(by_profile) == {"fog", "full", "default"}
    published = {(path.planner_epoch, path.plan_id) for path in run.paths}
    rolling_out = {(None, None)}  # it slows down after its path was dropped
    assert by_profile["fog"] - rolling_out <= published
    own = {profile: by_profile[profile] - rolling_out for profile in ("full", "default")}
    assert all(epoch == 0 for plans in own.values() for epoch, _ in plans)
    assert not own["full"] & own["default"], "no two paths of the robot's own have the same number"


def test_planner_numbers_plans_and_releases_on_while_the_robot_plans_for_itself():
    run = Run()
    run.drive()
    for profile in ("default", "fog"):
        run.switch(profile)
        run.drive()
    numbers = [path.plan_id for path in run.paths]
    assert numbers == sorted(numbers)
    newest = dict.fromkeys(numbers)
    assert all(release.plan_id in newest for release in run.releases)
    told = [release.plan_id for release in run.releases]
    assert told == sorted(told)
    state = run.state
    assert (state.planner_epoch, state.plan_id) == (1, numbers[-1])
    path = run.paths[-1]
    released = max(path.released_length, *(r.released_length for r in run.releases if r.plan_id == path.plan_id))
    follower = run.system.robot.agent._driving.mission.follower
    assert follower.progress <= released + 1e-6
    assert math.isclose(follower.released, min(released, follower.length), abs_tol=0.06)
