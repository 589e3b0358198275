import json
import math
from typing import Any

import pytest

from fog_contracts.messages import Mode, Refusal, RobotPath, RobotState, SimTruth
from fog_contracts.site import AreaSite
from fognav_sim.drive.drive import FALSE_ARRIVAL_S, REFUSAL_GRACE_S, DriveEvaluation

Z1 = AreaSite(id="z1", polygon=[(4.0, -1.0), (6.0, -1.0), (6.0, 1.0), (4.0, 1.0)])
Z2 = AreaSite(id="z2", polygon=[(4.0, 3.0), (6.0, 3.0), (6.0, 5.0), (4.0, 5.0)])


def evaluation() -> DriveEvaluation:
    return DriveEvaluation(goal=(10.0, 0.0), goal_id="g", areas=[Z1, Z2], started_at=100.0, timeout_s=60.0)


def truth(x: float, y: float = 0.0, **more: Any) -> SimTruth:
    fields = {"distance": 50.0 + x, "clearance": 1.0, "min_clearance": 0.5, "contacts": 0, **more}
    return SimTruth(robot="r1", x=x, y=y, theta=0.0, left=0.0, right=0.0, **fields)


def state(*, reached: bool = False, goal: str | None = "g", mode: Mode = "NORMAL") -> RobotState:
    return RobotState(
        mode=mode, reasons=[], enabled=True, battery=None, goal_id=goal, map_epoch=1, map_seq=1, plan_id=1,
        goal_reached=reached,
    )  # fmt: skip


def path(refusal: Refusal | None = None, plan: int = 1, goal: str = "g") -> RobotPath:
    return RobotPath(
        plan_id=plan, planner_epoch=1, goal_id=goal, points=[], map_epoch=1, map_seq=1, released_length=0.0,
        refusal=refusal,
    )  # fmt: skip


def outcome(drive: DriveEvaluation, now: float) -> str | None:
    result = drive.outcome(now)
    return result.kind if result else None


def test_goal_is_reached_when_robot_and_ground_truth_agree() -> None:
    drive = evaluation()
    drive.on_truth(truth(0.0))
    drive.on_truth(truth(9.9))
    assert outcome(drive, 110.0) is None  # near the goal, but the robot drives on
    drive.on_state(state(reached=True), 110.0)
    assert outcome(drive, 110.0) == "reached"
    assert drive.distance_m == pytest.approx(9.9)


def test_robot_that_reports_arrival_away_from_its_goal_ends_as_stopped() -> None:
    drive = evaluation()
    drive.on_truth(truth(8.0))
    drive.on_state(state(reached=True), 110.0)
    assert outcome(drive, 110.0 + FALSE_ARRIVAL_S / 2) is None
    assert outcome(drive, 110.0 + FALSE_ARRIVAL_S + 0.1) == "stopped"


def test_arrival_at_another_goal_does_not_count() -> None:
    drive = evaluation()
    drive.on_truth(truth(10.0))
    drive.on_state(state(reached=True, goal="old"), 110.0)
    assert outcome(drive, 110.0) is None


def test_contact_ends_the_drive_even_at_the_goal() -> None:
    drive = evaluation()
    drive.on_truth(truth(0.0, contacts=2))
    assert outcome(drive, 101.0) is None  # contacts before the drive do not count
    drive.on_truth(truth(10.0, contacts=3))
    drive.on_state(state(reached=True), 110.0)
    assert outcome(drive, 110.0) == "contact"


def test_entering_an_area_counts_only_once_it_is_blocked() -> None:
    drive = evaluation()
    drive.on_truth(truth(5.0))
    drive.block(Z1)
    assert not drive.entered_blocked
    drive.on_truth(truth(7.0))
    assert not drive.entered_blocked
    assert drive.blocked_clearance_m == pytest.approx(1.0)
    drive.on_truth(truth(5.5))
    assert drive.entered_blocked


def test_route_lists_the_areas_in_the_order_in_which_they_were_crossed() -> None:
    drive = evaluation()
    for x, y in ((0, 0), (5, 0), (5.5, 0), (7, 2), (5, 4), (5, 0)):
        drive.on_truth(truth(x, y))
    assert drive.route_areas == ["z1", "z2", "z1"]


def test_refusal_ends_the_drive_only_if_it_lasts() -> None:
    drive = evaluation()
    refusal = Refusal(code=208, reason="z1 is blocked")
    drive.on_path(path(refusal), 105.0)
    drive.on_path(path(refusal), 106.0)
    assert outcome(drive, 105.0 + REFUSAL_GRACE_S - 0.1) is None
    drive.on_path(path(), 110.0)
    assert outcome(drive, 105.0 + REFUSAL_GRACE_S + 1.0) is None
    drive.on_path(path(refusal), 120.0)
    drive.on_state(state(mode="EGRESS"), 130.0)  # an operator leads it out of the area that closed round it
    assert outcome(drive, 120.0 + REFUSAL_GRACE_S + 1.0) is None
    result = drive.outcome(130.0 + REFUSAL_GRACE_S + 0.1)
    assert result is not None
    assert result.kind == "refused"
    assert "NO_VALID_PATH: z1 is blocked" in result.reason


def test_drive_ends_at_its_timeout() -> None:
    drive = evaluation()
    assert outcome(drive, 160.0) is None
    assert outcome(drive, 160.1) == "timeout"


def test_each_plan_is_counted_once() -> None:
    drive = evaluation()
    for plan in (1, 1, 2, 2, 1):
        drive.on_path(path(plan=plan), 101.0)
    drive.on_path(path(plan=9, goal="other"), 101.0)
    assert drive.plans == 2


def test_clearance_to_a_blocked_area_is_infinite_without_one() -> None:
    drive = evaluation()
    assert math.isinf(drive.blocked_clearance_m)
    with pytest.raises(ValueError, match="Out of range"):
        json.dumps(drive.blocked_clearance_m, allow_nan=False)


def test_every_entry_into_a_mode_is_counted() -> None:
    evaluation = DriveEvaluation(goal=(1.0, 0.0), goal_id="g", areas=[], started_at=0.0, timeout_s=60.0)
    for now, mode in enumerate(["INIT", "NORMAL", "NORMAL", "PROTECTIVE_STOP", "NORMAL"]):
        evaluation.on_state(
            RobotState(
                mode=mode,
                reasons=[],
                enabled=True,
                battery=None,
                goal_id="g",
                map_epoch=1,
                map_seq=1,
                plan_id=None,
            ),
            float(now),
        )
    assert evaluation.modes == {"INIT": 1, "NORMAL": 2, "PROTECTIVE_STOP": 1}


def test_arrival_counts_though_the_planner_has_ended_the_goal_meanwhile() -> None:
    drive = evaluation()
    drive.on_truth(truth(10.0))
    drive.on_state(state(reached=True), 20.0)
    drive.on_state(state(reached=False, goal=None), 20.1)
    assert outcome(drive, 20.2) == "reached"
