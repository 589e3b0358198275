"""A sensor node: the firmware's cycle and judgement, with the real sonar's timing. Pure.

One sonar after the other, each for the time of flight (36 ms when no echo comes) but at least as long as its echoes
take to die away; then the reading is published and the firmware pauses. With echoes this gives about 9 readings a
second, without about 8. Source of the timing: HC-SR04 data sheet; the pause is the thesis's (section 3.3).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from fog_contracts.messages import AreaState, NodeConfig, NodeReading, SonarStatus
from fognav_sim.world import SOUND_M_S, World

if TYPE_CHECKING:
    from fog_contracts.site import NodeSite

NO_ECHO_S: Final = 0.036
"""The module ends its pulse by itself after some 38 ms without an echo; the firmware gives up just before."""
SETTLE_S: Final = 0.027
PUBLISH_S: Final = 0.002
FIRMWARE: Final = "sim-1"


def default_config(node: NodeSite) -> NodeConfig:
    """Return what a node is flashed with: the calibration of its site."""
    return NodeConfig(
        version=0,
        range_limit_m=[sonar.range_limit for sonar in node.sonars],
        no_echo_is_clear=[sonar.no_echo_is_clear for sonar in node.sonars],
    )


def judge(ranges: list[float | None], config: NodeConfig) -> AreaState:
    """Judge as the firmware does: one near echo blocks; clear needs every sonar to say so."""
    near = zip(ranges, config.range_limit_m, strict=True)
    if any(measured is not None and measured < limit for measured, limit in near):
        return "blocked"
    quiet = zip(ranges, config.no_echo_is_clear, strict=True)
    return "clear" if all(measured is not None or clear for measured, clear in quiet) else "unknown"


class SonarNode:
    """One node of the site; ask it for its readings as time goes by."""

    def __init__(self, node: NodeSite, boot: int, start: float) -> None:
        self.node = node
        self.config = default_config(node)
        self._boot = boot
        self._seq = 0
        self._started = start
        self._due = start
        self._index = 0
        self._ranges: list[float | None] = []

    def configure(self, config: NodeConfig) -> bool:
        """Take a configuration; False when it is for another number of sonars and was ignored."""
        count = len(self.node.sonars)
        if len(config.range_limit_m) != count or len(config.no_echo_is_clear) != count:
            return False
        self.config = config
        return True

    def poll(self, world: World, now: float) -> list[NodeReading]:
        """Let time pass up to `now` (s); return the readings that were due, oldest first."""
        readings: list[NodeReading] = []
        if now - self._due > 1.0:
            # The simulation paused: a node does not make up for readings that it never took.
            self._due = now
        while self._due <= now:
            if self._index < len(self.node.sonars):
                measured = world.sonar(self.node, self._index)
                flight = NO_ECHO_S if measured is None else 2 * measured / SOUND_M_S
                self._ranges.append(measured)
                self._index += 1
                self._due += max(flight, SETTLE_S)
                continue
            readings.append(self._reading())
            self._index, self._ranges = 0, []
            self._due += PUBLISH_S + self.config.pause_ms / 1000
        return readings

    def _reading(self) -> NodeReading:
        self._seq += 1
        status: list[SonarStatus] = ["no_echo" if measured is None else "ok" for measured in self._ranges]
        return NodeReading(
            seq=self._seq,
            boot=self._boot,
            uptime_ms=round((self._due - self._started) * 1000),
            range_m=[None if measured is None else round(measured, 4) for measured in self._ranges],
            status=status,
            state=judge(self._ranges, self.config),
            rssi=-55,
            fw=FIRMWARE,
        )
