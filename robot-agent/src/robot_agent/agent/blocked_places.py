"""The reasons for blocked cells: watched areas and no-go zones, and whether the robot is in one of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fog_contracts import channels as ch
from fog_contracts.costs import LETHAL
from fog_contracts.geometry import contains_point
from fog_contracts.messages import PolygonShape, Reason, ReasonCode
from fog_contracts.shapes import shape_contains, shape_spans

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from fog_contracts.grid import GridGeometry
    from fog_contracts.handlers import Handler, Ids, Moment, Publication
    from fog_contracts.messages import HazardArea, Shape, Zone, ZoneSet
    from fog_contracts.replica import Replica
    from fog_contracts.shapes import Spans
    from robot_agent.agent.obstacle_reporter import ObstacleReporter
    from robot_agent.localization.pose import Pose2


class BlockedPlaces:
    """The newest state of every watched area, and the no-go zones in force."""

    def __init__(self) -> None:
        self._hazards: dict[str, HazardArea] = {}
        self._zones: list[Zone] = []
        self._spans: dict[str, Spans] = {}
        """Cells of what was closed last: outlines are rasterized once."""

    def handlers(self) -> Mapping[ch.Channel, Handler]:
        """Return the handlers of the channels that carry areas and zones."""
        return {ch.HAZARD: self._on_hazard, ch.ZONES: self._on_zones}

    def _on_hazard(self, _ids: Ids, hazard: HazardArea, _at: Moment) -> Sequence[Publication]:
        self._hazards[hazard.hazard.area] = hazard
        return ()

    def _on_zones(self, _ids: Ids, zones: ZoneSet, _at: Moment) -> Sequence[Publication]:
        active = frozenset(zones.active)
        self._zones = [zone for zone in zones.zones if zone.id in active and zone.kind == "BLOCKED"]
        return ()

    def containing(self, pose: Pose2, replica: Replica, reporter: ObstacleReporter, now: float) -> str | None:
        """Return the name of the blocked place that contains the robot's centre (m, frame `map`), None without one.

        The map decides whether it is blocked, the areas and zones only give the reason. Cells that the robot reported
        itself do not count: they would be its own body, or an obstacle beside it.
        """
        if not _is_blocked(replica, pose):
            return None
        named = self._named(pose)
        if named is None and not reporter.is_self_reported(np.array([[pose.x, pose.y]]), now)[0]:
            return "a blocked part of the map"
        return named

    def named(self, pose: Pose2, replica: Replica) -> str | None:
        """Return the name of the area or zone that blocks where the robot's centre is (m, frame `map`), if one does."""
        return self._named(pose) if _is_blocked(replica, pose) else None

    def closed(self, geometry: GridGeometry) -> dict[str, Spans]:
        """Return the cells of each blocked area and no-go zone, by a name that changes with them."""
        closed: dict[str, Spans] = {}
        for name, outline in self._outlines():
            if name not in self._spans:
                self._spans[name] = shape_spans(outline, geometry)
            closed[name] = self._spans[name]
        self._spans = dict(closed)
        return closed

    def _outlines(self) -> Iterator[tuple[str, Shape]]:
        for area in self._hazards.values():
            if area.hazard.penalty >= LETHAL:
                yield f"area {area.hazard.area} {area.polygon}", PolygonShape(points=area.polygon)
        for zone in self._zones:
            yield f"zone {zone.id} {zone.shape}", zone.shape

    def _named(self, pose: Pose2) -> str | None:
        for hazard in self._hazards.values():
            if hazard.hazard.state != "clear" and contains_point(hazard.polygon, pose.x, pose.y):
                return f"the {hazard.hazard.state} area {hazard.label or hazard.hazard.area}"
        for zone in self._zones:
            if shape_contains(zone.shape, pose.x, pose.y):
                return f"the no-go zone {zone.id}" + (f" ({zone.reason})" if zone.reason else "")
        return None

    def caution(self, pose: Pose2) -> Reason | None:
        """Return why the robot must drive slowly where it is (m, frame `map`); None when it need not."""
        for hazard in self._hazards.values():
            if hazard.hazard.state == "unknown" and contains_point(hazard.polygon, pose.x, pose.y):
                sentence = f"the state of the area {hazard.label or hazard.hazard.area} is unknown"
                return Reason(ReasonCode.AREA_UNKNOWN, sentence)
        return None


def _is_blocked(replica: Replica, pose: Pose2) -> bool:
    """Whether the map is lethal at the pose, and not because of a wall: a pose may be some centimetres off."""
    geometry = replica.geometry
    if geometry is None:
        return False
    column, row = geometry.cell(pose.x, pose.y)
    if not geometry.contains_cell(column, row):
        return False
    return bool(replica.cost[row, column] == LETHAL and replica.static[row, column] != LETHAL)
