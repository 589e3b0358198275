"""Durations of blocks and paces of robots in Redis: a restarted planner, or the one that leads next, goes on."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

from fog_runtime.stores import records
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import RedisStore
from planner.waits.blocks import BlockRecord
from planner.waits.pace import PaceRecord

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from fog_runtime.clock import Clock
    from planner.waits.blocks import Blocks
    from planner.waits.pace import Paces

SAVE_S: Final = 10.0
"""How often durations are stored; of a block that ends meanwhile with its planner the part until then counts."""


class Learned(NamedTuple):
    """What was learned: durations of blocks by area, and paces by robot."""

    blocks: Mapping[str, BlockRecord]
    paces: Mapping[str, PaceRecord]


class LearnedStore(RedisStore):
    """The keys of what was learned."""

    async def learned(self) -> Learned:
        """Return what is stored; an unreadable record is left out and logged."""
        return Learned(
            await self._readable_records(records.BLOCKS, BlockRecord),
            await self._readable_records(records.PACES, PaceRecord),
        )

    async def put_learned(self, learned: Learned) -> None:
        """Write the records of some areas and robots durably; what was measured needs no audit."""
        for table, found in ((records.BLOCKS, learned.blocks), (records.PACES, learned.paces)):
            if found:
                await self._write_records(table, found)


class LearnedPersistence:
    """Keeps what was learned in store and core equal; `change_core` passes a change to the core's thread."""

    def __init__(
        self,
        blocks: Blocks,
        paces: Paces,
        store: LearnedStore,
        clock: Clock,
        change_core: Callable[[Callable[[], object]], None],
    ) -> None:
        self._blocks = blocks
        self._paces = paces
        self._store = store
        self._clock = clock
        self._change_core = change_core
        self._due = 0.0
        self._epoch: int | None = None

    async def load(self) -> None:
        """Continue with what is stored, once in each time of leading; raises `StoreError`."""
        if self._store.epoch == self._epoch:
            return
        stored = await self._store.learned()
        self._epoch = self._store.epoch
        self._change_core(lambda: self._blocks.restore(stored.blocks, self._clock.now()))
        self._change_core(partial(self._paces.restore, stored.paces))

    async def save(self) -> None:
        """Store what has changed, now and then; raises `StoreError`, after which it is tried again."""
        if self._clock.now() < self._due:
            return
        self._due = self._clock.now() + SAVE_S
        loop = asyncio.get_running_loop()
        taken: asyncio.Future[Learned] = loop.create_future()

        def take() -> None:
            found = Learned(self._blocks.to_store(self._clock.now()), self._paces.to_store())
            loop.call_soon_threadsafe(_answer, taken, found)

        self._change_core(take)
        learned = await taken
        try:
            await self._store.put_learned(learned)
        except StoreError:
            self._change_core(partial(self._blocks.store_again, learned.blocks))
            self._change_core(partial(self._paces.store_again, learned.paces))
            raise


def _answer(taken: asyncio.Future[Learned], learned: Learned) -> None:
    if not taken.cancelled():
        taken.set_result(learned)
