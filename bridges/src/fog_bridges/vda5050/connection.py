"""Connections to a fleet control's broker, and the numbered messages on it.

A message that is retained is never an order: nobody knows how old it is.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Sequence  # msgspec resolves annotations at run time
from typing import TYPE_CHECKING, Any, Final

import aiomqtt
import msgspec

from fog_bridges.floor import REFUSED
from fog_bridges.vda5050.incoming import RELEASES, Version
from fog_bridges.vda5050.outgoing import of_version, timestamp
from fog_runtime import logs
from fog_runtime.concurrency import raise_if_cancelled
from fog_runtime.transports.mqtt_connection import Broker, Inbox

if TYPE_CHECKING:
    from fog_runtime.clock import Clock

SYSTEM: Final = "vda5050"
RETRY_S: Final = 1.0
_log = logs.get(SYSTEM)


class Setup(msgspec.Struct, frozen=True, kw_only=True):
    """Where messages go, and in whose name."""

    site: str
    broker: Broker
    version: Version
    interface: str
    manufacturer: str
    map_id: str
    robots: Sequence[str]
    """Of Fognav, under the fleet's control."""
    zones: Sequence[tuple[str, str]]
    """Manufacturer and serial number of robots of others that are told of zones."""


class Sender:
    """Numbers and writes the messages on one robot's topics."""

    def __init__(self, setup: Setup, version: Version, manufacturer: str, serial: str) -> None:
        self._version: Version = version
        self._names = {"manufacturer": manufacturer, "serialNumber": serial}
        self._base = f"{setup.interface}/v{version.partition('.')[0]}/{manufacturer}/{serial}/"
        self.numbers: Counter[str] = Counter()
        """How many messages each topic has had."""

    def topic(self, name: str) -> str:
        """Return the whole topic."""
        return self._base + name

    def message(self, name: str, content: msgspec.Struct | dict[str, Any], stamp: float) -> bytes:
        """Return a message; `content` is what it has beside its header, in the words of 3.0."""
        header = {"headerId": self.numbers[name], "timestamp": timestamp(stamp), "version": RELEASES[self._version]}
        self.numbers[name] += 1
        return msgspec.json.encode({**header, **self._names, **of_version(name, content, self._version)})


class Connection:
    """A connection to the fleet's broker that is made again and again."""

    def __init__(self, broker: Broker, name: str, topics: Sequence[str], clock: Clock) -> None:
        self._broker = broker
        self._name = name
        self._topics = topics
        self.clock = clock
        self.limited = logs.RateLimited(_log)
        self.problem = "not connected yet"
        """Why nothing is told; empty while it is."""

    def will(self) -> aiomqtt.Will | None:
        """Return what the broker tells when this connection is lost."""
        return None

    def on_message(self, topic: str, payload: bytes) -> None:
        """Take in a message that is not retained."""

    async def serve(self, client: aiomqtt.Client) -> None:
        """Tell what is to be told, until cancelled."""
        raise NotImplementedError

    async def run(self) -> None:
        """Connect and stay connected until cancelled."""
        while True:
            inbox = Inbox(self._on_message)
            try:
                async with self._broker.client(self._name, self.will(), inbox) as client:
                    codes = await client.subscribe([(topic, 0) for topic in self._topics])
                    found = zip(self._topics, codes, strict=True)
                    refused = [topic for topic, code in found if getattr(code, "is_failure", False)]
                    if refused:  # a robot that hears nothing must not be told to be there
                        raise aiomqtt.MqttError(f"it lets this user not receive {', '.join(refused)}: allow that there")  # noqa: TRY301  # as any other failure
                    inbox.open()
                    self.problem = ""
                    await self.serve(client)
            except aiomqtt.MqttError as error:
                raise_if_cancelled()
                self.problem = f"the broker {self._broker} is not connected: {error}"
                self.limited.warning("broker_disconnected", self._name, self.clock.now(), reason=self.problem)
            await asyncio.sleep(RETRY_S)

    def _on_message(self, message: aiomqtt.Message) -> None:
        topic, payload = message.topic.value, message.payload
        if message.retain and not topic.endswith("/connection"):
            self.refuse("retained", topic, "it is retained, so nobody knows how old it is: delete it from the broker")
        elif isinstance(payload, bytes | bytearray):
            self.on_message(topic, bytes(payload))

    def refuse(self, reason: str, topic: str, words: str) -> None:
        """Count and log a message that is of no use."""
        REFUSED.labels(SYSTEM, reason).inc()
        self.limited.warning("message_refused", topic, self.clock.now(), topic=topic, reason=words[:300])
