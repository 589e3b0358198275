"""Zones: validated for operators, and all of them with their cells, found by id, by order and by place. Pure.

The change of one zone costs no time by their number. With thousands of zones, whatever walks through all of them takes
milliseconds, at each request.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, TypeVar

import msgspec
import numpy as np
from msgspec import structs

from fog_contracts import channels as ch
from fog_contracts.messages import ZoneSet
from fog_contracts.shapes import ShapeError, normalized_shape, shape_spans
from fog_contracts.weekly import is_time_zone

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry, Window
    from fog_contracts.messages import Zone
    from fog_contracts.shapes import Spans
    from map_service.zone_times import ZoneTimes

T = TypeVar("T")

_CAPACITY: Final = 64


def encoded_size(zone: Zone) -> int:
    """Return the size (bytes) of a zone in the message that lists all zones, which names it again while in force."""
    return len(msgspec.msgpack.encode(zone)) + len(msgspec.msgpack.encode(zone.id))


@dataclass(eq=False)
class ZoneEntry:
    """A zone, its cells, how many they are, its size in the list of zones (bytes), and whether it is in force."""

    zone: Zone
    spans: Spans
    cells: int
    size: int
    times: ZoneTimes
    active: bool

    @classmethod
    def of(cls, zone: Zone, spans: Spans, times: ZoneTimes, *, active: bool) -> ZoneEntry:
        """Return the entry of a zone with these cells and times."""
        return cls(zone, spans, spans.cells, encoded_size(zone), times, active)

    @property
    def timed(self) -> bool:
        """Whether time decides if the zone is in force."""
        zone = self.zone
        return not (zone.starts_at is None and zone.expires_at is None and zone.ttl_s is None and zone.schedule is None)


class ZoneCatalog:
    """The entries of all zones, and the sums over them."""

    def __init__(self) -> None:
        self._entries: dict[str, ZoneEntry] = {}
        self._timed: dict[str, ZoneEntry] = {}
        self._in_sets: dict[str, ZoneEntry] = {}
        self._zones: _Ordered[Zone] = _Ordered()
        self._active: _Ordered[str] = _Ordered()
        self._places = _Places()
        self._touched: dict[str, str] = {}
        self.cells = 0
        """How many cells all zones cover in sum."""
        self.size = 0
        """Size (bytes) of all zones in the message that lists them."""

    def __len__(self) -> int:
        return len(self._entries)

    def __getitem__(self, zone_id: str) -> ZoneEntry:
        return self._entries[zone_id]

    def get(self, zone_id: str) -> ZoneEntry | None:
        """Return the entry of a zone, None if there is none."""
        return self._entries.get(zone_id)

    def ids(self) -> list[str]:
        """Return the ids of all zones."""
        return list(self._entries)

    def zones(self) -> list[Zone]:
        """Return all zones by id; the same list, which nobody may change, until the next change."""
        return self._zones.values()

    def active(self) -> list[str]:
        """Return the ids of the zones in force, ordered; the same list, as above."""
        return self._active.values()

    def timed(self) -> Collection[ZoneEntry]:
        """Return the entries of the zones that begin or end by themselves."""
        return self._timed.values()

    def in_sets(self) -> Collection[ZoneEntry]:
        """Return the entries of the zones that are switched together with others."""
        return self._in_sets.values()

    def active_in(self, window: Window) -> list[ZoneEntry]:
        """Return the entries of the zones in force whose windows overlap this one."""
        return [self._entries[name] for name in self._places.overlapping(window)]

    def put(self, entry: ZoneEntry) -> None:
        """Add an entry, or replace that of the same zone."""
        name = entry.zone.id
        self.remove(name)
        self._entries[name] = entry
        self._zones.put(name, entry.zone)
        self.cells += entry.cells
        self.size += entry.size
        if entry.timed:
            self._timed[name] = entry
        if entry.zone.sets:
            self._in_sets[name] = entry
        if entry.active:
            self._activate(entry)
        self._touched[name] = "active" if entry.active else "inactive"

    def remove(self, zone_id: str) -> ZoneEntry | None:
        """Remove a zone; return its entry, None if there was none."""
        entry = self._entries.pop(zone_id, None)
        if entry is None:
            return None
        self._touched[zone_id] = "removed"
        self._zones.remove(zone_id)
        self._timed.pop(zone_id, None)
        self._in_sets.pop(zone_id, None)
        self.cells -= entry.cells
        self.size -= entry.size
        if entry.active:
            self._deactivate(entry)
        return entry

    def set_active(self, entry: ZoneEntry, active: bool) -> None:  # noqa: FBT001  # what the entry is to be
        """Put a zone into force, or end it."""
        if active and not entry.active:
            self._activate(entry)
        elif entry.active and not active:
            self._deactivate(entry)
        entry.active = active
        self._touched[entry.zone.id] = "active" if active else "inactive"

    def pop_touched(self) -> dict[str, str]:
        """Return the zones that have changed since the last call, each with what has become of it."""
        touched, self._touched = self._touched, {}
        return touched

    def _activate(self, entry: ZoneEntry) -> None:
        self._active.put(entry.zone.id, entry.zone.id)
        self._places.put(entry.zone.id, entry.spans.window)

    def _deactivate(self, entry: ZoneEntry) -> None:
        self._active.remove(entry.zone.id)
        self._places.remove(entry.zone.id)


class _Ordered(Generic[T]):
    """Values in the order of their names. A list that was handed out is never changed, but copied before a change."""

    def __init__(self) -> None:
        self._names: list[str] = []
        self._values: list[T] = []
        self._handed_out = False

    def values(self) -> list[T]:
        self._handed_out = True
        return self._values

    def put(self, name: str, value: T) -> None:
        """Add a new name."""
        index = bisect_left(self._names, name)
        self._names.insert(index, name)
        self._own().insert(index, value)

    def remove(self, name: str) -> None:
        """Remove a name that is there."""
        index = bisect_left(self._names, name)
        del self._names[index]
        del self._own()[index]

    def _own(self) -> list[T]:
        if self._handed_out:
            self._values, self._handed_out = self._values.copy(), False
        return self._values


class _Places:
    """The windows of the zones in force, as an array: which of them overlap another is one operation on it."""

    def __init__(self) -> None:
        self._names: list[str] = []
        self._rows: dict[str, int] = {}
        self._windows: NDArray[np.int64] = np.zeros((_CAPACITY, 4), np.int64)

    def put(self, name: str, window: Window) -> None:
        """Add a new name; the window of a shape beside the map is empty."""
        if window.empty:
            return
        row = len(self._names)
        if row == len(self._windows):
            self._windows = np.concatenate([self._windows, np.zeros_like(self._windows)])
        self._names.append(name)
        self._rows[name] = row
        self._windows[row] = window

    def remove(self, name: str) -> None:
        """Remove a name, if it is there; the last one takes its row."""
        row = self._rows.pop(name, None)
        if row is None:
            return
        last = self._names.pop()
        if last != name:
            self._names[row], self._rows[last] = last, row
            self._windows[row] = self._windows[len(self._names)]

    def overlapping(self, window: Window) -> Iterable[str]:
        x, y, width, height = self._windows[: len(self._names)].T
        overlapping = (x < window.x + window.width) & (window.x < x + width)
        overlapping &= (y < window.y + window.height) & (window.y < y + height)
        return [self._names[row] for row in np.flatnonzero(overlapping).tolist()]


MAX_ZONES: Final = 5_000
"""Most zones of a site."""
MAX_COVERAGE: Final = 64
"""How many times all zones together may cover the floor."""


class ZoneError(ValueError):
    """A zone is invalid: `field` is the path of the field in the zone, the message names the problem and the remedy."""

    def __init__(self, field: str, message: str) -> None:
        super().__init__(f"{field}: {message}")
        self.field = field
        self.message = message


class PreparedZone(NamedTuple):
    """A valid zone as it is stored (polygons counter-clockwise), and its cells."""

    zone: Zone
    spans: Spans


def prepare_zone(zone: Zone, geometry: GridGeometry, stamp: float) -> PreparedZone:
    """Validate and rasterize a zone; raises `ZoneError` that names field and remedy.

    `stamp` is the time (s since the epoch), or 0 while that is not known. Large shapes take some ten milliseconds: a
    service runs it on another thread.
    """
    if zone.kind == "PENALTY" and zone.factor is None:
        raise ZoneError("factor", "a PENALTY zone needs a factor from 1 to 5: how many free cells a cell counts")
    if zone.kind == "SPEED_LIMIT" and zone.speed is None:
        raise ZoneError("speed", "a SPEED_LIMIT zone needs a speed in m/s")
    if zone.kind != "PENALTY" and zone.factor is not None:
        raise ZoneError("factor", f"a {zone.kind} zone has no factor: leave it out or make the kind PENALTY")
    if zone.kind != "SPEED_LIMIT" and zone.speed is not None:
        raise ZoneError("speed", f"a {zone.kind} zone has no speed: leave it out or make the kind SPEED_LIMIT")
    if zone.schedule is not None and not is_time_zone(zone.schedule.time_zone):
        problem = f"{zone.schedule.time_zone!r} is no time zone that this machine knows"
        raise ZoneError("schedule.time_zone", f"{problem}: name one such as Europe/Lisbon or UTC")
    if zone.expires_at is not None and zone.expires_at <= max(stamp, zone.starts_at or 0.0):
        raise ZoneError("expires_at", "the zone would end before it starts: give a later time, or leave it out")
    try:
        shape = normalized_shape(zone.shape)
        spans = shape_spans(shape, geometry)
    except ShapeError as error:
        raise ZoneError(f"shape.{error.field}", error.problem) from error
    if spans.window.empty:
        left, bottom, right, top = geometry.bounds
        raise ZoneError(
            "shape",
            f"the zone lies off the map, which reaches from ({left:.2f}, {bottom:.2f}) to ({right:.2f}, {top:.2f}) m:"
            " move it onto the map",
        )
    return PreparedZone(structs.replace(zone, shape=shape), spans)


def check_sets(zone: Zone, known: Collection[str]) -> None:
    """Raise `ZoneError` for a set that the zone names and nobody has added."""
    for index, name in enumerate(zone.sets):
        if name not in known:
            problem = f"there is no set of zones {name}: PUT /api/v1/zone-sets/{name} first"
            raise ZoneError(f"sets.{index}", problem)


def check_room(prepared: PreparedZone, count: int, cells: int, geometry: GridGeometry) -> None:
    """Raise `ZoneError` when a zone is one too many for `count` others that cover `cells` cells in sum."""
    if count >= MAX_ZONES:
        raise ZoneError("", f"there are {count} zones already, which is the limit: delete zones that are not needed")
    floor = geometry.width * geometry.height
    if cells + prepared.spans.cells > MAX_COVERAGE * floor:
        problem = f"all zones together would cover the floor more than {MAX_COVERAGE} times"
        raise ZoneError("shape", f"{problem}: make it smaller, or delete zones that are not needed")


def zones_spans(zones: Iterable[Zone], geometry: GridGeometry) -> tuple[dict[str, Spans], dict[str, str]]:
    """Return the cells of each zone by its id, and, by id, why the shapes of others are invalid."""
    spans: dict[str, Spans] = {}
    invalid: dict[str, str] = {}
    for zone in zones:
        try:
            spans[zone.id] = named_spans(zone, geometry)
        except ShapeError as error:
            invalid[zone.id] = str(error)
    return spans, invalid


def named_spans(zone: Zone, geometry: GridGeometry) -> Spans:
    """Return the cells of a zone; raises `ShapeError`, which names the zone."""
    try:
        return shape_spans(zone.shape, geometry)
    except ShapeError as error:
        raise ShapeError(f"{zone.id}.shape.{error.field}", error.problem) from error


def list_size(size: int) -> int:
    """Return the largest size (bytes) of the message that tells robots of zones that have `size` bytes in sum."""
    return _EMPTY_LIST + size


def check_list_size(zone: Zone, others: int, known: int) -> None:
    """Raise `ZoneError` when this zone, new or changed, would make the list of all zones too large for robots.

    `others` are the bytes of all others (`encoded_size`), `known` those of all as they are: a list that is too large
    already may shrink.
    """
    size = list_size(others + encoded_size(zone))
    if size > max(ch.ZONES.limit, list_size(known)):
        raise ZoneError(
            "shape",
            f"the list of all zones would have {size} bytes, and robots accept {ch.ZONES.limit}: give the shape fewer"
            " corners, or delete zones that nobody needs",
        )


_LARGEST: Final = 2**53
_EMPTY_LIST: Final = len(msgspec.msgpack.encode(ZoneSet(epoch=_LARGEST, seq=_LARGEST, zones=[], active=[]))) + 2 * 4
"""Size of a list without zones, and of the longer numbers of zones and active ones in it."""
