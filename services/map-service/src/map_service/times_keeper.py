"""Keeps in the store what must survive a restart of the times of zones."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

    from map_service.core import MapCore
    from map_service.store import Store
    from map_service.zone_times import Progress

PERIOD_S: Final = 30.0
"""How often the remaining times are stored: after a boot, a zone may last longer by up to this time."""


class TimesKeeper:
    """Stores the times of zones: at once when one starts or ends, else periodically; `boot` is `clock.boot_id`."""

    def __init__(self, core: MapCore, store: Store, boot: str) -> None:
        self.boot = boot
        self._core = core
        self._store = store
        self._stored: dict[str, Progress] = {}
        self._stored_at = 0.0

    async def load(self) -> Mapping[str, Progress]:
        """Return the stored times by the zones' ids; raises `StoreError`."""
        return await self._store.zone_times()

    async def save(self, now: float) -> None:
        """Store the times if that is due at `now` (s, monotonic); raises `StoreError`."""
        current = self._core.zone_progress(self.boot, now)
        steps, stored_steps = (
            {name: (times.version, times.started, times.ended) for name, times in found.items()}
            for found in (current, self._stored)
        )
        if steps == stored_steps and (not current or now < self._stored_at + PERIOD_S):
            return
        await self._store.write_zone_times(current)
        self._stored, self._stored_at = current, now
