"""The transport of the sensor side: typed publishing and subscribing on MQTT channels over one connection.

The client is paho-mqtt, driven through aiomqtt. It speaks MQTT 3.1.1, which costs far less for each message than MQTT 5
(docs/performance.md). Each connection starts a clean session and subscribes again. State that must survive is retained,
or published again by `on_connect`, never kept by a broker.
"""

import asyncio
import random
from collections import deque
from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final, TypeVar, overload

import aiomqtt
from paho.mqtt.reasoncodes import ReasonCode

from fog_contracts.channels import Channel
from fog_contracts.codec import ContractError, encode, encode_text
from fog_contracts.messages import Message
from fog_runtime import logs, metrics
from fog_runtime.clock import Clock
from fog_runtime.concurrency import raise_if_cancelled
from fog_runtime.credentials import NOBODY, Credentials
from fog_runtime.transports.mqtt_connection import Broker, ForeignHandler, Ids, Inbox, Subscriptions

M = TypeVar("M", bound=Message)
T = TypeVar("T")

NOT_SUBSCRIBED: Final = "fog/nobody-subscribes"
"""A topic to which nobody subscribes: a broker answers who ends such a subscription, too, and changes nothing."""
BACKOFF_S: Final = (0.2, 2.0)
"""Real seconds between attempts to connect: initial and maximum."""

FOREIGN_LOSSES: Final = 3
"""Connections that may end while a topic of others is subscribed to, until it is left out."""

_log = logs.get("mqtt_edge")


@dataclass(frozen=True)
class Will:
    """The last will: what the broker publishes when this process disconnects unexpectedly."""

    channel: Channel
    message: Message | str
    ids: Ids = field(default_factory=dict)

    def on(self, topic: str) -> aiomqtt.Will:
        """Return it as it is given to a broker."""
        return aiomqtt.Will(topic, _encoded(self.channel, self.message), self.channel.qos, self.channel.retained)


def _encoded(channel: Channel, message: Message | str | None) -> bytes:
    if message is None:
        if not channel.retained:
            raise ContractError(channel.name, "is not retained: there is no message to delete")
        return b""
    return encode(channel, message) if isinstance(message, Message) else encode_text(channel, message)


async def _receive_retained(client: aiomqtt.Client, inbox: Inbox) -> None:
    """Wait until the inbox has what the broker retains of the topics that were subscribed to.

    Otherwise a restarted process would replace what the one before it had left by its own ignorance, and nobody would
    know it any more if it died then. A broker sends only so many messages that are not acknowledged, but each
    acknowledgement is on its way before the next question.
    """
    received = -1
    while received != inbox.retained:
        received = inbox.retained
        await client.unsubscribe(NOT_SUBSCRIBED)
        raise_if_cancelled()


async def _subscribe(client: aiomqtt.Client, qos_by_topic: Mapping[str, int]) -> None:
    codes = await client.subscribe(list(qos_by_topic.items()))
    raise_if_cancelled()
    for topic, code in zip(qos_by_topic, codes, strict=True):
        if isinstance(code, ReasonCode) and code.is_failure:
            _log.error("subscription_refused", topic=topic, reason=str(code))


class MqttEdge:
    """One process's connection to the broker. All handlers run on the event loop's thread."""

    def __init__(  # noqa: PLR0913  # what a connection is
        self,
        url: str,
        client_id: str,
        clock: Clock,
        *,
        site: str,
        will: Will | None = None,
        credentials: Credentials = NOBODY,
        transport: str = "mqtt",
    ) -> None:
        """Prepare a connection that `run` opens. `site` is filled into every topic that contains one.

        `transport` is its name in the metrics of connections.

        `url` may list several brokers, comma separated, that are bridged: each failure moves on to the next one. Raises
        `ValueError` for an invalid address, or one over which the password in `credentials` could be read.
        """
        self._brokers = deque(Broker.listed(url, credentials))
        self._client_id = client_id
        self._clock = clock
        self._site = site
        self._will = will
        self._transport = transport
        self.subscriptions = Subscriptions(clock, site=site)
        self._on_connect: list[Callable[[], Awaitable[None]]] = []
        self._on_connection_lost: list[Callable[[], object]] = []
        self._client: aiomqtt.Client | None = None
        self._changed = asyncio.Event()
        self._tasks: set[asyncio.Future[Any]] = set()
        # Topics that are no channel's, by how many connections in a row ended while they were subscribed to.
        self._losses: dict[str, int] = {}
        self._trying: set[str] = set()
        self._limited = logs.RateLimited(_log)

    @property
    def connected(self) -> bool:
        """Whether the connection is up and all subscriptions are made."""
        return self._client is not None

    async def broker_answers(self, timeout_s: float = 1.0) -> bool:
        """Ask the broker something (to end a subscription that nobody has); return whether it answers in real seconds.

        `connected` notices a broker that hangs, or a connection on which nothing passes any more, after 15 s only.
        """
        if (client := self._client) is None:
            return False
        try:
            await client.unsubscribe(NOT_SUBSCRIBED, timeout=timeout_s)
        except aiomqtt.MqttError:
            raise_if_cancelled()
            return False
        raise_if_cancelled()
        return client is self._client

    @property
    def pending(self) -> int:
        """How many messages wait for the connection or for the broker's answer."""
        return len(self._tasks)

    async def wait_connected(self) -> None:
        """Wait until the connection is up."""
        while self._client is None:
            self._changed.clear()
            await self._changed.wait()

    @overload
    def on(self, channel: Channel, handler: Callable[[Ids, M], object], kind: type[M]) -> None: ...
    @overload
    def on(
        self,
        channel: Channel,
        handler: Callable[[Ids, str], object],
        kind: None = None,
        *,
        numbers: Sequence[str | int] = (),
    ) -> None: ...

    def on(
        self,
        channel: Channel,
        handler: Callable[[Ids, Any], object],
        kind: type[Message] | None = None,
        *,
        numbers: Sequence[str | int] = (),
    ) -> None:
        """Call `handler(ids, message)` for each message of the channel; register before `run`.

        Channels without a message type deliver text. `numbers` lists the areas of the thesis's topics, for which MQTT
        has no wildcard.
        """
        self._subscriptions_of(channel).add(channel, handler, kind, numbers)

    def _subscriptions_of(self, _channel: Channel) -> Subscriptions:
        """Return the subscriptions of the connection that receives a channel."""
        return self.subscriptions

    async def add_number(self, channel: Channel, number: str | int) -> None:
        """Subscribe the handlers of one of the thesis's channels to one more area, now and after every connection.

        Without a connection the subscription is made at the next one.
        """
        topic = channel.key(number=str(number))
        added, client = self.subscriptions.add_topic(channel, topic), self._client
        if not added or client is None:
            return
        try:
            await _subscribe(client, {topic: channel.qos})
        except aiomqtt.MqttError as error:
            self._limited.warning("subscription_failed", topic, self._clock.now(), topic=topic, reason=str(error))

    async def listen_to_foreign(
        self, topics: Iterable[str], handler: ForeignHandler, again: Iterable[str] = ()
    ) -> None:
        """Call `handler(topic, payload, retained)` for each message of these topics, which are no channel's.

        They replace those of the call before, now and after every connection. The broker delivers the retained messages
        of those in `again` once more, though they were subscribed to before. Topics at which a broker ends the
        connection are left out, so that all others are received.
        """
        added, dropped = self.subscriptions.set_foreign(topics, handler, again)
        self._losses = {topic: self._losses[topic] for topic in self._losses.keys() - {*added, *dropped}}
        client = self._client
        if client is None:
            return
        try:
            await self._subscribe_foreign(client, added)
            if dropped:
                await client.unsubscribe(dropped)
        except aiomqtt.MqttError as error:
            self._limited.warning("subscription_failed", "foreign", self._clock.now(), topic=added, reason=str(error))

    async def _subscribe_foreign(self, client: aiomqtt.Client, topics: Collection[str]) -> None:
        if topics:
            self._trying |= {*topics}
            await _subscribe(client, dict.fromkeys(topics, 1))
            self._trying -= {*topics}
            for topic in topics:
                self._losses.pop(topic, None)

    async def _subscribe_suspects(self, client: aiomqtt.Client) -> None:
        """Subscribe to the topics at which the connection ended before, each alone: it may be only one of them."""
        for topic, losses in sorted(self._losses.items()):
            if losses < FOREIGN_LOSSES:
                await self._subscribe_foreign(client, [topic])

    def _count_losses(self) -> None:
        """Suspect the topics that were being subscribed to when the connection ended."""
        trying, self._trying = self._trying & {*self.subscriptions.foreign}, set()
        for topic in trying:
            self._losses[topic] = self._losses.get(topic, 0) + 1
            if self._losses[topic] == FOREIGN_LOSSES:
                remedy = "its source stays unknown: change its topic to one that the broker accepts"
                _log.error("topic_left_out", topic=topic, reason="the broker ends the connection at it", remedy=remedy)

    def on_connect(self, callback: Callable[[], Awaitable[None]]) -> None:
        """Run `callback` after every connection, once all subscriptions are made."""
        self._on_connect.append(callback)

    def on_connection_lost(self, callback: Callable[[], object]) -> None:
        """Run `callback` when a connection has ended, before the next one delivers anything."""
        self._on_connection_lost.append(callback)

    async def publish(self, channel: Channel, message: Message | str, *, wait: bool = False, **ids: str) -> bool:
        """Publish; True when it was passed to the connection or, with `wait`, acknowledged by the broker (QoS 1).

        Without a connection the message is dropped and the result is False; a caller that must not lose it publishes
        again in `on_connect`. Raises `ContractError` when the message violates the channel's contract.
        """
        return await self._send(channel, self._topic(channel, ids), _encoded(channel, message), wait=wait)

    def publish_nowait(self, channel: Channel, message: Message | str | None, **ids: str) -> None:
        """Publish in the order of the calls, without waiting; without a connection the message is dropped and counted.

        None deletes the retained message (in MQTT: by an empty retained payload). Raises `ContractError` when the
        message violates the channel's contract.
        """
        topic, data, client = self._topic(channel, ids), _encoded(channel, message), self._client
        if client is None:
            metrics.DROPPED.labels(channel.name).inc()
        else:
            self._spawn(self._transmit(client, channel, topic, data), topic)

    async def clear(self, channel: Channel, *, wait: bool = False, **ids: str) -> bool:
        """Delete a retained message (in MQTT: by an empty retained payload)."""
        return await self._send(channel, self._topic(channel, ids), _encoded(channel, None), wait=wait)

    async def run(self) -> None:
        """Connect and stay connected until cancelled; after a failure at the next broker."""
        failures = 0
        while True:
            broker, inbox = self._brokers[0], Inbox(self.subscriptions.deliver)
            try:
                async with broker.client(self._client_id, self._mqtt_will(), inbox) as client:
                    failures = 0
                    try:
                        await self._serve(client, broker, inbox)
                    except asyncio.CancelledError:
                        await self._publish_will(client)
                        raise
            except aiomqtt.MqttError as error:
                raise_if_cancelled()
                reason = str(error) or type(error).__name__
                now = self._clock.now()
                self._limited.warning("broker_disconnected", str(broker), now, broker=str(broker), reason=reason)
                self._brokers.rotate(-1)
            finally:
                self._on_disconnected()
            rounds = failures // len(self._brokers)
            delay = random.uniform(BACKOFF_S[0], min(BACKOFF_S[1], BACKOFF_S[0] * 2 ** min(rounds + 1, 10)))  # noqa: S311  # spreads attempts in time, no secret
            failures += 1
            await asyncio.sleep(delay)

    def _topic(self, channel: Channel, ids: Ids) -> str:
        if "site" in ids:
            raise ValueError("the edge fills in the site: leave it out")
        return channel.key(**({**ids, "site": self._site} if "site" in channel.fields else ids))

    def _mqtt_will(self) -> aiomqtt.Will | None:
        will = self._will
        return None if will is None else will.on(self._topic(will.channel, will.ids))

    async def _publish_will(self, client: aiomqtt.Client) -> None:
        """Publish the last will before an orderly end, at which a broker forgets it."""
        if (will := self._mqtt_will()) is not None:
            with suppress(aiomqtt.MqttError):  # without a connection the broker publishes it
                await client.publish(will.topic, will.payload, will.qos, will.retain)

    async def _serve(self, client: aiomqtt.Client, broker: Broker, inbox: Inbox) -> None:
        own = self.subscriptions.qos_by_topic()
        foreign = self.subscriptions.foreign - own.keys()
        if own:
            await _subscribe(client, own)
        await self._subscribe_foreign(client, sorted(foreign - self._losses.keys()))
        if own or foreign:
            await _receive_retained(client, inbox)
        self._client = client
        self._changed.set()
        metrics.CONNECTED.labels(self._transport).set(1)
        metrics.CONNECTIONS.labels(self._transport).inc()
        _log.info("broker_connected", broker=str(broker), client=self._client_id)
        inbox.open()
        for callback in self._on_connect:
            self._spawn(callback(), "on_connect")
        if self._losses:
            self._spawn(self._subscribe_suspects(client), "suspects")
        async for _ in client.messages:  # until the connection ends: the inbox delivers
            pass

    def _on_disconnected(self) -> None:
        was_connected, self._client = self._client is not None, None
        metrics.CONNECTED.labels(self._transport).set(0)
        for task in list(self._tasks):
            task.cancel()
        self._count_losses()
        for callback in self._on_connection_lost if was_connected else ():
            callback()

    def _spawn(self, work: Awaitable[T], name: str) -> asyncio.Future[T]:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)

        def ended(done: asyncio.Future[T]) -> None:
            self._tasks.discard(done)
            if not done.cancelled() and (error := done.exception()) is not None:
                _log.error("task_failed", error=error, task=name)

        task.add_done_callback(ended)
        return task

    async def _send(self, channel: Channel, topic: str, data: bytes, *, wait: bool) -> bool:
        client = self._client
        if client is None:
            metrics.DROPPED.labels(channel.name).inc()
            return False
        if channel.qos == 0:
            return await self._transmit(client, channel, topic, data)
        # A task in both cases: tasks start in order, so a message that is awaited does not overtake one that is not.
        task = self._spawn(self._transmit(client, channel, topic, data), topic)
        if not wait:
            return True
        await asyncio.wait([task])
        return not task.cancelled() and task.result()

    async def _transmit(self, client: aiomqtt.Client, channel: Channel, topic: str, data: bytes) -> bool:
        try:
            await client.publish(topic, data, qos=channel.qos, retain=channel.retained)
        except aiomqtt.MqttError as error:
            raise_if_cancelled()
            metrics.DROPPED.labels(channel.name).inc()
            self._limited.warning("message_dropped", channel.name, self._clock.now(), topic=topic, reason=str(error))
            return False
        metrics.PUBLISHED.labels(channel.name).inc()
        raise_if_cancelled()
        return True


INPUTS: Final = "mqtt-inputs"
"""The second connection's name: in metrics, and at the end of its client id."""


class MqttEdgeWithInputs(MqttEdge):
    """Publishes and subscribes on one connection, and receives the channels `inputs` on another.

    A broker acknowledges a publication behind all that it delivers on the same connection, and a client sends no more
    than 20 that are not acknowledged. On one connection, what a process says would wait behind what it has not read.

    Topics that are no channel's come on the second one, too. Among what one connection delivers, the order is the
    broker's.
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
