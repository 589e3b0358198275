"""Scheduled missions in Redis: what became of a window is stored, so that no restart gives its mission twice."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fog_runtime.stores.redis_store import ANY, Audit
from planner.lifts.persistence import RidePersistence

if TYPE_CHECKING:
    from fog_runtime.stores.redis_store import Outcome
    from planner.stops import ScheduledMission


class SchedulePersistence(RidePersistence):
    """The missions, and those that begin by the clock."""

    async def _load(self) -> None:
        self.schedules = await self._store.schedules()
        await super()._load()

    def stand_by(self) -> None:
        """Forget them: another planner changes them until this one leads again."""
        super().stand_by()
        self.schedules.clear()

    async def put_schedule(
        self, name: str, schedule: ScheduledMission | None, who: str, action: str, *, expected: str = ANY
    ) -> Outcome:
        """Store a scheduled mission, or delete it (None), if the stored one's version is `expected` (`0`: none is).

        Raises `StoreError`: then it may or may not be stored.
        """
        async with self._lock:
            await self._refresh()
            with self._uncertain_write():
                audit = Audit(self._clock.stamp(), who, action)
                outcome = await self._store.put_schedule(name, schedule, audit, expected=expected)
            if outcome != "ok":
                self._reload = True
            elif schedule is None:
                self.schedules.pop(name, None)
            else:
                self.schedules[name] = schedule
        return outcome
