"""The operator's commands for every state of a robot, without a robot."""

import msgspec
import pytest

from fog_contracts.messages import Mode, RobotState
from fognav_sim.drive.operator import FAULT_RESPONSE_S, HOLD_RESPONSE_S, STOP_RESPONSE_S, OperatorPolicy, Shuttle

WAITING = "not_enabled"


def state(mode: Mode, *codes: str, enabled: bool = True, reached: bool = False) -> RobotState:
    return RobotState(
        mode=mode, reasons=list(codes), codes=list(codes), enabled=enabled and mode != "INIT", battery=None,
        goal_id="g", map_epoch=1, map_seq=1, plan_id=1, goal_reached=reached, awaits_operator="passes" not in codes,
    )  # fmt: skip


def test_no_command_is_due_before_the_first_state() -> None:
    assert OperatorPolicy(0.0).command_due(1000.0) is None


def test_ready_robot_is_enabled_at_once_and_one_that_is_not_ready_after_a_while() -> None:
    policy = OperatorPolicy(0.0)
    policy.on_state(state("INIT", "pose_unknown", WAITING), 1.0)
    assert policy.command_due(1.0 + STOP_RESPONSE_S - 0.1) is None
    assert policy.command_due(1.0 + STOP_RESPONSE_S) == "enable"
    policy.on_state(state("INIT", WAITING), 2.0)
    assert policy.command_due(2.0) == "enable"
    assert policy.ready_s(5.0) == pytest.approx(4.0)


@pytest.mark.parametrize(
    ("mode", "after_s", "command"),
    [
        ("FAULT", FAULT_RESPONSE_S, "reset"),
        ("PROTECTIVE_STOP", STOP_RESPONSE_S, "enable"),
        ("HOLD", HOLD_RESPONSE_S, "enable"),
    ],
)
def test_operator_responds_to_a_stop_after_a_time_that_starts_with_the_mode(
    mode: Mode, after_s: float, command: str
) -> None:
    policy = OperatorPolicy(0.0)
    policy.on_state(state("NORMAL"), 1.0)
    policy.on_state(state(mode, "reason"), 10.0)
    policy.on_state(state(mode, "another reason"), 10.0 + after_s / 2)
    assert policy.command_due(10.0 + after_s - 0.01) is None
    assert policy.command_due(10.0 + after_s) == command


@pytest.mark.parametrize("mode", ["NORMAL", "DEGRADED", "PROTECTIVE_STOP"])
def test_no_command_is_due_while_the_robot_drives_or_goes_on_by_itself(mode: Mode) -> None:
    policy = OperatorPolicy(0.0)
    policy.on_state(state(mode, "passes"), 0.0)
    assert policy.command_due(1e6) is None
    assert policy.ready_s(1e6) == 0.0


def test_shuttle_alternates_between_its_places_with_one_goal_per_leg() -> None:
    shuttle = Shuttle("a", "b")
    assert shuttle.goal_due(state("INIT", WAITING)) is None
    places = []
    for _ in range(3):
        place = shuttle.goal_due(state("NORMAL"))
        assert place is not None
        shuttle.under_way = True
        assert shuttle.goal_due(state("NORMAL")) is None
        assert shuttle.on_state(state("NORMAL")) is None
        stopped = msgspec.structs.replace(state("INIT", WAITING), goal_reached=True)
        assert shuttle.on_state(stopped) is None
        assert shuttle.on_state(state("NORMAL", reached=True)) == place
        places.append(place)
    assert places == ["b", "a", "b"]
    assert shuttle.legs == 3
