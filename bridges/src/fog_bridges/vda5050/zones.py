"""Fognav's hazards and zones as zone sets of VDA 5050 3.0, and how robots of others come to use them. Pure.

A zone set never changes: each state of the floor is a set of its own, with an id by its content. A robot is sent it,
told to enable it once it has it, and then to delete those before it. The format has no time to live, so the sender lets
what it knows expire: what nobody confirms any more is slow, and what was blocked stays blocked (6.4). Whoever says so
first, aggregator or map-service, blocks an area; it is clear only as long as the map shows that, confirmed.
"""

from __future__ import annotations

import hashlib
import math
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec

from fog_bridges.vda5050.outgoing import Point, Zone, ZoneSet
from fog_contracts.costs import DEGRADED_SPEED, LETHAL

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from fog_bridges.vda5050.incoming import ReportedZoneSet

UNKNOWN_M_S: Final = DEGRADED_SPEED / 100.0
"""The speed limit of an area that nobody knows: that of Fognav's own robots there."""
AGAIN_S: Final = 5.0
"""After how long something is sent again that the robot's state does not show."""
CLEARING_S: Final = 2.0
"""The shortest time between two zone sets of which the later one blocks nothing new."""
_CORNERS: Final = 16
"""Corners of a circle; its polygon lies outside, so that nothing of it is missing."""


def zones_of(areas: Mapping[str, dict[str, Any]], drawn: Mapping[str, dict[str, Any]], *, known: bool) -> list[Zone]:
    """Return what areas and zones (as the console tells them) mean for a robot; not `known`: nobody confirms them."""
    found = [zone for name, area in sorted(areas.items()) if (zone := _of_area(name, area, known=known)) is not None]
    for name, value in sorted(drawn.items()):
        if value["active"]:
            rings = _rings(value["shape"])
            names = [f"zone-{name}"] if len(rings) == 1 else [f"zone-{name}-{n}" for n in range(1, len(rings) + 1)]
            found += [_of_zone(each, value, ring) for each, ring in zip(names, rings, strict=True)]
    return found


def _of_area(name: str, area: dict[str, Any], *, known: bool) -> Zone | None:
    definition, hazard, on_map = area["definition"], area["hazard"], area.get("on_map")
    ring, zone = _points(definition["polygon"]), f"area-{name}"
    state = "unknown" if hazard is None else hazard["state"]
    penalty = definition["unknown"]["penalty"] if hazard is None else hazard["penalty"]
    if on_map is not None:
        penalty = max(penalty, on_map["penalty"])
    if state == "clear" and not (known and on_map is not None and on_map["confirmed"]):
        state = "unknown"
    if penalty >= LETHAL:
        words = f"area {name} is {state}"
        return Zone(zone_id=zone, zone_type="BLOCKED", zone_descriptor=words, vertices=ring)
    if state == "unknown":
        words = f"nobody knows whether area {name} is clear"
        return Zone(
            zone_id=zone, zone_type="SPEED_LIMIT", zone_descriptor=words, vertices=ring, maximum_speed=UNKNOWN_M_S
        )
    if penalty > 0:
        factor, words = round(penalty / LETHAL, 3), f"area {name} is {state}"
        return Zone(zone_id=zone, zone_type="PENALTY", zone_descriptor=words, vertices=ring, penalty_factor=factor)
    return None


def _of_zone(name: str, value: dict[str, Any], ring: list[Point]) -> Zone:
    words = value.get("reason") or f"zone {value['id']}"
    if value["kind"] == "SPEED_LIMIT":
        return Zone(
            zone_id=name, zone_type="SPEED_LIMIT", zone_descriptor=words, vertices=ring, maximum_speed=value["speed"]
        )
    if value["kind"] == "PENALTY":
        # A factor says how many free metres a metre there is worth: 1 is none, and infinity would be the norm's 1.0.
        factor = round(1.0 - 1.0 / value["factor"], 3)
        return Zone(zone_id=name, zone_type="PENALTY", zone_descriptor=words, vertices=ring, penalty_factor=factor)
    if value["kind"] == "RELEASE":
        # The norm's RELEASE lets a robot ask to get in. A place that is leased to robots of Fognav can't be promised to
        # one whose way Fognav does not know, so it stays out.
        words = f"one robot at a time, of those that Fognav leads: {words}"
    return Zone(zone_id=name, zone_type="BLOCKED", zone_descriptor=words, vertices=ring)


def _points(ring: Sequence[Sequence[float]]) -> list[Point]:
    return [Point(x=round(x, 3), y=round(y, 3)) for x, y in ring]


def _rings(shape: dict[str, Any]) -> list[list[Point]]:
    """Return the polygons whose union covers a shape."""
    kind = shape["type"]
    if kind == "polygon":
        return [_points(shape["points"])]
    if kind == "rectangle":
        (x0, y0), (x1, y1) = shape["corner"], shape["opposite"]
        return [_points([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])]
    if kind == "circle":
        return [_capsule(shape["centre"], shape["centre"], shape["radius"])]
    line, half = shape["line"], shape["width"] / 2.0
    return [_capsule(a, b, half) for a, b in pairwise(line)]


def _capsule(a: Sequence[float], b: Sequence[float], reach: float) -> list[Point]:
    """Return a polygon round all that is within `reach` (m) of a line."""
    along, outer = math.atan2(b[1] - a[1], b[0] - a[0]), reach / math.cos(math.pi / _CORNERS)
    half = _CORNERS // 2
    turns = [along - math.pi / 2.0 + (n + 0.5) * math.tau / _CORNERS for n in range(_CORNERS)]
    ends = [b] * half + [a] * half
    ring = [(end[0] + outer * math.cos(t), end[1] + outer * math.sin(t)) for end, t in zip(ends, turns, strict=True)]
    return _points(ring)


class ZoneSets:
    """The floor as a zone set."""

    def __init__(self, site: str, map_id: str) -> None:
        self.prefix = f"fognav-{site}-"
        """What the ids of all of Fognav's sets of this floor begin with."""
        self._map_id = map_id
        self._areas: dict[str, dict[str, Any]] = {}
        self._drawn: dict[str, dict[str, Any]] = {}
        self._is_known = False
        self._is_complete = False
        self._changed_at = -math.inf
        self.current: ZoneSet | None = None
        """The set that robots are to use; None until the floor is known."""

    def on_event(self, name: str, data: dict[str, Any]) -> None:
        """Take in an event of the floor."""
        if name == "hello":
            self._is_complete = False
            if data["fresh"]:
                self._areas, self._drawn = {}, {}
        elif name == "ready":
            self._is_known = self._is_complete = True
        elif (things := {"area": self._areas, "zone": self._drawn}.get(name)) is not None:
            if data["value"] is None:
                things.pop(data["id"], None)
            else:
                things[data["id"]] = data["value"]

    def on_lost(self) -> None:
        """Take in that nobody confirms the floor's state any more."""
        self._is_known = False

    def update(self, now: float) -> None:
        """Make the floor's state the current set: at once if it blocks more, a little later otherwise."""
        if not self._is_complete:
            return
        zones = zones_of(self._areas, self._drawn, known=self._is_known)
        if self.current is not None and zones == self.current.zones:
            return
        before = set() if self.current is None else {_blocking(zone) for zone in self.current.zones}
        if now - self._changed_at < CLEARING_S and {_blocking(zone) for zone in zones} <= before:
            return
        digest = hashlib.sha256(msgspec.json.encode(zones)).hexdigest()[:16]
        self.current = ZoneSet(map_id=self._map_id, zone_set_id=self.prefix + digest, zones=zones)
        self._changed_at = now


def _blocking(zone: Zone) -> bytes:
    return msgspec.json.encode(zone) if zone.zone_type == "BLOCKED" else b""


Step = tuple[Literal["zoneSet", "enableZoneSet", "deleteZoneSet"], str]


class ZoneUser:
    """What a robot of others has of zone sets, by its state, and what to send it next."""

    def __init__(self, prefix: str, map_id: str) -> None:
        self._prefix = prefix
        self._map_id = map_id
        self._sets: dict[str, str] | None = None
        self._sent: dict[Step, float] = {}
        self._wanted = ""
        self._enabled = ""
        """The set of Fognav's that the robot has used last."""
        self.is_online = False
        self.problem = "it has not told its state yet"
        """Why it does not use the current set; empty if it does."""

    def on_state(self, sets: Sequence[ReportedZoneSet]) -> None:
        """Take in which sets the robot has."""
        self._sets = {each.zone_set_id: each.zone_set_status for each in sets if each.map_id == self._map_id}
        own = (name for name, status in self._sets.items() if status == "ENABLED" and name.startswith(self._prefix))
        self._enabled = next(own, self._enabled)

    def steps(self, wanted: str, now: float) -> Iterator[Step]:
        """Yield what is to be sent, so that the robot uses the set `wanted` and has no other of Fognav's."""
        if wanted != self._wanted:  # what was sent for another set says nothing of this one
            self._wanted, self._sent = wanted, {}
        if self._sets is None or not self.is_online:
            self.problem = "it is not online" if not self.is_online else "it has not told its state yet"
            return
        status = self._sets.get(wanted)
        other = next(
            (n for n, each in self._sets.items() if each == "ENABLED" and not n.startswith(self._prefix)), None
        )
        if status == "ENABLED":
            self.problem = ""
            before = [n for n in self._sets if n.startswith(self._prefix) and n != wanted]
            yield from (step for name in before for step in self._once("deleteZoneSet", name, now))
        elif status is None:
            self.problem = f"it does not have the zone set {wanted}"
            yield from self._once("zoneSet", wanted, now)
        elif other is not None and self._enabled == wanted:
            # Only one set of a map is in use: who enabled the other has decided so, and is not fought.
            self.problem = f"somebody else has enabled the zone set {other[:80]}"
        else:
            self.problem = f"it has not enabled the zone set {wanted}"
            yield from self._once("enableZoneSet", wanted, now)

    def _once(self, kind: Literal["zoneSet", "enableZoneSet", "deleteZoneSet"], name: str, now: float) -> list[Step]:
        """Return a step unless it was taken just now."""
        self._sent = {step: at for step, at in self._sent.items() if now - at < AGAIN_S}
        step: Step = kind, name
        if step in self._sent:
            return []
        self._sent[step] = now
        return [step]
