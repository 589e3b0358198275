"""Stored areas that this version can't use: unknown instead of watched, and named wherever people look."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import structs
from prometheus_client import Gauge

from fog_contracts.messages import FusionPolicy
from fog_runtime import logs
from hazard_aggregator.area_size import AreaError, check_size
from hazard_aggregator.sensors.source_profiles import SourceError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from fog_contracts.messages import AreaDefinition
    from fog_runtime.health import Health

UNUSABLE = Gauge("fognav_areas_unusable", "Stored areas that nothing watches because their records are invalid")

_log = logs.get("aggregator")


class UnusableAreas:
    """Why each of them is unusable, by id; `checked` returns an area as it counts, or raises `AreaError`."""

    def __init__(self, checked: Callable[[AreaDefinition], AreaDefinition], health: Health) -> None:
        self._checked = checked
        self._health = health
        self.reasons: dict[str, str] = {}
        self._records: dict[str, AreaDefinition] = {}
        self.moved: list[AreaDefinition] = []
        """Areas of the last call that are the cones of nodes, and are elsewhere now than their records have them."""

    def made_usable(self, definitions: Iterable[AreaDefinition], unreadable: Mapping[str, str]) -> list[AreaDefinition]:
        """Return stored areas such that each is usable: without nodes and sources those that are not, or were not read.

        A rule may have gone with the package that provided it, or the node whose cone the area is. The area stays on
        the map where its record has it, unknown, until somebody PUTs it again: left out, it would count as clear.
        `unreadable` tells why records could not be read.
        """
        reasons, usable, records = dict(unreadable), [], {}
        self.moved = []
        for definition in definitions:
            try:
                usable.append(self._usable(definition))
                if usable[-1].polygon != definition.polygon:
                    self.moved.append(usable[-1])
            except AreaError as error:
                reasons[definition.id] = str(error)
                records[definition.id] = definition
                rest = structs.replace(definition, nodes=[], sources=[], debounce={}, fusion=FusionPolicy())
                usable.append(structs.replace(rest, cone_of=None))
        self._records = records
        self._report(reasons)
        return usable

    def of_site(self, definitions: Iterable[AreaDefinition]) -> list[AreaDefinition]:
        """Return the areas of a site's file; without anything that watches them those that have an invalid source.

        They are unknown until somebody mends them, and the floor goes on. Raises `AreaError` for other mistakes.
        """
        usable = []
        for definition in definitions:
            try:
                usable.append(self._checked(definition))
            except SourceError as error:
                remedy = "mend it in site.toml, or PUT the area; until then it is unknown"
                _log.error("site_area_unusable", area=definition.id, reason=str(error), remedy=remedy)
                rest = self._checked(structs.replace(definition, sources=[], fusion=FusionPolicy()))
                usable.append(structs.replace(rest, nodes=[], cone_of=None))
        return usable

    def as_stored(self, definition: AreaDefinition) -> AreaDefinition:
        """Return the record of an area in force: whole, where it was made usable and was not PUT again since then."""
        record = self._records.get(definition.id)
        return definition if record is None or record.version != definition.version else record

    def _usable(self, definition: AreaDefinition) -> AreaDefinition:
        if definition.removed:
            return definition
        counts = self._checked(definition)
        check_size(counts)
        return counts

    def _report(self, reasons: dict[str, str]) -> None:
        for area, reason in reasons.items():
            if self.reasons.get(area) != reason:
                _log.error("stored_area_unusable", area=area, reason=reason, remedy="PUT the area again")
        self.reasons = reasons
        UNUSABLE.set(len(reasons))
        named = ", ".join(f"{area} ({reason})" for area, reason in sorted(reasons.items()))
        detail = f"unknown until they are PUT again, because their records are invalid: {named}"
        self._health.set("areas", ok=True, detail=detail[:500] if named else "")
