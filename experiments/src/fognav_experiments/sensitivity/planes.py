"""What a sweep drives: planes of two quantities each, and for every point drives that show what the fog saves. Pure.

At each point the robot that the fog leads is compared with the one on its own, on the same drawn routes.
"""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import msgspec

from fog_contracts.messages import NodeConfig
from fognav_experiments.comparison.driven import DrivenRoute
from fognav_experiments.statistics import Estimate, estimate

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from fog_contracts.messages import ProfileName
    from fog_contracts.site import Site
    from fognav_experiments.comparison.draws import RouteDraw

Quantity = Literal["readings", "pause_ms", "areas", "speed_m_s"]
UNITS: Final[dict[Quantity, str]] = {
    "readings": "readings that confirm a state (debounce N)",
    "pause_ms": "pause of a node between two readings, ms",
    "areas": "watched areas (0: all)",
    "speed_m_s": "highest speed of the robot, m/s",
}
OF_THE_ROBOT: Final[frozenset[Quantity]] = frozenset({"speed_m_s"})
"""What also changes the robot that nobody warns; it is driven once for all values of the others."""


NODE_PAUSE_MS: Final[int] = next(
    field.default for field in msgspec.structs.fields(NodeConfig) if field.name == "pause_ms"
)
"""The pause of a node that nobody has configured otherwise."""


class Variation(msgspec.Struct, frozen=True, kw_only=True):
    """A point of a plane.

    `readings` in a row confirm a state, 0: by the site's own rule. `pause_ms`: of a node between two readings. `areas`:
    how many are watched, 0: all. `speed_m_s`: the robot's highest.
    """

    readings: int = 0
    pause_ms: int = NODE_PAUSE_MS
    areas: int = 0
    speed_m_s: float = 0.3

    @property
    def name(self) -> str:
        """The point's name in files."""
        return f"n{self.readings}-p{self.pause_ms}-a{self.areas}-v{self.speed_m_s:g}"


BASE: Final = Variation()


class Axis(NamedTuple):
    """A quantity and its values."""

    quantity: Quantity
    values: Sequence[float]


class Plane(NamedTuple):
    """Two quantities of which every combination is tried, all others as they are by default."""

    x: Axis
    y: Axis

    def at(self, x: float, y: float) -> Variation:
        """Return the point with these values."""
        changed = {self.x.quantity: x, self.y.quantity: y}
        return msgspec.convert(msgspec.to_builtins(BASE) | changed, Variation)

    def points(self) -> list[Variation]:
        """Return every point, row by row."""
        return [self.at(x, y) for y in self.y.values for x in self.x.values]


class SweptDrive(DrivenRoute, frozen=True, kw_only=True):
    """One drive of a sweep in lockstep.

    `sources`: digest of the program on the machine that drove it.
    """

    variation: Variation
    sources: str = ""

    @property
    def name(self) -> str:
        """Name of the record's file, without suffix."""
        return f"{self.run:04}-{self.route}-{self.setup}-{self.variation.name}"


class SweepTask(NamedTuple):
    """A drive to run."""

    drawn: RouteDraw
    setup: ProfileName
    variation: Variation

    @property
    def name(self) -> str:
        """Name of its record."""
        return f"{self.drawn.run:04}-{self.drawn.route.name}-{self.setup}-{self.variation.name}"


def unwarned(variation: Variation) -> Variation:
    """Return the variation by which the robot on its own drives: what the fog has means nothing to it."""
    own = {quantity: getattr(variation, quantity) for quantity in OF_THE_ROBOT}
    return msgspec.convert(msgspec.to_builtins(BASE) | own, Variation)


def sweep_tasks(planes: Iterable[Plane], drawn: Sequence[RouteDraw]) -> list[SweepTask]:
    """Return the drives of all points, each once."""
    found: dict[str, SweepTask] = {}
    for route in drawn:
        for plane in planes:
            for point in plane.points():
                both = SweepTask(route, "default", unwarned(point)), SweepTask(route, "fog", point)
                found |= {task.name: task for task in both}
    return list(found.values())


def varied_site(site: Site, variation: Variation, seed: int) -> Site:
    """Return the site with so many of its watched areas, drawn from the seed, that debounce as the variation says."""
    kept = [area.id for area in site.areas]
    if 0 < variation.areas < len(kept):
        kept = random.Random(seed).sample(kept, variation.areas)  # noqa: S311  # repeatable, not a secret
    debounce = {"rule": "consecutive", "to_blocked": variation.readings, "to_clear": variation.readings}
    areas = [
        msgspec.structs.replace(area, debounce=debounce) if variation.readings else area
        for area in site.areas
        if area.id in kept
    ]
    return msgspec.structs.replace(site, areas=areas, nodes=[node for node in site.nodes if node.area in kept])


class Gain(NamedTuple):
    """What the fog saves at a point: metres and seconds, over the routes that both robots drove."""

    metres: Estimate
    seconds: Estimate


def gain(drives: Iterable[SweptDrive], point: Variation) -> Gain | None:
    """Return what the fog saves at a point; None without a route that both robots drove to its end."""
    known = {(drive.setup, drive.variation, drive.run, drive.route): drive for drive in drives if drive.success}
    metres, seconds = [], []
    for (setup, variation, run, route), led in known.items():
        alone = known.get(("default", unwarned(point), run, route))
        if setup == "fog" and variation == point and alone is not None:
            metres.append(alone.distance_m - led.distance_m)
            seconds.append((alone.time_s or 0.0) - (led.time_s or 0.0))
    return Gain(estimate(metres), estimate(seconds)) if metres else None
