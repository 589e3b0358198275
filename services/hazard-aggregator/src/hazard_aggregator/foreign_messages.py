"""Messages of other senders on the aggregator's topics: what they are about, and their highest epoch. Pure."""

from __future__ import annotations

from typing import Final, Literal, NamedTuple

from fog_contracts.fencing import within_reach

_MAX_FOREIGN: Final = 100
"""Messages of others between two calls of `pop`; further ones are not counted."""

ForeignKind = Literal["area", "hazard", "heartbeat"]


class ForeignMessage(NamedTuple):
    """A message of another sender on our topics: about an area that we don't list, or above our epoch."""

    kind: ForeignKind
    epoch: int
    area: str


class ForeignMessages:
    """Collects them; `epoch` is the highest one of another sender that receivers follow, 0 before the first."""

    def __init__(self) -> None:
        self.epoch = 0
        self._found: list[ForeignMessage] = []

    def add(self, kind: ForeignKind, epoch: int, area: str) -> None:
        """Record a message that another sender published."""
        self.epoch = max(self.epoch, within_reach(epoch, self.epoch))
        if len(self._found) < _MAX_FOREIGN:
            self._found.append(ForeignMessage(kind, epoch, area))

    def pop(self) -> list[ForeignMessage]:
        """Return the messages since the last call."""
        found, self._found = self._found, []
        return found
