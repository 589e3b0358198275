"""Kinds of sensors by what they cost a corridor, and how many metres they save: where a node hangs, another one.

Geometry decides, and what a kind can see at all: how much of the area its beams cover. What a warning saves is that of
drives that were made, with their own obstacles. A kind saves it for the share of places in the area at which it would
see an obstacle that closes the corridor. All kinds confirm within a second, which costs a robot 0.3 m of its way.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import numpy as np

from fog_contracts.geometry import normalized_polygon
from fog_contracts.messages import SimObstacle
from fog_kernels.sonar import SONAR_MAX_INCIDENCE
from fog_runtime.files import SHARED, atomic_write
from fognav_experiments.figures import (
    Block,
    Code,
    Estimate,
    Heading,
    Paragraph,
    Picture,
    Table,
    clustered,
    scatter,
    to_markdown,
)
from fognav_sim.floor import Floor

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from fog_contracts.site import AreaSite, NodeSite
    from fog_runtime.configuration.site import LoadedSite
    from fognav_experiments.comparison.records import Record

What = Literal["box", "door", "people"]
WHAT: Final[dict[What, float]] = {"box": 0.6, "door": 0.05, "people": 0.5}
"""What closes a corridor from wall to wall, and how thick (m) it is along it."""
NODE_EUR: Final = 16.0
"""A node without its two sonars: docs/hardware.md."""
MARGIN_M: Final = 0.3
"""An echo counts if it is so much nearer than the free corridor, as the nodes' limits of range are set."""
_PLACES: Final = 81
_RAYS: Final = 61
_BEGIN_M: Final = 0.2
"""So far before the node's wall it begins, as the barriers of the drives do: no robot fits between."""
_WALL_GAP_M: Final = 0.02


class SensorKind(NamedTuple):
    """A kind of sensor, as its data sheet describes it.

    beams: directions from the node's own and half widths (rad). ranges: whether one stands for a whole beam, or each
    zone has its own. oblique: the largest angle of incidence (rad) that still returns. sees: what it can see at all.
    each_eur: a piece, of which there are so many.
    """

    name: str
    beams: Sequence[tuple[float, float]]
    range_m: float
    ranges: Literal["one", "zones"]
    oblique: float
    sees: frozenset[What]
    pieces: int
    each_eur: float
    source: str
    price: str

    @property
    def eur(self) -> float:
        """What a corridor costs."""
        return self.pieces * self.each_eur + NODE_EUR


_ONE: Final = "one"
_ZONES: Final = "zones"
_ANY: Final = math.pi / 2.0
_ALL: Final = frozenset[What](("box", "door", "people"))
_SONARS: Final = ((-0.22, math.radians(7.5)), (0.22, math.radians(7.5)))
_HC_SR04: Final = "HC-SR04 data sheet: 15 degrees, 0.02 to 4 m, a cycle of 60 ms or more"
_ASSUMED: Final = "assumed: no shop's page was at hand"
KINDS: Final = (
    SensorKind(
        "ultrasound, two HC-SR04", _SONARS, 4.0, _ONE, SONAR_MAX_INCIDENCE, _ALL, 2, 2.0, _HC_SR04, "docs/hardware.md"
    ),
    SensorKind(
        "the same, if oblique faces echo", _SONARS, 4.0, _ONE, _ANY, _ALL, 2, 2.0, _HC_SR04, "docs/hardware.md"
    ),
    SensorKind(
        "time of flight, one VL53L1X", ((0.0, math.radians(13.5)),), 4.0, _ONE, _ANY, _ALL, 1, 12.0,
        "VL53L1X data sheet (DocID031281): 27 degrees, up to 4 m, up to 50 Hz", _ASSUMED,
    ),
    SensorKind(
        "wide cone in zones, one VL53L8CX", ((0.0, math.radians(22.5)),), 4.0, _ZONES, _ANY, _ALL, 1, 20.0,
        "VL53L8CX data sheet (DS14161) and manual: 45 x 45 degrees, 8 x 8 zones, up to 4 m, up to 60 Hz", _ASSUMED,
    ),
    SensorKind(
        "presence, one LD2410", ((0.0, math.radians(60.0)),), 6.0, _ZONES, _ANY, frozenset[What](("people",)), 1, 5.0,
        "HLK-LD2410 manual: 24 GHz, +-60 degrees, up to 6 m, people that move or breathe", _ASSUMED,
    ),
    SensorKind(
        "door contact, one reed switch", (), 0.0, _ONE, _ANY, frozenset[What](("door",)), 1, 7.9,
        "Adafruit 375: closes within 13 mm of its magnet", "store.robot-domestici.it, without VAT",
    ),
)  # fmt: skip


def coverage(site: LoadedSite, area: AreaSite, kind: SensorKind, what: What) -> float:
    """Return at which share of the places along an area its node's place lets this kind see what closes it there."""
    if what not in kind.sees:
        return 0.0
    if not kind.beams:
        return 1.0  # it is on the door itself
    node = next(node for node in site.site.nodes if node.area == area.id)
    floor = Floor(site.map.geometry, site.map.cells)
    along = np.array((-math.sin(node.theta), math.cos(node.theta)))
    offsets = (np.array(normalized_polygon(area.polygon)) - (node.x, node.y)) @ along
    half = WHAT[what] / 2.0
    seen = [_sees(floor, node, kind, shift, half) for shift in
            np.linspace(offsets.min() + half, offsets.max() - half, _PLACES)]  # fmt: skip
    return float(np.mean(seen))


def _sees(floor: Floor, node: NodeSite, kind: SensorKind, shift: float, half: float) -> bool:
    """Whether a kind in a node's place sees what closes the corridor so far (m) beside it, and is so thick."""
    ahead = np.array((math.cos(node.theta), math.sin(node.theta)))
    along = np.array((-ahead[1], ahead[0]))
    foot = np.array((node.x, node.y)) + shift * along
    far = float(floor.wall_ranges(float(foot[0]), float(foot[1]), np.array((node.theta,)), 20.0)[0]) - _WALL_GAP_M
    ends = ((_BEGIN_M, -half), (far, -half), (far, half), (_BEGIN_M, half))
    corners = [foot + u * ahead + v * along for u, v in ends]
    floor.place(SimObstacle(id="block", polygon=[(float(x), float(y)) for x, y in corners], height=1.0))
    for middle, width in kind.beams:
        rays = node.theta + middle + np.linspace(-width, width, _RAYS)
        free = floor.wall_ranges(node.x, node.y, rays, 20.0)
        ((_, found, squareness),) = floor.obstacle_ranges(node.x, node.y, rays, 20.0)
        limit = np.minimum((free if kind.ranges == "zones" else free.min()) - MARGIN_M, kind.range_m)
        if ((found <= limit) & (np.arccos(np.minimum(squareness, 1.0)) <= kind.oblique)).any():
            return True
    return False


class Saved(NamedTuple):
    """What a kind saves per 100 drives (m) if everything that closes corridors is of one sort, and how much it sees."""

    metres: Estimate
    share: float


def saved(site: LoadedSite, records: Sequence[Record], kind: SensorKind | None, what: What) -> Saved:
    """Return what a kind would have saved in drives of `default` and `fog`; None: a sensor that sees all of an area.

    Each run is a situation of its own. Raises `ValueError` without a run that both drove to its end.
    """
    known = {(record.setup, record.run): record for record in records if record.success}
    shares = {area.id: 1.0 if kind is None else coverage(site, area, kind, what) for area in site.site.areas}
    found = [
        100.0 * shares[fog.area] * (known["default", run].distance_m - fog.distance_m)
        for (setup, run), fog in known.items()
        if setup == "fog" and ("default", run) in known
    ]
    return Saved(clustered(found, range(len(found))), float(np.mean(list(shares.values()))))


def publish(site: LoadedSite, records: Sequence[Record], command: str, target: Path) -> list[Path]:
    """Write the page and its picture; return their files."""
    all_ = saved(site, records, None, "box")
    found = {kind: {what: saved(site, records, kind, what) for what in WHAT} for kind in KINDS}
    rows = [
        [kind.name, f"{kind.eur:.0f}", f"{100.0 * of['box'].share:.0f}", *(str(of[what].metres) for what in WHAT),
         f"{kind.eur / of['box'].metres.mean * 100.0:.1f}" if of["box"].metres.mean > 0.0 else "-"]
        for kind, of in found.items()
    ]  # fmt: skip
    points = {kind.name: (kind.eur, of["box"].metres) for kind, of in found.items()}
    picture = scatter(points, "cost of a corridor, euros", "m saved per 100 drives")
    blocks: list[Block] = [
        Heading("Kinds of sensors: cost against metres saved", 1),
        Paragraph(_ABOUT.format(n=all_.metres.n, all=all_.metres)),
        Code(command),
        Picture("cost-metres.svg", picture, _CAPTION),
        Table(_HEADER, rows),
        Heading("What the kinds are"),
        Table(
            ["kind", "from", "price of a piece, euros", "price from"],
            [[kind.name, kind.source, f"{kind.each_eur:g}", kind.price] for kind in KINDS],
        ),
        Heading("What this does not say"),
        Paragraph(_LIMITS),
    ]
    texts = {"README.md": to_markdown(blocks), "cost-metres.svg": picture}
    for name, text in texts.items():
        atomic_write(target / name, text.encode(), mode=SHARED)
    return [target / name for name in texts]


_CAPTION: Final = (
    "Metres saved per 100 drives if boxes close corridors, by what a corridor costs, with 95 % confidence intervals."
)
_HEADER: Final = [
    "in a node's place", "a corridor, euros", "places at which it sees a box, %", "saved per 100 drives, m: box",
    "closed door", "people", "euros a corridor per 100 m saved, box",
]  # fmt: skip
_ABOUT: Final = (
    "What other sensors in the place of each node would have saved in the {n} drives of "
    "[estig-floor](../estig-floor/README.md), which were made with barriers that the node saw. There the fog saved "
    "{all} m per 100 drives against a robot on its own (`default`, the control, in the same draws): a sensor that sees "
    "all of an area saves that. A kind saves its share of it: that of "
    f"{_PLACES} places along the area at which it sees what closes the corridor from wall to wall there, {MARGIN_M} m "
    "nearer than the free corridor. An obstacle that no sensor sees saves nothing "
    "([sensitivity](../sensitivity/README.md)). Each column takes everything that closes corridors for boxes 0.6 m "
    "thick, for closed doors, or for people shoulder to shoulder, since nobody has counted which share is which. "
    "Intervals are of 95 % and count draws, of which each is a situation of its own; they tell how the draws fell. All "
    "kinds have the same draws, and differ by their shares, which are computed and have no error of that sort."
)
_LIMITS: Final = (
    "Nothing was driven with these sensors: it is the geometry of their beams on drives that were made, and no "
    "reading. Ultrasound has two rows: by the simulator's model a face echoes only below an angle of incidence of "
    f"{math.degrees(SONAR_MAX_INCIDENCE):.0f} degrees, so that a box beside the node throws the sound away (in "
    "lockstep the node of z4 said `clear` of a box 0.45 m beside it, and `blocked` at 0.3 m); real ones have edges, "
    "and lie between. The data sheets give no rates of false alarms and misses, so none are assumed: a "
    "sonar that hears no soft coat, or a cone blinded by sunlight, saves less, and each false alarm that a robot meets "
    "costs it 2 to 15 m ([sensitivity-world](../sensitivity-world/README.md), three situations). One sensor hangs "
    "where the node hangs; who needs all of a corridor hangs more. The watched areas are 4 m long: in shorter ones the "
    "narrow kinds see a larger share. The contact is on the one door that closes the corridor. Prices are of "
    "single pieces, with the rest of a node of docs/hardware.md, for contact and radar, too; most are assumed, see "
    "above, and none has labour, cables or mains in it. A presence sensor says nothing of boxes, and people who can be "
    "passed bar no way."
)
