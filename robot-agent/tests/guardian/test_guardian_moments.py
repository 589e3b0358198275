"""The guardian at the very moments at which something falls due or goes stale, and what it says then.

Limits are literal. Times are chosen so that differences of them are exact: a limit that holds at its moment and no
longer must be told apart from one that ends a moment before.
"""

from __future__ import annotations

from itertools import pairwise

import msgspec
import pytest
from plain_base import DockingBase, PlainBase, Rig

from robot_agent.guardian import link
from robot_agent.guardian.core import GuardianCore
from robot_agent.guardian.link import WheelCommand
from robot_agent.hardware import Awakening, BaseReading, BaseStatus, WakeLine, WheelOdometry

STAND = b"0.0000,0.0000;"
RTS = WakeLine(name="rts", seconds=1.1)


# --- commands ---


# --- a base that is not awake ---


def test_charging_base_is_held_at_zero_from_the_first_tick_and_woken_when_it_falls_silent() -> None:
    base = PlainBase()
    rig = Rig.__new__(Rig)
    rig.base, rig.core = base, GuardianCore(base)
    rig.frame(0.0, charging=True)
    assert rig.core.tick(0.01).data == STAND
    assert rig.core.tick(0.3).data == STAND
    assert rig.core.tick(0.301).data == b"wake;"


def test_docking_base_that_charges_from_the_start_is_woken_once_and_its_mode_left_alone_then() -> None:
    base = DockingBase()
    rig = Rig.__new__(Rig)
    rig.base, rig.core = base, GuardianCore(base)
    rig.frame(0.0, charging=True)
    assert rig.core.tick(0.01).data == b"wake;", "it may be in any mode"
    for step in range(1, 400):
        now = 0.01 + 0.02 * step
        rig.frame(now, charging=True, mode_problem="Passive")
        assert rig.core.tick(now).data in {STAND, b""}
    assert rig.core.stop_command() == STAND


def test_mode_of_a_docking_base_that_is_awake_is_left_alone_when_the_guardian_ends() -> None:
    rig = Rig(base=DockingBase())
    rig.drive(0.1, 1.0)
    assert rig.core.stop_command() == STAND
    rig.command(1.02, 0.0, 0.0)
    rig.command(1.04, 0.0, 0.0, maneuver="seek_dock")
    rig.frame(1.05)
    assert rig.core.moving
    rig.command(1.06, 0.0, 0.0)
    assert rig.core.stop_command() == b"take;"
    rig.frame(1.3)
    assert rig.core.stop_command() == STAND, "it drives by wheel speeds again"


def test_charging_base_that_is_awake_stands_and_says_why() -> None:
    rig = Rig()
    rig.drive(0.1, 1.0)
    output = rig.frame(1.01, charging=True)
    assert output.feedback[-1].stopped == "the base is on its charger, where it does not drive"
    assert rig.wheels(rig.command(1.02)) == (0.0, 0.0)


# --- a base that falls silent ---


SILENCE = "the base has sent no valid frame for 0.3 s: check cable and power"


def test_base_that_has_not_moved_is_woken_again_when_it_falls_silent_and_its_fault_ends_with_its_silence() -> None:
    rig = Rig(begin=-0.2)
    rig.frame(0.0)
    rig.command(0.25, 0.0, 0.0)
    assert b"wake" not in rig.core.tick(0.3).data
    silent = rig.core.tick(0.3001)
    assert silent.data == b"wake;"
    (told,) = silent.feedback
    assert (told.fault, told.stopped, told.bumped) == (SILENCE, "the base is not ready to drive yet", False)
    assert told.passing
    assert rig.core.latched is None
    assert rig.command(0.32, 0.3, 0.3).data == b""
    assert rig.core.tick(0.35).feedback[0].fault == SILENCE
    assert not rig.core.moving
    back = rig.frame(0.36).feedback[-1]
    assert (back.fault, back.passing) == (None, False)
    assert rig.command(0.37, 0.3, 0.3).data == b"", "a frame from before the wake-up makes no base awake"
    rig.frame(0.41)
    assert rig.drive(0.43, 0.6, 0.1, 0.1) == (0.1, 0.1)
    rig.core.tick(0.9001)
    assert rig.core.latched == SILENCE


def test_silent_base_that_has_not_moved_is_woken_every_second_and_its_revival_is_tried() -> None:
    rig = Rig(begin=-0.2, base=PlainBase(awakening=Awakening(bauds=(115_200,), line=RTS)))
    rig.frame(0.0)
    outputs = {now: rig.core.tick(now) for now in (round(0.02 * step, 2) for step in range(1, 1000))}
    woken = [now for now, output in outputs.items() if b"wake" in output.data]
    assert woken[:4] == [0.32, 1.34, 2.36, 3.38]
    assert next(output.attempt.line for output in outputs.values() if output.attempt is not None) == RTS
    assert rig.core.unanswered == "the base does not answer at 115200 baud: check its cable and power"
    assert rig.core.latched is None


@pytest.mark.parametrize("wheels", [(0.01, 0.0), (0.0, 0.01), (-0.01, 0.0)])
def test_silence_is_latched_once_either_wheel_was_told_to_turn_even_long_ago(wheels) -> None:
    rig = Rig(begin=-1.0)
    rig.drive(-0.9, -0.5, *wheels)
    rig.drive(-0.48, 5.0, 0.0, 0.0)
    rig.core.tick(5.3001)
    assert rig.core.latched == SILENCE


def test_base_that_a_reset_has_woken_counts_as_not_moved() -> None:
    rig = Rig(begin=-1.0)
    rig.drive(-0.9, 0.0)
    rig.core.tick(0.3001)
    assert rig.command(0.4, 0.0, 0.0, reset=True).data == b"wake;"
    rig.frame(0.6)
    rig.core.tick(1.0)
    assert rig.core.latched is None


def test_latched_fault_of_a_base_that_has_not_moved_outlasts_its_silence() -> None:
    rig = Rig(begin=-0.2)
    rig.frame(0.0, bumper_left=True)
    assert rig.core.tick(0.301).data == STAND
    assert rig.core.latched == "the bumper is pressed (left)"
    assert rig.frame(0.4).feedback[-1].fault == "the bumper is pressed (left)"


def test_silence_on_the_way_off_the_dock_is_latched() -> None:
    leaving = Rig(base=DockingBase())
    leaving.frame(1.0, docked=True, charging=True)
    assert b"full;" in leaving.command(1.0, -0.1, -0.1, maneuver="leave_dock").data
    leaving.command(1.25, -0.1, -0.1, maneuver="leave_dock")
    leaving.core.tick(1.3001)
    assert leaving.core.latched == SILENCE


def test_of_frames_that_came_together_the_newest_is_told_and_each_that_says_something_else() -> None:
    rig = Rig()
    free, pressed = BaseStatus(), BaseStatus(bumper_left=True)
    told = []
    for now, statuses in ((1.0, [free, free, free]), (2.0, [free, free, pressed, pressed, free])):
        for number, status in enumerate(statuses):
            rig.base.frames.append(BaseReading(status, WheelOdometry(left_m=number, right_m=number)))
        told.append([feedback.odometry.left_m for feedback in rig.core.on_bytes(b"", now).feedback])
    assert told == [[2.0], [1.0, 3.0, 4.0]]
    assert rig.core.latched == "the bumper is pressed (left)"
    assert rig.core.frames == 1 + 3 + 5


def test_bump_that_was_reset_is_told_no_more() -> None:
    rig = Rig()
    assert rig.frame(0.2, bumper_left=True).feedback[-1].bumped
    rig.command(0.3, 0.0, 0.0, reset=True)
    told = rig.frame(0.5).feedback[-1]
    assert (told.fault, told.bumped) == (None, False)


def test_first_fault_is_answered_with_a_stop_even_if_zero_was_sent_a_moment_ago() -> None:
    rig = Rig()
    rig.drive(0.1, 1.0, 0.0, 0.0)
    assert rig.command(1.06, 0.0, 0.0).data == STAND
    assert rig.frame(1.07, bumper_left=True).data == STAND


# --- what is tried on a base that never answers ---


def attempts(rig: Rig, until: float, step: float = 0.02) -> dict[float, object]:
    """Tick until then; return what was tried, by time."""
    found = {}
    for number in range(round(until / step)):
        now = round(number * step, 3)
        attempt = rig.core.tick(now).attempt
        if attempt is not None:
            found[now] = attempt
    return found


def test_another_rate_is_set_and_the_base_woken_at_once_at_it() -> None:
    rig = Rig(awake=False, base=PlainBase(awakening=Awakening(bauds=(115_200, 19_200))))
    (at, first), *_ = attempts(rig, 6.0).items()
    assert first.baud == 19_200
    assert rig.base.bauds[0] == 19_200
    other = Rig(awake=False, base=PlainBase(awakening=Awakening(bauds=(115_200, 19_200))))
    attempts(other, at + 0.02)
    assert other.core.tick(at + 0.02).data == b"wake;"


def test_base_that_sends_frames_is_woken_only_whatever_its_mode() -> None:
    rig = Rig(awake=False, base=PlainBase(awakening=Awakening(bauds=(115_200,), line=RTS)))
    for step in range(1000):
        now = 0.02 * step
        rig.frame(now, mode_problem="it sleeps")
        assert rig.core.tick(now).attempt is None
    assert rig.core.unanswered is None


# --- feedback and messages ---


@pytest.mark.parametrize(("speed", "accepted"), [(0.5, True), (-0.5, True), (0.501, False), (-0.501, False)])
def test_command_of_more_than_0_5_m_s_is_no_command(speed, accepted) -> None:
    for left, right in ((speed, 0.0), (0.0, speed)):
        data = link.encode({"seq": 1, "left": left, "right": right})
        if accepted:
            command = link.decode_command(data)
            assert (command.left, command.right, command.reset) == (left, right, False)
        else:
            with pytest.raises(msgspec.ValidationError):
                link.decode_command(data)


# --- a base that is put to sleep ---


class SleepingBase(PlainBase):
    """One that is woken by a line."""

    def __init__(self) -> None:
        super().__init__(awakening=Awakening(bauds=(115_200,), line=RTS))

    def sleep(self) -> bytes:
        return b"sleep;"


@pytest.mark.parametrize("late", [{}, {"mode_problem": "it sleeps"}, {"bumper_left": True}])
def test_frame_that_was_on_its_way_when_the_base_fell_asleep_makes_no_fault_of_its_rest(late) -> None:
    rig = Rig(base=SleepingBase())
    rig.drive(0.2, 1.0, 0.0, 0.0)
    resting = WheelCommand(seq=1, left=0.0, right=0.0, rest=True)
    assert rig.core.on_command(resting, 1.01).data == b"sleep;"
    assert rig.frame(1.02, **late).data == b""
    asked = []
    for step in range(1, 60):
        assert rig.core.on_command(resting, 1.0 + 0.1 * step).data == b""
        told = rig.core.tick(1.0 + 0.1 * step)
        assert told.data in {b"", b"wake;"}
        asked += [step] * bool(told.data)
        assert [feedback.stopped for feedback in told.feedback] == ["the base is asleep to save power"]
    assert rig.core.latched is None
    assert asked[0] >= 10, "the base falls asleep first"
    assert {later - before for before, later in pairwise(asked)} == {5}, "as somebody else may have woken it"
    assert rig.core.on_command(WheelCommand(seq=2, left=0.0, right=0.0), 7.0).attempt.line == RTS
    rig.frame(7.005, **late)
    assert rig.core.tick(7.01).data == b"wake;"
    assert rig.core.latched is None
    rig.frame(7.2)
    assert rig.wheels(rig.command(7.21))[0] > 0.0


def test_base_that_sleeps_is_left_alone_when_the_link_to_the_agent_is_lost() -> None:
    rig = Rig(base=SleepingBase())
    rig.drive(0.2, 1.0, 0.0, 0.0)
    assert rig.core.on_command(WheelCommand(seq=1, left=0.0, right=0.0, rest=True), 1.01).data == b"sleep;"
    assert rig.core.on_agent_lost(1.5).data == b""
    assert rig.core.tick(2.0).data == b""


def test_base_that_no_line_wakes_is_not_put_to_sleep() -> None:
    rig = Rig(base=PlainBase())
    rig.drive(0.2, 1.0, 0.0, 0.0)
    assert b"sleep" not in rig.core.on_command(WheelCommand(seq=1, left=0.0, right=0.0, rest=True), 1.01).data
    rig.frame(1.02)
    assert rig.wheels(rig.command(1.03))[0] > 0.0
