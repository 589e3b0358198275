"""An idle robot rests and is woken, without a false stop or fault on the way."""

from __future__ import annotations

from dataclasses import replace

import pytest
from little_world import AGENT, L_PATH, LittleWorld

from fog_contracts.messages import Pose
from robot_agent.agent import power
from robot_agent.agent.core import AgentCore
from robot_agent.agent.power import IdleScans, RestPolicy

AFTER = 20.0


class RestingAgent(AgentCore):
    """An agent that rests after 20 s."""

    def __init__(self, config, seed):
        super().__init__(replace(config, rest_after=AFTER), seed)


class World(LittleWorld):
    """A world whose lidar is switched by the agent, and needs `spin_up` s; it records every mode."""

    spin_up = 1.5

    def __post_init__(self):
        super().__post_init__()
        self.modes = []
        self.on_since = self.now - self.spin_up

    def _step(self):
        if not self.agent.lidar_on:
            self.on_since = self.now
        self.lidar_on = self.agent.lidar_on and self.now - self.on_since >= self.spin_up
        super()._step()
        if not self.modes or self.modes[-1] != self.state().mode:
            self.modes.append(self.state().mode)


def world():
    assert AGENT.rest_after == 0.0
    return World(start_agent=RestingAgent)


def test_enabled_robot_rests_holds_for_hours_and_drives_to_the_next_goal():
    w = world().ready()
    assert w.run(AFTER + 1.0, lambda w: not w.agent.lidar_on)
    w.run(90.0)
    assert w.state().mode == "HOLD"
    assert w.state().reasons == ["at rest to save power, without its lidar: a goal or an operator's command wakes it"]
    w.modes.clear()
    w.drive_to(L_PATH[:3])
    w.run(0.2)
    assert w.agent.lidar_on
    assert "waking up: its lidar starts" in w.state().reasons
    assert w.run(10.0, lambda w: w.travelled > 0.5)
    assert w.modes == ["HOLD", "NORMAL"]
    assert w.error()[0] < 0.1


def test_disabled_robot_rests_and_is_woken_by_its_enable():
    w = world().ready()
    w.command("disable")
    w.run(AFTER + 1.0)
    assert (w.agent.lidar_on, w.state().mode) == (False, "INIT")
    w.modes.clear()
    assert w.command("enable").accepted
    assert w.run(8.0, lambda w: w.state().mode == "NORMAL")
    assert w.modes[-2:] == ["HOLD", "NORMAL"]
    assert set(w.modes) <= {"INIT", "HOLD", "NORMAL"}


@pytest.mark.parametrize("kind", ["initial_pose", "reset"])
def test_any_command_but_a_stop_wakes_the_robot(kind):
    w = world().ready()
    w.command("disable")
    w.run(AFTER + 1.0)
    w.command("disable")
    w.run(0.2)
    assert not w.agent.lidar_on
    w.command(kind, **({"pose": Pose(x=w.x, y=w.y, theta=w.theta)} if kind == "initial_pose" else {}))
    w.run(0.2)
    assert w.agent.lidar_on


def test_robot_on_a_mission_does_not_rest():
    w = world().ready()
    w.drive_to(L_PATH[:3])
    w.run(AFTER + 5.0)
    assert w.agent.lidar_on
    assert w.travelled > 2.0


def test_lidar_that_does_not_wake_stops_the_robot():
    w = world().ready()
    w.run(AFTER + 1.0)
    w.spin_up = 1e9
    w.drive_to(L_PATH[:3])
    w.run(power.WAKE_TIMEOUT_S + 0.5)
    assert w.state().mode == "PROTECTIVE_STOP"
    assert "the lidar has been silent" in w.state().reasons[0]
    assert w.travelled == 0.0


def test_a_robot_without_a_rest_time_never_rests():
    policy = RestPolicy(0.0)
    for now in range(0, 1_000_000, 1000):
        policy.update(busy=False, goal_id=None, now=float(now))
    assert policy.lidar_on
    assert policy.reason is None


# --- the base sleeps, too ---


class SleepingAgent(AgentCore):
    """An agent that rests after 20 s, with its base."""

    def __init__(self, config, seed):
        super().__init__(replace(config, rest_after=AFTER, rest_base=True), seed)


class SleepyWorld(World):
    """A world whose base sleeps while the agent lets it, and needs `wake_s` to wake; it counts the commands to rest."""

    wake_s = 2.5

    def __post_init__(self):
        self.asked, self.woken_at = [], None
        super().__post_init__()

    def _step(self):
        super()._step()
        if not self.asked or self.asked[-1] != self.resting:
            self.asked.append(self.resting)
        if self.resting:
            self.woken_at, self.stopped = None, "the base is asleep to save power"
        elif self.stopped:
            self.woken_at = self.woken_at or self.now
            waits = self.now - self.woken_at < self.wake_s
            self.stopped = "the base is not ready to drive yet" if waits else None


@pytest.mark.parametrize("wake_s", [0.5, 4.0])
def test_robot_whose_base_sleeps_holds_and_drives_once_both_are_awake(wake_s):
    w = SleepyWorld(start_agent=SleepingAgent).ready()
    w.wake_s = wake_s
    w.run(AFTER + 1.0)
    w.run(60.0)
    assert w.asked == [False, True]
    assert (w.state().mode, w.state().reasons[0][:7]) == ("HOLD", "at rest")
    w.modes.clear()
    w.drive_to(L_PATH[:3])
    assert w.run(20.0, lambda w: w.travelled > 0.5)
    assert w.modes == ["HOLD", "NORMAL"]
    assert w.asked == [False, True, False]
    assert w.error()[0] < 0.1


def test_base_that_does_not_wake_stops_the_robot():
    w = SleepyWorld(start_agent=SleepingAgent).ready()
    w.wake_s = 1e9
    w.run(AFTER + 1.0)
    w.drive_to(L_PATH[:3])
    w.run(power.WAKE_TIMEOUT_S + 0.5)
    assert w.state().mode == "PROTECTIVE_STOP"
    assert "the guardian holds the wheels: the base is not ready to drive yet" in w.state().reasons
    assert w.travelled == 0.0


def test_base_of_a_robot_that_shall_not_put_it_to_sleep_stays_awake():
    w = SleepyWorld(start_agent=RestingAgent).ready()
    w.run(AFTER + 5.0)
    assert w.asked == [False]


def test_an_idle_robot_that_knows_where_it_is_looks_at_every_third_scan_and_any_other_at_all():
    scans = IdleScans()
    assert [scans.counts(idle=True, status="good") for _ in range(7)] == [False, False, True] * 2 + [False]
    assert scans.counts(idle=False, status="good")
    assert not scans.counts(idle=True, status="good")
    for status in ("weak", "lost", "none"):
        assert scans.counts(idle=True, status=status)
