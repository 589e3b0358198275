"""The aggregator's records in Redis: areas that operators changed, and the last hazard of every area."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from fog_contracts.messages import AreaDefinition, AreaHazard
from fog_runtime import logs
from fog_runtime.redis_store import Audit, Outcome, RecoveryError, RedisStore, StoreError, StoreLostError, Table
from hazard_aggregator.area_size import AreaError, check_size

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from fog_runtime.idempotency import Attempt

__all__ = [
    "Audit",
    "Outcome",
    "RecoveryError",
    "Store",
    "StoreError",
    "StoreLostError",
    "Stored",
    "load_at_start",
    "usable_areas",
]

_AREAS: Final = Table("areas", "area")
_HAZARDS: Final = "hazards"

_log = logs.get("store")


class Stored(NamedTuple):
    """What an aggregator loads when it starts, and when it begins to lead."""

    definitions: list[AreaDefinition]
    hazards: list[AreaHazard]


class Store(RedisStore):
    """The aggregator's keys."""

    async def load(self) -> Stored:
        """Return all readable records."""
        hazards = await self._readable_records(_HAZARDS, AreaHazard)
        return Stored(await self.areas(), list(hazards.values()))

    async def areas(self) -> list[AreaDefinition]:
        """Return the stored areas; an unreadable one is left out, so the site's definition of it stays in force."""
        return list((await self._readable_records(_AREAS.name, AreaDefinition)).values())

    async def save_hazards(self, hazards: Iterable[AreaHazard]) -> None:
        """Write hazards durably (Redis answers after its fsync: `appendfsync always`)."""
        await self._write_records(_HAZARDS, {hazard.area: hazard for hazard in hazards})

    async def put_area(
        self, definition: AreaDefinition, *, expected: int, audit: Audit, before: AreaDefinition | None = None
    ) -> Outcome:
        """Write an area durably if the stored version is `expected` (0: none is stored, as for the site's own).

        `before` is the definition in force until now, for the audit entry of an area that was not stored yet.
        """
        return await self._swap(_AREAS, definition.id, definition, str(expected), audit, before=before)

    async def earlier_result(self, attempt: Attempt | None) -> AreaDefinition | None:
        """Return the area that an earlier attempt with the same idempotency key stored."""
        return await self.recall(attempt, AreaDefinition)

    async def restore(self, definitions: Iterable[AreaDefinition], hazards: Iterable[AreaHazard], audit: Audit) -> None:
        """Replace the stored areas and hazards by these, on an administrator's decision after Redis lost them."""
        areas = {definition.id: definition for definition in definitions}
        await self._adopt({_AREAS.name: areas, _HAZARDS: {hazard.area: hazard for hazard in hazards}}, audit)


async def load_at_start(store: Store) -> tuple[Stored, bool]:
    """Return the stored records, and whether Redis answered; if not, none."""
    try:
        return await store.load(), True
    except StoreError as error:
        _log.warning("started_without_store", reason=str(error))
        return Stored([], []), False


def usable_areas(
    definitions: Iterable[AreaDefinition], check: Callable[[AreaDefinition], object]
) -> list[AreaDefinition]:
    """Return the stored areas that `check` accepts; one that is invalid or too large is logged and left out.

    Its rule may have gone with the package that provided it. Whatever is in force without the record stays in force,
    and the REST API stays there to repair it.
    """
    usable = []
    for definition in definitions:
        try:
            check_size(definition)
            check(definition)
        except AreaError as error:
            _log.error("stored_area_unusable", area=definition.id, reason=str(error), remedy="PUT the area again")
        else:
            usable.append(definition)
    return usable
