"""The costmap in tiles, of which those whose cells changed are encoded anew, on another thread. Pure."""

from __future__ import annotations

import base64
import hashlib
import struct
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import msgspec

from fog_contracts.follower import MapFollower
from fog_contracts.grid import Window

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    import numpy as np
    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry
    from fog_contracts.messages import MapDelta, MapHeartbeat
    from fog_contracts.replica import Applied, DecodedMap, Version

SIDE: Final = 128
"""Cells of a tile's side, at the map's upper and right edge fewer."""
_LEVEL: Final = 6

Tile = tuple[int, int]
"""Column and row of a tile's lower left cell."""


class TileView(msgspec.Struct, frozen=True):
    """A tile as it is sent: its version of the map, its lower left cell, its size in cells, and its picture."""

    epoch: int
    seq: int
    column: int
    row: int
    width: int
    height: int
    png: str


def png(cells: NDArray[np.uint8]) -> bytes:
    """Return costs as a grey PNG (ISO/IEC 15948), whose first row is the last of the cells, the top."""
    height, width = cells.shape
    rows = b"".join(b"\0" + row.tobytes() for row in cells[::-1])
    parts = ((b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)), (b"IDAT", zlib.compress(rows, _LEVEL)))
    chunks = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in (*parts, (b"IEND", b""))
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


@dataclass
class TileJob:
    """A tile to be encoded: owns its cells, so that any thread may `run` it; `data` is None if it looks as before."""

    tile: Tile
    version: Version
    cells: NDArray[np.uint8]
    before: bytes
    digest: bytes = b""
    data: bytes | None = None

    def run(self) -> None:
        """Encode the tile, unless its cells are those that were encoded before."""
        self.digest = hashlib.blake2b(self.cells.tobytes(), digest_size=16).digest()
        if self.digest != self.before:
            height, width = self.cells.shape
            picture = base64.b64encode(png(self.cells)).decode()
            view = TileView(self.version.epoch, self.version.seq, *self.tile, width, height, picture)
            self.data = msgspec.json.encode(view)


class TiledMap:
    """Follows the map, and says which tiles are to be encoded."""

    def __init__(self) -> None:
        self._follower = MapFollower()
        self._dirty: dict[Tile, None] = {}
        self._digests: dict[Tile, bytes] = {}
        self._geometry: GridGeometry | None = None

    @property
    def version(self) -> Version | None:
        """The version of the map that is followed; None before the first one."""
        return self._follower.version

    @property
    def geometry(self) -> GridGeometry | None:
        """Its geometry."""
        return self._geometry

    @property
    def delay_s(self) -> float:
        """How long ago (s) it was true what the latest heartbeat says."""
        return self._follower.delay_s

    def on_delta(self, delta: MapDelta, now: float) -> None:
        """Apply a delta."""
        self._mark(self._follower.on_delta(delta, now))

    def on_heartbeat(self, heartbeat: MapHeartbeat, now: float) -> None:
        """Hear which version is the newest."""
        self._follower.on_heartbeat(heartbeat, now)

    def wants_snapshot(self, now: float) -> bool:
        """Whether a snapshot is needed."""
        return self._follower.wants_snapshot(now)

    def load(self, decoded: DecodedMap, now: float) -> list[Tile]:
        """Load a snapshot; return the tiles of a map before that had another geometry. Raises `MapError`."""
        applied = self._follower.on_snapshot(decoded, now)
        gone: list[Tile] = []
        if decoded.geometry != self._geometry:
            gone = list(self._digests)
            self._geometry, self._digests, self._dirty = decoded.geometry, {}, {}
        self._mark(applied)
        return gone

    def jobs(self, most: int) -> list[TileJob]:
        """Return up to `most` tiles to be encoded, those that wait longest first; `add` each that has run."""
        version, geometry = self._follower.version, self._geometry
        if version is None or geometry is None:
            return []
        found = []
        for tile in list(self._dirty)[:most]:
            del self._dirty[tile]
            window = geometry.clip(Window(*tile, SIDE, SIDE))
            cells = self._follower.replica.cost[window.rows, window.columns].copy()
            found.append(TileJob(tile, version, cells, self._digests.get(tile, b"")))
        return found

    def add(self, job: TileJob) -> bool:
        """Take over a job that has run; return whether the tile is another one than before."""
        geometry = self._geometry
        if geometry is None or job.cells.shape != _shape(geometry, job.tile):
            return False  # of the map before
        self._digests[job.tile] = job.digest
        return job.data is not None

    def _mark(self, applied: Applied | None) -> None:
        if applied is not None and self._geometry is not None:
            for layer, window in applied.windows:
                if layer == "cost":
                    self._dirty.update(dict.fromkeys(_tiles(self._geometry.clip(window))))


def _tiles(window: Window) -> Iterator[Tile]:
    for row in _steps(window.y, window.height):
        for column in _steps(window.x, window.width):
            yield column, row


def _steps(begin: int, size: int) -> Iterable[int]:
    return range(begin // SIDE * SIDE, begin + size, SIDE) if size > 0 else ()


def _shape(geometry: GridGeometry, tile: Tile) -> tuple[int, int]:
    window = geometry.clip(Window(*tile, SIDE, SIDE))
    return window.height, window.width
