"""A robot of others beside the demo's own (`fognav demo --with ros2`), and what becomes of its drive."""

from __future__ import annotations

import asyncio
import itertools
import json
import sys
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Final, Self

from fog_contracts.geometry import contains_point, distance_to_segment
from fog_supervisor import net
from fognav.ros2 import end, running_bridge
from fognav_sim.guest import NAME, RADIUS_M

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.messages import PointXY, Pose
    from fognav.demo.options import DrivePlan
    from fognav.stack import Stack

_MORE_S: Final = 150.0
"""So much longer (s) than Fognav's robot it may drive."""


class GuestDrive:
    """The guest's drive from the start of Fognav's robot to its goal, with a bridge to ROS 2 of its own."""

    def __init__(self, stack: Stack, plan: DrivePlan) -> None:
        self._stack, self._plan = stack, plan
        self._contexts = AsyncExitStack()
        self._process: asyncio.subprocess.Process | None = None

    async def __aenter__(self) -> Self:
        site, stack, port = self._plan.site.site, self._stack, net.free_port()
        start: Pose = site.robots[0].start
        async with AsyncExitStack() as contexts:
            settings = {"ROS2_ROBOTS": f"{NAME}:{RADIUS_M}"}
            await contexts.enter_async_context(running_bridge(stack, site.id, port, settings))
            where = (start.x, start.y, self._plan.goal.x, self._plan.goal.y, stack.config.speed)
            names = (f"tcp/{net.LOOPBACK}:{port}", site.id.replace("-", "_"), self._plan.robot.replace("-", "_"))
            log = contexts.enter_context(stack.log(NAME).open("wb"))
            self._process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "fognav_sim.guest", *names, *map(str, where),
                stdout=asyncio.subprocess.PIPE, stderr=log,
            )  # fmt: skip
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
