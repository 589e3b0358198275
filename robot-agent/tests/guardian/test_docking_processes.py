"""A base that drives to its dock by itself stands soon after anything goes wrong: real watchdog and guardian."""

from __future__ import annotations

import os
import signal
import time

import guardian_rig as rigs
import pytest
from guardian_rig import STOP_S, wait_for

from robot_agent.bases.roomba600.emulator import PASSIVE, SAFE

pytestmark = [pytest.mark.live, pytest.mark.reaction, pytest.mark.timeout(120)]

_SENSORS = ("bump_left", "cliff_front_left", "wheel_drop_left")


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    with rigs.Rig(tmp_path_factory.mktemp("docking")) as running:
        running.base.robot.set_dock(0.7, 0.0, 0.0)  # it never comes nearer
        yield running


def seek(rig) -> float:
    """Let the base seek its dock, and return when it does."""
    rig.agent.maneuver, rig.agent.wheels, rig.agent.reset = None, (0.0, 0.0), True
    rig.agent.feedback = None  # the old one says nothing
    wait_for(lambda: rig.base.robot.mode == SAFE and not rig.base.moving, "the base is ready")
    wait_for(lambda: rig.agent.feedback and not rig.agent.feedback.stopped and not rig.agent.feedback.fault, "all well")
    rig.agent.maneuver = "seek_dock"
    wait_for(lambda: rig.base.robot.seeking_dock and rig.base.moving, "the base seeks its dock")
    time.sleep(0.1)
    assert rig.base.robot.mode == PASSIVE
    return time.monotonic()


@pytest.mark.parametrize("sensor", _SENSORS)
def test_touched_sensor_ends_it(rig, sensor):
    begun = seek(rig)
    setattr(rig.base.robot.world, sensor, True)
    try:
        assert rig.base.stopped_within(begun) < STOP_S
        wait_for(lambda: rig.agent.feedback.fault, "the fault is reported")
    finally:
        setattr(rig.base.robot.world, sensor, False)


def test_agent_that_asks_no_more_or_falls_silent_ends_it(rig):
    begun = seek(rig)
    rig.agent.maneuver = None
    assert rig.base.stopped_within(begun) < STOP_S
    begun = seek(rig)
    rig.agent.wheels = None
    assert rig.base.stopped_within(begun) < STOP_S


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM])
def test_end_of_the_guardian_ends_it(rig, number):
    begun = seek(rig)
    pid = rig.watchdog.guardian()
    os.kill(pid, number)
    assert rig.base.stopped_within(begun) < STOP_S
    assert not rig.base.robot.seeking_dock
    rig.agent.maneuver = None
    wait_for(lambda: rig.watchdog.guardian() not in {None, pid}, "another guardian runs")
