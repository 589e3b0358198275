"""The interface of a pure core: handlers by channel with one signature, and the messages that they return to publish.

A core has a table of handlers for messages (`handlers`), one for queries (`query_handlers`), and one `tick`. Services
subscribe to and serve every channel of the tables and publish what the handlers return, lockstep delivers the messages
from core to core, and a replay feeds in recorded ones. None of them names a handler, so all three run the same
decisions.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

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
