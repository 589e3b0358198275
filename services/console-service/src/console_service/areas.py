"""What the map shows of areas, and whether that still holds. Pure; times are s of a monotonic clock.

What aggregator and nodes say of an area is on its way to the map: only the map-service knows whether robots go by it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from fog_contracts.messages import AreaState, HazardArea

MAP_SILENT_S: Final = 2.0
"""After so long without its heartbeat the map-service is silent: nobody confirms what areas are."""


class ShownAreas:
    """The hazards on the map, by area."""

    def __init__(self) -> None:
        self._shown: dict[str, HazardArea] = {}
        self._true_at = -math.inf
        self._lives = False

    def on_hazard(self, area: str, shown: HazardArea) -> None:
        """Take in what the map shows of an area."""
        self._shown[area] = shown

    def on_heartbeat(self, sent_at: float) -> None:
        """Take in that the map-service lived at a time."""
        self._true_at = max(self._true_at, sent_at)

    def has_turned(self, now: float) -> bool:
        """Return whether the map-service has fallen silent since the last call, or is heard again."""
        before, self._lives = self._lives, now - self._true_at < MAP_SILENT_S
        return self._lives != before

    def view(self, area: str, hazard: Any) -> dict[str, Any] | None:  # noqa: ANN401  # JSON
        """Return what the map shows of an area whose latest hazard is this; None while nobody knows.

        `confirmed`: the map-service has taken over this very hazard, and the aggregator confirms it.
        """
        shown = self._shown.get(area)
        if shown is None or not self._lives:
            return None
        on_map = shown.hazard
        is_same = hazard is not None and (hazard["epoch"], hazard["seq"]) == (on_map.epoch, on_map.seq)
        return {"state": on_map.state, "penalty": on_map.penalty, "confirmed": shown.confirmed and is_same}

    def state(self, area: str, hazard: Any) -> AreaState:  # noqa: ANN401  # JSON
        """Return what an area whose latest hazard is this (None: nobody knows) counts as: clear only if confirmed."""
        if hazard is None or hazard["state"] != "clear":
            return "unknown" if hazard is None else hazard["state"]
        shown = self.view(area, hazard)
        return "clear" if shown is not None and shown["confirmed"] and shown["state"] == "clear" else "unknown"
