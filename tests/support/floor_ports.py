"""Ports of a fog node for tests, those of its further floors included."""

from __future__ import annotations

from fog_supervisor import net
from fognav.hosting.folders import PORT_STEP

PORTS = ("MQTT", "REDIS", "ZENOH", "AGGREGATOR", "MAP", "PLANNER", "CONSOLE")
"""All that a node listens at: one that is missing here is the same in every test, and only one of them gets it."""


def floor_ports() -> dict[str, str]:
    """Return a free port for each of a node's servers and services, by `FOGNAV_NAME_PORT`.

    Those of a second floor are a step above: no other of these ports is there.
    """
    taken: set[int] = set()
    ports: dict[str, str] = {}
    for name in PORTS:
        port = net.free_port(taken)
        taken |= {port - PORT_STEP, port + PORT_STEP}
        ports[f"FOGNAV_{name}_PORT"] = str(port)
    return ports
