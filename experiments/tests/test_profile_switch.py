"""An operator switches a robot's profile on its way: it never drives by a path of the profile before."""

import math

import pytest
import ring_site as ring

from fog_contracts import channels as ch
from fognav_experiments.rigs import moment

pytestmark = pytest.mark.timeout(900)
LEG_M = 1.2
"""How far the robot drives by each profile."""


class Run(ring.Run):
    """The whole system with a robot on a mission; plans, releases and moments of motion are recorded, too."""

    def __init__(self):
        super().__init__()
        self.paths, self.releases, self.moved = [], [], []
        kept = {ch.ROBOT_PATH: self.paths, ch.ROBOT_RELEASE: self.releases}
        for channel, messages in kept.items():
            keep = messages.append
            self.system.bus.subscribe({channel: lambda _ids, message, _at, keep=keep: keep(message) or ()})
        self.enable()
        self.send()

    def step(self):
        before = self.world.distance
        super().step()
        if self.world.distance > before:
            state = self.agent_state()
            self.moved.append((state.profile, state.planner_epoch, state.plan_id))

    def agent_state(self):
        return self.robot.agent.state(moment(self.system.now))

    def drive(self):
        """Drive a leg of the mission, or to its end."""
        end = self.world.distance + LEG_M
        self.until(lambda: self.world.distance > end or self.state.goal_reached, 40.0)

    def switch(self, profile):
        """Switch the profile as an operator has to, and enable the robot again."""
        command = self.robot.command
        assert "disable it first" in command(f"profile_{profile}").reason
        assert command("disable").accepted
        self.until(lambda: self.robot.hardware.base.wheel_speeds_m_s == (0.0, 0.0), 1.0)
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
    assert run.world.contacts == 0

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
    follower = run.robot.agent._driving.mission.follower
    assert follower.progress <= released + 1e-6
    assert math.isclose(follower.released, min(released, follower.length), abs_tol=0.06)
