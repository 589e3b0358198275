"""What the map would be after a change of zones or areas, without making it: the request for the planner. Pure.

The layers that would change are replaced by ones that show the change; everything else is the map's own. Only the
windows of the change are computed, a portion at a time, and what comes out is compared with the map as it is.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np
from msgspec import structs

from fog_contracts.costs import LETHAL
from fog_contracts.grid import Window
from fog_contracts.messages import (
    PASSABLE_PENALTY,
    SEVERITY,
    DryRunRequest,
    HazardArea,
    MapPatch,
)
from fog_contracts.replica import pack
from fog_kernels.inflation import inflate_window
from map_service.costmap import COMMIT_CELLS, merge_overlapping

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from fog_contracts.messages import Layer, OverrideState, Target
    from map_service.costmap import LayeredCostmap
    from map_service.layers.base import CostLayer, Grid
    from map_service.layers.hazards import HazardsLayer
    from map_service.layers.zones import ZonesLayer
    from map_service.zones import PreparedZone

MAX_PATCHES: Final = 64
"""Most windows of a change; more are joined into one."""


@dataclass(frozen=True, kw_only=True)
class Change:
    """Zones that would be added or replaced, zones that would be removed, and overrides of areas (None: ended).

    Zones count as in force, whatever their times say; one that is not enabled is none.
    """

    zones: Sequence[PreparedZone] = ()
    removed: Sequence[str] = ()
    overrides: Mapping[str, OverrideState | None] = field(default_factory=dict)


class Hypothesis:
    """The map after a change: `combine` on the thread of the layers, then `request`, on any thread."""

    def __init__(
        self,
        costmap: LayeredCostmap,
        zones: ZonesLayer,
        hazards: HazardsLayer,
        change: Change,
        targets: Sequence[Target] = (),
    ) -> None:
        self._costmap = costmap
        self._targets = list(targets)
        self._version = costmap.version
        self._zones = [prepared for prepared in change.zones if prepared.zone.enabled]
        self._removed = {*change.removed, *(prepared.zone.id for prepared in change.zones if not prepared.zone.enabled)}
        gone = {*self._removed, *(prepared.zone.id for prepared in self._zones)}
        shown = {area: _overridden(hazards, area, state) for area, state in change.overrides.items()}
        self._hazards = list(shown.values())
        changed: dict[CostLayer, CostLayer] = {
            zones: zones.with_changes(self._zones, gone),
            hazards: hazards.with_changes({area: described.hazard for area, described in shown.items()}),
        }
        self._layers = [changed.get(layer, layer) for layer in costmap.layers]
        windows = [prepared.spans.window for prepared in self._zones]
        windows += [entry.spans.window for name in gone if (entry := zones.catalog.get(name)) and entry.active]
        windows += [hazards.window(area) for area in shown]
        reach = costmap.inflation_table.reach
        grown = [costmap.geometry.clip(window.grown(reach)) for window in windows if not window.empty]
        if len(grown) > MAX_PATCHES:
            whole = grown[0]
            for window in grown:
                whole = whole.union(window)
            grown = [whole]
        self._windows = merge_overlapping(grown)
        self._combined: list[tuple[Grid, Grid]] = []
        self._crops: list[_Crop] = []

    def combine(self) -> Iterator[None]:
        """Combine the layers, portion by portion; between two of them the map may change, which `is_current` tells."""
        for window in self._windows:
            cost = np.zeros((window.height, window.width), np.uint8)
            speed = np.zeros((window.height, window.width), np.uint8)
            rows = max(1, COMMIT_CELLS // window.width)
            for first in range(0, window.height, rows):
                part = Window(window.x, window.y + first, window.width, min(rows, window.height - first))
                inside = slice(first, first + part.height)
                for layer in self._layers:
                    layer.update_costs(part, cost[inside], speed[inside])
                yield
            self._combined.append((cost, speed))
        self._crops = [
            _Crop.of(self._costmap, window, *combined)
            for window, combined in zip(self._windows, self._combined, strict=True)
        ]

    @property
    def is_current(self) -> bool:
        """Whether the map is still as it was in the beginning, and no change is only partly on it."""
        return self._costmap.version == self._version and not self._costmap.pending

    def request(self) -> DryRunRequest:
        """Return the request for the planner; the cells of large windows take some ms to inflate."""
        return DryRunRequest(
            patches=[patch for crop in self._crops for patch in crop.patches()],
            zones=[prepared.zone for prepared in self._zones if prepared.zone.kind == "BLOCKED"],
            removed=sorted(
                {*self._removed, *(prepared.zone.id for prepared in self._zones if prepared.zone.kind != "BLOCKED")}
            ),
            hazards=self._hazards,
            targets=self._targets,
        )


@dataclass(frozen=True)
class _Crop:
    """A window of the map with the reach of the inflation around it, as copies: what is there, and what would be."""

    costmap: LayeredCostmap
    inside: Window
    """The window in which the layers were combined, relative to the crop."""
    whole: Window
    raw: Grid
    cost: Grid
    speed: Grid
    new_speed: Grid

    @classmethod
    def of(cls, costmap: LayeredCostmap, window: Window, cost: Grid, speed: Grid) -> _Crop:
        whole = costmap.geometry.clip(window.grown(2 * costmap.inflation_table.reach))
        inside = Window(window.x - whole.x, window.y - whole.y, window.width, window.height)
        raw = costmap.raw[whole.rows, whole.columns].copy()
        raw[inside.rows, inside.columns] = cost
        before = costmap.cost[whole.rows, whole.columns].copy()
        return cls(costmap, inside, whole, raw, before, costmap.speed[window.rows, window.columns].copy(), speed)

    def patches(self) -> Iterator[MapPatch]:
        """Yield the smallest windows with all cells that would differ."""
        cost = self.cost.copy()
        inflate_window(self.raw, self.costmap.inflation_table, *self.inside, cost)
        yield from _patch("cost", self.whole.x, self.whole.y, self.cost, cost)
        x, y = self.whole.x + self.inside.x, self.whole.y + self.inside.y
        yield from _patch("speed", x, y, self.speed, self.new_speed)


def _patch(layer: Layer, x: int, y: int, before: Grid, after: Grid) -> Iterator[MapPatch]:
    differs = before != after
    rows, columns = np.flatnonzero(differs.any(axis=1)), np.flatnonzero(differs.any(axis=0))
    if rows.size == 0:
        return
    place = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    packing, cells = pack(after[place])
    yield MapPatch(
        layer=layer,
        x=x + int(columns[0]),
        y=y + int(rows[0]),
        w=int(columns[-1] - columns[0]) + 1,
        h=int(rows[-1] - rows[0]) + 1,
        packing=packing,
        cells=cells,
        base=zlib.crc32(before[place].tobytes()),
    )


def _overridden(hazards: HazardsLayer, area: str, state: OverrideState | None) -> HazardArea:
    """Return an area as it would be with an override, or without the one that it has.

    As the hazard-aggregator decides it (`hazard_aggregator.areas`). Raises `RefusedMessageError` without such an area.
    """
    described, hazard = hazards.hazard(area), hazards.hazard(area).hazard
    if state == "blocked":
        changed = structs.replace(hazard, state="blocked", severity=SEVERITY["blocked"], penalty=LETHAL, free=[])
    elif state == "clear":
        penalty = min(PASSABLE_PENALTY, hazards.unknown_penalty(area))
        changed = structs.replace(hazard, state="unknown", severity=SEVERITY["unknown"], penalty=penalty)
    elif hazard.override is not None:
        measured, penalty = hazard.override.measured, hazard.override.measured_penalty
        changed = structs.replace(hazard, state=measured, severity=SEVERITY[measured], penalty=penalty, override=None)
    else:
        changed = hazard
    return structs.replace(described, hazard=changed)
