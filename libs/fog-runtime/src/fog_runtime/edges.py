"""A process's transports taken together: a core's table of handlers is subscribed to, and what it returns published."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from fog_contracts.handlers import Moment
from fog_contracts.messages import Message

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from fog_contracts.channels import Channel
    from fog_contracts.handlers import Handler, Ids, Publication, QueryHandler
    from fog_runtime.clock import Clock
    from fog_runtime.mqtt_edge import MqttEdge
    from fog_runtime.zenoh_edge import ZenohEdge


class Edges:
    """The MQTT and zenoh connections of one process, chosen by each channel's transport."""

    def __init__(self, clock: Clock, *, mqtt: MqttEdge | None = None, zenoh: ZenohEdge | None = None) -> None:
        self._clock = clock
        self._mqtt = mqtt
        self._zenoh = zenoh

    def now(self) -> Moment:
        """Return the present moment by the process's clock."""
        return Moment(self._clock.now(), self._clock.stamp())

    def subscribe(
        self,
        handlers: Mapping[Channel, Handler],
        publish: Callable[[Sequence[Publication]], object],
        *,
        numbers: Sequence[str | int] = (),
        only: Ids | None = None,
    ) -> None:
        """Have each channel's messages go to its handler, and what the handler returns to `publish`.

        Call it before the MQTT connection runs. `numbers` names the areas of the thesis's topics, for which MQTT has
        no wildcard; `only` narrows zenoh's channels to those of these ids, as a robot hears its own. Raises
        `ValueError` for a channel whose transport this process does not have.
        """
        for channel, handler in handlers.items():
            self._subscribe(channel, self._delivery(handler, publish), numbers, only or {})

    def serve(self, query_handlers: Mapping[Channel, QueryHandler], **ids: str) -> None:
        """Have each queryable's requests go to its query_handler; `ids` are the variable parts of the keys served."""
        for channel, query_handler in query_handlers.items():
            if self._zenoh is None:
                raise ValueError(f"channel {channel.name} is carried by zenoh, to which this process is not connected")
            self._zenoh.serve(channel, self._reply(query_handler), **_fitting(channel, ids))

    def publish(self, publication: Publication) -> None:
        """Publish without waiting; raises `ContractError` when the message breaks the channel's contract."""
        channel, message = publication.channel, publication.message
        if channel.transport == "mqtt":
            if self._mqtt is None:
                raise ValueError(f"channel {channel.name} is carried by MQTT, to which this process is not connected")
            self._mqtt.publish_nowait(channel, message, **publication.ids)
        else:
            if self._zenoh is None or not isinstance(message, Message):
                raise ValueError(f"channel {channel.name} is carried by zenoh: it needs a session and a typed message")
            self._zenoh.publish(channel, message, **publication.ids)

    def _delivery(
        self, handler: Handler, publish: Callable[[Sequence[Publication]], object]
    ) -> Callable[[dict[str, str], Any], None]:
        def deliver(ids: dict[str, str], message: object) -> None:
            publish(handler(ids, message, self.now()))

        return deliver

    def _reply(self, query_handler: QueryHandler) -> Callable[[dict[str, str], Any], Message]:
        def reply(ids: dict[str, str], request: object) -> Message:
            return query_handler(ids, request, self.now())

        return reply

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
            self._zenoh.subscribe(channel, channel.message, deliver, **_fitting(channel, only))
        else:
            raise ValueError(f"channel {channel.name} is carried by {channel.transport}: this process can't hear it")


def _fitting(channel: Channel, ids: Ids) -> dict[str, str]:
    """Return the ids that the channel has a place for."""
    return {name: value for name, value in ids.items() if name in channel.fields}
