"""A sensor node that runs the firmware's own code: the simulated world moves its echo lines. Pure but for the library.

The core is stepped once in a millisecond, as the loop of a board would at least; edges of the echo lines have their
exact times.
"""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING, Final

import msgspec

from fog_contracts.messages import NodeCalibration, NodeReading
from fognav_sim.firmware import Sonar
from fognav_sim.node import default_config
from fognav_sim.sensors import SOUND_M_S

if TYPE_CHECKING:
    from fog_contracts.messages import NodeConfig
    from fog_contracts.site import NodeSite
    from fognav_sim.firmware import Core
    from fognav_sim.world import World

FIRMWARE: Final = b"host-1"
STEP_US: Final = 1000
BURST_US: Final = 450
"""From trigger to the rise of the echo line: eight periods of 40 kHz and the module's own delay (HC-SR04)."""
NO_ECHO_US: Final = 38_000
_RSSI_DBM: Final = -55
_TRIGGER: Final = 1
_PUBLISH: Final = 2
_CALIBRATED: Final = 3
_US: Final = 1_000_000


class FirmwareNode:
    """One sensor node of the site; the same interface as `SonarNode`, the model in Python."""

    def __init__(self, core: Core, node: NodeSite, boot: int, start: float) -> None:
        self.node = node
        self.config = default_config(node)
        limits = zip(self.config.range_limit_m, self.config.range_max_m, self.config.no_echo_is_clear, strict=True)
        sonars = [Sonar(round(1000 * limit), round(1000 * farthest), int(silent)) for limit, farthest, silent in limits]
        self._core = core
        self._node = core.new(
            (Sonar * len(sonars))(*sonars), len(sonars), boot, self.config.pause_ms, int(node.every_reading), FIRMWARE
        )
        core.rssi(self._node, _RSSI_DBM)
        self._start = start
        self._now = ctypes.c_uint64(0)
        self._now_by_reference = ctypes.byref(self._now)
        self._edges: list[tuple[int, int, int]] = []
        self._calibration: NodeCalibration | None = None

    def __del__(self) -> None:
        self._core.free(self._node)

    def configure(self, config: NodeConfig) -> bool:
        """Apply a configuration; return False if it is for another number of sonars, and ignore it."""
        text = msgspec.json.encode(config)
        if self._core.configure(self._node, text, len(text)) is not None:
            return False
        self.config = config
        return True

    def on_connected(self) -> None:
        """Publish as after a change: the connection has come back."""
        self._core.connected(self._node)

    def command(self, text: str) -> str | None:
        """Begin what a command asks for, as learning the limits anew; return None, or why not."""
        problem = self._core.command(self._node, text.encode(), len(text.encode()))
        return None if problem is None else str(problem.decode())

    def restore(self, calibration: NodeCalibration) -> bool:
        """Apply a calibration from before the node was switched off; return False if it is for other sonars."""
        text = msgspec.json.encode(calibration)
        return self._core.restore(self._node, text, len(text)) is None

    def take_calibration(self) -> NodeCalibration | None:
        """Return the calibration that has ended since the last call, if one has."""
        calibration, self._calibration = self._calibration, None
        return calibration

    def poll(self, world: World, now: float) -> list[NodeReading]:
        """Run the firmware up to `now` (s); return the readings that it published, oldest first."""
        until = round((now - self._start) * _US)
        core, node, clock = self._core, self._node, self._now
        if until - clock.value > _US:
            # The simulation paused: a node does not catch up on readings that it missed.
            clock.value = until
        readings: list[NodeReading] = []
        while clock.value <= until:
            while self._edges and self._edges[0][0] <= clock.value:
                at, sonar, high = self._edges.pop(0)
                core.edge(node, sonar, high, ctypes.c_uint32(at))
            end = min(until, self._edges[0][0] - 1) if self._edges else until
            event = core.run(node, self._now_by_reference, end, STEP_US)
            if event == _TRIGGER:
                self._trigger(world, clock.value - STEP_US)
            elif event == _PUBLISH:
                readings.append(msgspec.json.decode(core.message(node), type=NodeReading))
            elif event == _CALIBRATED:
                self._calibration = msgspec.json.decode(core.message(node), type=NodeCalibration)
        return readings

    def _trigger(self, world: World, at_us: int) -> None:
        sonar = self._core.sonar(self._node)
        measured = world.sonar(self.node, sonar)
        flight_us = NO_ECHO_US if measured is None else round(2 * measured / SOUND_M_S * _US)
        rise = at_us + BURST_US
        self._edges = [(rise, sonar, 1), (rise + flight_us, sonar, 0)]
