import json
import math
from typing import Any

import msgspec
import pytest

from fog_contracts.messages import Refusal, RobotPath, RobotState, SimTruth, Trace
from fog_contracts.site import AreaSite
from fognav.demo.judge import CLAIM_S, REFUSAL_S, Judge, Traces, hazard_to_path_ms, stages_ms

Z1 = AreaSite(id="z1", polygon=[(4.0, -1.0), (6.0, -1.0), (6.0, 1.0), (4.0, 1.0)])
Z2 = AreaSite(id="z2", polygon=[(4.0, 3.0), (6.0, 3.0), (6.0, 5.0), (4.0, 5.0)])


def judge() -> Judge:
    return Judge(goal=(10.0, 0.0), goal_id="g", areas=[Z1, Z2], begun=100.0, timeout_s=60.0)


def truth(x: float, y: float = 0.0, **more: Any) -> SimTruth:
    known = {"distance": 50.0 + x, "clearance": 1.0, "min_clearance": 0.5, "contacts": 0, **more}
    return SimTruth(robot="r1", x=x, y=y, theta=0.0, left=0.0, right=0.0, **known)


def state(*, reached: bool, goal: str | None = "g") -> RobotState:
    return RobotState(
        mode="NORMAL", reasons=[], enabled=True, battery=None, goal_id=goal, map_epoch=1, map_seq=1, plan_id=1,
        goal_reached=reached,
    )  # fmt: skip


def path(refusal: Refusal | None = None, plan: int = 1, goal: str = "g") -> RobotPath:
    return RobotPath(
        plan_id=plan, planner_epoch=1, goal_id=goal, points=[], map_epoch=1, map_seq=1, released_length=0.0,
        refusal=refusal,
    )  # fmt: skip


def outcome(j: Judge, now: float) -> str | None:
    verdict = j.verdict(now)
    return verdict.outcome if verdict else None


def test_reached_is_what_the_truth_and_the_robot_agree_on() -> None:
    j = judge()
    j.on_truth(truth(0.0))
    j.on_truth(truth(9.9))
    assert outcome(j, 110.0) is None  # near the goal, but the robot drives on
    j.on_state(state(reached=True), 110.0)
    assert outcome(j, 110.0) == "reached"
    assert j.distance_m == pytest.approx(9.9)
    assert j.success("reached")


def test_a_robot_that_believes_to_have_arrived_elsewhere_has_not() -> None:
    j = judge()
    j.on_truth(truth(8.0))
    j.on_state(state(reached=True), 110.0)
    assert outcome(j, 110.0 + CLAIM_S / 2) is None
    assert outcome(j, 110.0 + CLAIM_S + 0.1) == "stopped"


def test_arriving_at_another_goal_is_not_arriving() -> None:
    j = judge()
    j.on_truth(truth(10.0))
    j.on_state(state(reached=True, goal="old"), 110.0)
    assert outcome(j, 110.0) is None


def test_a_touch_ends_the_run_even_at_the_goal() -> None:
    j = judge()
    j.on_truth(truth(0.0, contacts=2))
    assert outcome(j, 101.0) is None  # what was touched before the drive does not count
    j.on_truth(truth(10.0, contacts=3))
    j.on_state(state(reached=True), 110.0)
    assert outcome(j, 110.0) == "contact"


def test_entering_an_area_counts_only_after_it_was_blocked() -> None:
    j = judge()
    j.on_truth(truth(5.0))
    j.block(Z1)
    assert not j.entered_blocked
    j.on_truth(truth(7.0))
    assert j.success("reached")
    assert j.blocked_clearance_m == pytest.approx(1.0)
    j.on_truth(truth(5.5))
    assert j.entered_blocked
    assert not j.success("reached")


def test_the_route_names_the_areas_in_the_order_in_which_they_were_crossed() -> None:
    j = judge()
    for x, y in ((0, 0), (5, 0), (5.5, 0), (7, 2), (5, 4), (5, 0)):
        j.on_truth(truth(x, y))
    assert j.route_areas == ["z1", "z2", "z1"]


def test_a_refusal_is_final_only_when_it_stands() -> None:
    j = judge()
    no_way = Refusal(code=208, reason="z1 is blocked")
    j.on_path(path(no_way), 105.0)
    j.on_path(path(no_way), 106.0)
    assert outcome(j, 105.0 + REFUSAL_S - 0.1) is None
    j.on_path(path(), 110.0)
    assert outcome(j, 105.0 + REFUSAL_S + 1.0) is None
    j.on_path(path(no_way), 130.0)
    verdict = j.verdict(130.0 + REFUSAL_S + 0.1)
    assert verdict is not None
    assert verdict.outcome == "refused"
    assert "NO_VALID_PATH: z1 is blocked" in verdict.reason


def test_time_runs_out() -> None:
    j = judge()
    assert outcome(j, 160.0) is None
    assert outcome(j, 160.1) == "timeout"


def test_plans_are_counted_once_each() -> None:
    j = judge()
    for plan in (1, 1, 2, 2, 1):
        j.on_path(path(plan=plan), 101.0)
    j.on_path(path(plan=9, goal="other"), 101.0)
    assert j.paths == 2


FULL = Trace(
    area="z1", epoch=1, seq=4, first_reading=10.0, confirmed=10.45, costmap_published=10.47, plan_published=10.5,
    path_received=10.51, first_command=10.6,
)  # fmt: skip


def test_stages_add_up_to_the_whole_way_of_a_hazard() -> None:
    took = stages_ms(FULL)
    assert list(took) == ["debounce", "costmap", "plan", "deliver", "command"]
    assert sum(took.values()) == pytest.approx(600.0)
    assert hazard_to_path_ms(FULL) == pytest.approx(510.0)


def test_traces_of_one_hazard_are_merged_from_whoever_tells_of_them() -> None:
    traces = Traces()
    traces.take([msgspec.structs.replace(FULL, path_received=0.0, first_command=0.0)])
    assert hazard_to_path_ms(traces.of("z1", since=9.0)) is None
    traces.take([msgspec.structs.replace(FULL, first_reading=0.0, confirmed=0.0)])
    assert traces.of("z1", since=9.0) == FULL


def test_only_the_hazard_of_this_barrier_is_measured() -> None:
    traces = Traces()
    earlier = msgspec.structs.replace(FULL, seq=2, first_reading=5.0)
    later = msgspec.structs.replace(FULL, seq=9, first_reading=30.0)
    elsewhere = msgspec.structs.replace(FULL, area="z2", first_reading=9.5)
    traces.take([later, elsewhere, earlier, FULL])
    assert traces.of("z1", since=9.0) == FULL
    assert traces.of("z3", since=0.0) is None


def test_a_trace_that_is_under_way_tells_what_it_knows() -> None:
    begun = Trace(area="z1", epoch=1, seq=1, first_reading=1.0, confirmed=1.5)
    assert stages_ms(begun) == {"debounce": 500.0}
    assert stages_ms(None) == {}


def test_what_was_never_measured_is_no_number() -> None:
    j = judge()
    assert math.isinf(j.blocked_clearance_m)
    with pytest.raises(ValueError, match="Out of range"):
        json.dumps(j.blocked_clearance_m, allow_nan=False)


def test_each_entry_into_a_mode_is_counted() -> None:
    judge = Judge(goal=(1.0, 0.0), goal_id="g", areas=[], begun=0.0, timeout_s=60.0)
    for now, mode in enumerate(["INIT", "NORMAL", "NORMAL", "PROTECTIVE_STOP", "NORMAL"]):
        judge.on_state(
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
    assert judge.modes == {"INIT": 1, "NORMAL": 2, "PROTECTIVE_STOP": 1}
