"""Runs dry runs on the queue of long answers, below everything else that waits there, and for a bounded time."""

from __future__ import annotations

import asyncio
import time
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Final, TypeVar

from fog_contracts import channels as ch
from fog_contracts.codec import ContractError
from fog_contracts.messages import DryRunReply
from fog_contracts.replica import MapError
from planner.dry_run import DryRun, StaleError, goal_outcome
from planner.query_queue import BUSY_PAUSE_S, RETRY_AFTER_S, WAITING, BusyError
from planner.refusals import busy, no_map

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from fog_contracts.messages import DryRunRequest, GoalOutcome
    from planner.core import PlannerCore
    from planner.query_queue import QueryQueue

T = TypeVar("T")

DRY_RUN_S: Final = 3.0
"""After so long (real seconds) a dry run searches no more paths: robots that are left are named."""
MOST_DRY_RUNS: Final = WAITING["dry_run"]


class DryRuns:
    """Answers what a change, or a goal, would do; one at a time for each who asks."""

    def __init__(self, core: PlannerCore, queue: QueryQueue, now: Callable[[], float]) -> None:
        self._core = core
        self._now = now
        self._queue = queue
        self._askers: set[str] = set()

    async def goal(self, robot: str, x: float, y: float, asker: str) -> GoalOutcome | None:
        """Return the path that a robot would get to a goal (m, frame `map`); None: it has no pose, or there is no map.

        Raises `BusyError`, after a pause (`BUSY_PAUSE_S`), when too many wait, or one of this asker.
        """
        state = await self._queue.threads.run("core", partial(self._core.state, self._now()))
        if state is None or robot not in state.missions:
            return None
        search = partial(goal_outcome, state, robot, (x, y), self._core.config)
        try:
            with self._admitted(asker):
                return await self._run(asker, search)
        except BusyError:
            await asyncio.sleep(BUSY_PAUSE_S)
            raise

    async def change(self, request: DryRunRequest, asker: str) -> DryRunReply:
        """Return what a change would do; whatever else waits comes between the searches for two robots.

        Raises `ContractError` for cells that are damaged.
        """
        state = await self._queue.threads.run("core", partial(self._core.state, self._now()))
        if state is None:
            return DryRunReply(refusal=no_map())
        dry_run, until = DryRun(state, request, self._core.config), time.monotonic() + DRY_RUN_S
        try:
            with self._admitted(asker):
                await self._run(asker, dry_run.prepare)
                for step in dry_run.steps:
                    if time.monotonic() >= until:
                        break
                    await self._run(asker, step)
        except StaleError:
            return DryRunReply(stale=True)
        except MapError as error:
            raise ContractError(ch.PLANNER_DRY_RUN.name, str(error)) from error
        except BusyError as error:
            return DryRunReply(refusal=busy(str(error)))
        return dry_run.outcome()

    async def _run(self, asker: str, work: Callable[[], T]) -> T:
        return await self._queue.run("dry_run", asker, partial(self._queue.threads.run, "query", work))

    @contextmanager
    def _admitted(self, asker: str) -> Iterator[None]:
        """Admit a dry run as a whole, so that its steps find room in the queue; raises `BusyError`."""
        if asker in self._askers or len(self._askers) >= MOST_DRY_RUNS:
            whose = "one of yours" if asker in self._askers else f"{len(self._askers)} of others"
            raise BusyError(f"a dry run is computed already, {whose}; try again in {RETRY_AFTER_S:.0f} s")
        self._askers.add(asker)
        try:
            yield
        finally:
            self._askers.discard(asker)
