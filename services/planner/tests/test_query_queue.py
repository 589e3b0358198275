"""The queue of long answers: bounded, fair to askers, the most important first."""

from __future__ import annotations

import asyncio
from typing import Any, cast

import pytest

from planner.query_queue import PER_ASKER, WAITING, BusyError, Kind, QueryQueue, Threads


class Work:
    """Answers that wait until they are released; records the order in which they began."""

    def __init__(self) -> None:
        self.begun: list[str] = []
        self.release = asyncio.Event()

    def named(self, name: str) -> Any:
        async def work() -> str:
            self.begun.append(name)
            await self.release.wait()
            return name

        return work


def make_queue() -> QueryQueue:
    return QueryQueue(cast("Any", None))


async def settle() -> None:
    for _ in range(10):
        await asyncio.sleep(0)


def ask(queue: QueryQueue, kind: Kind, asker: str, work: Any) -> asyncio.Task[str]:
    return asyncio.create_task(queue.run(kind, asker, work))


async def test_one_asker_may_have_only_so_many_queries_waiting_and_others_are_still_answered() -> None:
    queue, work = make_queue(), Work()
    waiting = [ask(queue, "plan", "a", work.named(f"a{n}")) for n in range(PER_ASKER["plan"])]
    await settle()
    with pytest.raises(BusyError, match="your queries") as refused:
        await queue.run("plan", "a", work.named("too many"))
    assert refused.value.retry_after > 0.0
    waiting.append(ask(queue, "plan", "b", work.named("b0")))
    await settle()
    assert work.begun == ["a0"]  # one at a time
    work.release.set()
    assert await asyncio.gather(*waiting) == [*(f"a{n}" for n in range(PER_ASKER["plan"])), "b0"]
    assert await queue.run("plan", "a", work.named("again")) == "again"


async def test_queue_is_bounded_and_robots_that_want_out_are_admitted_although_it_is_full_of_previews() -> None:
    queue, work = make_queue(), Work()
    waiting = [ask(queue, "plan", f"asker{n}", work.named(f"p{n}")) for n in range(WAITING["plan"])]
    await settle()
    with pytest.raises(BusyError, match="waiting already"):
        await queue.run("plan", "late", work.named("late"))
    explained = ask(queue, "explanation", "", work.named("explanation"))
    out = ask(queue, "egress", "r1", work.named("egress"))
    await settle()
    work.release.set()
    await asyncio.gather(*waiting, explained, out)
    assert work.begun[:4] == ["p0", "egress", "explanation", "p1"]


async def test_query_whose_asker_has_gone_is_not_answered_and_makes_room() -> None:
    queue, work = make_queue(), Work()
    first = ask(queue, "plan", "a", work.named("first"))
    gone = [ask(queue, "plan", "a", work.named("gone")) for _ in range(PER_ASKER["plan"] - 1)]
    await settle()
    for task in gone:
        task.cancel()
    await settle()
    work.release.set()
    assert await first == "first"
    await settle()
    assert work.begun == ["first"]
    assert await queue.run("plan", "a", work.named("next")) == "next"


async def test_memory_is_released_when_all_have_been_answered_and_not_before() -> None:
    threads, work = Threads(), Work()
    loop, idle = asyncio.get_running_loop(), asyncio.Queue[list[str]]()
    queue = QueryQueue(threads, on_idle=lambda: loop.call_soon_threadsafe(idle.put_nowait, list(work.begun)))
    work.release.set()
    try:
        await asyncio.gather(*(ask(queue, "plan", "a", work.named(name)) for name in ("first", "second")))
        assert await idle.get() == ["first", "second"]
        assert await queue.run("plan", "a", work.named("third")) == "third"
        assert await idle.get() == ["first", "second", "third"]
    finally:
        queue.close()
        threads.close()
    assert idle.empty()


async def test_error_reaches_its_asker_alone() -> None:
    queue, work = make_queue(), Work()
    work.release.set()

    async def fail() -> str:
        raise ZeroDivisionError("a bug")

    failing, other = ask(queue, "plan", "a", fail), ask(queue, "plan", "b", work.named("b"))
    with pytest.raises(ZeroDivisionError):
        await failing
    assert await other == "b"
