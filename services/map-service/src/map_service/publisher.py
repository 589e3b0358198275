"""Publishes what the core returns, portion by portion for large changes, and records figures about it."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from prometheus_client import Counter, Gauge, Histogram

from fog_contracts import channels as ch
from fog_contracts.messages import MapDelta, MapHeartbeat, ZoneSet
from fog_runtime import logs, metrics

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fog_contracts.handlers import Moment, Publication
    from fog_runtime.transports.edges import Edges
    from map_service.core import MapCore

VERSION = Gauge("fognav_map_seq", "Sequence number of the map version within this epoch")
EPOCH = Gauge("fognav_map_epoch", "Epoch of the map: when this process claimed it, in ms since 1970")
DELTA_BYTES = Histogram(
    "fognav_map_delta_bytes",
    "Size of the cells of one delta, encoded",
    buckets=(64, 256, 1024, 2048, 4096, 16384, 65536),
)
ZONES = Gauge("fognav_zones", "Zones, stored and active", ["state"])
REQUESTS = Counter(
    "fognav_aggregator_requests_total", "Requests to publish all hazards again, because the map missed some"
)
COMMIT_SECONDS = Histogram(
    "fognav_map_commit_seconds",
    "Time of a map version's steps: combining the layers, inflating them, making the version",
    ["step"],
    buckets=(0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0),
)
HEARTBEAT_GAP = Histogram(
    "fognav_map_heartbeat_gap_seconds",
    "Time between two heartbeats of the map",
    buckets=(0.09, 0.11, 0.125, 0.15, 0.2, 0.25, 0.3, 0.5, 1.0, 2.0, 5.0),
)

_log = logs.get("map")


class Publisher:
    """Publishes the core's publications, and makes it continue changes that are only partly on the map."""

    def __init__(self, core: MapCore, edges: Edges, now: Callable[[], Moment]) -> None:
        metrics.expect_stages(["costmap"])
        self._core = core
        self._edges = edges
        self._now = now
        self._waiting = asyncio.Event()
        self._all_on_map = asyncio.Event()
        self._all_on_map.set()
        self._last_heartbeat: float | None = None
        core.costmap.measure = lambda step: COMMIT_SECONDS.labels(step).time()

    def publish(self, publications: Sequence[Publication]) -> None:
        """Publish what the core has returned."""
        for publication in publications:
            self._record(publication)
            self._edges.publish(publication)
        if self._core.pending:
            self._all_on_map.clear()
            self._waiting.set()

    async def all_on_map(self) -> None:
        """Wait until no change is only partly on the map."""
        await self._all_on_map.wait()

    async def commit_loop(self) -> None:
        """Put large changes on the map portion by portion; half of the time is left for everything else."""
        loop = asyncio.get_running_loop()
        while True:
            await self._waiting.wait()
            while self._core.pending:
                begun = loop.time()
                self.publish(self._core.continue_commit(self._now()))
                await asyncio.sleep(loop.time() - begun)
            self._waiting.clear()
            self._all_on_map.set()

    def _record(self, publication: Publication) -> None:
        message = publication.message
        if publication.channel is ch.AGGREGATOR_REQUEST:
            REQUESTS.inc()
            _log.warning("hazards_requested", missing=self._core.aggregator.overdue(self._now().now))
        elif isinstance(message, MapDelta):
            _record_delta(message)
        elif isinstance(message, ZoneSet):
            ZONES.labels("stored").set(len(message.zones))
            ZONES.labels("active").set(len(message.active))
        elif isinstance(message, MapHeartbeat):
            now, last = self._now().now, self._last_heartbeat
            self._last_heartbeat = now
            if last is not None:
                HEARTBEAT_GAP.observe(now - last)


def _record_delta(delta: MapDelta) -> None:
    DELTA_BYTES.observe(len(delta.cells))
    if delta.part > 0:
        return
    VERSION.set(delta.seq)
    EPOCH.set(delta.epoch)
    for trace in delta.traces:
        metrics.observe_trace(trace, ["costmap"])
    _log.info(
        "map_version_published",
        seq=delta.seq,
        parts=delta.parts,
        causes=[f"{c.id} {c.state}" for c in delta.causes],
    )
