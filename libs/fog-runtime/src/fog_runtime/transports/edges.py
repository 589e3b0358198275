"""Wiring of a core to a process's transports: subscribes and serves its tables, and publishes what they return."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

from fog_contracts.codec import ContractError
from fog_contracts.handlers import Later, Moment
from fog_contracts.messages import Message
from fog_runtime import logs, metrics

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence

    from fog_contracts.channels import Channel
    from fog_contracts.handlers import Handler, Ids, Publication, QueryHandler
    from fog_runtime.clock import Clock
    from fog_runtime.transports.mqtt_edge import MqttEdge
    from fog_runtime.transports.zenoh_edge import ZenohEdge

    Answer = Message | None | Awaitable[Message | None]
    Reply = Callable[[dict[str, str], Any], Answer]
    OnReply = Callable[[Channel, Message | None, Message], object]

_log = logs.get("edges")


class Gate(Protocol):
    """Whether this process may act (`fog_runtime.leadership`)."""

    def admit(self, channel: Channel, message: object, send: Callable[[], None]) -> None:
        """Send a message now, later or never; called on the thread that publishes."""

    def answers(self) -> bool:
        """Whether this process answers queries."""

    def on_message(self, channel: Channel, message: object) -> None:
        """Hear a message before its handler does."""

    def on_rival(self, epoch: int) -> None:
        """Hear that another process sent a message of this service with this epoch."""


class Edges:
    """The MQTT and zenoh connections of one process; each channel uses that of its transport.

    A `gate` decides what is published and whether queries are answered; without one, everything is. `synchronized`
    tells whether the time of day is right.
    """

    def __init__(
        self,
        clock: Clock,
        *,
        mqtt: MqttEdge | None = None,
        zenoh: ZenohEdge | None = None,
        gate: Gate | None = None,
        synchronized: Callable[[], bool] = lambda: True,
    ) -> None:
        self._clock = clock
        self._synchronized = synchronized
        self._gate = gate
        self._mqtt = mqtt
        self._zenoh = zenoh
        self._served_when_published: dict[Channel, Reply] = {}
        self._limited = logs.RateLimited(_log)
        self._making: dict[Later[Message], asyncio.Future[Message]] = {}
        self._served: set[tuple[Channel, frozenset[tuple[str, str]]]] = set()

    def now(self) -> Moment:
        """Return the current moment by the process's clock."""
        return Moment(self._clock.now(), self._clock.stamp(), clock=self._clock.id, synchronized=self._synchronized())

    def subscribe(
        self,
        handlers: Mapping[Channel, Handler],
        publish: Callable[[Sequence[Publication]], object],
        *,
        numbers: Sequence[str | int] = (),
        only: Ids | None = None,
        polled: Collection[Channel] = (),
    ) -> None:
        """Subscribe each handler to its channel; what it returns is passed to `publish`.

        Call it before the MQTT connection runs. `numbers` lists the areas of the thesis's topics, for which MQTT has
        no wildcard; `only` restricts zenoh channels with these ids to these values: a robot subscribes to its own.
        Messages of `polled` channels, on zenoh, are handled whenever the session is polled (`ZenohEdge.poll`), and at
        the latest before a message of another zenoh channel, so that nothing overtakes what was sent before it.
        Raises `ValueError` for a channel whose transport this process does not have.
        """
        for channel, handler in handlers.items():
            delivery = self._delivery(channel, handler, publish)
            if channel in polled and self._zenoh is not None and channel.message is not None:
                self._zenoh.subscribe_polled(channel, channel.message, delivery, **_ids_of(channel, only or {}))
            else:
                ordered = self._after_polled(delivery) if polled and channel.transport == "zenoh" else delivery
                self._subscribe(channel, ordered, numbers, only or {})

    def serve(
        self,
        query_handlers: Mapping[Channel, QueryHandler],
        *,
        only: Ids | None = None,
        on_reply: OnReply | None = None,
    ) -> None:
        """Answer each channel's queries with its handler; `only` gives the variable parts of the keys served.

        A published channel whose key has further variable parts is served under each key that this process publishes
        from now on. `on_reply` is called with each channel, request and reply, for logs. Raises `ValueError` for
        another channel with further variable parts, or without a zenoh session.
        """
        for channel, query_handler in query_handlers.items():
            reply, ids = self._reply(channel, query_handler, on_reply), _ids_of(channel, only or {})
            missing = set(channel.fields) - {"site", *ids}
            if not missing:
                self._serve(channel, reply, ids)
            elif channel.kind == "pub":
                self._served_when_published[channel] = reply
            else:
                raise ValueError(f"channel {channel.name} can't be served without the ids {sorted(missing)}")

    def publish(self, publication: Publication) -> None:
        """Publish without waiting; a message that violates its channel's contract is logged, counted and not published.

        It must not end the loop of a process: the others of its publications still matter. On zenoh any thread may
        publish, unless the channel is served, too.
        """
        if self._gate is None:
            self._publish_now(publication)
        else:
            self._gate.admit(publication.channel, publication.message, partial(self._publish_now, publication))

    def _publish_now(self, publication: Publication) -> None:
        try:
            self._send(publication)
        except ContractError as error:
            metrics.UNPUBLISHABLE.labels(publication.channel.name).inc()
            key = publication.channel.pattern(**publication.ids)
            self._limited.warning("message_unpublishable", key, self._clock.now(), key=key, reason=error.reason)

    def _send(self, publication: Publication) -> None:
        channel, message = publication.channel, publication.message
        if channel.transport == "mqtt":
            if self._mqtt is None:
                raise ValueError(f"channel {channel.name} is carried by MQTT, to which this process is not connected")
            self._mqtt.publish_nowait(channel, message, **publication.ids)
        else:
            if self._zenoh is None or not isinstance(message, Message):
                raise ValueError(f"channel {channel.name} is carried by zenoh: it needs a session and a typed message")
            self._zenoh.publish(channel, message, **publication.ids)
        if (reply := self._served_when_published.get(channel)) is not None:
            self._serve(channel, reply, publication.ids)

    def _serve(self, channel: Channel, reply: Reply, ids: Ids) -> None:
        """Serve one key, unless it is served already."""
        if self._zenoh is None:
            raise ValueError(f"channel {channel.name} is carried by zenoh, to which this process is not connected")
        key = (channel, frozenset(ids.items()))
        if key not in self._served:
            self._served.add(key)
            self._zenoh.serve(channel, reply, **ids)

    def _delivery(
        self, channel: Channel, handler: Handler, publish: Callable[[Sequence[Publication]], object]
    ) -> Callable[[dict[str, str], Any], None]:
        def deliver(ids: dict[str, str], message: object) -> None:
            if self._gate is not None:
                self._gate.on_message(channel, message)
            publish(handler(ids, message, self.now()))

        return deliver

    def _after_polled(self, deliver: Callable[[dict[str, str], Any], None]) -> Callable[[dict[str, str], Any], None]:
        """Return a delivery before which what waits to be polled is handled."""

        def ordered(ids: dict[str, str], message: object) -> None:
            if self._zenoh is not None:
                self._zenoh.poll()
            deliver(ids, message)

        return ordered

    def _reply(self, channel: Channel, query_handler: QueryHandler, on_reply: OnReply | None) -> Reply:
        def replied(request: Any, message: Message) -> Message | None:  # noqa: ANN401  # of the channel's type
            if self._gate is not None and not self._gate.answers():
                return None
            if on_reply is not None:
                on_reply(channel, request, message)
            return message

        async def later(request: Any, answer: Later[Message]) -> Message | None:  # noqa: ANN401  # as above
            return replied(request, await self._made(channel, answer))

        def reply(ids: dict[str, str], request: Any) -> Answer:  # noqa: ANN401  # as above
            if self._gate is not None and not self._gate.answers():
                return None
            answer = query_handler(ids, request, self.now())
            return later(request, answer) if isinstance(answer, Later) else replied(request, answer)

        return reply

    async def _made(self, channel: Channel, answer: Later[Message]) -> Message:
        """Return an answer that takes long to make: on another thread, once for all who ask for it meanwhile."""
        if answer.made is not None:
            return answer.made
        making = self._making.get(answer)
        if making is None:
            making = self._making[answer] = asyncio.ensure_future(self._make(channel, answer))
            making.add_done_callback(lambda _: self._making.pop(answer, None))
        return await asyncio.shield(making)

    async def _make(self, channel: Channel, answer: Later[Message]) -> Message:
        with metrics.REPLY_SECONDS.labels(channel.name).time():
            return await asyncio.to_thread(answer.make)

    def _subscribe(
        self,
        channel: Channel,
        deliver: Callable[[dict[str, str], Any], None],
        numbers: Sequence[str | int],
        only: Ids,
    ) -> None:
        if channel.transport == "mqtt" and self._mqtt is not None:
            if channel.message is None:
                self._mqtt.on(channel, deliver, numbers=numbers)
            else:
                self._mqtt.on(channel, deliver, channel.message)
        elif channel.transport == "zenoh" and self._zenoh is not None and channel.message is not None:
            self._zenoh.subscribe(channel, channel.message, deliver, **_ids_of(channel, only))
        else:
            raise ValueError(
                f"channel {channel.name} is carried by {channel.transport}, to which this process is not connected"
            )


def _ids_of(channel: Channel, ids: Ids) -> dict[str, str]:
    """Return those of the ids that the channel's key contains."""
    return {name: value for name, value in ids.items() if name in channel.fields}
