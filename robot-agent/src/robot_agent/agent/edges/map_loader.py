"""The edge that brings the map to the core: from disk at the start, then from the map-service, whenever it is wanted.

The last snapshot of the map is stored for offline starts, and beside it the last trusted pose.

Decoding a large map and computing localization's fields takes most of a second on a small computer: it runs on a
thread, while the stream of wheel commands goes on.
"""

from __future__ import annotations

import asyncio
import random
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Final

import msgspec

from fog_contracts import channels as ch
from fog_contracts.codec import ContractError
from fog_contracts.messages import MapSnapshot
from fog_contracts.replica import MapError
from fog_runtime import logs
from fog_runtime.clock import Ticker
from fog_runtime.files import atomic_write
from robot_agent.agent.berths import POSE_FILE
from robot_agent.agent.edges.exporter import name_thread
from robot_agent.agent.pose_persistence import start_pose
from robot_agent.localization.pose import SavedPose

if TYPE_CHECKING:
    from pathlib import Path

    from fog_contracts.site import RobotSite
    from fog_runtime.clock import Clock, Phase
    from fog_runtime.transports.zenoh_edge import ZenohEdge
    from robot_agent.agent.core import AgentCore
    from robot_agent.agent.navigation import PreparedMap

_log = logs.get("agent")
_store_log = logs.get("store")
_snapshots = msgspec.msgpack.Decoder(MapSnapshot)
_poses = msgspec.json.Decoder(SavedPose)


class Store:
    """Two files in the robot's data folder; each write replaces a file as a whole. All methods block."""

    def __init__(self, folder: Path) -> None:
        self._pose = folder / POSE_FILE
        self._snapshot = folder / "snapshot.msgpack"

    def pose(self, site: str) -> SavedPose | None:
        """Return the stored pose on this site, None without a valid one."""
        data = _read(self._pose)
        if data is None:
            return None
        try:
            saved = _poses.decode(data)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            _store_log.warning("stored_pose_refused", file=str(self._pose), reason=str(error))
            return None
        return saved if saved.site == site else None

    def put_pose(self, saved: SavedPose) -> None:
        """Store a pose; raises `OSError`."""
        atomic_write(self._pose, msgspec.json.encode(saved))

    def snapshot(self, site: str) -> MapSnapshot | None:
        """Return the stored map of this site, None without a readable one (its hash is not checked)."""
        data = _read(self._snapshot)
        if data is None:
            return None
        try:
            snapshot = _snapshots.decode(data)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            _store_log.warning("stored_map_refused", file=str(self._snapshot), reason=str(error))
            return None
        return snapshot if snapshot.site == site else None

    def put_snapshot(self, snapshot: MapSnapshot) -> None:
        """Store a map; raises `OSError`."""
        atomic_write(self._snapshot, msgspec.msgpack.encode(snapshot))


def _read(file: Path) -> bytes | None:
    try:
        return file.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        _store_log.warning("file_not_readable", file=str(file), reason=str(error))
        return None


CHECK_S: Final = 0.1
FIRST_CHECK_S: Final = 0.05
SNAPSHOT_TIMEOUT_S: Final = 3.0
"""Timeout of a snapshot request."""


class MapLoader:
    """Loads snapshots of one site's map into the core, on the loop's thread; one at a time."""

    def __init__(
        self, core: AgentCore, zenoh: ZenohEdge, store: Store, clock: Clock, *, site: str, phase: Phase | None = None
    ) -> None:
        """`phase` is that of the loops whose ticks this one shares."""
        self._core = core
        self._zenoh = zenoh
        self._store = store
        self._clock = clock
        self._site = site
        self._phase = phase
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="map", initializer=name_thread, initargs=("map",))
        self._stored: Future[PreparedMap | None] | None = None

    def begin(self) -> None:
        """Begin to read the stored map, on a thread; `run` loads it. What else the process does goes on meanwhile."""
        self._stored = self._thread.submit(self._read)

    async def run(self, body: RobotSite) -> None:
        """Restore the stored state, then keep the map up to date until cancelled."""
        try:
            await self.restore(body)
            await self.snapshot_loop()
        finally:
            self._thread.shutdown(wait=False, cancel_futures=True)

    async def restore(self, body: RobotSite) -> None:
        """Load the stored map and pose; without a stored pose, start at the site's start pose."""
        if self._stored is None:
            self.begin()
        assert self._stored is not None
        stored = await asyncio.wrap_future(self._stored)
        if stored is not None:
            try:
                self._core.load(stored, self._clock.now())
            except MapError as error:
                _log.warning("stored_map_refused", reason=str(error))
        saved = self._store.pose(self._site)
        if saved is None:
            saved = start_pose(self._site, body)
        self._core.restore(saved)
        _log.info("state_restored", map=stored is not None, x=saved.x, y=saved.y)

    def _read(self) -> PreparedMap | None:
        """Return the stored map, None without a valid one."""
        snapshot = self._store.snapshot(self._site)
        if snapshot is None:
            return None
        try:
            return self._core.prepare_map(snapshot)
        except MapError as error:
            _log.warning("stored_map_refused", reason=str(error))
            return None

    async def snapshot_loop(self) -> None:
        """Request a snapshot whenever the core wants one, with a growing delay after each failure."""
        failures = 0
        await self._clock.sleep(FIRST_CHECK_S)  # a heartbeat may come first and confirm the stored map
        ticker = Ticker(self._clock, CHECK_S, self._phase)
        while True:
            if not self._core.wants_snapshot(self._clock.now()):
                failures = 0
            await ticker.call(self._core.wants_snapshot)
            if await self._fetch():
                failures = 0
            else:
                failures += 1
                spread = random.uniform(0.5, 1.0)  # noqa: S311  # spreads attempts in time, no secret
                await self._clock.sleep(spread * min(2.0**failures / 5, 3))

    async def _fetch(self) -> bool:
        """Request a snapshot and load it; False without a valid one."""
        try:
            snapshot = await self._zenoh.query(ch.MAP_SNAPSHOT, None, MapSnapshot, SNAPSHOT_TIMEOUT_S)
            if snapshot is None:
                return False
            await self._load(snapshot)
        except (ContractError, MapError) as error:
            _log.warning("snapshot_refused", reason=str(error))
            return False
        version = self._core.replica.version
        _log.info("map_loaded", epoch=snapshot.epoch, snapshot=snapshot.seq, seq=version and version.seq)
        try:
            await asyncio.to_thread(self._store.put_snapshot, snapshot)
        except OSError as error:
            _log.error("map_not_stored", reason=str(error))
        return True

    async def _load(self, snapshot: MapSnapshot) -> None:
        loop = asyncio.get_running_loop()
        prepared = await loop.run_in_executor(self._thread, self._core.prepare_map, snapshot)
        self._core.load(prepared, self._clock.now())
