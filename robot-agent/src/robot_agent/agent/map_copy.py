"""The robot's copy of the master costmap: whether it is the newest, and when only a snapshot can mend it."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Final

from fog_contracts.replica import Applied, Replica

if TYPE_CHECKING:
    from fog_contracts.messages import MapDelta, MapHeartbeat, MapSnapshot

BEHIND_S: Final = 0.5
"""The copy may be behind the heartbeat for this long; then its delta is taken for lost."""
_HELD_DELTAS: Final = 256


class MapCopy:
    """A replica with what heartbeats tell of it. Times are seconds of the robot's monotonic clock."""

    def __init__(self) -> None:
        self.replica = Replica()
        self._heartbeat: MapHeartbeat | None = None
        self._confirmed_at = -math.inf
        self._gap_since: float | None = None
        self._held: deque[MapDelta] = deque(maxlen=_HELD_DELTAS)
        """Changes that came while a snapshot was needed: the one under way may be older than they are."""

    def on_delta(self, delta: MapDelta, now: float) -> bool:
        """Take one change; return whether the copy changed. It is fresh only if no heartbeat told of a newer one."""
        outcome = self.replica.apply(delta)
        if isinstance(outcome, Applied):
            self._note_freshness(now)
            return True
        if outcome == "gap":
            self._held.append(delta)
            if self._gap_since is None:
                self._gap_since = now
        return False

    def on_heartbeat(self, heartbeat: MapHeartbeat, now: float) -> None:
        """Take which version is the newest."""
        self._heartbeat = heartbeat
        self.replica.check(heartbeat)
        self._note_freshness(now)

    def load(self, snapshot: MapSnapshot, now: float) -> None:
        """Take a snapshot and the changes that came meanwhile; raises `MapError` when it is none.

        Only a heartbeat tells whether it is the newest one, so a map from disk alone is not fresh.
        """
        self.replica.load(snapshot)
        if not self._is_behind():
            self._gap_since = None
        held, self._held = self._held, deque(maxlen=_HELD_DELTAS)
        for delta in held:
            if delta.epoch == snapshot.epoch:
                self.on_delta(delta, now)

    def wants_snapshot(self, now: float) -> bool:
        """Return whether only a snapshot can mend the copy."""
        return self.replica.needs_snapshot or self.gap(now) > BEHIND_S

    def age(self, now: float) -> float:
        """Return how long ago (s) the copy was last known to be the newest version; infinite when it never was."""
        return now - self._confirmed_at

    def gap(self, now: float) -> float:
        """Return for how long (s) changes have been missing that the map-service told of; 0 when none are."""
        return 0.0 if self._gap_since is None else now - self._gap_since

    def _is_behind(self) -> bool:
        """Whether the copy is broken, or another than the newest that a heartbeat told of."""
        newest, version = self._heartbeat, self.replica.version
        if self.replica.needs_snapshot or version is None:
            return True
        return newest is not None and (newest.epoch != version.epoch or newest.seq > version.seq)

    def _note_freshness(self, now: float) -> None:
        if not self._is_behind():
            self._confirmed_at, self._gap_since = now, None
        elif self._gap_since is None:
            self._gap_since = now
