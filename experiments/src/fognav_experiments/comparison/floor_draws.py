"""Draws of stops, areas and moments at random over a floor, beside the thesis's few routes. Pure.

Two stops, uniform over the floor on which the robot can stand, with a way of some length between them; in three of four
draws one of the watched areas that this way crosses, else any of the site's; and, in half of them, a moment under way,
uniform over its length. Left out is only what is no drive: stops that no way leads between, and obstacles that leave
none. So every run is a situation of its own. Of areas anywhere one in twelve stood in the way on `estig`.
"""

from __future__ import annotations

import math
import random
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.messages import Place
from fognav_experiments.comparison.drives import UNDER_WAY_M, RouteDraw, RouteSpec
from fognav_experiments.comparison.limits import RouteGeometry
from fognav_sim.barrier import BarrierError
from fognav_sim.drive.hazard import entry_distance, path_length

if TYPE_CHECKING:
    from fognav_experiments.comparison.drives import When
    from fognav_sim.drive.hazard import SiteWithMap

STOPS: Final = ("p1", "p2")
"""Names of the stops that were drawn; they are no places of the site."""
ROUTE_M: Final = 20.0
"""Least way between two stops; on a small floor a third of its diagonal."""
CROSSED: Final = 0.75
"""Share of the draws whose area lies on the shortest way, where one does."""
_MOST_COST: Final = 128
"""Inflated cost below which a stop lies: a robot that stands there has walls at some distance."""
_ATTEMPTS: Final = 300


class FloorDrawError(ValueError):
    """A floor on which nothing can be drawn; the message says what is missing."""


class FloorDraws:
    """Draws the runs of one floor."""

    def __init__(self, site: SiteWithMap) -> None:
        """Prepare a floor; raises `FloorDrawError` for one without watched areas."""
        self._site = site
        if not site.site.areas:
            raise FloorDrawError(f"site {site.site.id} has no watched areas: nothing can be blocked there")
        self._geometry = RouteGeometry(site)
        grid = site.map.geometry
        cells = np.argwhere(self._geometry.open_cost < _MOST_COST)[:, ::-1] + 0.5
        self._floor = cells * grid.resolution + (grid.origin_x, grid.origin_y)
        west, south, east, north = grid.bounds
        self._least_m = min(ROUTE_M, math.hypot(east - west, north - south) / 3.0)

    def draw(self, seed: int, run: int) -> list[RouteDraw]:
        """Return the one route of a run, the same whenever it is drawn; raises `FloorDrawError` if none is found."""
        generator = random.Random(f"floor {seed} {run}")  # noqa: S311  # repeatable, not a secret
        areas = [area.id for area in self._site.site.areas]
        for _ in range(_ATTEMPTS):
            start, goal = self._stop(generator), self._stop(generator)
            way = self._geometry.way(start, goal)
            if way is None or (length := path_length(way)) < self._least_m:
                continue
            crossed = [area.id for area in self._site.site.areas if entry_distance(way, area.polygon) is not None]
            on_way = generator.random() < CROSSED
            moment: When = generator.choice(("before", "under way"))
            late = generator.uniform(min(UNDER_WAY_M[0], length), length)
            drawn = RouteDraw(
                run=run,
                route=RouteSpec(start=STOPS[0], goal=STOPS[1], areas=areas),
                seed=generator.randrange(2**31),
                theta=generator.uniform(-math.pi, math.pi),
                area=generator.choice(crossed if on_way and crossed else areas),
                moment=moment,
                trigger_m=0.0 if moment == "before" else round(late, 2),
                ends=(start, goal),
            )
            if self._can_be_driven(drawn):
                return [drawn]
        raise FloorDrawError(
            f"on the floor of site {self._site.site.id} no two stops {self._least_m:.0f} m apart were found between "
            f"which a way is left when an area is blocked ({_ATTEMPTS} draws of run {run}): draw on a larger floor"
        )

    def _stop(self, generator: random.Random) -> Place:
        x, y = self._floor[generator.randrange(len(self._floor))]
        return Place(x=round(float(x), 3), y=round(float(y), 3))

    def _can_be_driven(self, drawn: RouteDraw) -> bool:
        try:
            return self._geometry.saving(drawn) is not None
        except BarrierError:
            return False
