"""Versioned copies of the master costmap: one writer, many replicas, and a hash that proves them equal.

Every version is named by `epoch, seq, hash`. The epoch changes when the writer starts, the seq grows by one with each
change, and the hash is over geometry, floor plan and both layers: versions with the same hash are the same map. It
combines the hashes of 64 x 64 tiles by XOR, so that a change needs only the hashes of its tiles; each tile's hash is
keyed by layer and tile number, so that equal tiles don't cancel out.
"""

import hashlib
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from fog_contracts.channels import DELTA_LIMIT
from fog_contracts.grid import GridGeometry, Window
from fog_contracts.handlers import Later
from fog_contracts.messages import (
    Cause,
    Layer,
    MapDelta,
    MapGeometry,
    MapHeartbeat,
    MapSnapshot,
    Packing,
    Trace,
)

TILE: Final = 64
LAYERS: Final[tuple[Layer, ...]] = get_args(Layer)
_HEADROOM: Final = 8 * 1024
"""Bytes of a delta reserved for everything but its cells; causes and traces are limited to fit."""
_MAX_CAUSES: Final = 24
_MAX_TRACES: Final = 8

Grid = NDArray[np.uint8]


class MapError(ValueError):
    """Cells or a version that do not fit the map; the message says what does not fit."""


def pack(cells: Grid) -> tuple[Packing, bytes]:
    """Return cells as bytes, row by row, compressed where that makes them smaller."""
    raw = cells.tobytes()
    packed = zlib.compress(raw, 1)
    return ("zlib", packed) if len(packed) < len(raw) else ("raw", raw)


def unpack(packing: Packing, data: bytes, shape: tuple[int, int], subject: str) -> Grid:
    """Return the cells (height, width) of `pack`; raises `MapError`, which names the subject, for damaged ones."""
    size = shape[0] * shape[1]
    if packing == "zlib":
        unpacker = zlib.decompressobj()
        try:
            data = unpacker.decompress(data, size + 1)
        except zlib.error as error:
            raise MapError(f"{subject} can't be decompressed: {error}") from error
    if len(data) != size:
        raise MapError(f"{subject} has {len(data)} cells or more instead of {shape[1]} x {shape[0]} = {size}")
    return np.frombuffer(data, dtype=np.uint8).reshape(shape)


def _writable(cells: Grid) -> Grid:
    """Return a copy; one of zeros takes no memory where nothing is written (most floors have no speed limits)."""
    return cells.copy() if cells.any() else np.zeros(cells.shape, np.uint8)


def plan_hash(geometry: GridGeometry, static: Grid) -> int:
    """Return a 63-bit hash of what never changes of a map: its geometry and its floor plan."""
    g = geometry
    place = struct.pack("<2Q3d", g.width, g.height, g.resolution, g.origin_x, g.origin_y)
    digest = hashlib.blake2b(np.ascontiguousarray(static).data, digest_size=8, key=place)
    return int.from_bytes(digest.digest(), "little") >> 1


class TileHashes:
    """The hash of a map, updated by recomputing changed tiles only; `plan` is its `plan_hash`."""

    def __init__(self, layers: Mapping[Layer, Grid], plan: int = 0) -> None:
        height, width = layers[LAYERS[0]].shape
        self._columns = -(-width // TILE)
        self._rows = -(-height // TILE)
        self._tiles = {layer: np.zeros((self._rows, self._columns), dtype=np.uint64) for layer in LAYERS}
        self.value = plan
        for layer in LAYERS:
            self.update(layer, layers[layer], Window(0, 0, width, height))

    def update(self, layer: Layer, grid: Grid, window: Window) -> None:
        """Recompute the tiles of `grid` that `window`, in which cells changed, overlaps."""
        if window.empty:
            return
        tiles = self._tiles[layer]
        key = layer.encode()
        for row in range(window.y // TILE, (window.y + window.height - 1) // TILE + 1):
            for column in range(window.x // TILE, (window.x + window.width - 1) // TILE + 1):
                tile = grid[row * TILE : (row + 1) * TILE, column * TILE : (column + 1) * TILE]
                salt = (row * self._columns + column).to_bytes(8, "little")
                digest = hashlib.blake2b(tile.tobytes(), digest_size=8, key=key, salt=salt).digest()
                tile_hash = int.from_bytes(digest, "little") >> 1  # 63 bits, which every msgpack decoder can represent
                self.value ^= int(tiles[row, column]) ^ tile_hash
                tiles[row, column] = tile_hash


@dataclass(frozen=True)
class Version:
    """Identifies one state of the map."""

    epoch: int
    seq: int
    hash: int


class MasterMap:
    """The writer's side: holds both layers and makes deltas of changed windows and snapshots of the whole map."""

    def __init__(self, site: str, geometry: GridGeometry, static: Grid, cost: Grid, epoch: int) -> None:
        if static.shape != geometry.shape or cost.shape != geometry.shape:
            raise MapError(f"layers of shape {static.shape} and {cost.shape} don't fit a map of {geometry.shape}")
        self.site = site
        self.geometry = geometry
        self.static = static
        self.layers: dict[Layer, Grid] = {"cost": cost.copy(), "speed": np.zeros(geometry.shape, dtype=np.uint8)}
        self._hashes = TileHashes(self.layers, plan_hash(geometry, static))
        self._version = Version(epoch, 0, self._hashes.value)
        self._snapshot: Later[MapSnapshot] | None = None
        self._static_packed: bytes | None = None
        # Memory for the copies of the next snapshot: on a large floor, fresh memory costs more than the copying.
        self._spare: list[dict[Layer, Grid]] = [self._new_copies()]

    @property
    def version(self) -> Version:
        """The current version."""
        return self._version

    def heartbeat(self, uptime: float, clock: int = 0) -> MapHeartbeat:
        """Return the message that announces the current version, sent at `uptime` of the monotonic clock `clock`."""
        version = self._version
        return MapHeartbeat(epoch=version.epoch, seq=version.seq, hash=version.hash, sent=(clock, uptime))

    def write(
        self,
        changes: list[tuple[Layer, Window, Grid]],
        causes: list[Cause],
        traces: list[Trace],
    ) -> list[MapDelta]:
        """Write windows of new cells; return the deltas of the new version, or none when no cell differs.

        Each window is first reduced to the cells that differ; a window too large for one message is split into parts.
        """
        pieces: list[tuple[Layer, Window, Packing, bytes]] = []
        for layer, window, cells in changes:
            grid = self.layers[layer]
            changed = self._changed_window(grid, window, cells)
            if changed.empty:
                continue
            x, y = changed.x - window.x, changed.y - window.y
            grid[changed.rows, changed.columns] = cells[y : y + changed.height, x : x + changed.width]
            self._hashes.update(layer, grid, changed)
            pieces.extend(self._split(layer, grid, changed))
        if not pieces:
            return []
        self._version = Version(self._version.epoch, self._version.seq + 1, self._hashes.value)
        self._snapshot = None
        return [
            MapDelta(
                epoch=self._version.epoch,
                seq=self._version.seq,
                part=part,
                parts=len(pieces),
                layer=layer,
                x=window.x,
                y=window.y,
                w=window.width,
                h=window.height,
                packing=packing,
                cells=data,
                hash=self._version.hash,
                causes=causes[:_MAX_CAUSES],
                traces=traces[:_MAX_TRACES],
            )
            for part, (layer, window, packing, data) in enumerate(pieces)
        ]

    def set_epoch(self, epoch: int) -> None:
        """Continue as another history, with the same cells: readers that have them go on with it."""
        self._version = Version(epoch, self._version.seq, self._version.hash)
        self._snapshot = None

    def snapshot(self) -> MapSnapshot:
        """Return the whole map; it is encoded once per version."""
        return self.snapshot_later().make()

    def snapshot_later(self) -> Later[MapSnapshot]:
        """Return the whole map as it is now, to be encoded on any thread; the same one until the next version."""
        if self._snapshot is None:
            # The floor plan never changes; the layers are copied, because the next version is written into them.
            copies = self._spare.pop() if self._spare else self._new_copies()
            for layer, cells in copies.items():
                np.copyto(cells, self.layers[layer])
            self._snapshot = Later(partial(self._encode, self._version, copies))
        return self._snapshot

    def _new_copies(self) -> dict[Layer, Grid]:
        return {layer: cells.copy() for layer, cells in self.layers.items()}

    def _encode(self, version: Version, copies: dict[Layer, Grid]) -> MapSnapshot:
        g = self.geometry
        snapshot = MapSnapshot(
            site=self.site,
            epoch=version.epoch,
            seq=version.seq,
            hash=version.hash,
            geometry=MapGeometry(
                width=g.width, height=g.height, resolution=g.resolution, origin_x=g.origin_x, origin_y=g.origin_y
            ),
            cost=zlib.compress(copies["cost"].data, 1),
            speed=zlib.compress(copies["speed"].data, 1),
            static=self._packed_static(),
        )
        if not self._spare:
            self._spare.append(copies)
        return snapshot

    def _packed_static(self) -> bytes:
        if self._static_packed is None:
            self._static_packed = zlib.compress(np.ascontiguousarray(self.static).data, 1)
        return self._static_packed

    @staticmethod
    def _changed_window(grid: Grid, window: Window, cells: Grid) -> Window:
        if cells.shape != (window.height, window.width):
            raise MapError(f"cells of shape {cells.shape} don't fill a window of {window.width} x {window.height}")
        changed = grid[window.rows, window.columns] != cells
        rows = np.flatnonzero(changed.any(axis=1))
        columns = np.flatnonzero(changed.any(axis=0))
        if rows.size == 0:
            return Window(window.x, window.y, 0, 0)
        return Window(
            window.x + int(columns[0]),
            window.y + int(rows[0]),
            int(columns[-1] - columns[0]) + 1,
            int(rows[-1] - rows[0]) + 1,
        )

    def _split(self, layer: Layer, grid: Grid, window: Window) -> list[tuple[Layer, Window, Packing, bytes]]:
        packing, data = pack(grid[window.rows, window.columns])
        if len(data) <= DELTA_LIMIT - _HEADROOM:
            return [(layer, window, packing, data)]
        if window.height >= window.width:
            half = window.height // 2
            first = Window(window.x, window.y, window.width, half)
            second = Window(window.x, window.y + half, window.width, window.height - half)
        else:
            half = window.width // 2
            first = Window(window.x, window.y, half, window.height)
            second = Window(window.x + half, window.y, window.width - half, window.height)
        return [*self._split(layer, grid, first), *self._split(layer, grid, second)]


@dataclass(frozen=True)
class Applied:
    """A new version was applied: the windows that changed, and why."""

    version: Version
    windows: list[tuple[Layer, Window]]
    causes: list[Cause]
    traces: list[Trace]
    previous: list[Grid] = field(default_factory=list)
    """What was in each window just before, unless a snapshot was loaded."""


Outcome = Applied | Literal["waiting", "old", "gap"]
"""`waiting`: parts of the version are missing; `old`: applied before; `gap`: a snapshot is needed."""


@dataclass(frozen=True)
class DecodedMap:
    """A snapshot's cells, decompressed and checked: what takes long when it is loaded, and needs no replica."""

    site: str
    geometry: GridGeometry
    version: Version
    static: Grid
    layers: dict[Layer, Grid]
    hashes: TileHashes


def decode_map(snapshot: MapSnapshot) -> DecodedMap:
    """Return a snapshot's cells (some 30 ms for 2000 x 1200); raises `MapError` when they are damaged.

    It touches nothing else, so it may run on any thread. Each result can be loaded once: the replica writes into it.
    """
    g = snapshot.geometry
    geometry = GridGeometry(g.width, g.height, g.resolution, g.origin_x, g.origin_y)
    layers: dict[Layer, Grid] = {
        "cost": _writable(unpack("zlib", snapshot.cost, geometry.shape, "the cost layer")),
        "speed": _writable(unpack("zlib", snapshot.speed, geometry.shape, "the speed layer")),
    }
    static = unpack("zlib", snapshot.static, geometry.shape, "the static layer")
    hashes = TileHashes(layers, plan_hash(geometry, static))
    if hashes.value != snapshot.hash:
        raise MapError("the snapshot's cells don't have its hash: it was damaged in transit")
    version = Version(snapshot.epoch, snapshot.seq, snapshot.hash)
    return DecodedMap(snapshot.site, geometry, version, static, layers, hashes)


class Replica:
    """The reader's side: a copy of the map that is always exactly one of the writer's versions.

    After a gap, an unknown epoch or a wrong hash it accepts no more deltas (`needs_snapshot`) until a snapshot replaces
    it. `MapFollower` decides which version is the newest and when to request a snapshot.
    """

    def __init__(self) -> None:
        self.site = ""
        self.geometry: GridGeometry | None = None
        self.static: Grid = np.zeros((0, 0), dtype=np.uint8)
        self.layers: dict[Layer, Grid] = {}
        self.version: Version | None = None
        self.needs_snapshot = True
        self._hashes: TileHashes | None = None
        self._parts: dict[int, MapDelta] = {}

    @property
    def cost(self) -> Grid:
        """The master costmap (height, width)."""
        return self.layers["cost"]

    @property
    def speed(self) -> Grid:
        """The speed layer (height, width), cm/s, 0 = no limit."""
        return self.layers["speed"]

    def load(self, snapshot: MapSnapshot | DecodedMap) -> Applied:
        """Replace the copy by a snapshot; raises `MapError` and changes nothing when the snapshot is damaged."""
        decoded = snapshot if isinstance(snapshot, DecodedMap) else decode_map(snapshot)
        self.site, self.geometry = decoded.site, decoded.geometry
        self.layers, self.static = decoded.layers, decoded.static
        self._hashes = decoded.hashes
        self._parts = {}
        self.version = decoded.version
        self.needs_snapshot = False
        return Applied(self.version, [(layer, decoded.geometry.whole) for layer in LAYERS], [], [])

    def apply(self, delta: MapDelta) -> Outcome:
        """Apply one delta; the copy changes only when a version is complete and its hash matches."""
        if self.version is None or self._hashes is None or self.needs_snapshot:
            return "gap"
        if delta.epoch == self.version.epoch and delta.seq <= self.version.seq:
            return "old"
        if not self._follows(delta, self.version):
            return self._reject()
        self._parts[delta.part] = delta
        if len(self._parts) < delta.parts:
            return "waiting"
        return self._complete(delta)

    def rename(self, version: Version) -> None:
        """Take the copy for another history's version, with which it has the hash in common: it is the same map."""
        if self.version is None or self.needs_snapshot or self.version.hash != version.hash:
            raise ValueError(f"{version} is not the version of this copy, {self.version}, under another name")
        self.version = version
        self._parts = {}

    def invalidate(self) -> None:
        """Accept no more deltas until a snapshot arrives: the copy is not of the writer's history."""
        self.needs_snapshot = True
        self._parts = {}

    def _follows(self, delta: MapDelta, version: Version) -> bool:
        """Whether this is a part of the version after ours, and of the same one as the parts that are already here."""
        if (delta.epoch, delta.seq) != (version.epoch, version.seq + 1) or delta.part >= delta.parts:
            return False
        return all(known.parts == delta.parts and known.hash == delta.hash for known in self._parts.values())

    def _complete(self, delta: MapDelta) -> Outcome:
        assert self.version is not None
        assert self._hashes is not None
        assert self.geometry is not None
        parts = [self._parts[index] for index in sorted(self._parts)]
        self._parts = {}
        pieces: list[tuple[Layer, Window, Grid]] = []
        for part in parts:
            window = Window(part.x, part.y, part.w, part.h)
            if self.geometry.clip(window) != window:
                return self._reject()
            try:
                cells = unpack(part.packing, part.cells, (part.h, part.w), "a delta")
            except MapError:
                # Damaged cells are handled like lost ones.
                return self._reject()
            pieces.append((part.layer, window, cells))
        previous = [(layer, window, self._write(layer, window, cells)) for layer, window, cells in pieces]
        if self._hashes.value != delta.hash:
            # Readers that use the copy until a snapshot arrives must see the old version, not a mixture.
            for layer, window, cells in reversed(previous):
                self._write(layer, window, cells)
            return self._reject()
        self.version = Version(delta.epoch, delta.seq, delta.hash)
        windows = [(layer, window) for layer, window, _ in pieces]
        before = [cells for _, _, cells in previous]
        return Applied(self.version, windows, list(parts[0].causes), list(parts[0].traces), before)

    def _write(self, layer: Layer, window: Window, cells: Grid) -> Grid:
        """Write cells and return the previous ones."""
        assert self._hashes is not None
        grid = self.layers[layer]
        old = grid[window.rows, window.columns].copy()
        grid[window.rows, window.columns] = cells
        self._hashes.update(layer, grid, window)
        return old

    def _reject(self) -> Literal["gap"]:
        self.invalidate()
        return "gap"
