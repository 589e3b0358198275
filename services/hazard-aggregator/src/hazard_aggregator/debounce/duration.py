"""By time: readings that agree for long enough, without a break, confirm their state."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from msgspec import Meta, Struct

from hazard_aggregator.debounce import RuleFactory

if TYPE_CHECKING:
    from fog_contracts.messages import AreaState
    from hazard_aggregator.debounce import Observation


class Options(Struct, frozen=True, kw_only=True):
    """For how long (s) readings must agree: it is set fast, and cleared slowly. One reading alone confirms nothing."""

    blocked_s: Annotated[float, Meta(gt=0.0, le=3600.0)] = 0.3
    clear_s: Annotated[float, Meta(gt=0.0, le=3600.0)] = 1.0


class Duration:
    """Remembers since when readings have agreed, by the times at which they were taken.

    Unknown readings confirm `unknown` after as long as `blocked`.
    """

    def __init__(self, options: Options) -> None:
        self._needed = {"blocked": options.blocked_s, "unknown": options.blocked_s, "clear": options.clear_s}
        self._state: AreaState | None = None
        self._since = 0.0

    def update(self, seen: Observation, now: float) -> AreaState | None:
        """Add one reading; return its state if readings have shown it for long enough."""
        if seen.state != self._state:
            self._state, self._since = seen.state, now
        return seen.state if now - self._since >= self._needed[seen.state] else None

    def reset(self) -> None:
        """Forget all readings."""
        self._state = None


RULE = RuleFactory(options=Options, make=Duration)
