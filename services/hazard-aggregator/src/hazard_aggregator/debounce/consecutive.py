"""N consecutive readings of the same state confirm it (Mendes 2022, section 3.4, with N = 5)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from msgspec import Meta, Struct

from hazard_aggregator.debounce import RuleFactory

if TYPE_CHECKING:
    from fog_contracts.messages import AreaState


class Options(Struct, frozen=True, kw_only=True):
    """How many consecutive readings change a node's state (the thesis: five either way)."""

    to_blocked: Annotated[int, Meta(ge=1, le=1000)] = 5
    to_clear: Annotated[int, Meta(ge=1, le=1000)] = 5


class Consecutive:
    """Counts consecutive readings of the same state; a reading of another state restarts the count.

    Implausible readings confirm `unknown` after as many as confirm `blocked`.
    """

    def __init__(self, options: Options) -> None:
        self._needed = {"blocked": options.to_blocked, "unknown": options.to_blocked, "clear": options.to_clear}
        self._last: AreaState | None = None
        self._count = 0

    def update(self, state: AreaState, now: float) -> AreaState | None:  # noqa: ARG002  # it counts, whatever the time
        """Count one reading's state; return the state from its N-th consecutive reading on."""
        self._count = self._count + 1 if state == self._last else 1
        self._last = state
        return state if self._count >= self._needed[state] else None

    def reset(self) -> None:
        """Restart the count."""
        self._last = None
        self._count = 0


RULE = RuleFactory(options=Options, make=Consecutive)
