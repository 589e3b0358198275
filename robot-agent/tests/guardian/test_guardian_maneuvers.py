"""What the guardian allows beyond ordinary driving, and everything by which it ends it. Limits are literal here."""

from __future__ import annotations

import pytest
from plain_base import DockingBase, PlainBase, Rig

from robot_agent.bases.roomba600.driver import Roomba600Driver, Roomba600Options
from robot_agent.bases.roomba600.emulator import FULL, PASSIVE, SAFE, Quirks, RoombaEmulator
from robot_agent.bases.roomba600.signature import STOP
from robot_agent.guardian.core import GuardianCore
from robot_agent.guardian.link import WheelCommand
from robot_agent.hardware import BaseReading, BaseStatus, WheelOdometry

BUMP = "the bumper is pressed (left)"


class Docking(Rig):
    """A base in front of its dock, or on it; every 0.02 s a frame and a command."""

    def __init__(self, *, base=None, **status) -> None:
        super().__init__(base=base or DockingBase())
        self.status = status
        self.travel = 0.0
        self.now = 0.2
        self.data = b""
        self.feedback = None
        self.asked = None
        self.speed = 0.0

    def step(self, asked="", speed=None, **status) -> bytes:
        """Ask for a maneuver (None: for none, as it was: the empty string); return what was written to the base."""
        self.asked = self.asked if asked == "" else asked
        self.speed = self.speed if speed is None else speed
        self.status.update(status)
        self.now = round(self.now + 0.02, 3)
        frame = self.frame(self.now, self.travel, **self.status)
        command = self.command(self.now, self.speed, self.speed, maneuver=self.asked)
        self.feedback = frame.feedback[-1] if frame.feedback else self.feedback
        return frame.data + command.data

    def feedback_of(self, now: float) -> str | None:
        return self.core._stopped(now)

    def steps(self, seconds: float, asked="", speed=None, **status) -> bytes:
        return b"".join(self.step(asked, speed, **status) for _ in range(round(seconds / 0.02)))


def seeking() -> Docking:
    rig = Docking()
    assert rig.step("seek_dock") == b"seek;"
    assert rig.core.moving
    return rig


# --- Seek Dock ---


def test_base_seeks_its_dock_as_long_as_it_is_asked_for_without_any_wheel_command():
    rig = seeking()
    assert rig.steps(55.0, speed=0.3) == b""
    assert rig.feedback.stopped is None
    assert rig.step(None, 0.0) == b"take;"
    assert not rig.core.moving
    assert rig.step("seek_dock") == b""


def told(rig: Docking, *, heard: bool) -> list[int]:
    """Return the hundredths of the next second in which the base is told to stop."""
    begin, at = rig.now, []
    for n in range(1, 100):
        frame = rig.frame(begin + n * 0.01, mode_problem="Full").data if heard else b""
        if (frame + rig.core.tick(begin + n * 0.01).data).endswith(b"take;"):
            at.append(n)
    return at


@pytest.mark.parametrize("heard", [True, False])
def test_base_that_does_not_report_its_driving_mode_is_told_to_stop_twice_every_0_3_s(heard):
    rig = seeking()
    assert rig.step(mode_problem="Full") == b"take;"
    at = told(rig, heard=heard)
    assert len(at) == 5
    assert all(earliest <= n <= earliest + 4 for n, earliest in zip(at, (5, 34, 39, 69, 74), strict=True))


def test_base_that_stays_in_a_mode_of_its_own_is_woken_from_the_start_after_a_second():
    rig = seeking()
    rig.step(mode_problem="Full")
    told(rig, heard=True)
    assert rig.core.tick(rig.now + 1.1).data == b"wake;"


def test_base_that_is_silent_in_a_mode_of_its_own_is_told_to_stop_on_and_on():
    rig = seeking()
    rig.step(mode_problem="Full")
    rig.now += 10.0
    assert len(told(rig, heard=False)) >= 5


def test_seeking_ends_when_no_command_is_fresh():
    rig = seeking()
    rig.frame(0.42)
    assert rig.core.tick(0.42).data == b""
    assert rig.core.tick(0.4201).data == b"take;"


def test_seeking_ends_with_the_link_to_the_agent():
    rig = seeking()
    assert rig.core.on_agent_lost(0.23).data == b"take;"


def test_seeking_ends_after_sixty_seconds_and_says_so_until_the_agent_stops_asking():
    rig = seeking()
    assert rig.steps(60.0) == b""
    assert rig.step() == b"take;"
    rig.steps(1.0)
    assert rig.feedback.stopped == "the base's search for its dock took longer than 60 s"
    rig.steps(0.2, None)
    assert rig.feedback.stopped is None
    assert rig.step("seek_dock") == b"seek;"


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_seeking_ends_after_five_metres_for_it_may_have_become_a_cleaning(sign):
    rig = seeking()
    rig.travel = sign * 4.99
    assert rig.step() == b""
    rig.travel = sign * 5.0
    assert rig.step() == b"take;"
    rig.steps(0.5)
    assert rig.feedback.stopped == "the base's search for its dock has reached its limit of 5.00 m"


@pytest.mark.parametrize(
    ("status", "fault"),
    [
        ({"bumper_left": True}, BUMP),
        ({"cliff": True}, "a cliff sensor sees no floor"),
        ({"wheel_drop": True}, "a wheel has dropped"),
        ({"mode_problem": "Full"}, "the base left its driving mode: Full"),
    ],
)
def test_each_fault_ends_seeking_within_its_frame(status, fault):
    rig = seeking()
    assert rig.step(**status) == b"take;"
    assert rig.core.latched.startswith(fault)
    assert rig.step() == b""


def test_blocked_motor_ends_seeking_after_0_3_s():
    rig = seeking()
    assert rig.steps(0.3, overcurrent=True) == b""
    assert rig.step() == b"take;"


def test_silent_base_is_told_to_stop_seeking():
    rig = seeking()
    assert rig.core.tick(0.52).data == b"take;"
    assert not rig.core.moving


def test_base_that_has_found_its_dock_is_left_to_charge_and_its_bumper_may_touch_the_dock():
    rig = seeking()
    assert rig.steps(1.0, charging=True, docked=True, bumper_left=True) == b""
    assert rig.feedback.stopped is None
    assert rig.step(None, bumper_left=False) == b"start;"
    assert rig.core.latched is None
    rig.steps(2.0)
    assert rig.feedback.stopped == "the base is on its charger, where it does not drive"
    assert set(rig.core.tick(rig.now + 0.06).data.decode().split(";")) <= {"0.0000,0.0000", "start", ""}


@pytest.mark.parametrize("status", [{"charging": True}, {"charging": True, "docked": True}])
def test_charging_base_does_not_seek(status):
    assert b"seek" not in Docking(**status).step("seek_dock")


def test_moving_base_and_one_with_a_fault_do_not_seek():
    rig = Docking()
    rig.steps(0.2, None, 0.1)
    assert b"seek" not in rig.step("seek_dock")
    rig = Docking()
    rig.step(None, cliff=True)
    assert b"seek" not in rig.step("seek_dock", cliff=False)


def test_base_without_a_dock_makes_no_maneuver():
    rig = Docking(base=PlainBase())
    assert b"seek" not in rig.steps(0.2, "seek_dock")
    assert not rig.core.moving
    rig = Docking(base=PlainBase(), charging=True, docked=True)
    rig.steps(0.2, "leave_dock", -0.1)
    assert not rig.core.moving
    assert rig.core.stop_command() == b"0.0000,0.0000;"


def test_ending_guardian_stops_a_base_that_seeks():
    assert seeking().core.stop_command() == b"take;"


def test_ending_guardian_stops_a_base_that_has_not_yet_obeyed_the_end_of_its_search():
    rig = seeking()
    assert rig.step(None) == b"take;"
    assert rig.core.stop_command() == b"take;", "the first one may have been lost"


# --- leaving the dock ---


def leaving() -> Docking:
    rig = Docking(charging=True, docked=True)
    assert rig.step("leave_dock", -0.3).startswith(b"full;")
    return rig


def test_base_leaves_its_dock_straight_back_and_slowly_then_drives_as_ever():
    rig = leaving()
    rig.steps(0.4)
    assert rig.wheels(rig.command(rig.now + 0.06, -0.4, -0.2, maneuver="leave_dock")) == (-0.1, -0.1)
    assert rig.feedback.stopped is None
    assert rig.step(charging=False, docked=False).endswith(b"take;")
    rig.steps(0.3)
    assert rig.wheels(rig.command(rig.now + 0.06, -0.08, -0.08)) is not None


@pytest.mark.parametrize(("left", "right"), [(0.3, 0.3), (0.1, -0.1), (0.0, 0.0)])
def test_base_never_drives_forwards_or_turns_on_its_dock(left, right):
    rig = leaving()
    rig.command(rig.now + 0.02, left, right, maneuver="leave_dock")
    assert rig.wheels(rig.command(rig.now + 0.1, left, right, maneuver="leave_dock")) == (0.0, 0.0)


def test_base_has_three_seconds_to_leave_its_dock():
    rig = leaving()
    assert b"start" not in rig.steps(3.0)
    assert rig.step().endswith(b"start;")
    rig.steps(0.1)
    assert rig.feedback.stopped == "leaving the dock took longer than 3 s"


@pytest.mark.parametrize("travel", [0.4, -0.4, float("nan")])
def test_base_has_0_4_m_to_leave_its_dock(travel):
    rig = leaving()
    rig.travel = 0.399 if travel > 0 else -0.399
    assert b"start" not in rig.step()
    rig.travel = travel
    assert rig.step().endswith(b"start;")
    assert "0.40 m" in rig.core._stopped(rig.now)


@pytest.mark.parametrize("status", [{"cliff": True}, {"wheel_drop": True}])
def test_each_fault_ends_leaving_within_its_frame_although_the_base_protects_itself_no_more(status):
    rig = leaving()
    rig.steps(0.2)
    assert rig.step(**status).startswith(b"start;")
    assert rig.core.latched is not None


def test_fault_counts_from_the_first_frame_off_the_dock_although_the_base_has_not_reported_its_mode_yet():
    passive = {"charging": True, "docked": True, "mode_problem": "Passive"}
    rig = Rig(base=DockingBase(), awake=False)
    rig.frame(0.2, **passive)
    assert rig.command(0.21, -0.1, -0.1, maneuver="leave_dock").data.startswith(b"full;")
    assert rig.frame(0.22, **passive, cliff=True).data == b"start;"
    assert rig.core.latched == "a cliff sensor sees no floor"


def test_base_that_was_told_to_stand_is_told_again_after_0_05_s_and_then_has_time_to_change_its_modes():
    rig = seeking()
    assert rig.step(None) == b"take;"
    ended = rig.now
    assert rig.core.tick(ended + 0.04).data == b""
    assert rig.core.tick(ended + 0.06).data == b"take;"
    assert rig.core.tick(ended + 0.12).data == b""
    rig.frame(ended + 0.25)
    assert rig.feedback_of(ended + 0.25) == "the base is not ready to drive yet", "it may be between its modes"
    rig.frame(ended + 0.27)
    assert rig.feedback_of(ended + 0.27) == "no fresh command from the agent"
    assert rig.command(ended + 0.28, 0.0, 0.0).data == b"0.0000,0.0000;"


def test_dock_that_presses_the_bumper_does_not_keep_the_base():
    rig = leaving()
    rig.steps(0.5, bumper_left=True)
    assert rig.core.moving
    assert rig.core.latched is None


def test_base_with_a_cable_in_it_stays_where_it_is():
    rig = Docking(charging=True, docked=False)
    assert b"full" not in rig.steps(0.2, "leave_dock", -0.1)
    assert not rig.core.moving


def test_base_that_is_not_ready_to_leave_is_asked_again():
    rig = Docking(charging=True, docked=True)
    rig.base.ready = False
    assert b"full" not in rig.steps(0.2, "leave_dock", -0.1)
    rig.base.ready = True
    assert b"full" in rig.step()


# --- backing off ---


def bumped() -> Docking:
    rig = Docking()
    rig.step(None, bumper_left=True)
    assert rig.core.latched == BUMP
    assert rig.feedback.bumped
    return rig


def test_bumped_robot_backs_off_slowly_and_its_fault_stays():
    rig = bumped()
    rig.steps(0.5, "back_off", -0.3)
    assert rig.core.moving
    assert rig.wheels(rig.command(rig.now + 0.06, -0.3, -0.3, maneuver="back_off")) == (-0.05, -0.05)
    assert rig.core.latched == BUMP
    rig.step(None)
    assert not rig.core.moving


def test_back_off_ends_with_zero_speed_and_the_base_stays_in_its_mode():
    rig = bumped()
    rig.steps(0.5, "back_off", -0.05)
    assert rig.step(None, 0.0) == b"0.0000,0.0000;"
    assert rig.feedback.stopped is None
    assert rig.core.stop_command() == b"0.0000,0.0000;"


def test_robot_backs_off_for_four_seconds_once():
    rig = bumped()
    rig.steps(3.98, "back_off", -0.05)
    assert rig.core.moving
    rig.steps(0.06)
    assert not rig.core.moving
    rig.steps(5.0)
    assert not rig.core.moving


def test_robot_backs_off_by_less_than_0_1_m():
    rig = bumped()
    rig.steps(0.5, "back_off", -0.05)
    rig.travel = -0.094
    rig.step()
    assert rig.core.moving
    rig.travel = -0.095
    rig.step()
    assert not rig.core.moving


@pytest.mark.parametrize("status", [{"cliff": True}, {"wheel_drop": True}, {"mode_problem": "Passive"}])
def test_other_fault_ends_backing_off_and_is_latched_instead(status):
    rig = bumped()
    rig.steps(0.2, "back_off", -0.05)
    rig.step(**status)
    assert not rig.core.moving
    assert rig.core.latched != BUMP
    assert not rig.feedback.bumped
    rig.steps(0.5, None)
    rig.steps(0.5, "back_off", -0.05)
    assert not rig.core.moving


@pytest.mark.parametrize("lifted", [{"cliff": True}, {"wheel_drop": True}])
def test_robot_that_was_lifted_or_stands_at_an_edge_after_its_bump_backs_off_no_more(lifted):
    rig = bumped()
    rig.steps(0.1, None, bumper_left=False, **lifted)
    rig.steps(0.1, None, **dict.fromkeys(lifted, False))
    assert (rig.core.latched, rig.feedback.bumped) == (BUMP, False)
    rig.steps(0.5, "back_off", -0.05)
    assert not rig.core.moving


def test_maneuver_begins_with_the_bases_own_bytes_and_no_others():
    rig = Docking()
    rig.steps(0.1, None)
    assert rig.step("leave_dock") == b"", "it is on no dock"
    rig = bumped()
    rig.steps(0.2, None)
    assert rig.step("back_off", 0.0) == b""
    assert rig.core.moving


def test_wheels_that_back_off_turn_at_the_mean_of_what_is_asked_for():
    rig = backing_off()
    rig.steps(0.5, speed=-0.02)
    assert rig.wheels(rig.command(rig.now + 0.06, -0.03, -0.01, maneuver="back_off")) == (-0.02, -0.02)


@pytest.mark.parametrize("left", [True, False])
def test_wheel_that_goes_too_far_ends_backing_off_while_the_other_stands(left):
    rig = backing_off()
    travel = WheelOdometry(left_m=-0.1 if left else 0.0, right_m=0.0 if left else -0.1)
    rig.base.frames.append(BaseReading(BaseStatus(), travel))
    rig.core.on_bytes(b"", rig.now + 0.02)
    rig.command(rig.now + 0.03, -0.05, -0.05, maneuver="back_off")
    assert not rig.core.moving


def test_other_maneuver_begins_at_once_after_one_that_was_ended_by_its_limit():
    rig = leaving()
    rig.steps(3.1)
    assert "took longer than 3 s" in rig.feedback.stopped
    rig.steps(2.0, speed=0.0, charging=False, docked=False)
    assert b"seek;" in rig.steps(0.2, "seek_dock")


def test_asking_for_another_maneuver_ends_the_one_that_runs():
    rig = bumped()
    rig.steps(0.2, "back_off", -0.05)
    assert rig.step("seek_dock") == b"0.0000,0.0000;"
    rig.steps(1.0)
    assert not rig.core.moving
    rig = seeking()
    assert rig.step("back_off", 0.0) == b"take;"
    rig.steps(1.0)
    assert not rig.core.moving


@pytest.mark.parametrize("status", [{}, {"cliff": True}])
def test_robot_that_ends_backing_off_stands_at_once(status):
    rig = bumped()
    rig.steps(0.5, "back_off", -0.05)
    ended = rig.step(None, 0.0, **status) + rig.steps(0.2)
    assert set(ended.decode().split(";")) <= {"0.0000,0.0000", ""}
    assert b"0.0000,0.0000;" in ended


def test_bumper_that_stays_pressed_while_backing_off_is_a_fault_after_the_reset_too():
    rig = bumped()
    rig.steps(0.5, "back_off", -0.05)
    rig.steps(0.2, None, 0.0)
    rig.command(rig.now + 0.02, 0.0, 0.0, reset=True)
    assert rig.core.latched is None
    rig.now = round(rig.now + 0.2, 3)
    rig.step(None, 0.1)
    assert rig.core.latched == BUMP
    assert not rig.core.moving


def test_robot_backs_off_from_nothing_but_a_bump():
    for status in ({}, {"cliff": True}):
        rig = Docking()
        rig.step(None, **status)
        rig.steps(0.2, "back_off", -0.05, **dict.fromkeys(status, False))
        assert not (status and rig.core.moving)
        assert rig.core._maneuvers.running is None


def test_reset_ends_backing_off():
    rig = bumped()
    rig.steps(0.2, "back_off", -0.05)
    assert rig.command(rig.now + 0.02, -0.05, -0.05, reset=True, maneuver="back_off").data == b"wake;"
    assert not rig.core.moving


# --- an agent that falls silent ---


def backing_off() -> Docking:
    rig = bumped()
    rig.steps(0.2, "back_off", -0.05)
    return rig


@pytest.mark.parametrize(
    ("begin", "name"),
    [(seeking, "the base's search for its dock"), (leaving, "leaving the dock"), (backing_off, "backing off")],
)
@pytest.mark.parametrize("gone", [False, True])
def test_maneuver_that_the_agents_silence_has_ended_says_so_and_begins_again_by_a_new_order_only(begin, name, gone):
    rig = begin()
    assert rig.core.moving
    rig.now += 0.22
    rig.frame(rig.now, **rig.status)
    rig.core.on_agent_lost(rig.now) if gone else rig.core.tick(rig.now)
    assert not rig.core.moving
    rig.steps(0.5)
    assert not rig.core.moving
    assert rig.feedback.stopped == (
        f"{name} was ended because the agent sent no fresh command: find in the agent's log why it was late or gone, "
        "then order it again"
    )
    asked = rig.asked
    rig.steps(0.2, None)
    assert "was ended" not in (rig.feedback.stopped or "")
    rig.steps(0.1, asked)
    assert rig.core.moving


@pytest.mark.parametrize("gone", [False, True])
def test_base_that_has_left_its_charger_while_the_agent_was_silent_is_done_and_drives_on(gone):
    rig = leaving()
    rig.now += 0.22
    rig.status.update(charging=False, docked=False)
    parted = rig.frame(rig.now, **rig.status)
    ended = rig.core.on_agent_lost(rig.now) if gone else rig.core.tick(rig.now)
    assert (parted.data + ended.data).endswith(b"take;")
    assert not rig.core.moving
    for _ in range(25):
        rig.step()
        assert "was ended" not in (rig.feedback.stopped or "")
    assert rig.feedback.stopped is None
    assert rig.core.moving, "the rest of the way is ordinary driving"


def test_maneuver_that_the_agent_has_ended_leaves_no_problem():
    rig = backing_off()
    rig.steps(0.2, None, 0.0)
    assert rig.feedback.stopped is None


# --- with the emulated Roomba ---


class Roomba:
    """Guardian and emulated Roomba, 0.7 m in front of its dock or on it; 10 ms a step, a command every fifth."""

    def __init__(self, ahead: float, **quirks) -> None:
        self.robot = RoombaEmulator(quirks=Quirks(**quirks))
        self.core = GuardianCore(Roomba600Driver(Roomba600Options()))
        self.ahead, self.now, self.asked, self.speed = ahead, 10.0, None, 0.0
        self.feedback = None
        self.full_s = 0.0
        self.run(1.5)

    def run(self, seconds: float, until=lambda _: False) -> bool:
        for step in range(round(seconds / 0.01)):
            self.now += 0.01
            left, right = self.robot.wheel_speeds_m_s
            assert self.robot.mode != FULL or left == right <= 0.0
            self.full_s += 0.01 * (self.robot.mode == FULL)
            self.robot.add_wheel_travel(left * 0.01, right * 0.01)
            self.ahead -= (left + right) / 2 * 0.01
            self.robot.set_dock(self.ahead, 0.0, 0.0)
            self.robot.tick(self.now, 0.01)
            for output in (self.core.on_bytes(self.robot.outgoing(self.now), self.now), self.core.tick(self.now)):
                self._apply(output)
            if step % 5 == 0:
                self._apply(
                    self.core.on_command(
                        WheelCommand(seq=step, left=self.speed, right=self.speed, maneuver=self.asked), self.now
                    )
                )
            if until(self):
                return True
        return False

    def _apply(self, output) -> None:
        self.robot.receive(output.data, self.now)
        self.feedback = output.feedback[-1] if output.feedback else self.feedback


QUIRKS = [{}, {"mode_offset": 1}, {"stays_safe_on_dock": True, "mode_offset": 1}, {"damaged": 9, "text_period_s": 0.5}]


@pytest.mark.parametrize("quirks", QUIRKS)
def test_roomba_drives_into_its_dock_charges_there_and_leaves_it(quirks):
    roomba = Roomba(0.7, **quirks)
    roomba.asked = "seek_dock"
    assert roomba.run(15.0, lambda r: r.feedback.status.docked)
    assert roomba.run(2.0) is False
    assert (roomba.robot.mode, roomba.robot.wheel_speeds_m_s, roomba.core.latched) == (PASSIVE, (0.0, 0.0), None)
    roomba.asked = None
    roomba.run(3.0)
    assert roomba.robot.mode == PASSIVE
    assert roomba.robot.battery.current_ma > 0
    before = roomba.ahead
    roomba.asked, roomba.speed = "leave_dock", -0.1
    assert roomba.run(5.0, lambda r: r.ahead - before > 0.25)
    assert roomba.core.latched is None
    assert roomba.robot.mode == SAFE
    assert 0.0 < roomba.full_s < 1.0


@pytest.mark.parametrize("quirks", [*QUIRKS, {"stays_safe_on_dock": True}])
def test_roomba_on_its_dock_charges_on_after_a_restart_of_the_guardian_and_leaves_it(quirks):
    roomba = Roomba(0.7, **quirks)
    roomba.asked = "seek_dock"
    assert roomba.run(15.0, lambda r: r.feedback.status.docked)
    roomba.asked = None
    roomba.run(1.0)
    roomba.robot.receive(STOP.stop, roomba.now)  # the watchdog's, which brings some into Safe mode on the dock, too
    for _ in range(10):  # it sends on while the next guardian starts
        roomba.now += 0.01
        roomba.robot.tick(roomba.now, 0.01)
    roomba.core = GuardianCore(Roomba600Driver(Roomba600Options()))
    roomba.run(3.0)
    assert roomba.robot.mode == PASSIVE
    assert roomba.robot.battery.current_ma > 0
    before = roomba.ahead
    roomba.asked, roomba.speed = "leave_dock", -0.1
    assert roomba.run(5.0, lambda r: r.ahead - before > 0.25), roomba.feedback.stopped
    assert (roomba.core.latched, roomba.robot.mode) == (None, SAFE)


def test_roomba_that_is_stopped_on_its_way_to_the_dock_is_in_safe_mode_within_0_1_s():
    roomba = Roomba(0.7)
    roomba.asked = "seek_dock"
    roomba.run(1.0)
    assert roomba.robot.wheel_speeds_m_s[0] > 0.0
    roomba.robot.world.bump_left = True
    assert roomba.run(0.1, lambda r: r.robot.wheel_speeds_m_s == (0.0, 0.0))
    roomba.run(0.1)
    assert (roomba.robot.mode, roomba.robot.wheel_speeds_m_s) == (SAFE, (0.0, 0.0))


def test_lost_stop_of_a_seeking_roomba_is_repeated():
    roomba = Roomba(0.7)
    roomba.asked = "seek_dock"
    roomba.run(1.0)
    receive, roomba.robot.receive = roomba.robot.receive, lambda *_: None
    roomba.asked = None
    roomba.run(0.06)
    roomba.robot.receive = receive
    assert roomba.robot.wheel_speeds_m_s[0] > 0.0
    assert roomba.run(0.11, lambda r: r.robot.wheel_speeds_m_s == (0.0, 0.0))


def test_roomba_that_sees_no_dock_gives_up_and_stands():
    roomba = Roomba(4.0)
    roomba.asked = "seek_dock"
    roomba.run(1.0)
    assert roomba.robot.seeking_dock
    assert roomba.run(25.0, lambda r: not r.robot.seeking_dock)
    assert roomba.robot.wheel_speeds_m_s == (0.0, 0.0)
