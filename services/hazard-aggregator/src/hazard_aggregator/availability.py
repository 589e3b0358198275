"""Tells others on MQTT whether an aggregator leads: `online`, and `offline` as the last will of its connection."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from fog_contracts import channels as ch
from fog_contracts.handlers import Publication
from fog_runtime.transports.mqtt_edge import Will

if TYPE_CHECKING:
    import asyncio

    from fog_contracts.handlers import Ids
    from fog_runtime.transports.edges import Edges
    from fog_runtime.transports.mqtt_edge import MqttEdge

LAST_WILL: Final = Will(ch.AGGREGATOR_AVAILABILITY, ch.OFFLINE)


class Availability:
    """The word of the one that leads: `offline` comes from a copy that stood by, or from the leader before, too."""

    def __init__(self, edges: Edges, leading: asyncio.Event) -> None:
        self._edges = edges
        self._leading = leading

    def subscribe(self, mqtt: MqttEdge) -> None:
        """Register what keeps the word true; call before the connection runs."""
        mqtt.on(ch.AGGREGATOR_AVAILABILITY, self._on_availability)
        mqtt.on_connect(self._on_connect)

    def announce(self) -> None:
        """Publish that an aggregator leads, if this one does."""
        if self._leading.is_set():
            self._edges.publish(Publication(ch.AGGREGATOR_AVAILABILITY, ch.ONLINE))

    async def _on_connect(self) -> None:
        self.announce()

    def _on_availability(self, _ids: Ids, text: str) -> None:
        if text == ch.OFFLINE:
            self.announce()
