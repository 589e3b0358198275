"""Which aggregator the map believes, whether it lives, and which hazards it confirms. Pure; time is an argument.

A hazard says what its area was when it was sent. That it still holds is said by the heartbeats of the aggregator that
sent it, which list the `seq` of every area. No relief counts before a heartbeat confirms it, and none for longer than
the heartbeat lives; dangers need no confirmation. What the heartbeat lists and the map lacks was lost on the way.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from fog_contracts import channels as ch
from fog_contracts.handlers import RefusedMessageError, within_reach
from fog_contracts.liveness import HeartbeatWatch
from fog_contracts.messages import hazards_digest

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from fog_contracts.messages import AggregatorHeartbeat, AreaHazard

TRUSTED_AFTER_S: Final = 0.5
"""How long heartbeats of a new epoch must keep arriving until the map believes their sender."""
IN_FLIGHT_S: Final = 2 * ch.AGGREGATOR_HEARTBEAT.period_s
"""How long a listed hazard may be missing: its message may be under way still when the heartbeat has arrived."""
REQUEST_PERIOD_S: Final = 1.0
"""Seconds between two requests to publish everything again."""


class _Sender:
    """One run of an aggregator, by its epoch."""

    def __init__(self, heartbeat: AggregatorHeartbeat) -> None:
        self.heartbeat = heartbeat
        self.watch = HeartbeatWatch(ch.AGGREGATOR_HEARTBEAT.max_age_s, trusted_after_s=TRUSTED_AFTER_S)


class AggregatorMonitor:
    """Judges heartbeats and hazards; of several aggregators only the one with the highest epoch is believed."""

    def __init__(self) -> None:
        self._believed: _Sender | None = None
        self._reach = 0  # the highest epoch that an aggregator can have, as far as epochs were heard
        self._newest: _Sender | None = None  # the believed one, or one with a higher epoch that is not trusted yet
        self._missing: dict[str, float] = {}  # since when the map lacks what the heartbeat lists, by area
        self._compared_at = math.inf
        self._digest_differs = False
        self._asked_at = -REQUEST_PERIOD_S

    # --- Inputs -----------------------------------------------------------------------------------------------------

    def on_heartbeat(
        self,
        heartbeat: AggregatorHeartbeat,
        received: Mapping[str, AreaHazard],
        defined: Collection[str],
        now: float,
    ) -> None:
        """Handle a heartbeat, given the newest hazard received of each area, and the areas whose definition is known.

        Raises `RefusedMessageError` for an aggregator that another one has replaced, and for an epoch that none can
        have yet: it is forged, and would fence off all others.
        """
        self._reach = max(self._reach, within_reach(heartbeat.epoch, self._reach))
        if heartbeat.epoch > self._reach:
            raise RefusedMessageError(f"its epoch {heartbeat.epoch} is far above all before: no aggregator can have it")
        newest = self._newest
        if newest is None or heartbeat.epoch > newest.heartbeat.epoch:
            newest = self._newest = _Sender(heartbeat)
        elif heartbeat.epoch < newest.heartbeat.epoch:
            raise RefusedMessageError(
                f"the aggregator with epoch {heartbeat.epoch} was replaced by the one with {newest.heartbeat.epoch}"
            )
        newest.heartbeat = heartbeat
        newest.watch.on_heartbeat(heartbeat.uptime, now)
        if newest.watch.alive(now):
            self._believed = newest
        if self._believed is newest:
            self._compare(heartbeat, received, defined, now)

    def on_hazard(self, hazard: AreaHazard) -> None:
        """Handle the newest hazard of an area."""
        if self._listed(hazard) and not self._digest_differs:
            self._missing.pop(hazard.area, None)

    # --- State ------------------------------------------------------------------------------------------------------

    @property
    def epoch(self) -> int | None:
        """The epoch of the aggregator that the map believes."""
        return None if self._believed is None else self._believed.heartbeat.epoch

    def alive(self, now: float) -> bool:
        """Whether an aggregator lives."""
        return self._believed is not None and self._believed.watch.alive(now)

    def age(self, now: float) -> float:
        """Return the time (s) since the newest aggregator's latest heartbeat was sent; infinite before the first."""
        return float("inf") if self._newest is None else self._newest.watch.age(now)

    @property
    def delay_s(self) -> float:
        """How much longer (s) the newest aggregator's latest heartbeat took than its fastest one."""
        return 0.0 if self._newest is None else self._newest.watch.delay_s

    def confirms(self, hazard: AreaHazard, now: float) -> bool:
        """Whether a living aggregator lists this very hazard."""
        return self.alive(now) and self._listed(hazard) and not self._digest_differs

    def upholds(self, area: str, now: float) -> bool:
        """Whether an area's last hazard still holds: the aggregator lives, and nothing of the area is missing."""
        return self.alive(now) and now - self._missing.get(area, now) <= IN_FLIGHT_S

    def areas(self, now: float) -> Collection[str] | None:
        """Return all areas that exist; None while no aggregator that knows them all lives."""
        if self._believed is None or not self.alive(now) or not self._believed.heartbeat.complete:
            return None
        return self._believed.heartbeat.areas

    def overdue(self, now: float) -> list[str]:
        """Return the areas of which the map misses something that can't be under way any more."""
        return sorted(area for area, since in self._missing.items() if now - since > IN_FLIGHT_S)

    def request_due(self, now: float) -> bool:
        """Whether to ask the aggregator now to publish everything again."""
        if not self.alive(now) or not self.overdue(now) or now - self._asked_at < REQUEST_PERIOD_S:
            return False
        self._asked_at = now
        return True

    # --- Inside -----------------------------------------------------------------------------------------------------

    def _listed(self, hazard: AreaHazard) -> bool:
        heartbeat = None if self._believed is None else self._believed.heartbeat
        return (
            heartbeat is not None and heartbeat.epoch == hazard.epoch and heartbeat.areas.get(hazard.area) == hazard.seq
        )

    def _compare(
        self,
        heartbeat: AggregatorHeartbeat,
        received: Mapping[str, AreaHazard],
        defined: Collection[str],
        now: float,
    ) -> None:
        announced = [area for area, seq in heartbeat.areas.items() if seq > 0]
        missing = {area for area in announced if area not in received or not self._listed(received[area])}
        self._digest_differs = not missing and hazards_digest(received[area] for area in announced) != heartbeat.digest
        if self._digest_differs:
            missing.update(announced)
        missing.update(area for area in heartbeat.areas if area not in defined)
        missing.update(area for area in received if area not in heartbeat.areas)
        # What the heartbeat before this one confirmed holds no longer than that one lived, however late this one came.
        lived = self._compared_at + ch.AGGREGATOR_HEARTBEAT.max_age_s
        since = min(now, lived - IN_FLIGHT_S) if now <= lived else now
        self._missing = {area: self._missing.get(area, since) for area in missing}
        self._compared_at = now
