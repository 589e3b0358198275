"""Sensor nodes that go wrong: what a healthy one measures, changed on its way."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final, Literal

import msgspec

if TYPE_CHECKING:
    from collections.abc import Callable

    from fog_contracts.messages import AreaState, NodeCalibration, NodeConfig, NodeReading
    from fognav_sim.nodes import SensorNode
    from fognav_sim.world import World

Fault = Literal["stuck", "flapping", "lies-clear", "lies-blocked"]
FLAP_S: Final = 1.0
"""How long a flapping node says the same."""
_NEAR_M: Final = 0.6
_MARGIN_M: Final = 0.1


class _ChangedNode:
    """A node whose readings are changed on their way."""

    def __init__(self, healthy: SensorNode) -> None:
        self.node = healthy.node
        self._healthy = healthy

    def configure(self, config: NodeConfig) -> bool:
        """Apply a configuration."""
        return self._healthy.configure(config)

    def on_connected(self) -> None:
        """Publish as after a change."""
        self._healthy.on_connected()

    def command(self, text: str) -> str | None:
        """Begin what a command asks for; return None, or why not."""
        return self._healthy.command(text)

    def take_calibration(self) -> NodeCalibration | None:
        """Return the calibration that has ended since the last call, if one has."""
        return self._healthy.take_calibration()


class SlewedNodeSim(_ChangedNode):
    """A node whose clock gains `rate` seconds a second from now on."""

    def __init__(self, healthy: SensorNode, rate: float) -> None:
        super().__init__(healthy)
        self._rate = rate
        self._begun_ms: int | None = None

    def poll(self, world: World, now: float) -> list[NodeReading]:
        """Run the node up to `now` (s); return what it reports."""
        return [self._report(reading) for reading in self._healthy.poll(world, now)]

    def _report(self, reading: NodeReading) -> NodeReading:
        self._begun_ms = reading.uptime_ms if self._begun_ms is None else self._begun_ms
        shown = self._begun_ms + round((reading.uptime_ms - self._begun_ms) * (1.0 + self._rate))
        return msgspec.structs.replace(reading, uptime_ms=shown)


class LateNodeSim(_ChangedNode):
    """A node whose readings take a time (s) on their way, which `delay` draws for each; none overtakes another."""

    def __init__(self, healthy: SensorNode, delay: Callable[[], float]) -> None:
        super().__init__(healthy)
        self._delay = delay
        self._under_way: deque[tuple[float, NodeReading]] = deque()

    def poll(self, world: World, now: float) -> list[NodeReading]:
        """Run the node up to `now` (s); return what arrives."""
        for reading in self._healthy.poll(world, now):
            last = self._under_way[-1][0] if self._under_way else now
            self._under_way.append((max(now + self._delay(), last), reading))
        arrived = []
        while self._under_way and self._under_way[0][0] <= now:
            arrived.append(self._under_way.popleft()[1])
        return arrived


class FaultyNodeSim(_ChangedNode):
    """A node with a fault: it measures as the healthy one in it does, and reports something else."""

    def __init__(self, healthy: SensorNode, fault: Fault) -> None:
        super().__init__(healthy)
        self._fault: Fault = fault
        self._shown: AreaState | None = None

    def poll(self, world: World, now: float) -> list[NodeReading]:
        """Run the node up to `now` (s); return what it reports."""
        if (state := self._state(now)) != self._shown:
            self._shown = state
            self._healthy.on_connected()  # a change of what it reports goes out as one of what it measures would
        return [self._report(reading, now) for reading in self._healthy.poll(world, now)]

    def _state(self, now: float) -> AreaState:
        match self._fault:
            case "stuck":
                return "unknown"
            case "flapping":
                return "blocked" if int(now / FLAP_S) % 2 == 0 else "clear"
            case "lies-blocked":
                return "blocked"
            case "lies-clear":
                return "clear"

    def _report(self, reading: NodeReading, now: float) -> NodeReading:
        sonars = self.node.sonars
        state = self._state(now)
        if self._fault == "stuck":
            none: list[float | None] = [None] * len(sonars)
            return msgspec.structs.replace(reading, range_m=none, status=["stuck"] * len(sonars), state=state)
        # The wall across the corridor is a little farther away than the limit.
        ranges: list[float | None] = [
            _NEAR_M if state == "blocked" else sonar.range_limit + _MARGIN_M for sonar in sonars
        ]
        return msgspec.structs.replace(reading, range_m=ranges, status=["ok"] * len(sonars), state=state)
