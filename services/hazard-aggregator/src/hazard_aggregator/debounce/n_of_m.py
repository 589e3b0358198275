"""N of the latest M readings confirm their state: single wrong readings in between restart nothing."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Annotated

from msgspec import Meta, Struct

from hazard_aggregator.debounce import RuleFactory

if TYPE_CHECKING:
    from fog_contracts.messages import AreaState
    from hazard_aggregator.debounce import Observation


class Options(Struct, frozen=True, kw_only=True):
    """How many of the latest `window` readings confirm each state; of clear it takes more than of blocked."""

    window: Annotated[int, Meta(ge=1, le=1000)] = 7
    to_blocked: Annotated[int, Meta(ge=1, le=1000)] = 4
    to_clear: Annotated[int, Meta(ge=1, le=1000)] = 6

    def __post_init__(self) -> None:
        if max(self.to_blocked, self.to_clear) > self.window:
            raise ValueError(f"to_blocked and to_clear can't exceed the window of {self.window} readings")
        if self.to_blocked + self.to_clear <= self.window:
            raise ValueError(f"to_blocked and to_clear must exceed the window of {self.window} readings together")


class NOfM:
    """Keeps the latest readings; unknown ones take part, and as many as confirm `blocked` confirm `unknown`."""

    def __init__(self, options: Options) -> None:
        self._needed = {"blocked": options.to_blocked, "unknown": options.to_blocked, "clear": options.to_clear}
        self._latest: deque[AreaState] = deque(maxlen=options.window)

    def update(self, seen: Observation, now: float) -> AreaState | None:  # noqa: ARG002  # it counts, whatever the time
        """Add one reading; return its state if enough of the latest ones show it."""
        self._latest.append(seen.state)
        return seen.state if self._latest.count(seen.state) >= self._needed[seen.state] else None

    def reset(self) -> None:
        """Forget all readings."""
        self._latest.clear()


RULE = RuleFactory(options=Options, make=NOfM)
