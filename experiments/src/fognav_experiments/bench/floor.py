"""Measures map-service and planner, as real processes, on a floor of any size: start, memory, snapshot, paths.

Redis, broker and router are processes of their own; the robot, which stands at one end of the floor and has its goal
at the other, is a stand-in in this one, which has freed the floor before they start.
"""

from __future__ import annotations

import asyncio
import re
import time
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

from fog_contracts import channels as ch
from fog_contracts.messages import MapSnapshot, RobotPath
from fog_runtime.clock import SystemClock, ticker
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor.supervisor import NotReadyError, log_tail
from fognav.output import FailedError
from fognav.programs import MAP_SERVICE, PLANNER, SERVERS
from fognav.stack import Stack, StackConfig
from fognav_experiments.bench.common import SITE, ask, corridor_rows, in_background, make_office, standing, write_site

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from fog_contracts.handlers import Ids
    from fog_contracts.messages import PointXY

ROBOT: Final = "bench"
_READY_S: Final = 600.0
"""How long any step may take: the largest floor has 100 million cells."""
_POLL_S: Final = 0.005
_ZONE_HALF_M: Final = 1.0
_PEAK: Final = re.compile(r"^VmHWM:\s+(\d+) kB$", re.MULTILINE)
_NOW: Final = re.compile(r"^VmRSS:\s+(\d+) kB$", re.MULTILINE)
_START_M: Final = 5.0
"""How far from the floor's sides robot and goal are."""


def prepare(folder: Path, width: float, height: float) -> int:
    """Write the site of an office of `width` x `height` (m); return its number of cells."""
    floor = make_office(width, height)
    write_site(folder, floor)
    return int(floor.cells.size)


async def measure(
    folder: Path, cells: int, width: float, height: float, on_step: Callable[[str], object]
) -> dict[str, float | int]:
    """Return the figures for the site in `folder` (see `prepare`); raises `FailedError` when a step takes too long.

    Times are in s or ms, as their names say, memory in MB, and peaks in bytes for each cell, too.
    """
    rows = corridor_rows(height)
    start, goal = (_START_M, float(rows[0])), (width - _START_M, float(rows[-1]))
    config = StackConfig(site_dir=folder, robot="none", extra={"HAZARDS_WAIT_S": "0"})
    figures: dict[str, float | int] = {"cells": cells}
    async with Stack(config) as stack:
        for name in SERVERS:
            stack.supervisor.start(name)
        await stack.supervisor.wait_ready(SERVERS, _READY_S)
        for name, label in ((MAP_SERVICE, "map"), (PLANNER, "planner")):
            on_step(f"starting the {name}")
            begun = time.perf_counter()
            stack.supervisor.start(name)
            try:
                await stack.supervisor.wait_ready([name], _READY_S)
            except NotReadyError as error:
                raise FailedError(f"{error}\n{log_tail(stack.log(name))}") from error
            figures[f"{label}_ready_s"] = round(time.perf_counter() - begun, 1)
        async with _robot(stack, start) as robot:
            on_step("planning")
            figures |= await robot.measure(goal)
        for name, label in ((MAP_SERVICE, "map"), (PLANNER, "planner")):
            peak, now = _memory(stack.pids()[name])
            figures |= {
                f"{label}_rss_mb": round(now / 1e6, 1),
                f"{label}_peak_mb": round(peak / 1e6, 1),
                f"{label}_peak_bytes_per_cell": round(peak / cells, 1),
            }
    return figures


def _memory(pid: int) -> tuple[int, int]:
    """Return the most memory (bytes) that a process has had, and what it has now."""
    status = Path(f"/proc/{pid}/status").read_text("utf-8")
    peak, now = _PEAK.search(status), _NOW.search(status)
    assert peak is not None
    assert now is not None
    most, held = 1024 * int(peak[1]), 1024 * int(now[1])
    return max(most, held), held  # the kernel counts the two by itself, a little apart


class _Robot:
    """A robot that stands still, and receives paths."""

    def __init__(self, stack: Stack, edge: ZenohEdge, place: PointXY) -> None:
        self._stack = stack
        self._edge = edge
        self._place = place
        self._paths: list[tuple[float, RobotPath]] = []
        """When each arrived (s of `perf_counter`), and the path."""
        edge.subscribe(ch.ROBOT_PATH, RobotPath, self._on_path, robot=ROBOT)

    def _on_path(self, _ids: Ids, path: RobotPath) -> None:
        self._paths.append((time.perf_counter(), path))

    async def publish_loop(self) -> None:
        """Publish the pose until cancelled."""
        clock, (x, y) = SystemClock(), self._place
        async for _ in ticker(clock, ch.ROBOT_POSE.period_s):
            self._edge.publish(ch.ROBOT_POSE, standing(x, y, clock.stamp()), robot=ROBOT)

    async def measure(self, goal: PointXY) -> dict[str, float | int]:
        """Read a snapshot, drive to a goal, then have a zone put across the path, and taken off again."""
        begun = time.perf_counter()
        snapshot = await self._edge.query(ch.MAP_SNAPSHOT, None, MapSnapshot, _READY_S)
        if snapshot is None:
            raise FailedError("the map-service gave no snapshot")
        figures: dict[str, float | int] = {"snapshot_s": round(time.perf_counter() - begun, 2)}
        begun = await self._request(
            PLANNER, "PUT", f"/api/v1/robots/{ROBOT}/goal", {"pose": {"x": goal[0], "y": goal[1]}}
        )
        path, figures["path_ms"] = await self._next_path(0, begun)
        # The goal's distance field guides the next path. The first one did without, unless so long a search is refused
        # (the planner's `unguided_expansions`): then it waited for the field.
        await asyncio.sleep(1.0)
        x, y = path.points[len(path.points) // 2]
        shape = {
            "type": "rectangle",
            "corner": [x - _ZONE_HALF_M, y - _ZONE_HALF_M], "opposite": [x + _ZONE_HALF_M, y + _ZONE_HALF_M],
        }  # fmt: skip
        zone = {"kind": "BLOCKED", "shape": shape, "reason": "bench"}
        begun = await self._request(MAP_SERVICE, "POST", "/api/v1/zones", zone)
        _, figures["replan_ms"] = await self._next_path(path.plan_id, begun)
        return figures

    async def _next_path(self, plan_id: int, begun: float) -> tuple[RobotPath, float]:
        """Wait for a path of a newer plan; return it, and its time (ms) since `begun` (s of `perf_counter`)."""
        while not (new := [(at, path) for at, path in self._paths if path.plan_id > plan_id and path.points]):
            if time.perf_counter() - begun > _READY_S:
                refusals = [path.refusal.reason for _, path in self._paths if path.refusal is not None]
                raise FailedError(f"no path within {_READY_S:.0f} s; refusals: {refusals or 'none'}")
            await asyncio.sleep(_POLL_S)
        at, path = new[0]
        return path, round(1000.0 * (at - begun), 1)

    async def _request(self, service: str, method: str, path: str, body: object) -> float:
        """Send a request, again until the service knows the robot; return when (s of `perf_counter`) the last was sent.

        Raises `FailedError` for another refusal.
        """
        deadline = time.monotonic() + _READY_S
        while True:
            begun = time.perf_counter()
            response = await ask(self._stack, service, method, path, body)
            if response.status in (200, 201):
                return begun
            if response.status != 404 or time.monotonic() > deadline:
                raise FailedError(f"{service}: {method} {path}: {response.reason}")
            await asyncio.sleep(10 * _POLL_S)


@asynccontextmanager
async def _robot(stack: Stack, place: PointXY) -> AsyncIterator[_Robot]:
    async with ZenohEdge.open(
        connect=[stack.zenoh_endpoint], clock=SystemClock(), role="robot-agent", id=ROBOT, site=SITE
    ) as edge:
        robot = _Robot(stack, edge, place)
        async with in_background(robot.publish_loop(), "robot"):
            yield robot
