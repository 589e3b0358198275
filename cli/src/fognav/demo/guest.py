"""A robot of others beside the demo's own (`fognav demo --with ros2|rmf|vda5050`), and what becomes of its drive."""

from __future__ import annotations

import asyncio
import itertools
import json
import sys
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Final, Self

import numpy as np

from fog_contracts.geometry import contains_point, distance_to_segment
from fog_supervisor import net
from fognav.running_bridge import end, running_bridge, running_vda5050
from fognav_sim.guest import NAME, RADIUS_M, Grid, lattice
from fognav_sim.guest_vda5050 import MAKER, SERIAL

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.messages import PointXY, Pose
    from fognav.demo.options import DrivePlan
    from fognav.stack import Stack

_MORE_S: Final = 150.0
"""So much longer (s) than Fognav's robot it may drive."""


class GuestDrive:
    """The guest's drive from the start of Fognav's robot to its goal, with a bridge of its own to its world."""

    def __init__(self, stack: Stack, plan: DrivePlan, world: str) -> None:
        """Let it know what `world` tells, one of `GUESTS`."""
        self._stack, self._plan, self._world = stack, plan, world
        self._contexts = AsyncExitStack()
        self._process: asyncio.subprocess.Process | None = None

    async def __aenter__(self) -> Self:
        site, stack, port, robot = self._plan.site.site, self._stack, net.free_port(), self._plan.robot
        start: Pose = site.robots[0].start
        async with AsyncExitStack() as contexts:
            where: tuple[object, ...] = (start.x, start.y, self._plan.goal.x, self._plan.goal.y, stack.config.speed)
            if self._world != "vda5050":
                settings = {"ROS2_ROBOTS": f"{NAME}:{RADIUS_M}"}
                if self._world == "rmf":
                    graph, at = stack.folder / "nav_graph.yaml", self._plan.site.map.geometry
                    floor = Grid(self._plan.site.map.cells.view(np.int8), at.resolution, at.origin_x, at.origin_y)
                    graph.write_text(json.dumps({"building_name": site.id, "levels": {"L1": lattice(floor)}}), "utf-8")
                    settings |= {"RMF_LEVEL": "L1", "RMF_NAV_GRAPH": str(graph), "RMF_FLEETS": NAME}
                    where = *where, graph, NAME
                await contexts.enter_async_context(running_bridge(stack, site.id, port, settings))
                names = (f"tcp/{net.LOOPBACK}:{port}", site.id.replace("-", "_"), robot.replace("-", "_"))
                command: tuple[str, ...] = ("fognav_sim.guest", *names)
            else:
                bridge = running_vda5050(stack, site.id, port, robot, f"{MAKER}/{SERIAL}")
                url = await contexts.enter_async_context(bridge)
                own_map = str(self._plan.site.directory / site.map)
                command = (
                    "fognav_sim.guest_vda5050",
                    url,
                    own_map,
                    site.id,
                    f"vda5050/v3/fognav/{robot}/visualization",
                )
            log = contexts.enter_context(stack.log(NAME).open("wb"))
            self._process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", *command, *map(str, where), stdout=asyncio.subprocess.PIPE, stderr=log
            )
            contexts.push_async_callback(end, self._process)
            self._contexts = contexts.pop_all()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._contexts.aclose()

    async def finish(self, barrier: Sequence[PointXY] | None) -> dict[str, object]:
        """Wait until the guest is at its goal, or for a while; return its drive for the report.

        `barrier` is what its own sensors don't see.
        """
        process = self._process
        assert process is not None
        reading = asyncio.create_task(process.communicate())
        done, _ = await asyncio.wait({reading}, timeout=_MORE_S / self._stack.config.speed)
        if not done:
            process.terminate()
        out, _ = await reading
        try:
            told = json.loads(out)
        except ValueError:
            return {"reached": False, "reason": f"it has told nothing: see {self._stack.log(NAME)}"}
        return report(told, barrier)


def report(told: dict[str, object], barrier: Sequence[PointXY] | None) -> dict[str, object]:
    """Return a guest's drive: whether its first plan led through the barrier, and whether it ever touched that."""
    plans, trail = told.pop("plans"), told.pop("trail")
    assert isinstance(plans, list)
    assert isinstance(trail, list)
    through = touched = False
    if barrier is not None:
        through = bool(plans) and any(_touches(barrier, (x, y)) for x, y in plans[0])
        touched = any(_touches(barrier, (x, y)) for _, x, y in trail)
    return {
        **told, "plans": len(plans), "first_plan_through_barrier": through, "touched_barrier": touched,
        "trail": trail[::10],
    }  # fmt: skip


def _touches(polygon: Sequence[PointXY], at: PointXY) -> bool:
    """Whether the guest's body at a point reaches into a polygon."""
    sides = itertools.pairwise([*polygon, polygon[0]])
    return contains_point(polygon, *at) or any(distance_to_segment(a, b, *at) < RADIUS_M for a, b in sides)
