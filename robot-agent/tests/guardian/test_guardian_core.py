from __future__ import annotations

import math
import struct
from dataclasses import dataclass, field

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fog_contracts.messages import Reason
from robot_agent.bases.roomba600.driver import Roomba600Driver, Roomba600Options
from robot_agent.bases.roomba600.emulator import FULL, OFF, PASSIVE, SAFE, RoombaEmulator
from robot_agent.guardian.core import COMMAND_FRESH_S, GuardianCore
from robot_agent.guardian.link import WheelCommand

STEP = 0.01
BASE_SILENT_S = Roomba600Driver.timing.frame_timeout
IGNORED_AFTER_WAKE_S = Roomba600Driver.timing.ignored_after_wake


def commands(data: bytes) -> list[tuple[int, bytes]]:
    """The guardian's bytes, cut into the commands that it knows."""
    cut = []
    while data := data.lstrip(b"\0"):  # no opcode: completes a command whose bytes were lost
        size = {128: 1, 129: 2, 131: 1, 145: 5}.get(data[0]) or 2 + data[1]
        assert data[0] in {128, 129, 131, 145, 148}
        cut.append((data[0], data[1:size]))
        data = data[size:]
    return cut


@dataclass
class Rig:
    """A guardian and an emulated base on one line, in emulated time; every rule is checked after every step."""

    base: RoombaEmulator = field(default_factory=RoombaEmulator)
    core: GuardianCore = field(default_factory=lambda: GuardianCore(Roomba600Driver(Roomba600Options())))
    now: float = 100.0
    seq: int = 0
    command_at: float = -1e9
    wheels: tuple[float, float] = (0.0, 0.0)
    wheels_at: float = -1e9
    resetting: bool = False
    latched: str | None = None
    damage: int | None = None
    silent: bool = False
    moved: bool = False
    not_receiving: bool = False
    away_at: float = -1e9
    heard_at: float = -1e9
    back_at: float = -1e9
    feedback: list = field(default_factory=list)

    def handle(self, output) -> None:
        self.feedback.extend(output.feedback)
        for opcode, argument in commands(output.data):
            latched = self.latched is not None or self.core.latched is not None
            if opcode == 131:
                # Twice each time, 0.05 s apart, and again 0.3 s later; meanwhile it may have fallen silent, or has just
                # spoken again: nobody knows in which modes it was while it was silent.
                quiet = self.now - self.heard_at > 0.3 or self.now - self.back_at <= 0.05
                retaken = self.now - self.away_at <= 0.41 or quiet
                assert self.resetting or not latched or retaken, "disturbed although it stands in Safe mode"
            if opcode == 128:
                assert self.resetting or not self.moved or latched, "woken although it has moved and has no fault"
                self.moved = False
            if opcode in {128, 131}:
                self.wheels, self.wheels_at = (0.0, 0.0), self.now
            if opcode == 145:
                right, left = (speed / 1000 for speed in struct.unpack(">hh", argument))
                self.check_speeds(left, right)
                self.moved |= (left, right) != (0.0, 0.0)
                self.wheels, self.wheels_at = (left, right), self.now
        if output.data and not self.not_receiving:
            self.base.receive(output.data, self.now)
        self.latched = self.core.latched
        self.resetting = False

    def check_speeds(self, left: float, right: float) -> None:
        assert max(abs(left), abs(right)) <= 0.5
        assert abs(left + right) / 2 <= 0.3115
        if (left, right) != (0.0, 0.0):
            assert self.latched is None
            assert self.core.latched is None
            assert self.now - self.command_at <= COMMAND_FRESH_S
        gain = 1.65 * (self.now - self.wheels_at) + 0.004  # whole mm/s, and none that severs the line
        for new, old in ((left, self.wheels[0]), (right, self.wheels[1])):
            increase = abs(new) - abs(old) if new * old >= 0 else abs(new)
            assert increase <= gain, f"a wheel went from {old} to {new} m/s in {self.now - self.wheels_at:.3f} s"

    def command(self, left: float, right: float, *, reset: bool = False) -> None:
        self.seq += 1
        self.command_at, self.resetting = self.now, reset
        self.handle(self.core.on_command(WheelCommand(seq=self.seq, left=left, right=right, reset=reset), self.now))

    def lose_agent(self) -> None:
        self.command_at = -1e9
        self.handle(self.core.on_agent_lost(self.now))

    def step(self) -> None:
        self.now += STEP
        self.base.tick(self.now, STEP)
        data = self.base.outgoing(self.now)
        if data and not self.silent and self.damage is None:
            self.back_at = self.now if self.now - self.heard_at > 0.3 else self.back_at
            self.heard_at = self.now
        if self.damage is not None and data:
            corrupted = bytearray(data)
            corrupted[self.damage % len(corrupted)] ^= 0x10 | (self.damage & 0xFF)
            data, self.damage = bytes(corrupted), None
        if data and not self.silent:
            self.away_at = self.now if self.base.mode != SAFE else self.away_at
            self.handle(self.core.on_bytes(data, self.now))
        self.handle(self.core.tick(self.now))
        if self.now - self.command_at > COMMAND_FRESH_S or self.core.latched is not None:
            assert self.wheels == (0.0, 0.0)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP)):
            self.step()

    def drive(self, seconds: float, left: float = 0.3, right: float = 0.3) -> None:
        until = self.now + seconds
        while self.now < until:
            self.command(left, right)
            self.run(0.05)


def change_mode(base: RoombaEmulator, mode: int) -> None:
    """A button or an empty battery stops the motors; Full mode, which only a command can cause, keeps them."""
    if mode == FULL:
        base.mode = FULL
    else:
        base._leave(mode, keep_stream=True)


def ready_rig(**options) -> Rig:
    rig = Rig(**options)
    rig.run(0.4)
    assert rig.base.mode == SAFE
    assert rig.core.latched is None
    return rig


speeds = st.floats(-0.5, 0.5)
events = st.one_of(
    st.tuples(st.just("wait"), st.integers(1, 40)),
    st.tuples(st.just("command"), speeds, speeds),
    st.tuples(st.just("drive"), speeds, speeds, st.integers(1, 10)),
    st.tuples(st.just("reset"), speeds, speeds),
    st.tuples(st.just("lose_agent")),
    st.tuples(
        st.just("world"), st.sampled_from(["bump_left", "cliff_right", "wheel_drop_left", "charger"]), st.booleans()
    ),
    st.tuples(st.just("overcurrent"), st.booleans()),
    st.tuples(st.just("mode"), st.sampled_from([OFF, PASSIVE, FULL])),
    st.tuples(st.just("damage"), st.integers(0, 10_000)),
    st.tuples(st.just("silent"), st.booleans()),
    st.tuples(st.just("not_receiving"), st.booleans()),
    st.tuples(st.just("garbage"), st.binary(max_size=200)),
)


@settings(max_examples=300, deadline=None)
@example([("wait", 17), ("mode", OFF), ("drive", 0.0, 0.0, 1), ("silent", True), ("wait", 34), ("silent", False)])
@given(st.lists(events, max_size=30))
def test_no_sequence_of_events_moves_a_wheel_without_a_fresh_command(order):  # noqa: C901  # one case per kind of event
    rig = Rig()
    for name, *arguments in order:
        match name:
            case "wait":
                rig.run(arguments[0] * STEP)
            case "command":
                rig.command(*arguments)
            case "drive":
                rig.drive(arguments[2] * 0.05, *arguments[:2])
            case "reset":
                rig.command(*arguments, reset=True)
            case "lose_agent":
                rig.lose_agent()
                assert rig.wheels == (0.0, 0.0)
            case "world":
                setattr(rig.base.world, *arguments)
            case "overcurrent":
                rig.base.world.overcurrent_left = arguments[0]
            case "mode":
                change_mode(rig.base, arguments[0])
            case "garbage":
                rig.handle(rig.core.on_bytes(arguments[0], rig.now))
            case _:
                setattr(rig, name, arguments[0])
        rig.step()
    rig.not_receiving = False
    rig.run(COMMAND_FRESH_S + 0.1)
    assert rig.base.wheel_speeds_m_s == (0.0, 0.0)


def test_a_streamed_command_drives_and_a_pause_stops():
    rig = ready_rig()
    rig.drive(0.5)
    assert rig.base.wheel_speeds_m_s == (0.3, 0.3)
    rig.run(COMMAND_FRESH_S + 0.03)
    assert rig.base.wheel_speeds_m_s == (0.0, 0.0)


def test_speed_limit_scales_both_wheels_alike():
    rig = ready_rig()
    rig.drive(0.6, 0.5, 0.25)
    left, right = rig.base.wheel_speeds_m_s
    assert left / right == pytest.approx(2.0, rel=0.02)
    assert (left + right) / 2 == pytest.approx(0.31, abs=0.001)


@pytest.mark.parametrize(
    ("sensors", "reason"),
    [
        ({"bump_left": True}, "bumper"),
        ({"bump_right": True}, "bumper"),
        ({"cliff_front_left": True}, "floor"),
        ({"wheel_drop_right": True}, "dropped"),
    ],
)
def test_frame_with_a_safety_sensor_set_returns_the_stop_in_the_same_call(sensors, reason):
    rig = ready_rig()
    rig.drive(0.5)
    for name, value in sensors.items():
        setattr(rig.base.world, name, value)
    rig.now += 0.015
    rig.base.tick(rig.now, 0.015)
    output = rig.core.on_bytes(rig.base.outgoing(rig.now), rig.now)
    assert (145, bytes(4)) in commands(output.data)
    assert reason in rig.core.latched
    assert output.feedback[-1].fault == rig.core.latched


def test_a_latched_fault_outlasts_its_cause_and_every_command_but_a_reset():
    rig = ready_rig()
    rig.drive(0.3)
    rig.base.world.bump_left = True
    rig.run(0.1)
    rig.base.world.bump_left = False
    rig.drive(3.0)
    assert rig.base.wheel_speeds_m_s == (0.0, 0.0)
    rig.command(0.0, 0.0, reset=True)
    rig.run(0.3)
    rig.drive(0.5)
    assert rig.base.wheel_speeds_m_s == (0.3, 0.3)


def test_a_reset_while_the_cause_persists_latches_again_before_a_wheel_turns():
    rig = ready_rig()
    rig.base.world.bump_right = True
    rig.run(0.1)
    rig.command(0.3, 0.3, reset=True)
    for _ in range(60):
        rig.command(0.3, 0.3)
        rig.step()
        assert rig.base.wheel_speeds_m_s == (0.0, 0.0)
    assert "bumper" in rig.core.latched


@pytest.mark.parametrize("mode", [OFF, PASSIVE, FULL])
def test_base_that_leaves_safe_mode_is_brought_back_and_stands_there_until_a_reset(mode):
    rig = ready_rig()
    rig.drive(0.3)
    change_mode(rig.base, mode)
    rig.drive(0.1)
    assert rig.base.mode == SAFE
    rig.drive(5.0)
    assert rig.base.mode == SAFE
    assert "left its driving mode" in rig.core.latched
    assert rig.wheels == (0.0, 0.0)
    rig.command(0.0, 0.0, reset=True)
    rig.run(0.3)
    assert rig.base.mode == SAFE
    assert rig.core.latched is None


def test_frames_from_before_waking_do_not_make_the_base_awake():
    rig = ready_rig()
    rig.base.world.bump_left = True
    rig.run(0.1)
    rig.base.world.bump_left = False
    rig.run(0.2)
    old = rig.base.outgoing(rig.now + 0.015)
    assert old
    rig.not_receiving = True
    rig.command(0.3, 0.3, reset=True)
    rig.now += 0.5 * IGNORED_AFTER_WAKE_S
    rig.handle(rig.core.on_bytes(old, rig.now))
    assert rig.feedback[-1].stopped == "the base is not ready to drive yet"
    rig.command(0.3, 0.3)
    assert rig.wheels == (0.0, 0.0)


def test_silent_base_is_a_fault_that_is_reported_repeatedly():
    rig = ready_rig()
    rig.drive(0.3)
    rig.silent = True
    rig.drive(BASE_SILENT_S + 0.1)
    assert "no valid frame" in rig.core.latched
    before = len(rig.feedback)
    rig.run(1.0)
    assert len(rig.feedback) - before >= 15
    rig.silent = False
    rig.command(0.0, 0.0, reset=True)
    rig.run(0.3)
    rig.drive(0.3)
    assert rig.base.wheel_speeds_m_s == (0.3, 0.3)


def test_base_that_falls_silent_before_it_moved_is_woken_without_a_reset_and_drives_when_it_is_back():
    rig = ready_rig()
    rig.silent = True
    for _ in range(40):
        waiting = bool(rig.feedback[-1].fault)
        rig.command(*((0.3, 0.3) if waiting else (0.0, 0.0)))
        rig.run(0.05)
        assert rig.wheels == (0.0, 0.0)
    assert rig.core.latched is None
    assert "no valid frame" in rig.feedback[-1].fault
    rig.silent = False
    rig.run(1.5)
    assert rig.feedback[-1].fault is None
    rig.drive(0.5)
    assert rig.base.wheel_speeds_m_s == (0.3, 0.3)


def test_base_whose_frames_are_all_damaged_never_drives():
    rig = ready_rig()
    for number in range(200):
        rig.damage = 3 + 256 * number
        rig.command(0.3, 0.3)
        rig.step()
    assert "no valid frame" in rig.core.latched
    assert rig.core.corrupted > 50


def test_a_base_that_is_switched_on_late_is_woken_and_drives():
    rig = Rig(silent=True, not_receiving=True)
    rig.drive(4.0)
    assert rig.wheels == (0.0, 0.0)
    rig.silent = rig.not_receiving = False
    rig.run(1.5)
    rig.drive(0.5)
    assert rig.base.wheel_speeds_m_s == (0.3, 0.3)


def test_charging_base_is_not_woken_until_it_leaves_the_charger():
    rig = Rig()
    rig.base.world.charger = True
    rig.run(1.0)
    later = b"".join(rig.core.tick(rig.now + 0.02 * n).data for n in range(12))
    assert {opcode for opcode, _ in commands(later)} <= {145}
    assert rig.feedback[-1].stopped == "the base is on its charger, where it does not drive"
    assert rig.feedback[-1].status.charging
    rig.base.world.charger = False
    rig.run(1.5)
    assert rig.base.mode == SAFE


def test_a_short_surge_of_current_is_no_fault_and_a_blocked_motor_is():
    rig = ready_rig()
    rig.base.world.overcurrent_left = True
    rig.drive(0.2)
    rig.base.world.overcurrent_left = False
    rig.drive(0.2)
    assert rig.core.latched is None
    rig.base.world.overcurrent_left = True
    rig.drive(0.5)
    assert "current" in rig.core.latched


def test_feedback_carries_encoders_battery_and_the_reason_of_the_stop():
    rig = ready_rig(base=RoombaEmulator(left_encoder=65_530, right_encoder=7))
    rig.base.add_wheel_travel(0.1, 0.2)
    rig.run(0.1)
    feedback = rig.feedback[-1]
    travel = (feedback.odometry.left_m, feedback.odometry.right_m)
    assert travel == pytest.approx([ticks * math.pi * 0.072 / 508.8 for ticks in rig.base.encoders], abs=1e-9)
    assert feedback.status.battery == pytest.approx(2400 / 2600, abs=0.01)
    assert feedback.status.mode_problem is None
    assert feedback.stopped == "no fresh command from the agent"
    assert [feedback.seq for feedback in rig.feedback] == list(range(1, len(rig.feedback) + 1))


def feedback_of(rig: Rig, seconds: float) -> int:
    rig.feedback.clear()
    rig.run(seconds)
    return len(rig.feedback)


def test_feedback_comes_more_often_while_the_wheels_turn() -> None:
    rig = ready_rig()
    rig.run(0.5)
    assert 9 <= feedback_of(rig, 1.0) <= 11
    rig.feedback.clear()
    rig.drive(1.0)
    assert 16 <= len(rig.feedback) <= 23
    rig.run(0.5)
    rig.base.add_wheel_travel(0.01, 0.0)
    assert feedback_of(rig, 0.07) == 1, "wheels that are moved by hand are reported as soon as when they drive"


def test_the_stop_command_stops_the_wheels():
    rig = ready_rig()
    rig.drive(0.3)
    rig.base.receive(rig.core.stop_command(), rig.now)
    assert rig.base.wheel_speeds_m_s == (0.0, 0.0)


def test_fault_longer_than_its_field_in_the_feedback_is_cut() -> None:
    core = GuardianCore(Roomba600Driver(Roomba600Options()))
    core._latch(Reason("mode_left", "the base left its driving mode: " + "x" * 600), now=1.0)
    assert core.latched is not None
    assert len(core.latched) == 500
