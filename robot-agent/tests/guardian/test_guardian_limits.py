"""The guardian's limits as numbers: they are part of the robot's design, so no test takes them from the code."""

from __future__ import annotations

import pytest
from plain_base import Rig

from robot_agent.guardian.core import Limits
from robot_agent.hardware import BaseReading, BaseStatus, WheelOdometry

DROPPED = "a wheel has dropped: the robot was lifted or hangs over an edge"


def test_command_is_fresh_for_0_2_s_and_no_longer() -> None:
    rig = Rig()
    assert rig.drive(0.1, 1.0) == (0.1, 0.1)
    rig.frame(1.19)
    assert rig.wheels(rig.core.tick(1.199)) == (0.1, 0.1)
    assert rig.wheels(rig.core.tick(1.201)) == (0.0, 0.0)


@pytest.mark.parametrize(("at", "expected"), [(1.049, None), (1.051, (0.1, 0.1))])
def test_unchanged_command_is_repeated_every_0_05_s(at, expected) -> None:
    rig = Rig()
    rig.drive(0.1, 0.94)
    rig.frame(1.0)
    assert rig.wheels(rig.command(1.0)) == (0.1, 0.1)
    assert rig.wheels(rig.core.tick(at)) == expected


def test_wheel_gains_1_65_m_s2_and_at_most_0_06_s_at_once() -> None:
    rig = Rig()
    assert rig.wheels(rig.command(0.12, 0.3, 0.3)) == pytest.approx((0.033, 0.033), abs=1e-4)
    rig.frame(0.3)
    assert rig.wheels(rig.command(0.32, 0.3, 0.3)) == pytest.approx((0.132, 0.132), abs=1e-4)


def test_wheel_slows_down_at_once_and_reverses_through_zero() -> None:
    rig = Rig()
    rig.drive(0.1, 1.0, 0.3, 0.3)
    assert rig.wheels(rig.command(1.001, 0.05, 0.05)) == (0.05, 0.05)
    left, right = rig.wheels(rig.command(1.011, -0.3, -0.3))
    assert (left, right) == pytest.approx((-0.0165, -0.0165), abs=1e-4)


@pytest.mark.parametrize(
    ("asked", "driven"),
    [
        ((0.31, 0.31), (0.31, 0.31)),
        ((0.5, 0.5), (0.31, 0.31)),
        ((-0.5, -0.5), (-0.31, -0.31)),
        ((0.5, 0.25), (0.4133, 0.2067)),
        ((0.5, -0.5), (0.5, -0.5)),
    ],
)
def test_mean_speed_is_0_31_m_s_at_most_and_the_curve_is_kept(asked, driven) -> None:
    assert Rig().drive(0.1, 1.0, *asked) == pytest.approx(driven, abs=1e-4)


@pytest.mark.parametrize(("limits", "top_speed"), [(Limits(wheel=0.2), 0.5), (Limits(), 0.2)])
def test_no_wheel_is_faster_than_the_limit_or_its_base(limits, top_speed) -> None:
    assert Rig(limits, top_speed).drive(0.1, 1.0, 0.4, -0.2) == pytest.approx((0.2, -0.1), abs=1e-4)


@pytest.mark.parametrize(("silent_s", "faulty"), [(0.299, False), (0.301, True)])
def test_base_may_be_silent_for_its_timeout_of_0_3_s(silent_s, faulty) -> None:
    rig = Rig()
    rig.drive(0.1, 1.0)
    rig.core.tick(1.0 + silent_s)
    assert (rig.core.latched is not None) == faulty
    if faulty:
        assert "has sent no valid frame for 0.3 s" in rig.core.latched


@pytest.mark.parametrize(("seconds", "faulty"), [(0.299, False), (0.301, True)])
def test_overcurrent_is_a_fault_after_0_3_s(seconds, faulty) -> None:
    rig = Rig()
    rig.frame(1.0, overcurrent=True)
    rig.frame(1.0 + seconds, overcurrent=True)
    assert (rig.core.latched is not None) == faulty


def test_overcurrent_that_pauses_begins_anew() -> None:
    rig = Rig()
    rig.frame(1.0, overcurrent=True)
    rig.frame(1.2)
    rig.frame(1.25, overcurrent=True)
    rig.frame(1.5, overcurrent=True)
    assert rig.core.latched is None


def test_overcurrent_that_pauses_begins_anew_although_a_driver_gives_an_earlier_status_again() -> None:
    rig = Rig()
    calm, surge, odometry = BaseStatus(), BaseStatus(overcurrent=True), WheelOdometry(left_m=0.0, right_m=0.0)
    for now, status in ((1.0, calm), (1.1, surge), (1.2, calm), (1.3, surge), (1.5, surge)):
        rig.base.frames.append(BaseReading(status, odometry))
        rig.core.on_bytes(b"", now)
    assert rig.core.latched is None


@pytest.mark.parametrize(
    ("status", "code", "reason"),
    [
        ({"cliff": True}, "cliff", "a cliff sensor sees no floor"),
        ({"wheel_drop": True}, "wheel_drop", DROPPED),
        ({"bumper_left": True}, "bumper", "the bumper is pressed (left)"),
        ({"bumper_right": True}, "bumper", "the bumper is pressed (right)"),
        ({"bumper_left": True, "bumper_right": True}, "bumper", "the bumper is pressed (both sides)"),
        ({"mode_problem": "it sleeps"}, "mode_left", "the base left its driving mode: it sleeps"),
        ({"mode_problem": "it sleeps", "mode_code": "nap"}, "nap", "the base left its driving mode: it sleeps"),
        ({"cliff": True, "mode_problem": "it sleeps"}, "cliff", "a cliff sensor sees no floor"),
        ({"wheel_drop": True, "bumper_left": True}, "wheel_drop", DROPPED),
    ],
)
def test_each_fault_stops_the_wheels_in_its_frame_and_the_first_one_stays(status, code, reason) -> None:
    rig = Rig()
    assert rig.drive(0.1, 1.0) == (0.1, 0.1)
    output = rig.frame(1.001, **status)
    assert rig.wheels(output) == (0.0, 0.0)
    assert rig.core.latched == reason
    assert (output.feedback[-1].fault, output.feedback[-1].fault_code) == (reason, code)
    assert rig.frame(1.02).data == b""
    assert rig.frame(1.03, cliff=True, bumper_right=True).data == b""
    assert rig.core.latched == reason
    assert rig.wheels(rig.command(1.06)) in {None, (0.0, 0.0)}
    output = rig.command(1.07, reset=True)
    assert (output.data, rig.core.latched) == (b"wake;", None)
    assert rig.wheels(rig.command(1.08)) is None, "no wheel turns before the base is awake again"
    rig.frame(1.16)
    assert rig.wheels(rig.command(1.165)) is None, "frames within 0.1 s of the wake command may be older"
    rig.frame(1.18)
    assert rig.wheels(rig.command(1.2)) == pytest.approx((0.033, 0.033), abs=1e-4)


def test_reset_without_a_fault_is_an_ordinary_command() -> None:
    rig = Rig()
    assert rig.wheels(rig.command(0.12, reset=True)) == pytest.approx((0.033, 0.033), abs=1e-4)


def test_lost_agent_stops_the_wheels_at_once() -> None:
    rig = Rig()
    rig.drive(0.1, 1.0)
    assert rig.wheels(rig.core.on_agent_lost(1.001)) == (0.0, 0.0)
    assert rig.wheels(rig.core.tick(1.06)) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("turning", "after_s", "count"), [(True, 0.044, 0), (True, 0.046, 1), (False, 0.089, 0), (False, 0.091, 1)]
)
def test_feedback_is_due_every_0_045_s_while_the_wheels_turn_and_every_0_09_s_at_rest(turning, after_s, count) -> None:
    rig = Rig()
    rig.frame(1.0)
    rig.frame(1.1)
    assert len(rig.frame(1.1 + after_s, travel=0.01 if turning else 0.0).feedback) == count


def test_change_of_the_status_is_reported_at_once_but_for_the_battery() -> None:
    rig = Rig()
    rig.frame(1.0)
    rig.frame(1.1)
    assert rig.frame(1.11, battery=0.4).feedback == ()
    (feedback,) = rig.frame(1.12, overcurrent=True).feedback
    assert feedback.status.overcurrent
    assert feedback.stopped == "no fresh command from the agent"


def test_base_that_is_not_awake_is_woken_again_after_its_timeout_and_held_meanwhile() -> None:
    rig = Rig(awake=False)
    assert rig.core.tick(0.049).data == b""
    assert rig.core.tick(0.051).data == b"0.0000,0.0000;"
    assert rig.core.tick(0.999).data == b"0.0000,0.0000;"
    assert rig.core.tick(1.001).data == b"wake;"
    assert rig.command(1.002).data == b""
