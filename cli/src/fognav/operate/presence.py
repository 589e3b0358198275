"""Which processes of a running system are connected to its zenoh router, on whatever computer they run."""

import asyncio
from typing import Final

from fog_runtime.clock import SystemClock
from fog_runtime.credentials import Credentials
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fognav.operate.registry import System
from fognav.operate.systems import ROUTER

_CONSOLE: Final = "status"


def connected(system: System, credentials: Credentials) -> list[str] | None:
    """Return the connected processes as `role/id`, sorted; None if the system has no router that can be reached.

    They say so themselves for as long as their sessions are open (channel `live`): no safety signal, and a process that
    hangs is still listed.
    """
    if ROUTER not in system.urls or not system.site:
        return None
    return asyncio.run(_connected(system.urls[ROUTER], system.site, credentials))


async def _connected(endpoint: str, site: str, credentials: Credentials) -> list[str] | None:
    opened = ZenohEdge.open(
        connect=[endpoint], clock=SystemClock(), role="console", id=_CONSOLE, site=site, credentials=credentials
    )
    async with opened as edge:
        if not edge.connected:
            return None
        return sorted(f"{role}/{name}" for role, name in await edge.present())
