"""N consecutive readings of the same state confirm it (Mendes 2022, section 3.4, with N = 5)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from msgspec import Meta, Struct

from hazard_aggregator.debounce import RuleFactory

if TYPE_CHECKING:
    from fog_contracts.messages import AreaState
    from hazard_aggregator.debounce import Observation


class Options(Struct, frozen=True, kw_only=True):
    """How many readings change a node's state (the thesis: five consecutive ones either way)."""

    to_blocked: Annotated[int, Meta(ge=1, le=1000)] = 5
    to_clear: Annotated[int, Meta(ge=1, le=1000)] = 5


class Consecutive:
    """Counts consecutive readings of the same state; a reading of the opposite state restarts the count.

    An unknown reading says nothing about the area: it leaves a count of blocked readings as it is, and takes one off a
    count of clear ones, since a relief needs more evidence for it than missing. As many unknown readings in a row as
    confirm `blocked` confirm `unknown`, and restart both counts.
    """

    def __init__(self, options: Options) -> None:
        self._needed = {"blocked": options.to_blocked, "unknown": options.to_blocked, "clear": options.to_clear}
        self._count = dict.fromkeys(self._needed, 0)

    def update(self, seen: Observation, now: float) -> AreaState | None:  # noqa: ARG002  # it counts, whatever the time
        """Count one reading's state; return the state from its N-th reading on."""
        count, state = self._count, seen.state
        if state == "unknown":
            count["clear"] = max(0, count["clear"] - 1)
        else:
            count["unknown"] = count["clear" if state == "blocked" else "blocked"] = 0
        count[state] = min(count[state] + 1, self._needed[state])
        if count[state] < self._needed[state]:
            return None
        if state == "unknown":
            count["blocked"] = count["clear"] = 0
        return state

    def reset(self) -> None:
        """Restart all counts."""
        self._count = dict.fromkeys(self._needed, 0)


RULE = RuleFactory(options=Options, make=Consecutive)
