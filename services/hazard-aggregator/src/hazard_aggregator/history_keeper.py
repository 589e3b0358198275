"""Keeps the histories of areas: writes their periods as soon as Redis takes them, and reads them."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING, Final

from fog_runtime import logs
from hazard_aggregator.areas.area_history import period_of
from hazard_aggregator.store import StoreError

if TYPE_CHECKING:
    from fog_contracts.handlers import Moment
    from fog_contracts.messages import AreaHazard
    from hazard_aggregator.areas.area_history import HistoryPage
    from hazard_aggregator.core import Aggregator
    from hazard_aggregator.store import Store

_QUEUE: Final = 10_000
"""Hazards that wait while Redis is away; beyond them the oldest are missing in the history."""
_PERIOD_S: Final = 0.5

_log = logs.get("history")


class HistoryKeeper:
    """The queue of published hazards that begin periods; Redis refuses those that it has already."""

    def __init__(self, core: Aggregator, store: Store, leading: asyncio.Event) -> None:
        self._core = core
        self._store = store
        self._leading = leading
        self._queue: deque[tuple[AreaHazard, Moment | None]] = deque(maxlen=_QUEUE)
        self._newest: dict[str, tuple[int, int]] = {}

    def add(self, hazard: AreaHazard, at: Moment) -> None:
        """Queue a hazard that is published at this moment, unless it was queued before.

        The first of an epoch begins its period when its state began: the earlier run may have been killed before it
        wrote that.
        """
        epoch, seq = self._newest.get(hazard.area, (0, 0))
        if (epoch, seq) != (hazard.epoch, hazard.seq):
            self._newest[hazard.area] = (hazard.epoch, hazard.seq)
            self._queue.append((hazard, at if epoch == hazard.epoch else None))

    async def page(self, area: str, cursor: str | None, limit: int, at: Moment) -> HistoryPage:
        """Return a page of an area's history at this moment; raises `CursorError` and `StoreError`."""
        return await self._store.history(area, cursor=cursor, limit=limit, at=at)

    async def run(self) -> None:
        """Write what is queued, while this process leads."""
        while True:
            await asyncio.sleep(_PERIOD_S)
            await self._leading.wait()
            try:
                await self.write()
            except StoreError as error:
                # It stays queued; the store's own loop reports the state of Redis in the process's health.
                _log.debug("history_waits", reason=str(error), queued=len(self._queue))

    async def write(self) -> None:
        """Write all that is queued; raises `StoreError`, and keeps what is not written.

        What was decided under an earlier epoch, while another copy led, is that copy's to write.
        """
        while self._queue:
            hazard, at = self._queue[0]
            if hazard.epoch == self._core.epoch:
                await self._store.begin_period(hazard, period_of(hazard, at))
            if self._queue and self._queue[0][0] is hazard:
                self._queue.popleft()
