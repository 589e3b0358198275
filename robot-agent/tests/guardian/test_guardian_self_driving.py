"""A base that drives off by itself, by its CLEAN button or its schedule, is stopped whatever state the guardian is in.

In its own Passive mode a Roomba ignores wheel speeds, zero too: only Start or Safe stop it there.
"""

from __future__ import annotations

import pytest
from plain_base import DockingBase, PlainBase, Rig

from robot_agent.bases.roomba600.driver import Roomba600Driver, Roomba600Options
from robot_agent.bases.roomba600.emulator import FULL, OFF, PASSIVE, SAFE, Quirks, RoombaEmulator
from robot_agent.guardian.core import GuardianCore
from robot_agent.guardian.link import WheelCommand

STEP_S = 0.01


class Roomba:
    """Guardian and emulated Roomba on the floor; the agent asks for zero speeds; `rolled` is how far it went (m)."""

    def __init__(self, **quirks) -> None:
        self.robot = RoombaEmulator(quirks=Quirks(**quirks))
        self.core = GuardianCore(Roomba600Driver(Roomba600Options(brc="rts")))
        self.now, self.rolled, self.rest, self.reset, self.feedback = 10.0, 0.0, False, False, None
        self.mute = self.deaf = self.back_off = False
        self.run(1.5)
        assert self.robot.mode == SAFE

    def run(self, seconds: float) -> None:
        for step in range(round(seconds / STEP_S)):
            self.now += STEP_S
            left, right = self.robot.wheel_speeds_m_s
            self.rolled += abs(left + right) / 2 * STEP_S
            self.robot.add_wheel_travel(left * STEP_S, right * STEP_S)
            self.robot.tick(self.now, STEP_S)
            sent = self.robot.outgoing(self.now)
            self._apply(self.core.on_bytes(b"" if self.mute else sent, self.now))
            self._apply(self.core.tick(self.now))
            if step % 5 == 0:
                speed, maneuver = (-0.05, "back_off") if self.back_off else (0.0, None)
                command = WheelCommand(
                    seq=step, left=speed, right=speed, rest=self.rest, reset=self.reset, maneuver=maneuver
                )
                self._apply(self.core.on_command(command, self.now))

    def _apply(self, output) -> None:
        if output.attempt is not None and output.attempt.line is not None:
            self.robot.pulse_wake_line(output.attempt.line.seconds)
        self.robot.receive(b"" if self.deaf else output.data, self.now)
        self.feedback = output.feedback[-1] if output.feedback else self.feedback

    def drop_wheel(self, seconds: float = 2.0) -> None:
        """Lift the robot for so long, and put it down again."""
        self.robot.world.wheel_drop_left = True
        self.run(seconds)
        assert self.core.latched.startswith("a wheel has dropped")
        self.robot.world.wheel_drop_left = False

    def assert_stops_cleaning(self) -> None:
        """Let its schedule begin a cleaning, which ends at once, in the mode in which none can begin."""
        self.robot.clean()
        self.run(3.0)
        assert self.rolled < 0.09, "0.3 m/s for 0.3 s at most"
        assert self.robot.mode == SAFE


@pytest.fixture(params=[{}, {"mode_offset": 1}, {"damaged": 9, "text_period_s": 0.5}])
def roomba(request) -> Roomba:
    return Roomba(**request.param)


@pytest.mark.parametrize("lifted_s", [0.05, 0.4, 3.0])
def test_roomba_that_was_put_down_with_its_fault_latched_does_not_clean(roomba, lifted_s):
    roomba.drop_wheel(lifted_s)
    roomba.run(0.02)
    roomba.robot.press_clean()
    roomba.run(5.0)
    assert roomba.rolled < 0.09, "0.3 m/s for 0.3 s at most"
    assert (roomba.robot.cleaning, roomba.robot.mode) == (False, SAFE), "where its buttons are without effect"
    assert roomba.core.latched is not None, "only an operator resets it"


def test_roomba_with_a_latched_fault_is_in_safe_mode_soon_after_it_was_put_down(roomba):
    roomba.drop_wheel()
    roomba.run(0.3)
    roomba.robot.press_clean()
    roomba.run(2.0)
    assert (roomba.rolled, roomba.robot.mode) == (0.0, SAFE)


def test_roomba_whose_fault_was_not_its_own_is_kept_out_of_passive_mode_too(roomba):
    roomba.robot.world.bump_left = True
    roomba.run(0.2)
    assert roomba.core.latched.startswith("the bumper is pressed")
    roomba.robot.world.wheel_drop_left = True
    roomba.run(0.5)
    assert roomba.robot.mode == PASSIVE
    roomba.robot.world.wheel_drop_left = False
    roomba.run(0.02)
    roomba.assert_stops_cleaning()


def test_roomba_that_is_being_woken_while_a_wheel_hangs_does_not_clean_when_it_is_put_down(roomba):
    roomba.drop_wheel()
    roomba.robot.world.wheel_drop_left = True
    roomba.reset = True
    roomba.run(0.06)
    roomba.reset = False
    roomba.run(2.0)
    assert roomba.core.latched is None
    roomba.robot.world.wheel_drop_left = False
    roomba.assert_stops_cleaning()


def test_roomba_that_went_off_under_a_latched_fault_is_stopped_when_it_drives(roomba):
    roomba.drop_wheel()
    roomba.run(1.0)
    roomba.robot.receive(bytes((7,)), roomba.now)  # as when its battery is seated anew: its stream is off
    assert roomba.robot.mode == OFF
    roomba.run(3.0)
    roomba.robot.clean()
    roomba.run(3.0)
    assert roomba.robot.wheel_speeds_m_s == (0.0, 0.0)
    assert roomba.core.latched.startswith("a wheel has dropped")
    assert (roomba.robot.mode, roomba.feedback.stopped) == (SAFE, None), "it is heard again"


@pytest.mark.parametrize("mute_after_s", [0.0, 0.5, 2.0])
def test_roomba_that_cannot_be_heard_under_a_latched_fault_is_kept_in_safe_mode(roomba, mute_after_s):
    roomba.drop_wheel(0.3)
    roomba.robot.world.wheel_drop_left = True
    roomba.run(mute_after_s)
    roomba.mute = True
    roomba.robot.world.wheel_drop_left = False
    roomba.run(2.0)
    for _ in range(20):
        roomba.run(0.17)
        assert roomba.robot.mode == SAFE
        roomba.robot.clean()
    assert roomba.rolled == 0.0


def test_robot_that_is_heard_again_is_reset_as_ever(roomba):
    roomba.robot.world.bump_left = True
    roomba.run(0.2)
    roomba.robot.world.bump_left = False
    roomba.mute = True
    roomba.run(5.0)
    roomba.mute = False
    roomba.reset = True
    roomba.run(0.06)
    roomba.reset = False
    roomba.run(1.0)
    assert (roomba.core.latched, roomba.robot.mode, roomba.feedback.stopped) == (None, SAFE, None)


def test_lifted_robot_backs_off_no_more_from_what_it_bumped_into_elsewhere(roomba):
    roomba.robot.world.bump_left = True
    roomba.run(0.2)
    assert roomba.feedback.bumped
    roomba.robot.world.bump_left = False
    roomba.robot.world.wheel_drop_left = True
    roomba.run(1.0)
    roomba.robot.world.wheel_drop_left = False
    roomba.run(1.0)
    assert not roomba.feedback.bumped
    roomba.back_off = True
    roomba.run(3.0)
    assert roomba.rolled == 0.0
    assert roomba.core.latched.startswith("the bumper is pressed")


@pytest.mark.parametrize("mode_s", [0.0, 0.01, 0.02])
def test_roomba_that_needs_time_for_each_change_of_its_mode_comes_to_rest_in_safe_mode(mode_s):
    roomba = Roomba(mode_change_s=mode_s)
    roomba.drop_wheel(0.5)
    roomba.run(1.0)
    for _ in range(50):
        roomba.run(0.1)
        assert roomba.robot.mode == SAFE
        assert roomba.feedback.stopped is None


def test_docked_roomba_with_a_latched_fault_charges_and_is_stopped_when_it_leaves(roomba):
    roomba.drop_wheel()
    roomba.robot.world.wheel_drop_left = True
    roomba.run(0.5)
    roomba.robot.set_dock(0.0, 0.0, 0.0)
    roomba.robot.world.wheel_drop_left = False
    roomba.run(3.0)
    assert roomba.robot.mode == PASSIVE
    assert roomba.robot.battery.current_ma > 0
    roomba.robot.press_clean()
    roomba.run(0.3)
    roomba.robot.set_dock(-0.03, 0.0, 0.0)
    roomba.run(2.0)
    assert roomba.rolled < 0.1
    assert roomba.robot.mode == SAFE
    assert roomba.core.latched is not None


@pytest.mark.parametrize("fault", [False, True])
def test_roomba_that_would_stay_in_safe_mode_charges_where_it_was_pushed_onto_its_dock(fault):
    roomba = Roomba(stays_safe_on_dock=True)
    if fault:
        roomba.drop_wheel()
        roomba.run(1.0)
    roomba.robot.set_dock(0.0, 0.0, 0.0)
    roomba.run(3.0)
    assert roomba.robot.mode == PASSIVE
    assert roomba.robot.battery.current_ma > 0


def test_charger_that_is_touched_for_a_moment_changes_nothing():
    roomba = Roomba(stays_safe_on_dock=True)
    for _ in range(3):
        for ahead_m, steps in ((0.0, 20), (-0.1, 30)):
            roomba.robot.set_dock(ahead_m, 0.0, 0.0)
            for _ in range(steps):
                roomba.run(0.02)
                assert roomba.robot.mode == SAFE
    assert roomba.core.latched is None


def test_roomba_that_did_not_hear_the_end_of_its_undocking_charges_on():
    roomba = Roomba()
    roomba.robot.set_dock(0.0, 0.0, 0.0)
    roomba.run(1.0)
    roomba.reset = True
    roomba.run(0.06)
    roomba.reset = False
    roomba.run(2.0)
    roomba.robot.mode = FULL  # as if nothing that ended it had been heard for a second
    roomba.run(3.0)
    assert roomba.robot.mode == PASSIVE
    assert roomba.robot.battery.current_ma > 0


def test_docked_roomba_is_told_to_stop_no_more_than_a_second_and_then_left_to_charge():
    rig = Rig(base=DockingBase())
    rig.frame(0.2, cliff=True)
    on_dock = {"mode_problem": "Passive", "charging": True, "docked": True}
    told = b"".join(rig.frame(0.2 + n * 0.1, **on_dock).data + rig.core.tick(0.2 + n * 0.1).data for n in range(1, 30))
    assert 2 <= told.count(b"start;") <= 8
    assert b"wake;" not in told
    assert b"start;" not in rig.frame(3.3, **on_dock).data + rig.core.tick(3.3).data


def test_base_of_another_kind_that_leaves_its_driving_mode_is_told_to_stand():
    rig = Rig(base=PlainBase())
    rig.frame(0.2, mode_problem="emergency stop pressed")
    assert rig.core.tick(0.26).data == b"0.0000,0.0000;"
    assert rig.frame(0.27, mode_problem="emergency stop pressed").data == b""


# --- asleep ---


def sleeping(**quirks) -> Roomba:
    roomba = Roomba(**quirks)
    roomba.rest = True
    roomba.run(2.0)
    assert roomba.robot.asleep
    return roomba


def test_sleeping_roomba_stays_asleep():
    roomba = sleeping()
    roomba.run(30.0)
    assert roomba.robot.asleep
    assert roomba.feedback.stopped == "the base is asleep to save power"


def test_roomba_that_its_schedule_wakes_is_stopped_and_sleeps_again():
    roomba = sleeping()
    roomba.robot.clean()
    roomba.run(3.0)
    assert roomba.rolled < 0.16, "0.3 m/s for half a second"
    assert roomba.robot.mode == SAFE
    roomba.run(62.0)
    assert roomba.robot.asleep
    roomba.run(10.0)
    assert roomba.robot.asleep


def test_roomba_that_its_button_wakes_sleeps_again():
    roomba = sleeping()
    for _ in range(2):
        roomba.robot.press_clean()
        roomba.run(0.1)
    roomba.run(65.0)
    assert roomba.rolled < 0.16
    assert roomba.robot.asleep


def test_roomba_that_questions_wake_is_asked_no_more_after_two_sleeps():
    roomba = Roomba(bytes_wake=True)
    roomba.rest = True
    roomba.run(0.5)
    for _ in range(2):
        assert roomba.robot.asleep
        roomba.run(3.0)
        assert roomba.robot.mode == SAFE
        roomba.run(58.0)
    assert roomba.robot.asleep
    roomba.run(120.0)
    assert roomba.robot.asleep


@pytest.mark.parametrize("after_s", [0.3, 0.9, 1.2, 1.6])
def test_button_that_wakes_a_roomba_as_soon_as_it_sleeps_is_not_taken_for_the_question(after_s):
    roomba = Roomba()
    roomba.rest = True
    roomba.run(0.3)
    assert roomba.robot.asleep
    roomba.run(after_s)
    roomba.robot.press_clean()
    roomba.run(70.0)
    assert roomba.robot.asleep
    roomba.robot.clean()
    roomba.run(5.0)
    assert roomba.rolled < 0.16


def test_roomba_that_did_not_hear_that_it_shall_sleep_is_told_again():
    roomba = Roomba()
    roomba.deaf = roomba.rest = True
    roomba.run(0.2)
    roomba.deaf = False
    roomba.run(65.0)
    assert roomba.robot.asleep


def test_sleeping_roomba_wakes_when_it_is_needed():
    roomba = sleeping()
    roomba.rest = False
    roomba.run(4.0)
    assert (roomba.robot.asleep, roomba.robot.mode, roomba.core.latched) == (False, SAFE, None)
