"""Runs the core: passes it what arrives, encodes tiles of the map on another thread, and wakes the readers."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Final, TypeVar

from prometheus_client import Gauge

from console_service.readers import Readers
from console_service.recording import STEP_S, Frame, Recording, as_json, pack
from console_service.timeline import read_timeline
from fog_contracts import channels as ch
from fog_contracts.codec import ContractError
from fog_contracts.messages import MapDelta, MapSnapshot, RobotObstacles
from fog_contracts.replica import MapError, decode_map
from fog_runtime import logs
from fog_runtime.clock import ticker
from fog_runtime.transports.edges import Edges

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from console_service.core import ConsoleCore
    from console_service.recording import Shown
    from console_service.tiles import TileJob
    from console_service.timeline import TimelinePage
    from fog_contracts.handlers import Handler, Ids, Moment, Publication
    from fog_runtime.clock import Clock
    from fog_runtime.health import Health
    from fog_runtime.stores.redis_connection import RedisConnection
    from fog_runtime.transports.mqtt_edge import MqttEdge
    from fog_runtime.transports.zenoh_edge import ZenohEdge

T = TypeVar("T")

AHEAD_S: Final = 60.0
"""How far ahead the clock of a service or of Redis may be."""
RECORDING_BYTES = Gauge("fognav_console_recording_bytes", "Memory of what the last hour was")

TICK_S: Final = 0.1
SNAPSHOT_TIMEOUT_S: Final = 3.0
TILES_AT_ONCE: Final = 8
"""Tiles that are encoded before they are told: 5 ms, in which the interpreter is mostly free for others."""


class Service:
    """The running console-service; its loops are tasks of the process."""

    def __init__(  # the process's parts
        self,
        core: ConsoleCore,
        mqtt: MqttEdge,
        zenoh: ZenohEdge,
        redis: RedisConnection,
        clock: Clock,
        health: Health,
    ) -> None:
        self.core = core
        self.redis = redis
        self.recording = Recording()
        self.readers = Readers(core.log, core.site)
        self._mqtt = mqtt
        self._zenoh = zenoh
        self._clock = clock
        self._health = health
        self._edges = Edges(clock, mqtt=mqtt, zenoh=zenoh)
        self._changed = asyncio.Event()
        self._limited = logs.RateLimited(logs.get("console-service"))
        self._thread = ThreadPoolExecutor(1, "tiles")

    def now(self) -> float:
        """Return the time (s, monotonic)."""
        return self._clock.now()

    def subscribe(self) -> None:
        """Register subscriptions."""
        handlers = {channel: self._waking(handler) for channel, handler in self.core.handlers().items()}
        self._edges.subscribe(handlers, _publish_nothing)

    def _waking(self, handler: Handler) -> Handler:
        def handle(ids: Ids, message: object, at: Moment) -> Sequence[Publication]:
            publications = handler(ids, message, at)
            self.readers.wake()
            if isinstance(message, MapDelta):
                self._changed.set()
            elif isinstance(message, RobotObstacles):
                self._tell_scan(ids["robot"])
            return publications

        return handle

    def _tell_scan(self, robot: str) -> None:
        if robot in self.readers.scans_wanted and (scan := self.core.scan(robot)) is not None:
            self.readers.on_scan(robot, scan)

    async def tick_loop(self) -> None:
        """Advance the core ten times a second."""
        async for _ in ticker(self._clock, TICK_S):
            self.core.tick(self._edges.now())
            self.readers.wake()
            for name, connected in (("mqtt", self._mqtt.connected), ("zenoh", self._zenoh.connected)):
                self._health.set(name, ok=connected, detail="" if connected else "not connected")

    async def map_loop(self) -> None:
        """Fetch a snapshot of the map whenever one is needed."""
        async for now in ticker(self._clock, TICK_S):
            if not self.core.wants_snapshot(now):
                continue
            try:
                snapshot = await self._zenoh.query(ch.MAP_SNAPSHOT, None, MapSnapshot, SNAPSHOT_TIMEOUT_S)
                if snapshot is None:
                    continue  # the map-service does not answer: the page sees that there is no map
                decoded = await self._in_thread(partial(decode_map, snapshot))
                self.core.load(decoded, self._clock.now())
            except (MapError, ContractError) as error:
                self._limited.warning("map_refused", "map", now, reason=str(error))
                continue
            self._changed.set()
            self.readers.wake()

    async def tile_loop(self) -> None:
        """Encode the tiles of the map that changed, a few at a time."""
        while True:
            await self._changed.wait()
            self._changed.clear()
            while jobs := self.core.tile_jobs(TILES_AT_ONCE):
                await self._in_thread(partial(_run_all, jobs))
                for job in jobs:
                    self.core.add_tile(job)
                self.readers.wake()

    async def recording_loop(self) -> None:
        """Keep what changes, for those who look back."""
        async for _ in ticker(self._clock, STEP_S):
            changes = self.recording.changes(self.core.log)
            packed = await self._in_thread(partial(pack, changes))
            self.recording.add(Frame(self._clock.stamp(), packed))
            RECORDING_BYTES.set(self.recording.size)

    async def show(self, begin: float, end: float) -> tuple[Shown, bytes]:
        """Return what was from `begin` to `end` (s since the epoch), and its frames as JSON."""
        copied = self.recording.copy()

        def made() -> tuple[Shown, bytes]:
            shown = copied.show(begin, end)
            return shown, b"".join(as_json(shown))

        return await self._in_thread(partial(made))

    async def timeline(
        self, kinds: Collection[str], begin: float, end: float | None, cursor: str | None, limit: int
    ) -> TimelinePage:
        """Return what happened; raises as `read_timeline`."""
        return await read_timeline(
            self.redis,
            self.core.site,
            kinds=kinds,
            areas=self.core.areas,
            faults=list(self.core.faults),
            begin=begin,
            end=self._clock.stamp() + AHEAD_S if end is None else end,
            cursor=cursor,
            limit=limit,
        )

    async def _in_thread(self, work: partial[T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, work)

    def close(self) -> None:
        """Shut the thread down once its current work is done."""
        self._thread.shutdown(wait=False, cancel_futures=True)


def _run_all(jobs: Sequence[TileJob]) -> None:
    for job in jobs:
        job.run()


def _publish_nothing(publications: Sequence[Publication]) -> None:
    assert not publications
