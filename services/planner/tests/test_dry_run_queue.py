"""How dry runs share the planner's thread for long answers, and how they are bounded. What they say: experiments."""

from __future__ import annotations

import asyncio
import threading
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest
from ring_map import LEFT, RIGHT, RingMap, goal, pose

from fog_contracts import channels as ch
from fog_contracts.handlers import Moment
from fog_contracts.messages import DryRunRequest
from planner import dry_run_queue
from planner.core import PlannerCore
from planner.dry_run import DryRun
from planner.dry_run_queue import MOST_DRY_RUNS, DryRuns
from planner.query_queue import BusyError, QueryQueue, Threads

if TYPE_CHECKING:
    from collections.abc import Iterator

    from fog_contracts.messages import GoalOutcome
    from planner.missions import Mission

ROBOTS = [f"r{number}" for number in range(12)]


@pytest.fixture
def queue() -> Iterator[QueryQueue]:
    threads = Threads()
    yield QueryQueue(threads)
    threads.close()


def core_with_robots() -> PlannerCore:
    core, world = PlannerCore(epoch=1), RingMap()
    core.load(world.master.snapshot(), 0.0)
    for robot in ROBOTS:
        core.handlers()[ch.ROBOT_POSE]({"robot": robot}, pose(*LEFT), Moment(0.0, 0.0))
        core.set_goal(robot, goal(*RIGHT))
    return core


async def test_a_robot_that_wants_out_waits_for_one_search_of_a_dry_run_and_not_for_all(
    queue: QueryQueue, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []
    loop, two_done, search = asyncio.get_running_loop(), asyncio.Event(), DryRun._add

    def add(self: DryRun, robot: str, mission: Mission) -> None:
        order.append(robot)
        if len(order) == 2:
            loop.call_soon_threadsafe(two_done.set)
        search(self, robot, mission)

    monkeypatch.setattr(DryRun, "_add", add)
    dry_runs = DryRuns(core_with_robots(), queue, lambda: 0.0)

    async def egress() -> None:
        await two_done.wait()
        await queue.run("egress", "r1", partial(queue.threads.run, "query", lambda: order.append("way out")))

    reply, _ = await asyncio.gather(dry_runs.change(DryRunRequest(), "map"), egress())
    assert reply.outcome is not None
    assert [robot.robot for robot in reply.outcome.robots] == ROBOTS
    assert order.index("way out") < len(ROBOTS)


async def test_dry_run_ends_in_time_and_names_the_robots_that_are_left(
    queue: QueryQueue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dry_run_queue, "DRY_RUN_S", 0.0)
    reply = await DryRuns(core_with_robots(), queue, lambda: 0.0).change(DryRunRequest(), "map")
    assert reply.outcome is not None
    assert (reply.outcome.robots, reply.outcome.unfinished) == ([], sorted(ROBOTS))


async def test_each_asker_has_one_dry_run_at_a_time_and_all_together_a_few(
    queue: QueryQueue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dry_run_queue, "BUSY_PAUSE_S", 0.0)
    monkeypatch.setattr(dry_run_queue, "DRY_RUN_S", 60.0)
    dry_runs = DryRuns(core_with_robots(), queue, lambda: 0.0)
    all_asked, search = threading.Event(), dry_run_queue.goal_outcome

    def search_when_all_asked(*arguments: Any) -> GoalOutcome | None:
        assert all_asked.wait(60.0)
        return search(*arguments)

    monkeypatch.setattr(dry_run_queue, "goal_outcome", search_when_all_asked)
    askers = ["map", "map", *(f"person {number}" for number in range(MOST_DRY_RUNS))]
    asked = [asyncio.ensure_future(dry_runs.goal("r1", *RIGHT, asker)) for asker in askers]
    await asyncio.wait([asked[1], asked[-1]], timeout=60.0)
    all_asked.set()
    answers = await asyncio.gather(*asked, return_exceptions=True)
    assert [isinstance(answer, BusyError) for answer in answers] == [False, True, *[False] * 7, True]
    assert await dry_runs.goal("r1", *RIGHT, "map") is not None, "there is room again"
    assert await dry_runs.goal("r99", *RIGHT, "map") is None, "nobody knows where it is"
