"""What benchmarks have in common: floors and sites, repeatable by seed, and systems that are started and ended."""

from __future__ import annotations

import asyncio
import itertools
from abc import ABC, abstractmethod
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

import numpy as np

from fog_contracts.costs import FREE, LETHAL
from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.messages import RobotPose, RobotState
from fog_runtime.configuration.maps import save_map
from fog_supervisor import net

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Coroutine

    from numpy.typing import NDArray

    from fog_contracts.messages import RobotPath
    from fognav.stack import Stack


class RunningSystem(ABC):
    """A system that runs while its context is open; what `start` entered ends with it, also when `start` fails."""

    def __init__(self) -> None:
        self._contexts = AsyncExitStack()

    @abstractmethod
    async def _start(self) -> None:
        """Start the parts, each entered into `_contexts`."""

    async def __aenter__(self) -> Self:
        try:
            await self._start()
        except BaseException:
            await self._contexts.aclose()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._contexts.aclose()


@asynccontextmanager
async def in_background(work: Coroutine[None, None, None], name: str) -> AsyncIterator[None]:
    """Run a loop while the context is open, and cancel it then; raises what the loop raised."""
    task = asyncio.create_task(work, name=name)
    try:
        yield
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


async def ask(stack: Stack, service: str, method: str, path: str, body: object = None) -> net.Response:
    """Send a request to a service that runs; return its answer, also a refusal."""
    port = stack.port(service)
    assert port is not None
    return await asyncio.to_thread(net.request, method, port, path, body=body, token=stack.token)


def standing(x: float, y: float, stamp: float, theta: float = 0.0) -> RobotPose:
    """Return the pose of a stand-in for a robot, lower than any sensor: it is no hazard itself."""
    return RobotPose(
        x=x, y=y, theta=theta, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.17, height=0.1, stamp=stamp
    )  # fmt: skip


def following(path: RobotPath, stamp: float = 0.0) -> RobotState:
    """Return the state of a stand-in that has this path: the planner does not repeat a path that its robot names."""
    return RobotState(
        mode="NORMAL", reasons=[], enabled=True, battery=None, goal_id=path.goal_id, map_epoch=path.map_epoch,
        map_seq=path.map_seq, plan_id=path.plan_id, planner_epoch=path.planner_epoch, stamp=stamp,
    )  # fmt: skip


def first_child(pid: int) -> int | None:
    """Return the id of the first child of a process's main thread, such as the watchdog's guardian; None without one.

    Raises `FileNotFoundError` for a process that has ended.
    """
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text("ascii").split()
    return int(children[0]) if children else None


RESOLUTION: Final = 0.05
CORRIDOR: Final = 2.4
"""Width (m) of the corridors."""
_SPACING: Final = (23.0, 14.0)
"""Between the middles (m) of vertical and of horizontal corridors."""
_ROOM_DEPTH: Final = 5.2
_DOOR: Final = 1.0
_WALL: Final = 0.2


class _Floor:
    def __init__(self, geometry: GridGeometry) -> None:
        self.cells: NDArray[np.uint8] = np.full(geometry.shape, LETHAL, np.uint8)

    def fill(self, left: float, bottom: float, right: float, top: float, value: int) -> None:
        """Fill a rectangle (m)."""
        x0, y0, x1, y1 = (max(0, round(value / RESOLUTION)) for value in (left, bottom, right, top))
        self.cells[y0:y1, x0:x1] = value


def corridor_rows(height: float) -> NDArray[np.float64]:
    """Return the y (m) of the middles of the horizontal corridors of an office."""
    return np.arange(8.0, height - 2.0, _SPACING[1])


def make_office(width: float = 100.0, height: float = 60.0, seed: int = 1) -> StaticMap:
    """Return an office of `width` x `height` (m) at 5 cm per cell: by default 2000 x 1200 cells."""
    geometry = GridGeometry(round(width / RESOLUTION), round(height / RESOLUTION), RESOLUTION, 0.0, 0.0)
    floor, rng = _Floor(geometry), np.random.default_rng(seed)
    rows = corridor_rows(height)
    columns = np.arange(3.0, width - 2.0, _SPACING[0])
    half = CORRIDOR / 2
    for y in rows:
        floor.fill(2.0, y - half, width - 2.0, y + half, FREE)
    for x in columns:
        floor.fill(x - half, rows[0] - half, x + half, rows[-1] + half, FREE)
    for y in rows:
        for left, right in itertools.pairwise(columns):
            _add_rooms(floor, rng, left + half + 2 * _WALL, right - half - 2 * _WALL, float(y))
    return StaticMap(geometry, floor.cells)


def _add_rooms(floor: _Floor, rng: np.random.Generator, left: float, right: float, y: float) -> None:
    """Add rooms on both sides of a part of a horizontal corridor, each with a door and two pieces of furniture."""
    while left + 4.0 < right:
        end = min(left + rng.uniform(4.0, 6.0), right)
        for side in (1.0, -1.0):
            near, far = y + side * (CORRIDOR / 2 + _WALL), y + side * (CORRIDOR / 2 + _WALL + _ROOM_DEPTH)
            bottom, top = min(near, far), max(near, far)
            floor.fill(left, bottom, end - _WALL, top, FREE)
            door = rng.uniform(left + 0.3, end - 0.3 - _DOOR)
            sill = y + side * CORRIDOR / 2
            floor.fill(door, min(sill, near), door + _DOOR, max(sill, near), FREE)
            for _ in range(2):
                x, low = rng.uniform(left + 0.5, end - 1.5), rng.uniform(bottom + 1.2, top - 1.2)
                floor.fill(x, low, x + 0.7, low + 0.5, LETHAL)
        left = end


SITE: Final = "bench"


def write_site(folder: Path, floor: StaticMap) -> None:
    """Write a site without areas and robots."""
    save_map(folder / "map", floor)
    (folder / "site.toml").write_text(f'id = "{SITE}"\nmap = "map.yaml"\n', "utf-8")
