"""Value types with their bounds and units, and what messages of every family contain.

Stamps are seconds since the Unix epoch by the sender's clock (`fog_runtime.clock.Clock.stamp`); they serve traces and
people. Freshness is never computed from them but from the receiver's own monotonic clock.
"""

from collections.abc import Iterable
from enum import StrEnum
from typing import Annotated, Final, Literal, Self

from msgspec import Meta, Struct

# The lookahead refuses a line feed at the end, which a bare $ accepts.
Id = Annotated[str, Meta(pattern=r"^[a-z0-9][a-z0-9-]{0,31}$(?!\n)")]
# Bounds also refuse NaN and infinity: no comparison with a bound holds for NaN.
Finite = Annotated[float, Meta(ge=-1e12, le=1e12)]
# The units appear in the generated documents and in the firmware's header.
Metres = Annotated[float, Meta(ge=-100_000.0, le=100_000.0, extra={"unit": "m"})]
Radians = Annotated[float, Meta(ge=-1_000.0, le=1_000.0, extra={"unit": "rad"})]
Speed = Annotated[float, Meta(ge=-10.0, le=10.0, extra={"unit": "m/s"})]
AngularSpeed = Annotated[float, Meta(ge=-10.0, le=10.0, extra={"unit": "rad/s"})]
Stamp = Annotated[float, Meta(ge=0.0, le=1e12, extra={"unit": "s"})]
Seconds = Annotated[float, Meta(ge=0.0, le=1e12, extra={"unit": "s"})]
"""A reading of a monotonic clock, which means nothing to another host."""
TimeToLive = Annotated[float, Meta(gt=0.0, le=1e9, extra={"unit": "s"})]
Boot = Annotated[str, Meta(max_length=32)]
"""Id of one run of a process: random, so that no other run has it."""
Count = Annotated[int, Meta(ge=0, le=2**53)]
Sent = tuple[Count, Seconds]
"""When a message was sent: the id of a monotonic clock of its sender, and that clock's reading. How late messages come
is computed from it (`fog_contracts.liveness.Delays`)."""
Hash = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Cells = Annotated[int, Meta(ge=0, le=65_535, extra={"unit": "cells"})]
SENTENCE_MAX: Final = 500
"""Characters of the longest sentence."""
Sentence = Annotated[str, Meta(max_length=SENTENCE_MAX)]
Code = Annotated[str, Meta(max_length=32)]
"""An identifier for programs, beside a sentence for people."""
Codes = list[Code]
PointXY = tuple[Metres, Metres]
Ring = Annotated[list[PointXY], Meta(min_length=3, max_length=500)]

AreaState = Literal["blocked", "clear", "unknown"]
SonarStatus = Literal["ok", "no_echo", "stuck"]
CalibrationResult = Literal["done", "stuck", "unsteady", "too_near"]


class Message(Struct, frozen=True, kw_only=True):
    """Base of all messages: frozen, fields by name; unknown fields are ignored when decoding."""


class Described(StrEnum):
    """Base of identifiers, each with what it says, for the documents that are made of them."""

    says: str

    def __new__(cls, code: str, says: str) -> Self:
        """Return an identifier with what it says."""
        member = str.__new__(cls, code)
        member._value_, member.says = code, says
        return member


class Reason(str):
    """A sentence for people with its identifier for programs, and those of its causes.

    Codecs know only the sentence: send the others beside it.
    """

    __slots__ = ("causes", "code")
    code: str
    causes: tuple[str, ...]

    def __new__(cls, code: str, sentence: str, causes: Iterable[str] = ()) -> Self:
        """Return a sentence with its identifier, and those of its causes."""
        reason = super().__new__(cls, sentence)
        reason.code, reason.causes = code, tuple(causes)
        return reason

    def __reduce__(self) -> tuple[type[Self], tuple[str, str, tuple[str, ...]]]:
        """Return what a copy is made from."""
        return type(self), (self.code, str(self), self.causes)


class Pose(Message, frozen=True, kw_only=True):
    """Position and heading in the frame `map`."""

    x: Metres
    y: Metres
    theta: Radians


Epochs = dict[Id, Count]
"""The highest epoch received of each service, by its role: whoever leads it next needs a higher one."""


class Leader(Message, frozen=True, kw_only=True):
    """The announcement of the one process of a service that acts; `holder` identifies it.

    `answered`: when the newest heartbeat of the map was sent that it has handled, by which its copies judge how late
    it is (planners only).
    """

    epoch: Count
    holder: Annotated[str, Meta(min_length=1, max_length=100)]
    epochs: Epochs = {}
    answered: Sent | None = None


Author = Annotated[str, Meta(max_length=100)]
"""The name of the token with which a change was made."""


class Trace(Message, frozen=True, kw_only=True):
    """Stamps of the stages that one hazard passes, from first reading to first wheel command; 0 = not reached yet."""

    area: Id
    epoch: Count
    seq: Count
    first_reading: Stamp = 0.0
    confirmed: Stamp = 0.0
    costmap_published: Stamp = 0.0
    plan_published: Stamp = 0.0
    path_received: Stamp = 0.0
    first_command: Stamp = 0.0
