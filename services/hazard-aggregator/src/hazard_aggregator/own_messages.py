"""Recognizes the aggregator's own messages when the broker returns them: everything else on its topics is foreign."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from fog_contracts.messages import AggregatorHeartbeat, AreaHazard

_HAZARDS: Final = 64
"""Hazards remembered per area: more than one area changes while a message is under way."""
_HEARTBEATS: Final = 3000
"""Heartbeats remembered: those of ten minutes."""


class OwnMessages:
    """The latest hazards and heartbeats that were published."""

    def __init__(self) -> None:
        self._hazards: dict[str, deque[tuple[int, int, str, int]]] = {}
        self._heartbeats: deque[tuple[int, float]] = deque(maxlen=_HEARTBEATS)

    def add(self, hazard: AreaHazard) -> None:
        """Remember a hazard that is published now."""
        if not self.contains(hazard):
            self._hazards.setdefault(hazard.area, deque(maxlen=_HAZARDS)).append(_content(hazard))

    def contains(self, hazard: AreaHazard) -> bool:
        """Whether this hazard was published here."""
        return _content(hazard) in self._hazards.get(hazard.area, ())

    def add_heartbeat(self, heartbeat: AggregatorHeartbeat) -> None:
        """Remember a heartbeat that is published now."""
        self._heartbeats.append((heartbeat.epoch, heartbeat.uptime))

    def contains_heartbeat(self, heartbeat: AggregatorHeartbeat) -> bool:
        """Whether this heartbeat was published here."""
        # The newest one is the most likely.
        return (heartbeat.epoch, heartbeat.uptime) in reversed(self._heartbeats)


def _content(hazard: AreaHazard) -> tuple[int, int, str, int]:
    return hazard.epoch, hazard.seq, hazard.state, hazard.penalty
