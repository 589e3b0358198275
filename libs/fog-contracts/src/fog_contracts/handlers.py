"""The interface of a pure core: handlers by channel with one signature, and the messages that they return to publish.

A core has a table of handlers for messages (`handlers`), one for queries (`query_handlers`), and one `tick`. Services
subscribe to and serve every channel of the tables and publish what the handlers return, lockstep delivers the messages
from core to core, and a replay feeds in recorded ones. None of them names a handler, so all three run the same
decisions.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import wraps
from typing import Any, Final, Generic, Protocol, TypeVar, runtime_checkable

import msgspec

from fog_contracts.channels import Channel
from fog_contracts.messages import Message, Sent

M = TypeVar("M", bound=Message)

Ids = Mapping[str, str]
"""The variable parts of a topic or key by name, without the site: for example `{"robot": "r1"}`."""


class Moment(msgspec.Struct, frozen=True):
    """When an input is handled: `now` in seconds of the receiver's monotonic clock, `stamp` in seconds since the epoch.

    Ages and timeouts are computed from `now` alone; `stamp` is for traces and people. `synchronized` says whether the
    clock that `stamp` is of can be believed, and `clock` identifies the one that `now` is of
    (`fog_runtime.clock.Clock.id`).
    """

    now: float
    stamp: float
    synchronized: bool = True
    clock: int = 0

    @property
    def sent(self) -> Sent:
        """What a message that is sent now tells its receivers, so that they notice how late it comes."""
        return self.clock, self.now


@dataclass(frozen=True, slots=True)
class Publication:
    """A message to be published on its channel, under these ids; None deletes the retained one (MQTT)."""

    channel: Channel
    message: Message | str | None
    ids: Ids = field(default_factory=dict)


class RefusedMessageError(ValueError):
    """A handler can't use a message although it is well-formed; the text says why.

    The edge that delivered the message counts and logs it like one that violates its channel's contract.
    """


Handler = Callable[[Ids, Any, Moment], Sequence[Publication]]
"""Handles one message of a channel; its second argument is the channel's message type (text for a text channel)."""


class Later(Generic[M]):
    """An answer that takes long to make. It owns its inputs, so that one other thread may make it, for all who ask."""

    def __init__(self, make: Callable[[], M]) -> None:
        self._make: Callable[[], M] | None = make
        self._made: M | None = None

    @property
    def made(self) -> M | None:
        """The answer, if it was made."""
        return self._made

    def make(self) -> M:
        """Return the answer, and make it first if that was not done yet."""
        if self._made is None:
            assert self._make is not None
            self._made = self._make()
            self._make = None  # it may hold large inputs
        return self._made


def completed(answer: Message | Later[Message]) -> Message:
    """Return a query's answer, made here and now if it is for later."""
    return answer.make() if isinstance(answer, Later) else answer


QueryHandler = Callable[[Ids, Any, Moment], Message | Later[Any]]
"""Answers one query; its second argument is the channel's request type, or None for a query without one."""


@runtime_checkable
class Core(Protocol):
    """The decisions of a process, without I/O and without a clock."""

    def handlers(self) -> Mapping[Channel, Handler]:
        """Return the handler of every channel that this core subscribes to."""

    def query_handlers(self) -> Mapping[Channel, QueryHandler]:
        """Return the handler of every channel whose queries this core answers."""

    def tick(self, at: Moment) -> Sequence[Publication]:
        """Advance to `at`, at least ten times a second; return what is to be published now."""


HEARD_LIMIT: Final = 2**52
"""No clock (ms) gives an epoch as high as this one: above it, epochs rise in steps of at most `MOST_AHEAD`."""
MOST_AHEAD: Final = 2**20
"""How far one message may raise the highest known epoch above `HEARD_LIMIT`. So many leaders don't follow one another
unheard, and it takes billions of forged messages to leave no room for a leader above them."""


def within_reach(epoch: int, known: int) -> int:
    """Return how far an epoch that is heard of may raise the highest known one: it may be forged.

    Receivers and leaders limit what they hear alike. So a leader can always get an epoch that its receivers accept,
    and one whose own epoch lies above `HEARD_LIMIT` still gives way to a higher one.
    """
    return min(epoch, max(known, HEARD_LIMIT) + MOST_AHEAD)


class Fence:
    """The highest epoch received of each service, by its role.

    A service has one leader at a time, whose epoch is larger than that of every leader before it
    (`fog_runtime.lease`). A leader that was replaced without knowing it, because it was stopped or cut off,
    still sends its own epoch.
    """

    def __init__(self) -> None:
        self._highest: dict[str, int] = {}

    @property
    def epochs(self) -> dict[str, int]:
        """The highest epoch received of each service."""
        return dict(self._highest)

    def raise_to(self, service: str, epoch: int) -> None:
        """Refuse messages of the service below an epoch that came another way, as far as it is `within_reach`."""
        highest = self._highest.get(service, 0)
        self._highest[service] = max(within_reach(epoch, highest), highest)

    def reaches(self, service: str, epoch: int) -> bool:
        """Return whether the service can have the epoch, by the highest one that is known of it."""
        return epoch <= within_reach(epoch, self._highest.get(service, 0))

    def require_current(self, service: str, epoch: int) -> None:
        """Raise `RefusedMessageError` for an epoch below the highest one of its service, or far above all possible."""
        if not self.reaches(service, epoch):
            raise RefusedMessageError(f"its epoch {epoch} is far above all before: no {service} can have it yet")
        if epoch < (highest := self._highest.get(service, 0)):
            raise RefusedMessageError(f"its epoch {epoch} is below {highest}: another {service} has taken over")

    def accept(self, service: str, epoch: int) -> None:
        """Raise the highest epoch of the service to that of a message; raises as `require_current`.

        A refused epoch raises it, too, but only by a step: a receiver that has just started, and has heard of none,
        gets up to a leader that had to follow forged ones.
        """
        try:
            self.require_current(service, epoch)
        finally:
            self.raise_to(service, epoch)

    def guarded(self, handlers: Mapping[Channel, Handler]) -> dict[Channel, Handler]:
        """Return the handlers, refusing messages of lower epochs on the channels that carry one (`Channel.epoch`)."""
        return {
            channel: self._guarded(channel, handler) if channel.epoch else handler
            for channel, handler in handlers.items()
        }

    def _guarded(self, channel: Channel, handler: Handler) -> Handler:
        @wraps(handler)
        def handle(ids: Ids, message: object, at: Moment) -> Sequence[Publication]:
            service, epoch = channel.publishers[0], getattr(message, channel.epoch)
            self.accept(service, epoch)
            return handler(ids, message, at)

        return handle


def epoch_in(channel: Channel, message: object, service: str) -> int:
    """Return the highest epoch of a service that a message shows: its own one, or one that its sender received."""
    own = getattr(message, channel.epoch) if channel.epoch and service in channel.publishers else 0
    seen: Mapping[str, int] = getattr(message, "epochs", {})
    return max(own, seen.get(service, 0))
