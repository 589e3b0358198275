"""The channels inside one process: cores exchange messages as bytes, in one order, for lockstep, replays and tests.

It takes the tables that a process's edges take, so whoever connects cores by it names no handler of theirs.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from fog_contracts.codec import ContractError, decode, decode_text, encode, encode_text
from fog_contracts.handlers import RefusedMessageError
from fog_contracts.messages import Message

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from fog_contracts.channels import Channel
    from fog_contracts.handlers import Handler, Ids, Moment, Publication, QueryHandler

M = TypeVar("M", bound=Message)


@dataclass(frozen=True)
class _Subscription:
    channel: Channel
    handler: Handler
    only: Ids


@dataclass(frozen=True)
class _Service:
    channel: Channel
    query_handler: QueryHandler
    only: Ids


@dataclass(frozen=True)
class _InFlight:
    channel: Channel
    key: str
    data: bytes


class Bus:
    """All channels of one site. Messages are delivered oldest first, to subscribers in the order of subscription."""

    def __init__(self, site: str) -> None:
        self._site = site
        self._subscriptions: list[_Subscription] = []
        self._services: list[_Service] = []
        self._in_flight: deque[_InFlight] = deque()
        self.refused: list[str] = []
        """What subscribers refused (`RefusedMessageError`): the topic or key, and their reason."""

    def subscribe(self, handlers: Mapping[Channel, Handler], *, only: Ids | None = None) -> None:
        """Have each channel's messages go to its handler, and what the handler returns be published.

        `only` narrows channels with such ids to these values, as a robot hears its own.
        """
        self._subscriptions += [_Subscription(c, handler, _fitting(c, only)) for c, handler in handlers.items()]

    def serve(self, query_handlers: Mapping[Channel, QueryHandler], *, only: Ids | None = None) -> None:
        """Have each queryable's requests go to its query_handler; `only` as for `subscribe`."""
        self._services += [_Service(c, query_handler, _fitting(c, only)) for c, query_handler in query_handlers.items()]

    def publish(self, publications: Iterable[Publication]) -> None:
        """Put messages on their way; raises `ContractError` for one that breaks its channel's contract."""
        for publication in publications:
            channel, message = publication.channel, publication.message
            data = encode(channel, message) if isinstance(message, Message) else encode_text(channel, message)
            self._in_flight.append(_InFlight(channel, self._key(channel, publication.ids), data))

    def deliver(self, at: Moment) -> int:
        """Deliver what is on its way, and all that is published in return, until nothing is; return how much it was.

        Every message is handled at `at`. What a subscriber refuses is noted in `refused`; other errors pass through.
        """
        count = 0
        while self._in_flight:
            message = self._in_flight.popleft()
            ids = self._ids(message.channel, message.key)
            for subscription in self._subscriptions:
                if subscription.channel is message.channel and _matches(subscription.only, ids):
                    self._hand(message, ids, subscription.handler, at)
            count += 1
        return count

    def query(self, channel: Channel, request: Message | None, kind: type[M], at: Moment, **ids: str) -> M | None:
        """Ask a queryable; return its answer, or None when nobody serves it.

        Raises `ContractError` when request or answer break the channel's contract.
        """
        asked = self._ids(channel, self._key(channel, ids))
        for service in self._services:
            if service.channel is channel and _matches(service.only, asked):
                taken = None if request is None else roundtrip(channel, request)
                reply = service.query_handler(asked, taken, at)
                if not isinstance(reply, kind):
                    raise ContractError(channel.name, f"was answered by {type(reply).__name__}, not {kind.__name__}")
                return roundtrip(channel, reply, reply=channel.kind == "query")
        return None

    def _hand(self, message: _InFlight, ids: dict[str, str], handler: Handler, at: Moment) -> None:
        # Decoded anew for each: nobody can change what another one gets.
        content = _decoded(message.channel, message.data)
        try:
            publications: Sequence[Publication] = handler(ids, content, at)
        except RefusedMessageError as error:
            self.refused.append(f"{message.key}: {error}")
        else:
            self.publish(publications)

    def _key(self, channel: Channel, ids: Ids) -> str:
        return channel.key(**ids, **({"site": self._site} if "site" in channel.fields else {}))

    def _ids(self, channel: Channel, key: str) -> dict[str, str]:
        ids = channel.match(key)
        assert ids is not None
        ids.pop("site", None)
        return ids


def roundtrip(channel: Channel, message: M, *, reply: bool = False) -> M:
    """Return a message as its receiver gets it: encoded and decoded, with every limit enforced."""
    return decode(channel, encode(channel, message, reply=reply), type(message), reply=reply)


def _decoded(channel: Channel, data: bytes) -> Any:  # noqa: ANN401  # of the channel's type, which a table of channels can't say
    """Return what a channel's bytes hold, a message or text; raises `ContractError`."""
    return decode_text(channel, data) if channel.message is None else decode(channel, data, channel.message)


def _fitting(channel: Channel, ids: Ids | None) -> Ids:
    """Return the ids that the channel has a place for."""
    return {name: value for name, value in (ids or {}).items() if name in channel.fields}


def _matches(only: Ids, ids: Ids) -> bool:
    return all(ids[name] == value for name, value in only.items())
