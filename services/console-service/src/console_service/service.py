"""Runs the core: passes it what arrives, and its events on to the readers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from fog_runtime.clock import ticker
from fog_runtime.transports.edges import Edges

if TYPE_CHECKING:
    from collections.abc import Sequence

    from console_service.core import ConsoleCore
    from fog_contracts.handlers import Publication
    from fog_runtime.clock import Clock
    from fog_runtime.health import Health
    from fog_runtime.transports.mqtt_edge import MqttEdge
    from fog_runtime.transports.zenoh_edge import ZenohEdge

TICK_S: Final = 0.1


class Service:
    """The running console-service; its loops are tasks of the process."""

    def __init__(self, core: ConsoleCore, mqtt: MqttEdge, zenoh: ZenohEdge, clock: Clock, health: Health) -> None:
        self._core = core
        self._mqtt = mqtt
        self._zenoh = zenoh
        self._clock = clock
        self._health = health
        self._edges = Edges(clock, mqtt=mqtt, zenoh=zenoh)

    def subscribe(self) -> None:
        """Register subscriptions."""
        self._edges.subscribe(self._core.handlers(), _publish_nothing)

    async def tick_loop(self) -> None:
        """Advance the core ten times a second."""
        async for _ in ticker(self._clock, TICK_S):
            self._core.tick(self._edges.now())
            for name, connected in (("mqtt", self._mqtt.connected), ("zenoh", self._zenoh.connected)):
                self._health.set(name, ok=connected, detail="" if connected else "not connected")


def _publish_nothing(publications: Sequence[Publication]) -> None:
    assert not publications
