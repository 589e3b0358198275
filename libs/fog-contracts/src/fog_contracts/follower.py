"""Following the master costmap: a replica kept up to date from deltas, heartbeats and snapshots, despite message loss.

Pure: messages and times go in; applied changes, the need for a snapshot, and the copy's age and gap come out. Times are
in seconds of the reader's monotonic clock.
"""

import math
from collections.abc import Sequence
from typing import Final

from fog_contracts.liveness import Delays
from fog_contracts.messages import MapDelta, MapHeartbeat, MapSnapshot
from fog_contracts.replica import Applied, DecodedMap, MapError, Replica, Version

GRACE_S: Final = 0.5
"""How long an announced delta may be in transit before it is considered lost (5 heartbeats)."""
MAX_HELD: Final = 256


class MapFollower:
    """Keeps a replica at the newest known version of the map.

    The newest version is the highest that a heartbeat, a delta or a snapshot announced: higher epoch first, then higher
    seq. It never goes back: a writer with a lower epoch was replaced (`fog_contracts.handlers`).

    A map-service that takes over has another epoch, and usually the same map: as its hash proves that, the copy goes on
    under its new name, without a snapshot.

    Deltas that can't be applied yet are held, the latest `max_held` of them, and applied as soon as the missing ones
    or a snapshot arrive.
    """

    def __init__(self, *, grace_s: float = GRACE_S, max_held: int = MAX_HELD) -> None:
        self._grace_s = grace_s
        self._max_held = max_held
        self._replica = Replica()
        self._held: dict[tuple[int, int, int], MapDelta] = {}
        """Deltas by epoch, seq and part, oldest arrival first."""
        self._newest: Version | None = None
        self._behind_since: float | None = None
        self._confirmed_at = -math.inf
        self._delays = Delays()
        self.delay_s = 0.0
        """How much longer (s) the latest heartbeat took than the fastest one: so long ago it was true what it says."""

    # --- Messages in ------------------------------------------------------------------------------------------------

    def on_delta(self, delta: MapDelta, now: float) -> Applied | None:
        """Apply a delta and all held deltas that it completes; return what changed, or None if nothing did."""
        announced = Version(delta.epoch, delta.seq, delta.hash)
        if self._newest is None or _order(announced) > _order(self._newest):
            self._newest = announced
        self._hold(delta, self._newest)
        applied = _merged(self._apply_held())
        self._update_freshness(now, confirmed=applied is not None)
        return applied

    def on_heartbeat(self, heartbeat: MapHeartbeat, now: float) -> None:
        """Record which version the writer has, or had when it sent this."""
        self.delay_s = self._delays.update(heartbeat.sent, now)
        announced = Version(heartbeat.epoch, heartbeat.seq, heartbeat.hash)
        if self._newest is None or _order(announced) >= _order(self._newest):
            self._newest = announced
            self._continue_with(announced)
        self._update_freshness(now, confirmed=announced == self._newest)

    def on_snapshot(self, snapshot: MapSnapshot | DecodedMap, now: float) -> Applied:
        """Load a snapshot, decoded or not, and apply the deltas held since it was requested; return all that changed.

        It does not make the copy fresh, because it may come from a disk: the next heartbeat does. Raises `MapError` and
        changes nothing when it is damaged, older than the copy, or from a writer that was replaced.
        """
        announced = snapshot.version if isinstance(snapshot, DecodedMap) else _version_of(snapshot)
        self._check_not_outdated(announced)
        loaded = self._replica.load(snapshot)
        if self._newest is None or _order(loaded.version) > _order(self._newest):
            self._newest = loaded.version
        self._held = {key: delta for key, delta in self._held.items() if delta.epoch == announced.epoch}
        applied = _merged([loaded, *self._apply_held()])
        assert applied is not None
        self._update_freshness(now, confirmed=False)
        return applied

    # --- State out --------------------------------------------------------------------------------------------------

    @property
    def up_to_date(self) -> bool:
        """Whether the copy is intact and no newer version is known."""
        intact = self._replica.version is not None and not self._replica.needs_snapshot
        return intact and self._newest in (None, self._replica.version)

    def wants_snapshot(self, now: float) -> bool:
        """Whether a snapshot is needed: no copy yet, an invalid one, one of another history, or a lost delta."""
        version, newest = self._replica.version, self._newest
        if version is None or self._replica.needs_snapshot:
            return True
        if newest is None or newest == version:
            return False
        if newest.epoch != version.epoch or newest.seq <= version.seq:
            return True
        if any(epoch == version.epoch and seq > version.seq + 1 for epoch, seq, _ in self._held):
            return True  # deltas are delivered in order: an earlier one was lost
        return self.gap(now) > self._grace_s

    def age(self, now: float) -> float:
        """Return the seconds since a message was sent that confirmed the copy as the newest version; inf before one."""
        return max(0.0, now - self._confirmed_at)

    def gap(self, now: float) -> float:
        """Return for how long (s) a version newer than the copy's has been known; 0 when the copy is the newest."""
        return 0.0 if self._behind_since is None else max(0.0, now - self._behind_since)

    @property
    def replica(self) -> Replica:
        """The copy, for reading: exactly one version, even while it is behind or waits for a snapshot."""
        return self._replica

    @property
    def version(self) -> Version | None:
        """The copy's version; None before the first snapshot."""
        return self._replica.version

    # --- Internals --------------------------------------------------------------------------------------------------

    def _continue_with(self, newest: Version) -> None:
        """Follow another writer's history with the copy as it is, if that one's newest version is the same map."""
        version = self._replica.version
        if version is None or self._replica.needs_snapshot or newest.epoch <= version.epoch:
            return
        if newest.hash == version.hash:
            self._replica.rename(newest)
            self._held = {key: delta for key, delta in self._held.items() if key[:2] > _order(newest)}

    def _hold(self, delta: MapDelta, newest: Version) -> None:
        version = self._replica.version
        if version is not None and delta.epoch == version.epoch and not self._replica.needs_snapshot:
            if delta.seq <= version.seq:
                return
        elif delta.epoch != newest.epoch:
            return  # a late message from a writer that was replaced
        self._held[delta.epoch, delta.seq, delta.part] = delta
        if len(self._held) > self._max_held:
            del self._held[next(iter(self._held))]

    def _apply_held(self) -> list[Applied]:
        """Apply the held deltas that follow the copy's version without a gap."""
        changes: list[Applied] = []
        while (version := self._replica.version) is not None and not self._replica.needs_snapshot:
            next_parts = [key for key in self._held if key[:2] == (version.epoch, version.seq + 1)]
            if not next_parts:
                break
            outcomes = [self._replica.apply(self._held.pop(key)) for key in next_parts]
            changes += [outcome for outcome in outcomes if isinstance(outcome, Applied)]
        if version is not None and not self._replica.needs_snapshot:
            applied_up_to = _order(version)
            self._held = {key: delta for key, delta in self._held.items() if key[:2] > applied_up_to}
        return changes

    def _check_not_outdated(self, snapshot: Version) -> None:
        version, newest = self._replica.version, self._newest
        if newest is None:
            return
        if snapshot.epoch < newest.epoch:
            raise MapError(f"the snapshot has epoch {snapshot.epoch}, but the map-service is at epoch {newest.epoch}")
        if version is not None and snapshot.epoch == version.epoch and snapshot.seq < version.seq:
            raise MapError(f"the snapshot has version {snapshot.seq}, older than the copy's {version.seq}")

    def _update_freshness(self, now: float, *, confirmed: bool) -> None:
        if self.up_to_date:
            self._behind_since = None
            if confirmed:
                # A delta came the same way as the heartbeats.
                self._confirmed_at = max(self._confirmed_at, now - self.delay_s)
        elif self._behind_since is None:
            self._behind_since = now


def _version_of(snapshot: MapSnapshot) -> Version:
    return Version(snapshot.epoch, snapshot.seq, snapshot.hash)


def _order(version: Version) -> tuple[int, int]:
    return version.epoch, version.seq


def _merged(changes: Sequence[Applied]) -> Applied | None:
    """Merge consecutive changes into one; None when there are none."""
    if len(changes) < 2:
        return changes[0] if changes else None
    deltas_only = all(len(change.previous) == len(change.windows) for change in changes)
    return Applied(
        changes[-1].version,
        [window for change in changes for window in change.windows],
        [cause for change in changes for cause in change.causes],
        [trace for change in changes for trace in change.traces],
        [cells for change in changes for cells in change.previous] if deltas_only else [],
    )
