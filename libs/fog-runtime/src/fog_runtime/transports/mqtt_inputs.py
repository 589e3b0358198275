"""An MQTT edge with a second connection for channels with thousands of messages a second.

A broker acknowledges a publication on the connection on which it came, behind all that it delivers there, and a client
sends no more than 20 publications that are not acknowledged. On one connection, what a process has to say would wait
behind what it has not read yet.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from fog_runtime.credentials import NOBODY, Credentials
from fog_runtime.transports.mqtt_edge import MqttEdge, Will

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable

    from fog_contracts.channels import Channel
    from fog_runtime.clock import Clock
    from fog_runtime.transports.mqtt_subscriptions import ForeignHandler, Subscriptions

INPUTS: Final = "mqtt-inputs"
"""The second connection's name: in metrics, and at the end of its client id."""


class MqttEdgeWithInputs(MqttEdge):
    """Publishes and subscribes on one connection, and receives the channels `inputs` on another.

    Topics that are no channel's come on that one, too. Among what one connection delivers, the order is the broker's.
    """

    def __init__(  # noqa: PLR0913  # what a connection is
        self,
        url: str,
        client_id: str,
        clock: Clock,
        *,
        site: str,
        inputs: Collection[Channel],
        will: Will | None = None,
        credentials: Credentials = NOBODY,
    ) -> None:
        """Prepare two connections that `run` opens; the other arguments are those of `MqttEdge`."""
        super().__init__(url, client_id, clock, site=site, will=will, credentials=credentials)
        self._channels = frozenset(channel.name for channel in inputs)
        self._inputs = MqttEdge(url, f"{client_id}-inputs", clock, site=site, credentials=credentials, transport=INPUTS)

    @property
    def connected(self) -> bool:
        """Whether both connections are up and all subscriptions are made."""
        return super().connected and self._inputs.connected

    async def broker_answers(self, timeout_s: float = 1.0) -> bool:
        """Return whether the broker answers on both connections within real seconds."""
        return all(await asyncio.gather(super().broker_answers(timeout_s), self._inputs.broker_answers(timeout_s)))

    async def wait_connected(self) -> None:
        """Wait until both connections are up."""
        await super().wait_connected()
        await self._inputs.wait_connected()

    def _subscriptions_of(self, channel: Channel) -> Subscriptions:
        return self._inputs.subscriptions if channel.name in self._channels else self.subscriptions

    async def add_number(self, channel: Channel, number: str | int) -> None:
        """Subscribe the handlers of one of the thesis's channels to one more area."""
        if channel.name in self._channels:
            await self._inputs.add_number(channel, number)
        else:
            await super().add_number(channel, number)

    async def listen_to_foreign(
        self, topics: Iterable[str], handler: ForeignHandler, again: Iterable[str] = ()
    ) -> None:
        """Call `handler(topic, payload, retained)` for each message of these topics, which are no channel's."""
        await self._inputs.listen_to_foreign(topics, handler, again)

    def on_connection_lost(self, callback: Callable[[], object]) -> None:
        """Run `callback` when the connection of the inputs has ended, before the next one delivers anything."""
        self._inputs.on_connection_lost(callback)

    async def run(self) -> None:
        """Connect both and stay connected until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(super().run(), name="mqtt")
            tasks.create_task(self._inputs.run(), name=INPUTS)
