"""The simulated sensor nodes: with the firmware's own code where it can be compiled, else with a model of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal, Protocol

from fog_runtime import logs
from fognav_sim.firmware import Core, FirmwareError, build_library, find_firmware
from fognav_sim.firmware_node import FirmwareNode
from fognav_sim.node import SonarNode

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from fog_contracts.messages import NodeCalibration, NodeConfig, NodeReading
    from fog_contracts.site import NodeSite
    from fognav_sim.world import World

CACHE: Final = ".fognav/firmware"
"""Where a checkout keeps the compiled core."""

_log = logs.get("sim")


class SensorNode(Protocol):
    """What the simulator needs of a sensor node."""

    node: NodeSite

    def configure(self, config: NodeConfig) -> bool:
        """Apply a configuration; return False if it is for another number of sonars, and ignore it."""

    def on_connected(self) -> None:
        """Publish as after a change: the connection has come back."""

    def command(self, text: str) -> str | None:
        """Begin what a command asks for, as learning the limits anew; return None, or why not."""

    def take_calibration(self) -> NodeCalibration | None:
        """Return the calibration that has ended since the last call, if one has."""

    def poll(self, world: World, now: float) -> list[NodeReading]:
        """Run the node up to `now` (s); return the readings that it publishes, oldest first."""


def why_model() -> str | None:
    """Return why simulated nodes run a model, or None where they run the firmware, which is then compiled."""
    try:
        _firmware()
    except (FirmwareError, OSError) as error:
        return str(error)
    return None


def make_nodes(
    nodes: Sequence[NodeSite],
    boot: int,
    start: float,
    kind: Literal["auto", "firmware", "model"] = "auto",
    *,
    apart: float = 0.0,
) -> list[SensorNode]:
    """Return the site's nodes, switched on at `start` (s), `apart` (s) one after the other, in groups of eight.

    Raises `FirmwareError` if `firmware` is asked for and can't be built.
    """
    if kind != "model":
        try:
            core = Core(_firmware())
        except (FirmwareError, OSError) as error:
            if kind == "firmware":
                raise
            _log.info("nodes_run_a_model", reason=str(error))
        else:
            _log.info("nodes_run_the_firmware")
            return [FirmwareNode(core, node, boot + i, start + apart * (i % 8)) for i, node in enumerate(nodes)]
    return [SonarNode(node, boot + i, start + apart * (i % 8)) for i, node in enumerate(nodes)]


def _firmware() -> Path:
    return build_library(find_firmware().parent / CACHE)
