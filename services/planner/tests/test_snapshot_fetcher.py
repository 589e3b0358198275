"""The planner's map: what takes long of a snapshot keeps the core's thread from nothing."""

from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING, Any, cast

from manual_clock import ManualClock
from ring_map import RingMap

from fog_runtime.health import Health
from planner import planning_map, snapshot_fetcher
from planner.core import PlannerCore
from planner.query_queue import QueryQueue, Threads
from planner.snapshot_fetcher import SnapshotFetcher

if TYPE_CHECKING:
    import pytest

    from fog_contracts.costs import Inflation
    from fog_contracts.messages import MapSnapshot
    from planner.planning_map import PreparedMap


class MapService:
    """Answers each query with the same snapshot."""

    def __init__(self) -> None:
        self.snapshot = RingMap().master.snapshot()

    async def query(self, *_: object) -> MapSnapshot:
        return self.snapshot


async def test_snapshot_is_decoded_and_inflated_beside_the_core_s_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    prepare, used = planning_map.prepare_map, list[str]()

    def recording(snapshot: MapSnapshot, inflation: Inflation) -> PreparedMap:
        used.append(threading.current_thread().name)
        return prepare(snapshot, inflation)

    # The core prepares by itself what it gets unprepared.
    for module in (snapshot_fetcher, planning_map):
        monkeypatch.setattr(module, "prepare_map", recording)
    core, clock, threads, loaded = PlannerCore(epoch=1), ManualClock(1.0), Threads(), asyncio.Event()
    queue = QueryQueue(threads)
    fetcher = SnapshotFetcher(core, cast("Any", MapService()), clock, Health(), queue, on_loaded=loaded.set)
    assert not fetcher.loaded
    running = asyncio.create_task(fetcher.snapshot_loop())
    try:
        async with asyncio.timeout(60):
            await loaded.wait()
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        queue.close()
        threads.close()
    assert fetcher.loaded
    assert not core.wants_snapshot(clock.now())
    assert [name.rpartition("_")[0] for name in used] == ["planner query"]
