"""The durations of blocks in Redis: a restarted planner, or the one that leads next, continues with them."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import TYPE_CHECKING, Final

from fog_runtime.stores import records
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import RedisStore
from planner.waits.blocks import BlockRecord

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from fog_runtime.clock import Clock
    from planner.waits.blocks import Blocks

SAVE_S: Final = 10.0
"""How often durations are stored; of a block that ends meanwhile with its planner the part until then counts."""


class BlockStore(RedisStore):
    """The keys of durations."""

    async def blocks(self) -> dict[str, BlockRecord]:
        """Return the stored durations by area; an unreadable record is left out and logged."""
        return await self._readable_records(records.BLOCKS, BlockRecord)

    async def put_blocks(self, blocks: Mapping[str, BlockRecord]) -> None:
        """Write the durations of some areas durably; what was measured needs no audit."""
        await self._write_records(records.BLOCKS, blocks)


class BlockPersistence:
    """Keeps the durations of store and core equal; `change_core` passes a change to the core's thread."""

    def __init__(
        self, blocks: Blocks, store: BlockStore, clock: Clock, change_core: Callable[[Callable[[], object]], None]
    ) -> None:
        self._blocks = blocks
        self._store = store
        self._clock = clock
        self._change_core = change_core
        self._due = 0.0
        self._epoch: int | None = None

    async def load(self) -> None:
        """Continue with what is stored, once in each time of leading; raises `StoreError`."""
        if self._store.epoch == self._epoch:
            return
        self._epoch = self._store.epoch
        self._change_core(partial(self._blocks.restore, await self._store.blocks()))

    async def save(self) -> None:
        """Store what has changed, now and then; raises `StoreError`, after which it is tried again."""
        if self._clock.now() < self._due:
            return
        self._due = self._clock.now() + SAVE_S
        loop = asyncio.get_running_loop()
        taken: asyncio.Future[dict[str, BlockRecord]] = loop.create_future()

        def take() -> None:
            changed = self._blocks.to_store(self._clock.now())
            loop.call_soon_threadsafe(_answer, taken, changed)

        self._change_core(take)
        changed = await taken
        if not changed:
            return
        try:
            await self._store.put_blocks(changed)
        except StoreError:
            self._change_core(partial(self._blocks.store_again, changed))
            raise


def _answer(taken: asyncio.Future[dict[str, BlockRecord]], changed: dict[str, BlockRecord]) -> None:
    if not taken.cancelled():
        taken.set_result(changed)
