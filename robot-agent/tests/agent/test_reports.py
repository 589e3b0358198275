"""What the base measures reaches state, metrics and reasons; pose, state and obstacles are published when due."""

from __future__ import annotations

import itertools

import msgspec
import pytest

from fog_contracts import channels as ch
from fog_contracts.messages import Power, RobotObstacles, RobotPose, RobotState, Trace
from fog_runtime.configuration.robot_file import default_robot
from robot_agent.agent.path_driving import PathTraces
from robot_agent.agent.reports import STANDING_POSE_S, PublishingPolicy, power_warnings
from robot_agent.bases.diffdrive.emulator import DiffDriveEmulator
from robot_agent.bases.roomba600.driver import MEASURE_S
from robot_agent.bases.roomba600.emulator import Battery, RoombaEmulator
from robot_agent.guardian.core import GuardianCore
from robot_agent.hardware import BaseStatus
from robot_agent.registry import make_base


def readings(base, name, seconds, *, change=None):
    """The feedback of a base in emulated time; `change` is called before each step with the time."""
    core, now, feedback = GuardianCore(make_base(default_robot(base=name))), 10.0, []
    for step in range(round(seconds / 0.01)):
        now += 0.01
        if change is not None:
            change(step * 0.01)
        base.tick(now, 0.01)
        outputs = [core.on_bytes(base.outgoing(now), now), core.tick(now)]
        for output in outputs:
            feedback += output.feedback
            base.receive(output.data, now)
    return feedback


def test_battery_charger_and_light_bumper_of_a_roomba_are_read():
    base = RoombaEmulator(battery=Battery(charge_mah=650.0, capacity_mah=2600.0))
    base.world.light_signals = (0, 10, 250, 3000, 4095, 7)
    base.world.temperature_c = 31
    status = readings(base, "roomba600", 1.0)[-1].status
    assert status.battery == pytest.approx(0.25, abs=0.001)
    assert status.proximity == (0, 10, 250, 3000, 4095, 7)
    power = status.power
    assert (power.charge_ah, power.capacity_ah, power.temperature_c) == (0.65, 2.6, 31.0)
    assert power.voltage_v == pytest.approx(base.battery.voltage_mv / 1000, abs=0.01)
    assert power.current_a == pytest.approx(-0.18)
    assert power.charging == "no"
    base.world.home_base = True
    status = readings(base, "roomba600", 1.0)[-1].status
    assert (status.charging, status.power.charging) == (True, "bulk")
    assert status.power.current_a == pytest.approx(1.25)


def test_voltage_of_a_board_is_read():
    status = readings(DiffDriveEmulator(), "diffdrive", 0.5)[-1].status
    assert status.power.voltage_v is not None
    assert 10.0 < status.power.voltage_v < 13.0
    assert status.proximity == ()


def test_noise_of_the_measurements_sends_no_more_feedback():
    def flicker(base):
        def change(at):
            base.world.light_signals = (round(at * 1000) % 4000,) * 6

        return change

    still, noisy = RoombaEmulator(), RoombaEmulator()
    expected = len(readings(still, "roomba600", 4.0))
    feedback = readings(noisy, "roomba600", 4.0, change=flicker(noisy))
    assert len(feedback) == expected
    assert len({each.status.proximity for each in feedback}) >= 4.0 / MEASURE_S - 1


@pytest.mark.parametrize(
    ("status", "warnings"),
    [
        (None, []),
        (BaseStatus(), []),
        (BaseStatus(battery=0.2), []),
        (BaseStatus(battery=0.199), ["the battery is low (15 %): take the robot to its charger"]),
        (BaseStatus(battery=0.15), ["the battery is low (15 %): take the robot to its charger"]),
        (BaseStatus(battery=0.0), ["the battery is low (0 %): take the robot to its charger"]),
        (BaseStatus(battery=0.1, charging=True), []),
        (
            BaseStatus(battery=0.9, charging=True, power=Power(charging="fault")),
            ["the charger reports a fault: the battery does not charge"],
        ),
    ],
)
def test_a_low_battery_and_a_charger_in_fault_are_reasons(status, warnings):
    assert power_warnings(status, 0.2) == warnings


POSE = RobotPose(x=0.0, y=0.0, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.2, height=0.3, stamp=0.0)
STATE = RobotState(mode="HOLD", reasons=["the map is 1.2 s old"], enabled=True, battery=0.8, goal_id=None, map_epoch=1,
                   map_seq=1, plan_id=None)  # fmt: skip
REPORT = RobotObstacles(points=[], stamp=0.0, ttl=10.0)


def run(seconds, *, step=0.1, state=lambda _now: STATE, pose=POSE, report=REPORT, standing=lambda _now: False):
    """Return the times at which each channel was published."""
    policy = PublishingPolicy("r1")
    times = {ch.ROBOT_POSE: [], ch.ROBOT_STATE: [], ch.ROBOT_OBSTACLES: []}
    for number in range(round(seconds / step)):
        now = 100.0 + number * step
        for publication in policy.due(lambda: pose, state(now), lambda: report, now, standing=standing(now)):
            assert publication.ids == {"robot": "r1"}
            times[publication.channel].append(round(now - 100.0, 3))
    return times


@pytest.mark.parametrize("step", [0.1, 0.05, 0.025])
def test_pose_is_published_at_10_hz_and_state_and_obstacles_at_1_hz(step):
    times = run(3.0, step=step)
    assert len(times[ch.ROBOT_POSE]) == pytest.approx(30, abs=1)
    assert len(times[ch.ROBOT_STATE]) == len(times[ch.ROBOT_OBSTACLES]) == pytest.approx(3, abs=1)


def test_obstacle_that_bars_the_way_is_published_at_once_and_the_next_report_a_second_later():
    policy, times = PublishingPolicy("r1"), []
    for number in range(30):
        published = policy.due(lambda: POSE, STATE, lambda: REPORT, 100.0 + 0.1 * number, barred=number == 4)
        times += [number for publication in published if publication.channel is ch.ROBOT_OBSTACLES]
    assert times == [0, 4, 14, 24]


def test_a_robot_that_stands_publishes_its_pose_less_often_and_at_once_when_it_moves():
    times = run(3.0, standing=lambda now: now < 101.65)[ch.ROBOT_POSE]
    standing = [at for at in times if at < 1.65]
    assert len(standing) == 5
    assert times[5] == 1.7
    assert len(times[5:]) == pytest.approx(13, abs=1)


def test_one_lost_pose_of_a_standing_robot_does_not_make_the_pose_before_too_old():
    longest = max(
        after - before
        for before, after in itertools.pairwise(run(20.0, step=0.1, standing=lambda _now: True)[ch.ROBOT_POSE])
    )
    assert longest == pytest.approx(STANDING_POSE_S)
    # Of which the last part is for the way of the message, and for a tick that comes late.
    assert 2.0 * longest <= ch.ROBOT_POSE.max_age_s - 0.15


def test_a_standing_robot_whose_state_changes_publishes_its_pose_with_it():
    other = msgspec.structs.replace(STATE, mode="NORMAL")
    times = run(1.0, standing=lambda _now: True, state=lambda now: other if now >= 100.15 else STATE)
    assert times[ch.ROBOT_POSE][:2] == [0.0, 0.2]
    assert times[ch.ROBOT_STATE][:2] == [0.0, 0.2]


@pytest.mark.parametrize(
    ("change", "times"),
    [
        ({"mode": "NORMAL"}, [0.0, 0.5, 1.5]),
        ({"goal_reached": True}, [0.0, 0.5, 1.5]),
        ({"map_seq": 2}, [0.0, 0.5, 1.5]),
        ({"reasons": ["the lidar is silent"]}, [0.0, 0.5, 1.5]),
        ({"reasons": ["the map is 1.3 s old"]}, [0.0, 1.0]),
        ({"goal_distance": 3.0, "battery": 0.7, "stamp": 5.0}, [0.0, 1.0]),
    ],
)
def test_changed_state_is_published_immediately(change, times):
    other = msgspec.structs.replace(STATE, **change)
    assert run(1.6, state=lambda now: other if now >= 100.49 else STATE)[ch.ROBOT_STATE] == times


def test_state_is_published_without_pose_and_obstacles():
    times = run(1.0, pose=None, report=None)
    assert times == {ch.ROBOT_POSE: [], ch.ROBOT_STATE: [0.0], ch.ROBOT_OBSTACLES: []}


def test_obstacles_are_computed_only_when_a_report_is_due():
    calls = []
    policy = PublishingPolicy("r1")
    for number in range(20):
        policy.due(lambda: None, STATE, lambda at=number: calls.append(at), 100.0 + number * 0.1)
    assert calls == [0, 10]


def test_traces_of_a_path_that_was_replaced_before_its_first_command_are_dropped():
    traces = PathTraces()
    for area in ("z1", "z2"):
        traces.begin([Trace(area=area, epoch=1, seq=1, first_reading=1.0, confirmed=2.0)], 3.0)
    traces.close(4.0)
    traces.close(5.0)
    (closed,) = traces.take_finished()
    assert (closed.area, closed.path_received, closed.first_command) == ("z2", 3.0, 4.0)
    assert traces.take_finished() == []
    assert traces.recent == [closed]


def test_only_the_last_traces_are_kept_for_the_state():
    traces = PathTraces()
    for number in range(20):
        traces.begin([Trace(area=f"z{number}", epoch=1, seq=1, first_reading=1.0, confirmed=2.0)], 3.0)
        traces.close(4.0)
    assert [trace.area for trace in traces.recent] == [f"z{number}" for number in range(4, 20)]
    assert len(traces.take_finished()) == 20
