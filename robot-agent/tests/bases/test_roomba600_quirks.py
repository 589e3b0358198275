"""Roombas that deviate from the specification, as their owners report: the robot drives, or the reason is named."""

from __future__ import annotations

import itertools

import guardian_rig as rigs
import pytest
from guardian_rig import wait_for

from robot_agent.bases.roomba600.driver import BRC_PULSE_S, ModeMonitor, Roomba600Driver, Roomba600Options
from robot_agent.bases.roomba600.emulator import PASSIVE, SAFE, Quirks, RoombaEmulator
from robot_agent.bases.roomba600.open_interface import SLOW_STREAM, Mode, stream_frame_size
from robot_agent.guardian.base import ATTEMPT_S, OTHERS_AFTER, Attempt
from robot_agent.guardian.core import GuardianCore
from robot_agent.guardian.link import WheelCommand

STEP = 0.01
QUIRKS = {
    "none": Quirks(),
    "mode one too high in the stream": Quirks(mode_offset=1),
    "mode 32 in single frames": Quirks(mode_noise=7),
    "text in the stream": Quirks(text_period_s=0.4),
    "damaged frames": Quirks(damaged=5),
    "all at once": Quirks(mode_offset=1, mode_noise=11, text_period_s=0.7, damaged=9),
}
every_quirk = pytest.mark.parametrize("quirks", QUIRKS.values(), ids=QUIRKS.keys())


class Line:
    """A guardian and a base on a line of any rate, in emulated time; the agent commands all the time."""

    def __init__(self, base=None, **options):
        self.base = base or RoombaEmulator()
        self.core = GuardianCore(Roomba600Driver(Roomba600Options(**options)))
        self.now, self.seq, self.wheels = 50.0, 0, (0.0, 0.0)
        self.baud = options.get("baud", 115200)
        self.line_until = None
        self.rest = False
        self.feedback, self.attempts = [], []
        self.waiting, self.late_s = 0.0, 0.0
        """Bytes that wait for the line, and for how long (s) the last one of them had to wait at worst."""

    def handle(self, output):
        self.feedback += output.feedback
        self.waiting += len(output.data)
        self.late_s = max(self.late_s, 10.0 * self.waiting / self.baud)
        if output.attempt is not None:
            self.attempts.append(output.attempt)
            self.baud = output.attempt.baud or self.baud
            if output.attempt.line is not None:
                self.line_until = self.now + output.attempt.line.seconds
        if output.data and self.baud == self.base.baud:
            self.base.receive(output.data, self.now)

    def run(self, seconds):
        for step in range(round(seconds / STEP)):
            self.now += STEP
            self.waiting = max(0.0, self.waiting - STEP * self.baud / 10.0)
            if self.line_until is not None and self.now >= self.line_until:
                self.base.pulse_wake_line(BRC_PULSE_S)
                self.line_until = None
            left, right = self.base.wheel_speeds_m_s
            self.base.add_wheel_travel(left * STEP, right * STEP)
            self.base.tick(self.now, STEP)
            sent = self.base.outgoing(self.now)
            self.handle(self.core.on_bytes(sent if self.baud == self.base.baud else b"", self.now))
            if step % 5 == 0:
                self.seq += 1
                command = WheelCommand(seq=self.seq, left=self.wheels[0], right=self.wheels[1], rest=self.rest)
                self.handle(self.core.on_command(command, self.now))
            if step % 2 == 0:
                self.handle(self.core.tick(self.now))

    @property
    def drives(self):
        return self.base.wheel_speeds_m_s == pytest.approx((0.3, 0.25))


@every_quirk
def test_the_base_comes_up_and_drives_for_a_minute_without_a_fault(quirks):
    line = Line(RoombaEmulator(quirks=quirks))
    line.run(0.5)
    assert line.base.mode == SAFE
    line.wheels = (0.3, 0.25)
    line.run(60.0)
    assert (line.core.latched, line.drives) == (None, True)


@every_quirk
def test_leaving_the_driving_mode_is_a_fault_with_every_quirk(quirks):
    line = Line(RoombaEmulator(quirks=quirks))
    line.wheels = (0.3, 0.25)
    line.run(1.5)
    assert line.drives
    line.base.receive(b"\x80", line.now)
    line.run(0.3)
    assert "mode Passive instead of Safe" in line.core.latched
    assert line.base.wheel_speeds_m_s == (0.0, 0.0)


@every_quirk
def test_a_bump_stops_the_wheels_within_a_few_frames(quirks):
    line = Line(RoombaEmulator(quirks=quirks))
    line.wheels = (0.3, 0.25)
    line.run(1.5)
    line.base.world.bump_left = True
    line.run(0.06)
    assert line.base.wheel_speeds_m_s == (0.0, 0.0)
    assert "bumper" in line.core.latched


def test_a_robot_that_is_driven_on_while_it_is_woken_is_not_taken_for_one_with_an_offset():
    """Frames of Safe mode that still arrive after Start must not count as Passive reported one too high."""
    monitor = ModeMonitor()
    monitor.restart()
    reports = itertools.chain([2] * 6, [1] * 10)
    for number, value in enumerate(reports):
        monitor.on_report(value, 0.015 * number)
    assert (monitor.offset, monitor.mode) == (0, Mode.PASSIVE)


def test_a_number_that_stays_no_mode_is_a_problem():
    line = Line(RoombaEmulator(quirks=Quirks(mode_noise=1)))
    line.run(2.0)
    assert line.base.mode == PASSIVE
    monitor = ModeMonitor()
    for step in range(20):
        monitor.on_report(1, 0.015 * step)
    monitor.on_report(2, 1.0)
    monitor.on_report(32, 1.02)
    assert monitor.mode == Mode.SAFE
    monitor.on_report(32, 1.13)
    assert monitor.mode == 32


def test_a_sleeping_robot_is_woken_by_its_wired_brc_pin():
    line = Line(brc="rts")
    line.base.asleep = True
    line.wheels = (0.3, 0.25)
    line.run(ATTEMPT_S + BRC_PULSE_S + 2.5)
    assert [attempt.line.name for attempt in line.attempts] == ["rts"]
    assert line.drives
    assert line.core.unanswered is None


def test_a_sleeping_robot_without_that_wire_is_named_with_what_to_do():
    line = Line()
    line.base.asleep = True
    line.run(4 * ATTEMPT_S)
    assert "does not answer at 115200 or 19200 baud: it may be asleep" in line.core.unanswered
    assert "press its CLEAN button" in line.core.unanswered
    assert line.attempts[:2] == [Attempt(baud=19200), Attempt(baud=115200)]
    line.base.asleep = False  # somebody presses it
    line.wheels = (0.3, 0.25)
    line.run(3.0)
    assert line.core.unanswered is None
    assert line.drives


@pytest.mark.parametrize("brc", ["none", "rts"])
@pytest.mark.parametrize("configured", [115200, 19200])
def test_a_robot_at_the_other_rate_is_found_and_driven_there(brc, configured):
    other = 19200 if configured == 115200 else 115200
    line = Line(RoombaEmulator(quirks=Quirks(baud=other, keeps_baud=True)), brc=brc, baud=configured)
    line.wheels = (0.3, 0.25)
    line.run(2 * ATTEMPT_S + 2.5)
    assert (line.baud, line.drives, line.core.latched) == (other, True, None)
    attempts = len(line.attempts)
    line.run(10.0)
    assert len(line.attempts) == attempts


@pytest.mark.parametrize("brc", ["none", "rts"])
@pytest.mark.parametrize("configured", [115200, 19200])
def test_a_robot_at_the_other_rate_is_brought_to_the_configured_one_and_driven_there(brc, configured):
    line = Line(RoombaEmulator(quirks=Quirks(baud=134400 - configured)), brc=brc, baud=configured)
    line.wheels = (0.3, 0.25)
    unanswered = []
    for _ in range(round((5 * ATTEMPT_S if brc == "rts" else 3 * ATTEMPT_S) / 0.1)):
        line.run(0.1)
        unanswered.append(line.core.unanswered)
    assert (line.base.baud, line.baud, line.drives, line.core.latched) == (configured, configured, True, None)
    assert set(unanswered) == {None}, "no agent was told that there is no base"
    attempts = len(line.attempts)
    line.run(10.0)
    assert len(line.attempts) == attempts


@pytest.mark.parametrize("configured", [115200, 19200])
@pytest.mark.parametrize("keeps_baud", [False, True])
def test_a_robot_that_changed_its_rate_after_it_had_answered_is_found_again(configured, keeps_baud):
    line = Line(RoombaEmulator(quirks=Quirks(keeps_baud=keeps_baud)), baud=configured)
    line.run(4 * ATTEMPT_S)
    assert line.feedback[-1].status.mode_problem is None
    line.base.switch_on(held=True)
    line.run(4 * ATTEMPT_S)
    line.wheels = (0.3, 0.25)
    line.run(1.5)
    assert (line.base.baud, line.drives, line.core.latched) == (19200 if keeps_baud else configured, True, None)


def test_a_robot_that_changes_its_rate_on_its_way_is_a_fault_and_found_again_after_the_reset():
    line = Line()
    line.wheels = (0.3, 0.25)
    line.run(1.5)
    line.base.switch_on(held=True)
    line.run(20.0)
    assert "has sent no valid frame" in line.core.latched
    assert line.base.wheel_speeds_m_s == (0.0, 0.0)
    line.handle(line.core.on_command(WheelCommand(seq=10**6, left=0.0, right=0.0, reset=True), line.now))
    line.seq = 10**6
    line.run(4 * ATTEMPT_S)
    assert (line.base.baud, line.drives, line.core.latched) == (115200, True, None)


def test_a_sleeping_robot_at_the_other_rate_is_found_after_somebody_has_pressed_clean_minutes_later():
    line = Line(RoombaEmulator(quirks=Quirks(baud=19200)))
    line.base.asleep = True
    line.run(200.0)
    assert "press its CLEAN button" in line.core.unanswered
    line.base.press_clean()
    line.wheels = (0.3, 0.25)
    line.run((OTHERS_AFTER + 3) * ATTEMPT_S)
    assert (line.base.baud, line.core.unanswered, line.drives) == (115200, None, True)


@pytest.mark.parametrize("configured", [115200, 19200])
def test_a_robot_that_answers_at_the_configured_rate_is_told_no_other(configured):
    driver = Roomba600Driver(Roomba600Options(baud=configured))
    for rate in (configured, 134400 - configured, configured):
        driver.use_baud(rate)
        code = {115200: 11, 19200: 7}[configured]
        assert driver.wake().endswith(bytes((129, code))) == (rate != configured)


# --- sleeping while the robot rests ---


@pytest.mark.parametrize("brc", ["rts", "dtr"])
def test_resting_robots_base_sleeps_for_hours_without_a_fault_and_drives_within_three_seconds(brc):
    line = Line(brc=brc)
    line.run(0.5)
    line.rest = True
    line.run(30.0)
    assert line.base.asleep
    assert (line.core.latched, line.core.unanswered, line.attempts) == (None, None, [])
    assert line.feedback[-1].stopped == "the base is asleep to save power"
    assert line.now - 50.0 > 30.0
    line.rest, line.wheels = False, (0.3, 0.25)
    line.run(3.0)
    assert [attempt.line.name for attempt in line.attempts] == [brc]
    assert (line.base.asleep, line.drives, line.core.latched) == (False, True, None)


def test_base_that_no_line_could_wake_stays_awake():
    line = Line()
    line.rest = True
    line.run(2.0)
    assert (line.base.asleep, line.base.mode) == (False, SAFE)


def test_base_that_moves_charges_or_has_a_fault_does_not_sleep():
    line = Line(brc="rts")
    line.wheels = (0.3, 0.25)
    line.run(1.0)
    line.rest = True
    line.run(1.0)
    assert not line.base.asleep
    line = Line(brc="rts")
    line.run(0.5)
    line.base.world.home_base = True
    line.run(0.1)
    line.rest = True
    line.run(1.0)
    assert not line.base.asleep
    line = Line(brc="rts")
    line.run(0.5)
    line.base.world.bump_left = True
    line.run(0.1)
    line.rest = True
    line.run(1.0)
    assert not line.base.asleep
    assert "bumper" in line.core.latched


def test_base_sleeps_on_when_the_agent_ends_and_is_woken_by_the_next_one():
    line = Line(brc="rts")
    line.run(0.5)
    line.rest = True
    line.run(1.0)
    line.handle(line.core.on_agent_lost(line.now))
    for _ in range(100):
        line.now += 0.05
        line.handle(line.core.tick(line.now))
    assert line.base.asleep
    line.rest = False
    line.run(3.0)
    assert line.base.mode == SAFE


def test_base_that_does_not_wake_is_pulsed_again_and_then_named():
    line = Line(brc="rts")
    line.run(0.5)
    line.rest = True
    line.run(1.0)
    line.base.pulse_wake_line = lambda _seconds: None
    line.rest = False
    line.run(30.0)
    assert len(line.attempts) > 2
    assert "pulsed awake without success" in line.core.unanswered


def test_pulses_are_no_series_that_changes_the_rate():
    line = Line(brc="dtr")
    line.base.asleep = True
    line.base.pulse_wake_line = lambda _seconds: None
    times = []
    for _ in range(400):
        before = len(line.attempts)
        line.run(0.1)
        times += [line.now for attempt in line.attempts[before:] if attempt.line is not None]
    assert len(times) > 5
    assert min(b - a for a, b in itertools.pairwise(times)) > BRC_PULSE_S + 1.0
    assert "pulsed awake without success" in line.core.unanswered


@pytest.mark.parametrize("baud", [115200, 19200])
def test_stops_of_who_taps_a_key_do_not_pile_up_on_the_line(baud):
    line = Line(RoombaEmulator(quirks=Quirks(baud=baud)), baud=baud)
    line.run(1.5)
    for _ in range(40):
        line.wheels = (0.1, 0.1)
        line.run(0.15)
        line.wheels = (0.0, 0.0)
        line.run(0.1)
    assert line.late_s < 0.35, "a stop waits for what completes one earlier stop, at most"


def test_the_slow_stream_fits_into_its_period():
    assert stream_frame_size(SLOW_STREAM) * 10 / 19200 <= 0.015


@pytest.mark.parametrize("quirks", [Quirks(), Quirks(stays_safe_on_dock=True)])
def test_a_robot_that_is_put_on_its_dock_says_why_it_does_not_drive(quirks):
    line = Line(RoombaEmulator(quirks=quirks))
    line.run(1.0)
    line.base.world.home_base = True
    line.wheels = (0.3, 0.25)
    line.run(1.0)
    assert line.base.wheel_speeds_m_s == (0.0, 0.0)
    reason = line.core.latched or line.feedback[-1].stopped
    assert "charger" in reason


def test_a_robot_on_its_dock_is_left_in_passive_mode_and_comes_up_when_it_is_taken_off():
    line = Line()
    line.base.world.home_base = True
    line.run(3.0)
    assert line.base.mode == PASSIVE
    assert line.feedback[-1].stopped == "the base is on its charger, where it does not drive"
    line.base.world.home_base = False
    line.wheels = (0.3, 0.25)
    line.run(2.0)
    assert line.drives


@pytest.mark.live
@pytest.mark.parametrize(
    "quirks",
    [QUIRKS["all at once"], Quirks(baud=19200)],
    ids=["all quirks of the stream at once", "19200 baud"],
)
def test_the_processes_drive_a_robot_with_quirks(tmp_path, quirks):
    with rigs.Rig(tmp_path, robot=RoombaEmulator(quirks=quirks)) as rig:
        rig.drive()
        assert rig.agent.feedback.fault is None


@pytest.mark.live
def test_the_agent_is_told_of_a_robot_that_never_answers(tmp_path):
    robot = RoombaEmulator()
    robot.asleep = True
    with rigs.Rig(tmp_path, robot=robot) as rig:
        reason = wait_for(lambda: rig.agent.refused, "the agent is told")
        assert "the base does not answer at 115200 or 19200 baud: it may be asleep" in reason
        assert rig.watchdog.count("base_silent") >= 2
        with rig.base.lock:
            robot.asleep = False
        rig.drive()
