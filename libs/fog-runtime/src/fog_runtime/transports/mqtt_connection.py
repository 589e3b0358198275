"""One MQTT connection: its broker's address, its options, its subscriptions, and how messages get to handlers."""

import asyncio
import socket
from collections.abc import Callable, Iterable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, Self, cast
from urllib.parse import unquote, urlsplit

import aiomqtt

from fog_contracts.channels import Channel
from fog_contracts.codec import ContractError, decode, decode_text
from fog_contracts.handlers import RefusedMessageError
from fog_contracts.messages import Message
from fog_runtime import logs, metrics
from fog_runtime.clock import Clock
from fog_runtime.credentials import NOBODY, Credentials

_KEEPALIVE_S: Final = 10
"""A connection without traffic for 1.5 times as long is considered lost by both sides."""
_TIMEOUT_S: Final = 5.0
_QUEUE: Final = 10_000

_log = logs.get("mqtt_edge")


class Inbox(asyncio.Queue[aiomqtt.Message]):
    """Passes each message on as soon as it is read from the connection; until it is opened, it keeps them.

    A queue costs a task of the event loop for each message: several times what its handler costs.
    """

    def __init__(self, deliver: Callable[[aiomqtt.Message], object]) -> None:
        super().__init__(_QUEUE)
        self._deliver = deliver
        self._opened = False
        self.retained = 0
        """How many of the messages so far the broker had kept from before the subscription."""

    def open(self) -> None:
        """Deliver what has arrived, and from now on each message at once."""
        while not self.empty():
            self._deliver(self.get_nowait())
        self._opened = True

    def put_nowait(self, item: aiomqtt.Message) -> None:
        """Deliver a message, or keep it; raises `asyncio.QueueFull`."""
        self.retained += item.retain
        if self._opened:
            self._deliver(item)
        else:
            super().put_nowait(item)


@dataclass(frozen=True)
class Broker:
    """A broker's address, with the credentials of this process."""

    host: str
    port: int
    user: str | None
    password: str | None
    tls: bool
    credentials: Credentials = NOBODY

    @classmethod
    def of(cls, url: str, credentials: Credentials = NOBODY) -> Self:
        """Read an address, whose user and password, if it has any, replace those of `credentials`.

        Raises `ValueError` for an invalid one, and `CredentialsError` if it would reveal the password.
        """
        parts = urlsplit(url)
        if parts.scheme not in {"mqtt", "mqtts"} or not parts.hostname:
            raise ValueError("the broker's address must look like mqtt://host:1883 or mqtts://user:password@host:8883")
        tls = parts.scheme == "mqtts"
        user = unquote(parts.username) if parts.username else None
        password = unquote(parts.password) if parts.password else None
        if user is None and (login := credentials.login("mqtt", url, parts.hostname, encrypted=tls)) is not None:
            user, password = login
        return cls(
            host=parts.hostname,
            port=parts.port or (8883 if tls else 1883),
            user=user,
            password=password,
            tls=tls,
            credentials=credentials,
        )

    @classmethod
    def listed(cls, urls: str, credentials: Credentials = NOBODY) -> list[Self]:
        """Read comma separated addresses of bridged brokers; raises as `of`."""
        return [cls.of(url.strip(), credentials) for url in urls.split(",")]

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"

    def client(self, identifier: str, will: aiomqtt.Will | None, inbox: Inbox | None = None) -> aiomqtt.Client:
        """Return a client of this broker that is not connected yet; its messages go to `inbox`, if one is given."""
        client = aiomqtt.Client(
            self.host,
            self.port,
            username=self.user,
            password=self.password,
            identifier=identifier,
            protocol=aiomqtt.ProtocolVersion.V311,
            clean_session=True,
            will=will,
            timeout=_TIMEOUT_S,
            socket_options=[(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)],  # a hazard waits for no acknowledgement
            keepalive=_KEEPALIVE_S,
            queue_type=None if inbox is None else cast("type[asyncio.Queue[aiomqtt.Message]]", lambda **_: inbox),
            tls_context=self.credentials.tls_context() if self.tls else None,
        )
        client.pending_calls_threshold = 1000
        return client


Ids = dict[str, str]
ForeignHandler = Callable[[str, bytes | None, bool], object]
"""Handles a message of a topic that is no channel's: topic, payload (None: too long), and whether it was retained."""
FOREIGN_LIMIT: Final = 16 * 1024
"""Bytes of the longest payload of such a topic."""
FOREIGN: Final = "foreign"
"""The label of such messages in metrics, in place of a channel's name."""

_ROUTES: Final = 10_000
"""Topics whose handlers are remembered: thousands of messages a second come on the same few hundred topics."""


@dataclass
class _Subscription:
    channel: Channel
    handler: Callable[[Ids, Any], object]
    kind: type[Message] | None
    topics: list[str]


class _Route(NamedTuple):
    """Who gets the messages of one topic; `malformed` are the channels that it nearly belongs to."""

    foreign: tuple[ForeignHandler, ...]
    malformed: tuple[Channel, ...]
    subscriptions: tuple[tuple[_Subscription, Ids], ...]


class Subscriptions:
    """All handlers of one process, whether it is connected or not."""

    def __init__(self, clock: Clock, *, site: str) -> None:
        self._clock = clock
        self._site = site
        self._subscriptions: list[_Subscription] = []
        self._foreign: dict[str, ForeignHandler] = {}
        self._routes: dict[str, _Route] = {}
        self._limited = logs.RateLimited(_log)

    def add(
        self,
        channel: Channel,
        handler: Callable[[Ids, Any], object],
        kind: type[Message] | None,
        numbers: Sequence[str | int],
    ) -> None:
        """Call `handler(ids, message)` for each message of the channel, as `MqttEdge.on` says."""
        if channel.transport != "mqtt" or channel.message is not kind:
            expected = channel.message.__name__ if channel.message else "text"
            raise ValueError(f"channel {channel.name} carries {expected} over {channel.transport}")
        if "number" in channel.fields:
            topics = [channel.key(number=str(number)) for number in numbers]
        else:
            topics = [channel.pattern(**({"site": self._site} if "site" in channel.fields else {}))]
        self._subscriptions.append(_Subscription(channel, handler, kind, topics))
        metrics.expect_messages(channel.name)
        self._routes.clear()

    def add_topic(self, channel: Channel, topic: str) -> bool:
        """Give the channel's handlers one more topic; return whether any of them did not have it yet."""
        without = [one for one in self._subscriptions if one.channel == channel and topic not in one.topics]
        for subscription in without:
            subscription.topics.append(topic)
        self._routes.clear()
        return bool(without)

    def set_foreign(
        self, topics: Iterable[str], handler: ForeignHandler, again: Iterable[str] = ()
    ) -> tuple[list[str], list[str]]:
        """Pass the messages of these topics, which are no channel's, to a handler, and those of others no more.

        Returns the topics to subscribe to, those of them that `again` names included, and those to unsubscribe from.
        """
        old, self._foreign = self._foreign, dict.fromkeys(topics, handler)
        if self._foreign:
            metrics.expect_messages(FOREIGN)
        self._routes.clear()
        kept = self.qos_by_topic().keys() | self.foreign
        added = self._foreign.keys() - (old.keys() - set(again))
        return sorted(added), sorted(old.keys() - kept)

    @property
    def foreign(self) -> AbstractSet[str]:
        """The topics that are no channel's."""
        return self._foreign.keys()

    def qos_by_topic(self) -> dict[str, int]:
        """Return the topics of all channels, with their quality of service."""
        return {topic: one.channel.qos for one in self._subscriptions for topic in one.topics}

    def deliver(self, message: aiomqtt.Message) -> None:
        """Pass a message to the handlers of its channel; count and log it when it breaks the channel's contract."""
        topic = message.topic.value
        route = self._routes.get(topic)
        if route is None:
            if len(self._routes) >= _ROUTES:
                self._routes.clear()
            route = self._routes[topic] = self._route(message.topic)
        for handler in route.foreign:
            self._deliver_foreign(handler, message)
        for channel in route.malformed:
            self._refuse(channel, topic, "the ids in the topic are malformed")
        for subscription, ids in route.subscriptions:
            self._deliver_to(subscription, ids, topic, message)

    def _route(self, topic: aiomqtt.Topic) -> _Route:
        foreign = {self._foreign[pattern] for pattern in self._foreign if topic.matches(pattern)}
        subscriptions: list[tuple[_Subscription, Ids]] = []
        malformed: list[Channel] = []
        for subscription in self._subscriptions:
            ids = subscription.channel.match(topic.value)
            if ids is not None:
                ids.pop("site", None)  # always this process's own site
                subscriptions.append((subscription, ids))
            elif any(topic.matches(pattern) for pattern in subscription.topics):
                malformed.append(subscription.channel)
        return _Route(tuple(foreign), tuple(malformed), tuple(subscriptions))

    def _deliver_to(self, subscription: _Subscription, ids: Ids, topic: str, message: aiomqtt.Message) -> None:
        channel, data = subscription.channel, message.payload
        if message.retain and not channel.retained:
            # It may be years old; a stale reading must never be used as a fresh one.
            self._refuse(channel, topic, "retained, but this channel's messages never are: delete it from the broker")
            return
        if channel.retained and not data:
            return  # a retained message was deleted
        try:
            content = (
                decode_text(channel, data) if subscription.kind is None else decode(channel, data, subscription.kind)
            )
        except ContractError as error:
            self._refuse(channel, topic, error.reason)
            return
        metrics.RECEIVED.labels(channel.name).inc()
        try:
            subscription.handler(dict(ids), content)
        except RefusedMessageError as error:
            self._refuse(channel, topic, str(error))
        except Exception as error:  # noqa: BLE001  # one message must not end the process; the bug is logged
            metrics.HANDLER_ERRORS.labels(channel.name).inc()
            _log.error("handler_failed", error=error, channel=channel.name, topic=topic)

    def _deliver_foreign(self, handler: ForeignHandler, message: aiomqtt.Message) -> None:
        topic, data = message.topic.value, message.payload
        if len(data) > FOREIGN_LIMIT:
            metrics.REFUSED.labels(FOREIGN).inc()
            reason = f"{len(data)} bytes are over the limit of {FOREIGN_LIMIT}"
            self._limited.warning("message_refused", topic, self._clock.now(), topic=topic, reason=reason)
        else:
            metrics.RECEIVED.labels(FOREIGN).inc()
        try:
            handler(topic, data if len(data) <= FOREIGN_LIMIT else None, message.retain)
        except Exception as error:  # noqa: BLE001  # one message must not end the process; the bug is logged
            metrics.HANDLER_ERRORS.labels(FOREIGN).inc()
            _log.error("handler_failed", error=error, channel=FOREIGN, topic=topic)

    def _refuse(self, channel: Channel, topic: str, reason: str) -> None:
        metrics.REFUSED.labels(channel.name).inc()
        self._limited.warning("message_refused", channel.name, self._clock.now(), topic=topic, reason=reason)
