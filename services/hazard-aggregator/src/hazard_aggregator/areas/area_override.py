"""The records of an operator's override of an area: its word, and the time that is left of it (`overrides`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from fog_contracts.messages import (
    Author,
    Count,
    Finite,
    Id,
    Message,
    OverrideReason,
    OverrideState,
    Seconds,
    Stamp,
    TimeToLive,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

LONGEST_S: Final[Mapping[OverrideState, float]] = {"blocked": 30 * 86_400.0, "clear": 900.0}
"""How long (s) an override may last: one that declares an area clear counts against what nodes measure."""


class AreaOverride(Message, frozen=True, kw_only=True):
    """An operator's word on an area, as it is stored: it holds until `deadline` (s) of the clock of the boot `boot`."""

    area: Id
    state: OverrideState
    author: Author
    reason: OverrideReason
    ttl_s: TimeToLive
    set_at: Stamp
    boot: str
    deadline: Finite
    version: Count


class Rest(Message, frozen=True, kw_only=True):
    """The time (s) that was left of this version of an override when it was last stored.

    `deadline` (s) is the same as a time of the clock of the boot `boot`, so that a restart within it prolongs nothing.
    """

    version: Count
    rest_s: Seconds
    boot: str = ""
    deadline: Finite = 0.0
