"""Hazard areas: what the aggregator says about a place, as cost and speed limit.

Penalty 254 is lethal and gets inflated, anything lower is a graded cost as it stands. An unknown area limits the speed
too. A defined area of which nothing has been heard yet counts as unknown by its own policy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from msgspec import structs

from fog_contracts.geometry import normalized_polygon, rasterize
from fog_contracts.messages import AreaHazard, Cause, HazardArea
from map_service.layers.protocol import Touch, paint_figure
from map_service.shapes import Figure

if TYPE_CHECKING:
    from typing import Final

    from fog_contracts.grid import GridGeometry, Window
    from fog_contracts.messages import AreaDefinition
    from map_service.layers.protocol import Grid

UNKNOWN_SPEED: Final = 15
"""Speed limit (cm/s) in an area that nobody can vouch for: the robot's DEGRADED speed."""


@dataclass
class _Area:
    definition: AreaDefinition
    figure: Figure
    effective: AreaHazard


class HazardsLayer:
    """Holds every area's definition and hazard, in whatever order they come."""

    def __init__(self, geometry: GridGeometry) -> None:
        self._geometry = geometry
        self._areas: dict[str, _Area] = {}
        self._heard: dict[str, AreaHazard] = {}
        self._watched = True
        self._touched: list[Touch] = []

    def define(self, definition: AreaDefinition) -> list[HazardArea]:
        """Take an area's definition; raises `GeometryError` when its polygon can't be used.

        Returns what to tell the robots. An older version than the known one is ignored.
        """
        old = self._areas.get(definition.id)
        if old is not None and (definition == old.definition or definition.version < old.definition.version):
            return []
        if definition.removed:
            if old is None:
                return []
            del self._areas[definition.id]
            self._touched.append(Touch(old.figure.window, Cause(kind="hazard", id=definition.id, state="removed")))
            gone = structs.replace(
                old.effective, state="clear", severity=0, penalty=0, cause="the area was removed", trace=None
            )
            return [_described(old.definition, gone)]
        figure = Figure(*rasterize(normalized_polygon(definition.polygon), self._geometry))
        area = _Area(definition, figure, self._effective(definition))
        self._areas[definition.id] = area
        cause = Cause(kind="hazard", id=definition.id, state=area.effective.state)
        if old is not None:
            self._touched.append(Touch(old.figure.window, cause))
        self._touched.append(Touch(figure.window, cause, area.effective.trace))
        return [_described(definition, area.effective)]

    def take(self, hazard: AreaHazard) -> list[HazardArea]:
        """Take an area's hazard; returns what to tell the robots.

        Duplicates and overtaken ones of the same epoch are ignored; of an older epoch, only what raises the cost is
        taken (a clock that went back must not hide a danger).
        """
        old = self._heard.get(hazard.area)
        if old is not None:
            if hazard.epoch == old.epoch and hazard.seq <= old.seq:
                return []
            if hazard.epoch < old.epoch and hazard.penalty <= old.penalty:
                return []
        self._heard[hazard.area] = hazard
        return self._refresh(hazard.area)

    def set_watched(self, watched: bool) -> list[HazardArea]:  # noqa: FBT001  # the one thing it sets
        """Say whether the aggregator is there; while it is not, no area counts as clear."""
        if watched == self._watched:
            return []
        self._watched = watched
        return [told for area in list(self._areas) for told in self._refresh(area)]

    def described(self) -> list[HazardArea]:
        """Return every area with its hazard."""
        return [_described(area.definition, area.effective) for area in self._areas.values()]

    def unheard(self) -> list[str]:
        """Return the defined areas of which no hazard has come yet."""
        return sorted(set(self._areas) - set(self._heard))

    def tick(self, now: float, stamp: float) -> None:
        """Hazards don't expire."""

    def touched(self) -> list[Touch]:
        """Return the windows of areas that changed."""
        touched, self._touched = self._touched, []
        return touched

    def paint(self, window: Window, cost: Grid, speed: Grid) -> None:
        """Write the penalties, and the speed limit of unknown areas."""
        for area in self._areas.values():
            if area.effective.penalty > 0:
                paint_figure(area.figure, window, cost, area.effective.penalty)
            if area.effective.state == "unknown":
                paint_figure(area.figure, window, speed, UNKNOWN_SPEED, speed=True)

    def _refresh(self, name: str) -> list[HazardArea]:
        area = self._areas.get(name)
        if area is None:
            return []
        before, area.effective = area.effective, self._effective(area.definition)
        if area.effective == before:
            return []
        if (before.penalty, before.state) != (area.effective.penalty, area.effective.state):
            cause = Cause(kind="hazard", id=name, state=area.effective.state)
            self._touched.append(Touch(area.figure.window, cause, area.effective.trace))
        return [_described(area.definition, area.effective)]

    def _effective(self, definition: AreaDefinition) -> AreaHazard:
        """Return the hazard that counts: what was heard, or unknown where nothing vouches for the area."""
        heard = self._heard.get(definition.id)
        if heard is not None and (self._watched or heard.state != "clear"):
            return heard
        return AreaHazard(
            area=definition.id,
            state="unknown",
            severity=1,
            penalty=definition.unknown.penalty,
            since=heard.since if heard else 0.0,
            seq=heard.seq if heard else 0,
            epoch=heard.epoch if heard else 0,
            cause="the hazard aggregator is gone, or the broker between"
            if heard
            else "the hazard aggregator has not spoken of it yet",
        )


def _described(definition: AreaDefinition, hazard: AreaHazard) -> HazardArea:
    return HazardArea(hazard=hazard, polygon=definition.polygon, label=definition.label)
