"""The operator of the simulated robot in a container: arrivals, and the goals that follow them."""

from typing import Any, cast

from fog_contracts.messages import RobotState
from fognav_sim.robot_unit import Settings, _Operator


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
    operator = _Operator(settings, "r1", ("a", "b"), cast("Any", session))
    operator._shuttle.under_way = True
    session.handler({}, state(goal="g", reached=True))
    session.handler({}, state(goal=None, reached=False))
    assert operator._shuttle.legs == 1
    assert operator._shuttle.goal_due(state(goal=None, reached=False)) == "a"
