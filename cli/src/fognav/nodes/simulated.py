"""One node of a site, simulated with the firmware's own code on a real broker: to try a site before building."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import FREE
from fog_contracts.geometry import GeometryError
from fog_contracts.messages import Pose, SimObstacle
from fog_contracts.site import RobotSite
from fog_runtime.clock import SystemClock
from fognav.output import WrongUseError
from fognav_sim.floor import Floor
from fognav_sim.live import VirtualNode, run_nodes
from fognav_sim.nodes import make_nodes
from fognav_sim.world import World

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.geometry import Point
    from fog_contracts.site import NodeSite
    from fog_runtime.configuration.site import LoadedSite
    from fog_runtime.credentials import Credentials

PERSON_RADIUS_M: Final = 0.25
_MITE_M: Final = 0.01
_AXLE_M: Final = 0.235


class StillFloor:
    """A floor on which nothing moves: what a simulated node measures. `now` is the time of the clock (s)."""

    def __init__(
        self, loaded: LoadedSite, persons: Sequence[Point], clock: SystemClock, *, world: type[World] = World
    ) -> None:
        """Put persons on the site's floor, a `world`; raises `WrongUseError` for one that does not stand on it."""
        self._clock = clock
        self.silent_nodes: frozenset[str] = frozenset()
        # A world has a robot: here one that lies below every sensor's cone.
        x, y = loaded.map.geometry.centre(*np.argwhere(loaded.map.cells == FREE)[0][::-1].tolist())
        mite = RobotSite(id="mite", start=Pose(x=x, y=y, theta=0.0), radius=_MITE_M, height=_MITE_M)
        self.world = world(Floor(loaded.map.geometry, loaded.map.cells), mite, seed=1, axle_m=_AXLE_M)
        for index, (x, y) in enumerate(persons):
            if not loaded.map.geometry.contains(x, y):
                raise WrongUseError(f"--person {x:g},{y:g} is not on the map")
            angles = np.linspace(0.0, math.tau, 16, endpoint=False)
            ring = [(x + PERSON_RADIUS_M * math.cos(a), y + PERSON_RADIUS_M * math.sin(a)) for a in angles]
            try:
                self.world.place(SimObstacle(id=f"person-{index + 1}", polygon=ring, height=1.7))
            except (GeometryError, ValueError) as error:
                raise WrongUseError(f"--person {x:g},{y:g}: {error}") from error

    @property
    def now(self) -> float:
        """The time at which the floor is measured (s)."""
        return self._clock.now()


async def run(
    loaded: LoadedSite, node: NodeSite, broker: str, credentials: Credentials, persons: Sequence[Point]
) -> None:
    """Run a node against a broker until cancelled; raises `WrongUseError` for a person who can't stand there."""
    clock = SystemClock(1.0)
    floor = StillFloor(loaded, persons, clock)
    (sonars,) = make_nodes([node], int(time.time()), clock.now())
    await run_nodes([VirtualNode(sonars, floor, broker, clock, loaded.site.id, credentials)], clock)
