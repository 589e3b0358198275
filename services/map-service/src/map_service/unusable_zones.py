"""Stored zones that this version of the map-service can't use: left out of the map, and named wherever people look."""

from __future__ import annotations

from typing import TYPE_CHECKING

from prometheus_client import Gauge

from fog_runtime import logs

if TYPE_CHECKING:
    from collections.abc import Mapping

UNUSABLE = Gauge("fognav_zones_unusable", "Stored zones that are left out of the map because their record is invalid")

_log = logs.get("map")


class UnusableZones:
    """Why each of them is left out, by id."""

    def __init__(self) -> None:
        self.reasons: dict[str, str] = {}

    def replace(self, reasons: Mapping[str, str]) -> None:
        """Record which zones are left out now; each new one is logged."""
        for name, reason in reasons.items():
            if self.reasons.get(name) != reason:
                _log.error("stored_zone_unusable", zone=name, reason=reason, remedy="DELETE the zone and add it again")
        self.reasons = dict(reasons)
        UNUSABLE.set(len(reasons))

    def detail(self) -> str:
        """Return a text for /readyz that names them; empty without any."""
        named = ", ".join(f"{name} ({reason})" for name, reason in sorted(self.reasons.items()))
        return f"; left out, because their records are invalid: {named}"[:500] if named else ""
