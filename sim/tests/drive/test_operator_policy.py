"""What an operator does about a robot's states, swept without a robot."""

import msgspec
import pytest

from fog_contracts.messages import Mode, RobotState
from fognav_sim.drive.operator import FAULT_S, HELD_S, LOOK_S, OperatorPolicy, Shuttle

ASKS = "waiting for an operator to enable"


def state(mode: Mode, *reasons: str, enabled: bool = True, reached: bool = False) -> RobotState:
    return RobotState(
        mode=mode, reasons=list(reasons), enabled=enabled and mode != "INIT", battery=None, goal_id="g", map_epoch=1,
        map_seq=1, plan_id=1, goal_reached=reached,
    )  # fmt: skip


def test_nothing_is_due_before_the_robot_has_spoken() -> None:
    assert OperatorPolicy(0.0).command_due(1000.0) is None


def test_a_robot_that_lacks_only_the_operator_is_enabled_at_once_and_another_after_a_look() -> None:
    policy = OperatorPolicy(0.0)
    policy.on_state(state("INIT", "the pose is not known", ASKS), 1.0)
    assert policy.command_due(1.0 + LOOK_S - 0.1) is None
    assert policy.command_due(1.0 + LOOK_S) == "enable"
    policy.on_state(state("INIT", ASKS), 2.0)
    assert policy.command_due(2.0) == "enable"
    assert policy.ready_s(5.0) == pytest.approx(4.0)


@pytest.mark.parametrize(
    ("mode", "after_s", "command"), [("FAULT", FAULT_S, "reset"), ("PROTECTIVE_STOP", LOOK_S, "enable"),
                                     ("HOLD", HELD_S, "enable")]
)  # fmt: skip
def test_what_stands_is_looked_at_after_a_time_that_begins_with_its_mode(
    mode: Mode, after_s: float, command: str
) -> None:
    policy = OperatorPolicy(0.0)
    policy.on_state(state("NORMAL"), 1.0)
    policy.on_state(state(mode, "why"), 10.0)
    policy.on_state(state(mode, "why, still"), 10.0 + after_s / 2)
    assert policy.command_due(10.0 + after_s - 0.01) is None
    assert policy.command_due(10.0 + after_s) == command


@pytest.mark.parametrize("mode", ["NORMAL", "DEGRADED"])
def test_a_robot_that_drives_is_left_alone(mode: Mode) -> None:
    policy = OperatorPolicy(0.0)
    policy.on_state(state(mode), 0.0)
    assert policy.command_due(1e6) is None
    assert policy.ready_s(1e6) == 0.0


def test_a_shuttle_goes_back_and_forth_and_sends_once_for_each_leg() -> None:
    shuttle = Shuttle("a", "b")
    assert shuttle.goal_due(state("INIT", ASKS)) is None
    places = []
    for _ in range(3):
        place = shuttle.goal_due(state("NORMAL"))
        assert place is not None
        shuttle.under_way = True
        assert shuttle.goal_due(state("NORMAL")) is None
        assert shuttle.on_state(state("NORMAL")) is None
        stopped = msgspec.structs.replace(state("INIT", ASKS), goal_reached=True)
        assert shuttle.on_state(stopped) is None
        assert shuttle.on_state(state("NORMAL", reached=True)) == place
        places.append(place)
    assert places == ["b", "a", "b"]
    assert shuttle.legs == 3
