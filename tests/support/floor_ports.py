"""Ports of a fog node for tests, those of its further floors included."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fog_supervisor import net
from fognav.hosting.folders import PORT_STEP

if TYPE_CHECKING:
    from collections.abc import Iterable


def floor_ports(names: Iterable[str]) -> dict[str, str]:
    """Return a free port for each of these names of variables, by `FOGNAV_NAME_PORT`.

    Those of a second floor are a step above: no other of these ports is there.
    """
    taken: set[int] = set()
    ports: dict[str, str] = {}
    for name in names:
        port = net.free_port(taken)
        taken |= {port - PORT_STEP, port + PORT_STEP}
        ports[f"FOGNAV_{name}_PORT"] = str(port)
    return ports
