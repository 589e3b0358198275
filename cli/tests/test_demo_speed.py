"""What a demo makes of lateness and of stops at a speed above 1: docs/adr/0008-what-excuses-a-demo.md."""

import pytest

from fog_contracts.messages import LoopHealth, Mode, RobotState, SimTruth
from fog_runtime.site import load_site
from fognav import checkout
from fognav.demo.attempt import Attempt
from fognav.demo.options import DrivePlan, Options
from fognav.demo.report import modes
from fognav.demo.scene import Scene
from fognav.demo.speed import SpeedWatch, TooFastError
from fognav_sim.drive.evaluation import DriveEvaluation, DriveOutcome

REACHED = DriveOutcome("reached", "the robot stands 0.08 m from its goal")
TIMEOUT = DriveOutcome("timeout", "the goal was not reached within 600 s")
SILENT = "no message from the guardian for 0.6 s"


class Drive:
    """An attempt in the midst of its drive; nothing runs."""

    def __init__(self, speed: float) -> None:
        site = load_site(checkout.root() / "sites" / "estig")
        plan = DrivePlan.of(site, Options(speed=speed))
        self.attempt = Attempt(plan, Scene(site, plan.robot, 1, speed))
        self.evaluation = self.attempt.evaluation = DriveEvaluation(
            goal=(59.0, 44.0), goal_id="g", areas=site.site.areas, started_at=0.0, timeout_s=600.0
        )
        self.hazard_done = True
        self.is_at(5.0, 25.4)
        self.robot_is("NORMAL")

    def is_at(self, x: float, y: float) -> None:
        self.truth = SimTruth(
            robot="r1", x=x, y=y, theta=0.0, left=0.0, right=0.0, distance=1.0, clearance=1.0, min_clearance=0.5,
            contacts=0, sustained_speed=self.attempt.scene.speed,
        )  # fmt: skip
        self.evaluation.on_truth(self.truth)

    def robot_is(self, mode: Mode, *reasons: str, late: int = 0) -> None:
        self.state = RobotState(
            mode=mode, reasons=list(reasons), enabled=True, battery=None, goal_id="g", map_epoch=1, map_seq=1,
            plan_id=1, loop=LoopHealth(late=late),
        )  # fmt: skip
        self.evaluation.on_state(self.state, 0.0)

    @property
    def watch(self) -> SpeedWatch:
        return self.attempt.speed_watch

    def check(self) -> None:
        stops = self.attempt.unexplained_stops()
        self.watch.check(6.0, self.truth, self.state, stops, entered_blocked=self.evaluation.entered_blocked)

    def end(self, outcome: DriveOutcome) -> None:
        stops = self.attempt.unexplained_stops()
        entered = self.evaluation.entered_blocked
        self.watch.check_outcome(outcome, self.truth, stops, entered_blocked=entered, hazard_done=self.hazard_done)


def test_arriving_after_a_stop_that_nothing_asked_for_keeps_no_speed_above_1() -> None:
    drive = Drive(3.0)
    drive.robot_is("PROTECTIVE_STOP", SILENT)
    drive.robot_is("NORMAL")
    drive.check()  # no beat was late: the drive goes on, and whatever it touches is seen
    with pytest.raises(TooFastError, match=f"stopped on its way: PROTECTIVE_STOP: {SILENT}"):
        drive.end(REACHED)
    assert modes(drive.attempt) == {"NORMAL": 2, "PROTECTIVE_STOP": 1}


def test_at_speed_1_a_stop_changes_nothing() -> None:
    drive = Drive(1.0)
    drive.robot_is("FAULT", SILENT, late=50)
    drive.check()
    drive.end(REACHED)


def test_arriving_without_a_stop_keeps_the_speed() -> None:
    drive = Drive(3.0)
    drive.robot_is("DEGRADED", "the map is 1.2 s old")
    drive.robot_is("HOLD", "the map is 3.2 s old")
    drive.check()
    drive.end(REACHED)
    assert drive.watch.sustained == 3.0


def test_a_stop_beside_late_beats_ends_the_attempt_at_once() -> None:
    drive = Drive(3.0)
    drive.robot_is("FAULT", SILENT, late=1)
    with pytest.raises(TooFastError, match=f"1 of the agent's beats late in 6 s; FAULT: {SILENT}"):
        drive.check()


def test_the_next_attempt_is_slower_than_what_was_sustained_and_never_slower_than_the_clock() -> None:
    assert TooFastError(2.4, "late").lower(3.0) == 2.1
    assert TooFastError(1.6, "late").lower(3.0) == 1.6
    assert TooFastError(0.8, "late").lower(3.0) == 1.0


def test_each_stop_is_weighed_against_the_beats_of_its_own_stretch() -> None:
    drive = Drive(3.0)
    drive.robot_is("PROTECTIVE_STOP", SILENT)
    drive.check()
    drive.robot_is("NORMAL", late=1)
    drive.check()


def test_a_stop_excuses_no_run_that_failed() -> None:
    drive = Drive(3.0)
    drive.robot_is("PROTECTIVE_STOP", "the pose is lost")
    drive.check()
    drive.end(TIMEOUT)


def test_a_run_in_which_nothing_was_blocked_failed_and_is_not_excused() -> None:
    drive = Drive(3.0)
    drive.hazard_done = False
    drive.robot_is("PROTECTIVE_STOP", SILENT)
    drive.end(REACHED)


def test_a_stop_after_a_process_died_is_as_it_should_be() -> None:
    drive = Drive(3.0)
    drive.attempt.restarts["robot-agent"] = 1
    drive.robot_is("PROTECTIVE_STOP", SILENT, late=1)
    drive.check()
    drive.end(REACHED)


@pytest.mark.parametrize("late", [0, 500])
def test_neither_a_touch_nor_a_blocked_area_entered_is_ever_excused(late: int) -> None:
    touched = Drive(3.0)
    touched.robot_is("NORMAL", late=late)
    touched.check()
    touched.robot_is("FAULT", "the bumper is pressed", late=late)
    touched.end(DriveOutcome("contact", "the robot made contact with an obstacle"))

    entered = Drive(3.0)
    z1 = next(area for area in entered.attempt.plan.site.site.areas if area.id == "z1")
    entered.evaluation.block(z1)
    entered.is_at(40.0, 28.0)
    entered.robot_is("PROTECTIVE_STOP", "the robot is in z1", late=late)
    for _ in range(3):
        entered.check()
        entered.robot_is("NORMAL", late=2 * late)
    entered.end(REACHED)
    entered.end(TIMEOUT)


def test_a_failure_while_beats_were_late_is_tried_again_more_slowly() -> None:
    drive = Drive(3.0)
    drive.robot_is("NORMAL", late=100)
    drive.check()
    with pytest.raises(TooFastError, match="timeout: the goal was not reached"):
        drive.end(TIMEOUT)
