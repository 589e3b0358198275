"""Measures a planner's real process with many robots, as `fleet` measures its core: the same floor, places and hazards.

Planner, Redis and zenoh router are processes of their own; map-service and robots are stand-ins in this one
(`fleet_stand_ins`). A time runs from the publication of a hazard and its delta to the arrival of a robot's path or
refusal at that robot's subscriber, so that both encodings, the router and the planner's queues count.
"""

from __future__ import annotations

import asyncio
import re
import time
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final

import psutil
import zenoh

from fog_runtime.clock import SystemClock
from fog_runtime.transports.zenoh_edge import ZenohEdge, session_config
from fog_supervisor import net
from fog_supervisor.supervisor import NotReadyError, log_tail
from fognav.output import FailedError
from fognav.programs import PLANNER, REDIS, ROUTER
from fognav.stack import Stack, StackConfig
from fognav.stack_doors import Doors
from fognav_experiments.bench.fleet import closures, hazard_message, percentile
from fognav_experiments.bench.fleet_stand_ins import Receivers, StandIns
from fognav_experiments.bench.running import in_background
from fognav_experiments.bench.site import SITE, write_site

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping

    from fognav_experiments.bench.fleet import FleetMap, Trip
    from fognav_experiments.bench.fleet_stand_ins import Change

QUIET_S: Final = 1.0
"""How long no path may change until a measurement ends; the bytes of a change are counted for as long."""
_READY_S: Final = 120.0
_BENCH: Final = "bench"
"""The user who stands for the map-service and the robots."""
_FIELD_BYTES: Final = re.compile(r"^fognav_planner_goal_fields_bytes (\S+)$", re.MULTILINE)


async def measure(
    map_: FleetMap,
    fleet: Mapping[str, Trip],
    trials: int,
    on_progress: Callable[[int, int], object],
    quiet_s: float = QUIET_S,
) -> dict[str, object]:
    """Run the trials and return the figures; times in ms. Raises `FailedError` when the planner does not answer."""
    async with _planner(map_, fleet, quiet_s) as planner:
        await planner.send_all()
        await planner.settle()
        changes = _Changes([], [], [])
        steady = await planner.world.steady_bytes()
        for number, (across, wall) in enumerate(closures(map_, trials)):
            change, seq = planner.world.change, 4 * number
            begin = hazard_message(across, seq, blocked=True)
            changes.replanned.append(await change(map_.put(across), begin, refused=False))
            end = hazard_message(across, seq + 1, blocked=False)
            await change(map_.clear(across), end, refused=False)
            # New goals: a path that was just moved to another way would not be moved back for a while.
            await planner.send_all()
            await planner.settle()
            begin = hazard_message(wall, seq + 2, blocked=True)
            changes.cut_off.append(await change(map_.put(wall), begin, refused=True))
            end = hazard_message(wall, seq + 3, blocked=False)
            changes.back.append(await change(map_.clear(wall), end, refused=False))
            await planner.settle()
            on_progress(number + 1, trials)
        return {
            **changes.figures(),
            "rss_mb": round(planner.process.memory_info().rss / 1e6, 1),
            "front_rss_mb": round(sum(front.memory_full_info().uss for front in planner.process.children()) / 1e6, 1),
            "goal_fields_mb": round(await planner.field_bytes() / 1e6, 1),
            "bytes_per_robot": changes.bytes_per_robot(),
            "steady_bytes_per_robot_s": round(steady),
        }


@dataclass(frozen=True)
class _Changes:
    """What followed the hazards across all paths, those that cut all goals off, and the end of these."""

    replanned: list[Change]
    cut_off: list[Change]
    back: list[Change]

    def figures(self) -> dict[str, object]:
        replans = [ms for change in self.replanned for ms in change.times()]
        return {
            "replans": len(replans),
            "replan_p50_ms": percentile(replans, 50),
            "replan_p99_ms": percentile(replans, 99),
            "cut_off_ms": percentile([max(change.times()) for change in self.cut_off], 50),
            "cut_off_explained_ms": percentile([change.until_last() for change in self.cut_off], 50),
            "back_ms": percentile([max(change.times()) for change in self.back], 50),
        }

    def bytes_per_robot(self) -> int:
        return round(sum(change.bytes_per_robot() for change in self.replanned) / len(self.replanned))


class _Planner:
    """The running planner, and the world around it."""

    def __init__(self, stack: Stack, world: StandIns, fleet: Mapping[str, Trip]) -> None:
        self.world = world
        self._fleet = fleet
        self._stack = stack
        self.process = psutil.Process(stack.pids()[PLANNER])
        port = stack.port(PLANNER)
        assert port is not None
        self._port = port

    async def _request(self, method: str, path: str, body: object = None) -> net.Response:
        return await asyncio.to_thread(net.request, method, self._port, path, body=body, token=self._stack.token)

    async def send_all(self) -> None:
        """Give every robot a mission, as an operator does, and wait for the paths; raises `FailedError`."""
        await self._know(len(self._fleet))
        goal_ids = {}
        for robot, (_, (x, y)) in self._fleet.items():
            response = await self._request("PUT", f"/api/v1/robots/{robot}/goal", {"pose": {"x": x, "y": y}})
            if not isinstance(response.body, dict) or "goal_id" not in response.body:
                raise FailedError(f"the planner refused the goal of {robot} at ({x}, {y}): {response.reason}")
            goal_ids[robot] = response.body["goal_id"]
        paths = self.world.receivers.paths
        await self.world.until(
            lambda: all(
                (path := paths.get(robot)) is not None and path.goal_id == goal and path.refusal is None
                for robot, goal in goal_ids.items()
            ),
            "every robot has a path to its goal. Choose another --seed if a zone lies on a goal",
        )

    async def _know(self, robots: int) -> None:
        """Wait until the planner has heard of so many robots: it has goals for no others."""
        deadline = time.monotonic() + _READY_S
        while not isinstance(found := (await self._request("GET", "/api/v1/robots")).body, list) or len(found) < robots:
            if time.monotonic() > deadline:
                raise FailedError(f"the planner does not know its {robots} robots within {_READY_S:.0f} s: {found}")
            await asyncio.sleep(QUIET_S / 10)

    async def field_bytes(self) -> float:
        """Return the memory of all distance fields."""
        found = _FIELD_BYTES.search(str((await self._request("GET", "/metrics")).body))
        if found is None:
            raise FailedError("the planner's /metrics lack fognav_planner_goal_fields_bytes")
        return float(found[1])

    async def settle(self) -> None:
        """Wait until paths and distance fields change no more; raises `FailedError`."""
        deadline, before = time.monotonic() + _READY_S, 0.0
        while not (before > 0 and await self.field_bytes() == before):
            if time.monotonic() > deadline:
                raise FailedError(f"the planner's distance fields still change after {_READY_S:.0f} s")
            before = await self.field_bytes()
            await self.world.quiet(time.perf_counter())


@asynccontextmanager
async def _planner(map_: FleetMap, fleet: Mapping[str, Trip], quiet_s: float) -> AsyncIterator[_Planner]:
    """Run a planner with its servers, all on the loopback address, and the stand-ins; end them with the context."""
    with TemporaryDirectory(prefix="fognav-") as folder:
        write_site(Path(folder), map_.floor)
        doors = Doors(site=SITE, unrestricted=(_BENCH,))
        async with Stack(StackConfig(site_dir=Path(folder), robot="none", doors=doors)) as stack:
            for name in (REDIS, ROUTER):
                stack.supervisor.start(name)
            await stack.supervisor.wait_ready([REDIS, ROUTER], _READY_S)
            async with _stand_ins(stack, map_, fleet, quiet_s) as world:
                stack.supervisor.start(PLANNER)
                try:
                    await stack.supervisor.wait_ready([PLANNER], _READY_S)
                    yield _Planner(stack, world, fleet)
                except (FailedError, NotReadyError) as error:
                    raise FailedError(f"{error}\n{log_tail(stack.log(PLANNER))}") from error


@asynccontextmanager
async def _stand_ins(
    stack: Stack, map_: FleetMap, fleet: Mapping[str, Trip], quiet_s: float
) -> AsyncIterator[StandIns]:
    """Run map-service and robots on two sessions of the router: what the planner sees, and what reaches the robots."""
    endpoint, own = stack.zenoh_endpoint, stack.doors.credentials(_BENCH)
    config = session_config("client", connect=[endpoint], credentials=own)
    with await asyncio.to_thread(zenoh.open, config) as session:
        receivers = Receivers(session, SITE, list(fleet))
        async with ZenohEdge.open(
            connect=[endpoint], clock=SystemClock(), role="map-service", id=SITE, site=SITE, credentials=own
        ) as edge:
            world = StandIns(edge, map_, fleet, receivers, quiet_s)
            try:
                async with in_background(world.publish_loop(), "stand-ins"):
                    yield world
            finally:
                receivers.close()
