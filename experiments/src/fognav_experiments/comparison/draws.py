"""What a run consists of: routes, and what blocks each of them where and when, drawn from a seed. Pure.

The draws depend on seed and run alone, so that every setup meets the same obstacles.
"""

from __future__ import annotations

import math
import random
from typing import TYPE_CHECKING, Annotated, Final, Literal

import msgspec
from msgspec import Meta

from fog_contracts.messages import Id  # read at run time, when a file is decoded

if TYPE_CHECKING:
    from fog_contracts.site import Site

UNDER_WAY_M: Final = (3.0, 25.0)
"""Range of the distance that the robot has driven when the obstacle appears, in the runs in which it does so late."""

Moment = Literal["before", "under way"]


class RouteSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A route between two places, and the watched areas one of which is blocked on it."""

    start: Id
    goal: Id
    areas: Annotated[list[Id], Meta(min_length=1)]

    @property
    def name(self) -> str:
        """The route's name in files and tables."""
        return f"{self.start}{self.goal}"


class ExperimentSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A site's experiment (`experiment.toml` beside `site.toml`)."""

    routes: Annotated[list[RouteSpec], Meta(min_length=1)]

    def problems(self, site: Site) -> list[str]:
        """Return what the site lacks for this experiment."""
        areas = {area.id for area in site.areas}
        missing = [f"place {name}" for route in self.routes for name in (route.start, route.goal)]
        missing = [text for text in missing if text.removeprefix("place ") not in site.places]
        return missing + [f"area {name}" for route in self.routes for name in route.areas if name not in areas]


class RouteDraw(msgspec.Struct, frozen=True, kw_only=True):
    """One route of one run: the robot's heading at its start (rad), the blocked area, and when it becomes blocked.

    `trigger_m`: distance (m) that the robot has driven then; 0 is before the start. `seed`: of noise and obstacle.
    """

    run: int
    route: RouteSpec
    seed: int
    theta: float
    area: Id
    moment: Moment
    trigger_m: float


def draw(spec: ExperimentSpec, seed: int, run: int) -> list[RouteDraw]:
    """Return the routes of a run, numbered from 1."""
    generator = random.Random(f"{seed} {run}")  # noqa: S311  # repeatable, not a secret
    draws = []
    for route in spec.routes:
        moment: Moment = generator.choice(("before", "under way"))
        late = generator.uniform(*UNDER_WAY_M)
        draws.append(
            RouteDraw(
                run=run,
                route=route,
                seed=generator.randrange(2**31),
                theta=generator.uniform(-math.pi, math.pi),
                area=generator.choice(route.areas),
                moment=moment,
                trigger_m=0.0 if moment == "before" else round(late, 2),
            )
        )
    return draws
