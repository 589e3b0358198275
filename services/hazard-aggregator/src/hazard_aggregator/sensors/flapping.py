"""Notices a node or source that changes its confirmed state too often to be believed. Pure."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from fog_contracts.messages import AreaState

WINDOW_S: Final = 60.0
STEADY_S: Final = 5.0
"""So long (s) one state must last before a flapping node is believed again."""


class FlapDetector:
    """Counts the changes of state within a minute; nodes tell only those between blocked and clear."""

    def __init__(self, max_changes: int) -> None:
        self.max_changes = max_changes
        self.flapping = False
        self._changes: deque[float] = deque()
        self._state: AreaState | None = None
        self._since = 0.0

    def update(self, confirmed: AreaState, now: float) -> bool:
        """Take a confirmed state at `now` (s); return whether the node flaps."""
        if self.flapping and now - self._since >= STEADY_S:
            self.flapping = False
            self._changes.clear()
        if confirmed != self._state:
            if self._state is not None:
                self._changes.append(now)
            self._state, self._since = confirmed, now
        while self._changes and now - self._changes[0] > WINDOW_S:
            self._changes.popleft()
        if len(self._changes) > self.max_changes:
            self.flapping = True
        return self.flapping
