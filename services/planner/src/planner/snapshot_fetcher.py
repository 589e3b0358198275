"""Fetches snapshots of the map whenever the core needs one, and prepares them off the core's thread."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import TYPE_CHECKING, Final

from prometheus_client import Counter

from fog_contracts import channels as ch
from fog_contracts.codec import ContractError
from fog_contracts.messages import MapSnapshot
from fog_contracts.replica import MapError
from fog_runtime import logs
from planner.planning_map import prepare_map

if TYPE_CHECKING:
    from collections.abc import Callable

    from fog_runtime.clock import Clock
    from fog_runtime.health import Health
    from fog_runtime.transports.zenoh_edge import ZenohEdge
    from planner.core import PlannerCore
    from planner.query_queue import QueryQueue

RETRY_S: Final = 0.1
SNAPSHOT_TIMEOUT_S: Final = 3.0

SNAPSHOTS = Counter("fognav_planner_snapshots_total", "Queries for a snapshot of the map, by outcome", ["outcome"])

_log = logs.get("planner")


class SnapshotFetcher:
    """Keeps the core's map complete; `on_loaded` is called when there is a new one."""

    def __init__(
        self,
        core: PlannerCore,
        zenoh: ZenohEdge,
        clock: Clock,
        health: Health,
        queue: QueryQueue,
        *,
        on_loaded: Callable[[], object],
    ) -> None:
        self._core = core
        self._zenoh = zenoh
        self._clock = clock
        self._health = health
        self._queue = queue
        self._on_loaded = on_loaded
        self.loaded = False
        """Whether the core has a map, though perhaps not the newest."""
        self._needed = asyncio.Event()
        self._needed.set()

    def request(self) -> None:
        """Fetch a snapshot, if the core still needs one."""
        self._needed.set()

    async def snapshot_loop(self) -> None:
        """Fetch a snapshot of the map whenever the core needs one."""
        while True:
            await self._needed.wait()
            if not await self._queue.threads.run("core", lambda: self._core.wants_snapshot(self._clock.now())):
                self._needed.clear()
                continue
            try:
                if await self._fetch():
                    continue
            except (MapError, ContractError) as error:
                SNAPSHOTS.labels("refused").inc()
                self._health.set("map", ok=False, detail=str(error))
            await self._clock.sleep(RETRY_S)

    async def _fetch(self) -> bool:
        """Fetch and load a snapshot; return whether one came. Raises `MapError` and `ContractError`."""
        snapshot = await self._zenoh.query(ch.MAP_SNAPSHOT, None, MapSnapshot, SNAPSHOT_TIMEOUT_S)
        if snapshot is None:
            SNAPSHOTS.labels("unanswered").inc()
            self._health.set("map", ok=False, detail="the map-service does not answer")
            return False
        prepare = partial(prepare_map, snapshot, self._core.config.inflation)
        prepared = await self._queue.run("map", "", partial(self._queue.threads.run, "query", prepare))
        await self._queue.threads.run("core", lambda: self._core.load(prepared, self._clock.now()))
        self._needed.clear()
        self.loaded = True
        self._on_loaded()
        SNAPSHOTS.labels("loaded").inc()
        self._health.set("map", ok=True)
        _log.info("map_loaded", epoch=snapshot.epoch, seq=snapshot.seq)
        return True
