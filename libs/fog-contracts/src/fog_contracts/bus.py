"""The channels inside one process: cores exchange encoded messages in a fixed order, for lockstep, replays and tests.

It takes the same tables of handlers as a process's edges, so code that connects cores names no single handler.
"""

from __future__ import annotations

from collections import defaultdict, deque
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from fog_contracts.codec import ContractError, decode, decode_text, encode, encode_text
from fog_contracts.handlers import RefusedMessageError, completed
from fog_contracts.messages import Message

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from fog_contracts.channels import Channel
    from fog_contracts.handlers import Core, Handler, Ids, Moment, Publication, QueryHandler

M = TypeVar("M", bound=Message)


@dataclass(frozen=True)
class _Subscription:
    handler: Handler
    only: Ids


@dataclass(frozen=True)
class _Service:
    channel: Channel
    query_handler: QueryHandler
    only: Ids


class _InFlight(NamedTuple):
    channel: Channel
    key: str
    ids: Ids
    data: bytes


class Bus:
    """All channels of one site. Messages are delivered oldest first, to subscribers in the order of subscription."""

    def __init__(self, site: str) -> None:
        self._site = site
        self._subscriptions: defaultdict[Channel, list[_Subscription]] = defaultdict(list)
        self._services: list[_Service] = []
        self._in_flight: deque[_InFlight] = deque()
        self.refused: list[str] = []
        """Messages that subscribers refused (`RefusedMessageError`): topic or key, and reason."""

    def subscribe(self, handlers: Mapping[Channel, Handler], *, only: Ids | None = None) -> None:
        """Subscribe each handler to its channel; what it returns is published.

        `only` restricts channels with these ids to these values: a robot subscribes to its own.
        """
        for channel, handler in handlers.items():
            self._subscriptions[channel].append(_Subscription(handler, _fitting(channel, only)))

    def serve(self, query_handlers: Mapping[Channel, QueryHandler], *, only: Ids | None = None) -> None:
        """Answer each channel's queries with its handler; `only` as for `subscribe`."""
        self._services += [_Service(c, query_handler, _fitting(c, only)) for c, query_handler in query_handlers.items()]

    def connect(self, core: Core, *, only: Ids | None = None) -> None:
        """Subscribe and serve all that a core's tables contain; `only` as for `subscribe`."""
        self.subscribe(core.handlers(), only=only)
        self.serve(core.query_handlers(), only=only)

    def disconnect(self, handlers: Iterable[Handler | QueryHandler]) -> None:
        """End the subscriptions and services of these handlers, as when their process dies."""
        ended = set(map(id, handlers))
        for channel, subscriptions in self._subscriptions.items():
            self._subscriptions[channel] = [s for s in subscriptions if id(s.handler) not in ended]
        self._services = [s for s in self._services if id(s.query_handler) not in ended]

    def publish(self, publications: Iterable[Publication]) -> None:
        """Queue messages for delivery; raises `ContractError` for one that violates its channel's contract."""
        for publication in publications:
            channel, message = publication.channel, publication.message
            if message is None:
                continue  # a bus retains nothing, so there is nothing to delete
            data = encode(channel, message) if isinstance(message, Message) else encode_text(channel, message)
            self._in_flight.append(_InFlight(channel, self._key(channel, publication.ids), publication.ids, data))

    def deliver(self, at: Moment) -> int:
        """Deliver all queued messages and those published in response; return how many were delivered.

        Every message is handled at `at`. What a subscriber refuses is added to `refused`; other errors propagate.
        """
        count = 0
        while self._in_flight:
            message = self._in_flight.popleft()
            for subscription in self._subscriptions[message.channel]:
                if _matches(subscription.only, message.ids):
                    self._call(message, subscription.handler, at)
            count += 1
        return count

    def query(self, channel: Channel, request: Message | None, kind: type[M], at: Moment, **ids: str) -> M | None:
        """Send a query; return the reply, or None when nobody serves the channel.

        Raises `ContractError` when the request or the reply violates the channel's contract.
        """
        self._key(channel, ids)  # they are valid
        for service in self._services:
            if service.channel is channel and _matches(service.only, ids):
                received = None if request is None else roundtrip(channel, request)
                reply = completed(service.query_handler(ids, received, at))
                if not isinstance(reply, kind):
                    raise ContractError(channel.name, f"was answered with {type(reply).__name__}, not {kind.__name__}")
                return roundtrip(channel, reply, reply=channel.kind == "query")
        return None

    def _call(self, message: _InFlight, handler: Handler, at: Moment) -> None:
        # Each subscriber gets its own copy.
        content = _decoded(message.channel, message.data)
        try:
            publications: Sequence[Publication] = handler(message.ids, content, at)
        except RefusedMessageError as error:
            self.refused.append(f"{message.key}: {error}")
        else:
            self.publish(publications)

    def _key(self, channel: Channel, ids: Ids) -> str:
        return _checked_key(channel, self._site, tuple(ids.items()))


@cache
def _checked_key(channel: Channel, site: str, ids: tuple[tuple[str, str], ...]) -> str:
    """Return the key with these ids, of which a process that runs cores has few."""
    return channel.key(**dict(ids), **({"site": site} if "site" in channel.fields else {}))


def roundtrip(channel: Channel, message: M, *, reply: bool = False) -> M:
    """Return a message as its receiver gets it: encoded and decoded, with all limits enforced."""
    return decode(channel, encode(channel, message, reply=reply), type(message), reply=reply)


def _decoded(channel: Channel, data: bytes) -> Any:  # noqa: ANN401  # of the channel's type, which a table of channels can't say
    """Decode a channel's bytes to a message or text; raises `ContractError`."""
    return decode_text(channel, data) if channel.message is None else decode(channel, data, channel.message)


def _fitting(channel: Channel, ids: Ids | None) -> Ids:
    """Return those of the ids that the channel's key contains."""
    return {name: value for name, value in (ids or {}).items() if name in channel.fields}


def _matches(only: Ids, ids: Ids) -> bool:
    return all(ids[name] == value for name, value in only.items())
