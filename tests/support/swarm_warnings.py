"""Obstacles before the nodes of a floor on several machines: how soon a robot has a path around each.

All runs in a process of its own, so that what else a test does delays nothing that is measured.
"""

from __future__ import annotations

import asyncio
import itertools
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from http.client import HTTPException
from multiprocessing import get_context
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import zenoh

from fog_runtime.clock import SystemClock
from fog_runtime.configuration.site import load_site
from fog_runtime.credentials import Credentials
from fog_runtime.transports.zenoh_edge import session_config
from fog_supervisor import net
from fognav.output import FailedError
from fognav_experiments.bench.warning import Obstacles, WatchedWorld, running_nodes
from fognav_sim.barrier import BarrierError
from fognav_sim.live import StillFloor

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from multiprocessing.synchronize import Event
    from pathlib import Path

    from fog_runtime.configuration.site import LoadedSite

READY_S: Final = 120.0
PATIENCE_S: Final = 3.0
_SPREAD_S: Final = 0.3
"""Obstacles come at any moment of the nodes' cycle, which is shorter than this."""
AREA: Final = "z4"
"""Where the robot's way leads while nothing is blocked; a path elsewhere is left as soon as the planner knows that."""
_events: dict[str, Event] = {}
"""Those of the process that measures, by their use."""


class Place(NamedTuple):
    """A floor, and how to reach it."""

    site: Path
    credentials: Path
    token: str
    machines: Sequence[str]
    """Those with broker and router: nodes and robot know them all."""
    gateways: Sequence[str]

    def of(self, user: str) -> Credentials:
        """Read a user's credentials."""
        return Credentials.read(self.credentials / f"{user}.toml")


class Met(NamedTuple):
    """When an obstacle came (s since the epoch), and how long after its first echo (s) there was a path around it."""

    at: float
    took: float | None


class Warnings:
    """Obstacles that come one after the other."""

    def __init__(self, place: Place) -> None:
        """Prepare; `coming` begins."""
        context = get_context("spawn")
        self._place = place
        self._ready, self._due, self._stopped = context.Event(), context.Event(), context.Event()
        events = {"ready": self._ready, "due": self._due, "stopped": self._stopped}
        self._pool = ProcessPoolExecutor(1, context, _know, (events,))
        self._met: list[Met] = []

    @contextmanager
    def coming(self) -> Iterator[None]:
        """Let obstacles come while entered."""
        with self._pool:
            self._due.set()
            self._running = self._pool.submit(_measure, self._place)
            try:
                self._wait_ready()
                yield
            finally:
                self._stopped.set()
                self._due.set()
                self._met = self._running.result()

    def with_next(self) -> float:
        """Return when the robot drives to an obstacle's place and that is about to come (s since the epoch)."""
        self._due.clear()
        self._wait_ready()
        since = time.time()
        self._due.set()
        return since

    def _wait_ready(self) -> None:
        end = time.monotonic() + READY_S
        while not self._ready.wait(0.1):
            if self._running.done():
                self._running.result()  # raises what it ended with
            assert time.monotonic() < end, "no robot drives"

    def figures(self, since: float) -> dict[str, Any]:
        """Return what came of them before and since a moment; the first one since then came with what happened."""
        before, after = ([each for each in self._met if (each.at >= since) is late] for late in (False, True))
        return {"before": _figures(before), "during": _figures(after), "first_s": after[0].took if after else None}


def _figures(met: Sequence[Met]) -> dict[str, Any]:
    took = [each.took for each in met if each.took is not None]
    found: dict[str, Any] = {"obstacles": len(met), "missed": len(met) - len(took)}
    for name, p in (("p50_s", 50), ("p99_s", 99), ("max_s", 100)):
        found[name] = round(float(np.percentile(took, p)), 3) if took else None
    return found


class _Obstacles(Obstacles):
    def __init__(self, loaded: LoadedSite, world: WatchedWorld, session: zenoh.Session, place: Place) -> None:
        super().__init__(loaded, world, session, 1)
        self._gateways, self._token = place.gateways, place.token
        self._tls = place.of(self.robot.id).tls_context()

    async def ask(self, service: str, method: str, path: str, body: object = None) -> net.Response:
        del service  # the gateways know it by the path
        said = ""
        for gateway in self._gateways:
            try:
                return await asyncio.to_thread(
                    net.request, method, 443, path, body=body, token=self._token, host=gateway, tls=self._tls,
                    timeout_s=PATIENCE_S,
                )  # fmt: skip
            except (OSError, HTTPException) as error:
                said = str(error)
        return net.Response(502, said)

    def logs(self) -> str:
        return ""


def _know(events: dict[str, Event]) -> None:
    _events.update(events)


def _measure(place: Place) -> list[Met]:
    return asyncio.run(_meet(place))


async def _meet(place: Place) -> list[Met]:
    loaded, met = load_site(place.site), []
    floor = StillFloor(loaded, (), SystemClock(), world=WatchedWorld)
    assert isinstance(floor.world, WatchedWorld)
    brokers = ",".join(f"mqtts://{machine}:8883" for machine in place.machines)
    routers = [f"tls/{machine}:7447" for machine in place.machines]
    settings = session_config("client", connect=routers, credentials=place.of(loaded.site.robots[0].id))
    async with running_nodes(loaded, floor, brokers, place.of):
        with await asyncio.to_thread(zenoh.open, settings) as session:
            obstacles = _Obstacles(loaded, floor.world, session, place)
            async with obstacles.robot.publishing():
                for number in itertools.count():
                    try:
                        hazard = await obstacles.drive(number)
                    except FailedError as error:
                        if not isinstance(error.__cause__, BarrierError):
                            raise
                        continue
                    if hazard.area.id != AREA:
                        continue
                    _events["ready"].set()
                    await asyncio.sleep(obstacles.random.uniform(0.0, _SPREAD_S))
                    await asyncio.to_thread(_events["due"].wait)
                    _events["ready"].clear()
                    if _events["stopped"].is_set():
                        break
                    met.append(Met(time.time(), await obstacles.meet(hazard, obstacles.path_around)))
    return met
