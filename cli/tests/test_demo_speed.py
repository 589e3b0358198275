"""When late processes and stops lower a demo's speed: docs/operator.md."""

import pytest

from fog_contracts.messages import LoopHealth, Mode, RobotState, SimTruth
from fog_runtime.configuration.site import load_site
from fognav import checkout
from fognav.demo.attempt import Attempt
from fognav.demo.machine import SpeedWatch, TooFastError
from fognav.demo.options import DrivePlan, Options
from fognav.demo.run import modes
from fognav.demo.scene import Scene
from fognav_sim.drive.drive import Drive, DriveOutcome

REACHED = DriveOutcome("reached", "the robot stands 0.08 m from its goal")
TIMEOUT = DriveOutcome("timeout", "the goal was not reached within 600 s")
REASON = "no message from the guardian for 0.6 s"


class DriveRig:
    """An attempt during its drive, without any process."""

    def __init__(self, speed: float) -> None:
        site = load_site(checkout.root() / "sites" / "estig")
        plan = DrivePlan.of(site, Options(speed=speed))
        self.attempt = Attempt(plan, Scene(site, plan.robot, 1, speed))
        self.hazard_placed = True
        self.set_position(5.0, 25.4)
        self.drive = self.attempt.drive = Drive(
            goal=(59.0, 44.0), goal_id="g", areas=site.site.areas, truth=self.truth, now=0.0, hazard=None
        )
        self.evaluation = self.drive.evaluation
        self.set_mode("NORMAL")

    def set_position(self, x: float, y: float) -> None:
        self.truth = SimTruth(
            robot="r1", x=x, y=y, theta=0.0, left=0.0, right=0.0, distance=1.0, clearance=1.0, min_clearance=0.5,
            contacts=0, sustained_speed=self.attempt.scene.speed,
        )  # fmt: skip
        if self.attempt.drive is not None:
            self.attempt.drive.on_truth(self.truth)

    def set_mode(self, mode: Mode, *reasons: str, late: int = 0) -> None:
        self.state = RobotState(
            mode=mode, reasons=list(reasons), enabled=True, battery=None, goal_id="g", map_epoch=1, map_seq=1,
            plan_id=1, loop=LoopHealth(late=late),
        )  # fmt: skip
        self.drive.on_state(self.state, 0.0)

    @property
    def watch(self) -> SpeedWatch:
        return self.attempt.speed_watch

    def check(self) -> None:
        stops = self.attempt.unexplained_stops()
        self.watch.check(6.0, self.truth, self.state, stops, entered_blocked=self.evaluation.entered_blocked)

    def end(self, outcome: DriveOutcome) -> None:
        stops = self.attempt.unexplained_stops()
        entered = self.evaluation.entered_blocked
        self.watch.check_outcome(outcome, self.truth, stops, entered_blocked=entered, hazard_placed=self.hazard_placed)


def test_drive_with_an_unexplained_stop_lowers_a_speed_above_1() -> None:
    drive = DriveRig(3.0)
    drive.set_mode("PROTECTIVE_STOP", REASON)
    drive.set_mode("NORMAL")
    drive.check()  # no cycle was late: the drive continues, so that a contact would be noticed
    with pytest.raises(TooFastError, match=f"but stopped before: PROTECTIVE_STOP: {REASON}"):
        drive.end(REACHED)
    assert modes(drive.attempt) == {"NORMAL": 2, "PROTECTIVE_STOP": 1}


def test_stop_at_speed_1_changes_nothing() -> None:
    drive = DriveRig(1.0)
    drive.set_mode("FAULT", REASON, late=50)
    drive.check()
    drive.end(REACHED)


def test_drive_without_a_stop_keeps_the_speed() -> None:
    drive = DriveRig(3.0)
    drive.set_mode("DEGRADED", "the map is 1.2 s old")
    drive.set_mode("HOLD", "the map is 3.2 s old")
    drive.check()
    drive.end(REACHED)
    assert drive.watch.sustained == 3.0


def test_stop_with_late_cycles_ends_the_attempt_at_once() -> None:
    drive = DriveRig(3.0)
    drive.set_mode("FAULT", REASON, late=1)
    with pytest.raises(TooFastError, match=f"1 of the agent's cycles late in 6 s; FAULT: {REASON}"):
        drive.check()


def test_next_speed_is_at_most_the_sustained_one_and_at_least_1() -> None:
    assert TooFastError(2.4, "late").lower(3.0) == 2.1
    assert TooFastError(1.6, "late").lower(3.0) == 1.6
    assert TooFastError(0.8, "late").lower(3.0) == 1.0


def test_stop_counts_only_with_late_cycles_since_the_last_check() -> None:
    drive = DriveRig(3.0)
    drive.set_mode("PROTECTIVE_STOP", REASON)
    drive.check()
    drive.set_mode("NORMAL", late=1)
    drive.check()


def test_stop_does_not_excuse_a_failed_drive() -> None:
    drive = DriveRig(3.0)
    drive.set_mode("PROTECTIVE_STOP", "the pose is lost")
    drive.check()
    drive.end(TIMEOUT)


def test_stop_does_not_excuse_a_drive_without_its_hazard() -> None:
    drive = DriveRig(3.0)
    drive.hazard_placed = False
    drive.set_mode("PROTECTIVE_STOP", REASON)
    drive.end(REACHED)


def test_stop_after_a_process_died_is_expected() -> None:
    drive = DriveRig(3.0)
    drive.attempt.restarts["robot-agent"] = 1
    drive.set_mode("PROTECTIVE_STOP", REASON, late=1)
    drive.check()
    drive.end(REACHED)


@pytest.mark.parametrize("late", [0, 500])
def test_contact_and_entering_a_blocked_area_are_never_excused(late: int) -> None:
    contact = DriveRig(3.0)
    contact.set_mode("NORMAL", late=late)
    contact.check()
    contact.set_mode("FAULT", "the bumper is pressed", late=late)
    contact.end(DriveOutcome("contact", "the robot made contact with an obstacle"))

    entered = DriveRig(3.0)
    z1 = next(area for area in entered.attempt.plan.site.site.areas if area.id == "z1")
    entered.evaluation.block(z1)
    entered.set_position(40.0, 28.0)
    entered.set_mode("PROTECTIVE_STOP", "the robot is in z1", late=late)
    for _ in range(3):
        entered.check()
        entered.set_mode("NORMAL", late=2 * late)
    entered.end(REACHED)
    entered.end(TIMEOUT)


def test_failed_drive_with_late_cycles_is_repeated_more_slowly() -> None:
    drive = DriveRig(3.0)
    drive.set_mode("NORMAL", late=100)
    drive.check()
    with pytest.raises(TooFastError, match="timeout: the goal was not reached"):
        drive.end(TIMEOUT)
