"""N readings in a row that say the same settle a state (Mendes 2022, section 3.4, with N = 5)."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fog_contracts.messages import AreaState, Debounce


class Consecutive:
    """Counts verdicts in a row; one that differs starts the count again.

    A row of implausible readings settles `unknown` after as many as settle `blocked`.
    """

    def __init__(self, limits: Debounce) -> None:
        self._needed = {"blocked": limits.to_blocked, "unknown": limits.to_blocked, "clear": limits.to_clear}
        self._last: AreaState | None = None
        self._count = 0

    def feed(self, verdict: AreaState) -> AreaState | None:
        """Take the verdict of one reading; return it once it is the N-th in a row."""
        self._count = self._count + 1 if verdict == self._last else 1
        self._last = verdict
        return verdict if self._count >= self._needed[verdict] else None

    def reset(self) -> None:
        """Forget the row."""
        self._last = None
        self._count = 0


def make(limits: Debounce) -> Consecutive:
    """Return a fresh rule for one node."""
    return Consecutive(limits)
