"""Stored areas that this version can't use: unknown instead of watched, and named wherever people look."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import structs
from prometheus_client import Gauge

from fog_contracts.messages import FusionPolicy
from fog_runtime import logs
from hazard_aggregator.area_size import AreaError, check_size

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from fog_contracts.messages import AreaDefinition
    from fog_runtime.health import Health

UNUSABLE = Gauge("fognav_areas_unusable", "Stored areas that nothing watches because their records are invalid")

_log = logs.get("aggregator")


class UnusableAreas:
    """Why each of them is unusable, by id; `check` raises `AreaError` for an area with invalid settings."""

    def __init__(self, check: Callable[[AreaDefinition], object], health: Health) -> None:
        self._check = check
        self._health = health
        self.reasons: dict[str, str] = {}

    def made_usable(self, definitions: Iterable[AreaDefinition], unreadable: Mapping[str, str]) -> list[AreaDefinition]:
        """Return stored areas such that each is usable: without nodes and sources those that are not, or were not read.

        A rule may have gone with the package that provided it. The area stays on the map, unknown, until somebody PUTs
        it again: left out, it would count as clear. `unreadable` tells why records could not be read.
        """
        reasons, usable = dict(unreadable), []
        for definition in definitions:
            try:
                if not definition.removed:
                    check_size(definition)
                    self._check(definition)
            except AreaError as error:
                reasons[definition.id] = str(error)
                usable.append(structs.replace(definition, nodes=[], sources=[], debounce={}, fusion=FusionPolicy()))
            else:
                usable.append(definition)
        self._report(reasons)
        return usable

    def _report(self, reasons: dict[str, str]) -> None:
        for area, reason in reasons.items():
            if self.reasons.get(area) != reason:
                _log.error("stored_area_unusable", area=area, reason=reason, remedy="PUT the area again")
        self.reasons = reasons
        UNUSABLE.set(len(reasons))
        named = ", ".join(f"{area} ({reason})" for area, reason in sorted(reasons.items()))
        detail = f"unknown until they are PUT again, because their records are invalid: {named}"
        self._health.set("areas", ok=True, detail=detail[:500] if named else "")
