"""Robots that want to their docks: who is sent where, once, and what becomes of a refusal or a lost store."""

from __future__ import annotations

import asyncio

import pytest

from fog_contracts.messages import Pose, Refusal, RobotGoal, RobotState
from fog_contracts.site import RobotSite, Site
from fog_runtime.stores.redis_connection import StoreError
from planner.dock_missions import DockGoals, DockMissions
from planner.store import NO_MISSION, MissionConflictError

FRONT = Pose(x=1.0, y=2.0, theta=0.5)


def state(*, wants_dock: bool = True, goal_id: str | None = None) -> RobotState:
    return RobotState(
        mode="NORMAL", reasons=[], enabled=True, battery=0.1, goal_id=goal_id, map_epoch=1, map_seq=1, plan_id=None,
        wants_dock=wants_dock,
    )  # fmt: skip


def goal(pose: Pose | None) -> RobotGoal:
    return RobotGoal(goal_id="g", pose=pose, stamp=0.0)


def test_robot_that_wants_to_its_dock_is_sent_in_front_of_it_from_any_other_goal() -> None:
    assert DockGoals({"r1": FRONT}).due("r1", state(), None, 5.0) == FRONT
    elsewhere = goal(Pose(x=9.0, y=9.0, theta=0.0))
    assert DockGoals({"r1": FRONT}).due("r1", state(goal_id="g"), elsewhere, 5.0) == FRONT


def test_robot_that_has_not_heard_yet_where_an_operator_sent_it_is_not_sent_to_its_dock() -> None:
    docks, elsewhere = DockGoals({"r1": FRONT}), goal(Pose(x=9.0, y=9.0, theta=0.0))
    assert docks.due("r1", state(), elsewhere, 5.0) is None
    assert docks.due("r1", state(goal_id="an earlier one"), elsewhere, 5.0) is None
    assert docks.due("r1", state(goal_id="cancelled meanwhile"), None, 5.0) is None


def test_robot_that_is_sent_there_already_or_has_no_dock_or_does_not_want_to_is_not_sent() -> None:
    docks = DockGoals({"r1": FRONT})
    assert docks.due("r1", state(), goal(FRONT), 5.0) is None
    assert docks.due("r2", state(), None, 5.0) is None
    assert docks.due("r1", state(wants_dock=False), None, 5.0) is None


def test_robot_is_sent_again_only_after_two_seconds() -> None:
    docks = DockGoals({"r1": FRONT, "r2": FRONT})
    assert docks.due("r1", state(), None, 5.0) == FRONT
    assert docks.due("r1", state(), None, 6.99) is None
    assert docks.due("r2", state(), None, 6.99) == FRONT
    assert docks.due("r1", state(), None, 7.0) == FRONT


def test_front_of_the_dock_is_0_7_m_before_it_and_robots_without_one_are_left_out() -> None:
    robots = [
        RobotSite(id="r1", start=FRONT, dock=Pose(x=1.0, y=2.0, theta=1.5707963267948966), radius=0.17),
        RobotSite(id="r2", start=FRONT, radius=0.17),
    ]
    staging = Site(id="s", robots=robots).staging
    assert list(staging) == ["r1"]
    assert (staging["r1"].x, staging["r1"].y) == (pytest.approx(1.0), pytest.approx(1.3))
    assert staging["r1"].theta == pytest.approx(1.5707963)


async def test_operator_who_was_faster_is_not_overruled() -> None:
    orders = []

    async def send(order):
        orders.append(order)
        raise MissionConflictError("r1", None)

    dock_missions, elsewhere = DockMissions({"r1": FRONT}, send), goal(Pose(x=9.0, y=9.0, theta=0.0))
    dock_missions.on_state("r1", state(goal_id="g"), elsewhere, 5.0)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert [order.expected for order in orders] == ["g"]


@pytest.mark.parametrize("outcome", [None, Refusal(code=206, reason="a wall"), StoreError("Redis is away")])
async def test_refused_or_lost_goal_ends_nothing_and_is_tried_again(outcome: object) -> None:
    orders = []

    async def send(order):
        orders.append(order)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    dock_missions = DockMissions({"r1": FRONT}, send)
    dock_missions.on_state("r1", state(), None, 5.0)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    dock_missions.on_state("r1", state(), None, 7.0)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert [(order.robot, order.pose, order.any_heading, order.expected) for order in orders] == [
        ("r1", FRONT, False, NO_MISSION)
    ] * 2
    assert "to its dock" in orders[0].who
