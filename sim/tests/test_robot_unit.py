"""The operator of the simulated robot in a container: arrivals, and the goals that follow them."""

from typing import Any, cast

import msgspec

from fog_contracts.messages import RobotState
from fog_runtime.health import Health
from fognav_sim.robot_unit import Settings, UnitHealth, _Operator, _programs


class Session:
    """Keeps the one handler that the operator registers."""

    def subscribe(self, _channel, _kind, handler, **_ids) -> None:
        self.handler = handler


def state(*, goal: str | None, reached: bool) -> RobotState:
    return RobotState(
        mode="NORMAL", reasons=[], enabled=True, battery=None, goal_id=goal, map_epoch=1, map_seq=1, plan_id=None,
        goal_reached=reached,
    )  # fmt: skip


def test_arrival_that_is_reported_between_two_looks_leads_to_the_next_goal(tmp_path):
    for name in ("key", "token"):
        (tmp_path / name).write_text("00" * 32)
    settings = Settings(
        site_dir=tmp_path, data_dir=tmp_path, run_dir=tmp_path, planner_url="http://127.0.0.1:1",
        token_file=tmp_path / "token", operator_key_file=tmp_path / "key",
    )  # fmt: skip
    session = Session()
    operator = _Operator(settings, "r1", ("a", "b"), cast("Any", session), Health())
    operator._shuttle.under_way = True
    session.handler({}, state(goal="g", reached=True))
    session.handler({}, state(goal=None, reached=False))
    assert operator._shuttle.legs == 1
    assert operator._shuttle.goal_due(state(goal=None, reached=False)) == "a"


def test_robot_is_well_while_it_speaks_and_is_in_no_fault():
    health = UnitHealth("r1")
    assert all(health.conditions(100.0).values()), "it has never spoken"
    driving = state(goal="g", reached=False)
    health.on_state(driving, 100.0)
    assert health.conditions(105.0) == {"speaks": "", "no_fault": ""}
    assert health.conditions(106.5)["speaks"] == "r1 has told no state for 6 s"
    health.on_state(msgspec.structs.replace(driving, mode="FAULT", reasons=["bumper", "cliff"]), 107.0)
    assert health.conditions(107.0) == {"speaks": "", "no_fault": "FAULT: bumper; cliff"}
    health.on_state(driving, 108.0)
    assert health.conditions(108.0) == {"speaks": "", "no_fault": ""}


def test_each_program_gets_its_own_credentials(tmp_path):
    settings = Settings(
        site_dir=tmp_path, data_dir=tmp_path, run_dir=tmp_path, planner_url="http://planner:8000",
        token_file=tmp_path / "token", operator_key_file=tmp_path / "key", credentials_dir=tmp_path / "own",
    )  # fmt: skip
    files = {each.name: each.environment.get("FOGNAV_CREDENTIALS_FILE") for each in _programs(settings, "r7")}
    assert files["simulator"] == str(tmp_path / "own" / "sim.toml")
    assert files["robot-agent"] == str(tmp_path / "own" / "r7.toml")
    assert files["watchdog"] is None
