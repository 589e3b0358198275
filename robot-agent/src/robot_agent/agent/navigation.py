"""The map, its blocked places, and the planner that the robot drives by: the fog's or its own, as its profile says.

The safety gate judges a robot by the sources that its profile uses, and by no other: one that plans for itself waits
for no message of the fog's planner.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_contracts import channels as ch
from fog_contracts.costs import LETHAL
from fog_contracts.geometry import contains_point
from fog_contracts.messages import PolygonShape, Reason, ReasonCode, RefusalCode
from fog_contracts.replica import decode_map
from fog_contracts.shapes import shape_contains, shape_spans
from robot_agent.localization.pose import Pose2
from robot_agent.profiles import FOG, ProfileError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from fog_contracts.follower import MapFollower
    from fog_contracts.geometry import Point
    from fog_contracts.grid import GridGeometry
    from fog_contracts.handlers import Handler, Ids, Moment, Publication
    from fog_contracts.messages import (
        HazardArea,
        MapDelta,
        MapHeartbeat,
        MapSnapshot,
        ProfileName,
        RobotGoal,
        RobotPath,
        RobotRelease,
        Shape,
        Zone,
        ZoneSet,
    )
    from fog_contracts.replica import DecodedMap, Replica, Version
    from fog_contracts.shapes import Spans
    from robot_agent.agent.obstacle_reporter import ObstacleReporter
    from robot_agent.agent.path_driving import PathDriving
    from robot_agent.config import AgentConfig
    from robot_agent.localization.localizer import Localizer
    from robot_agent.localization.map_fields import MapFields
    from robot_agent.profiles import FindProfile, Found, OwnPlanner, Profile, Search


class BlockedPlaces:
    """The newest state of every watched area, and the no-go zones in force."""

    def __init__(self) -> None:
        self._hazards: dict[str, HazardArea] = {}
        self._zones: list[Zone] = []
        self._spans: dict[str, Spans] = {}
        """Cells of what was closed last: outlines are rasterized once ..."""
        self._geometry: GridGeometry | None = None
        """... on each map."""

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

    def only_watched(self, pose: Pose2, replica: Replica) -> bool:
        """Whether no operator, but sensors may block where the robot's centre is: who passes it is gone again.

        An area that is clear counts, too: the map may follow a moment later. So does one that only touches the cell:
        the map blocks that as well.
        """
        corners = _corners(replica, pose)
        areas = (area for area in self._hazards.values() if any(contains_point(area.polygon, *at) for at in corners))
        hazards = [area.hazard for area in areas]
        overridden = any(hazard.override is not None for hazard in hazards)
        zones = any(shape_contains(zone.shape, *at) for zone in self._zones for at in corners)
        return bool(hazards) and not overridden and not zones

    def closed(self, geometry: GridGeometry) -> dict[str, Spans]:
        """Return the cells of each blocked area and no-go zone, by a name that changes with them."""
        closed: dict[str, Spans] = {}
        if geometry != self._geometry:
            self._geometry, self._spans = geometry, {}
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


def _corners(replica: Replica, pose: Pose2) -> list[Point]:
    """Return the corners of the pose's cell (m), a hair outside of it; none where the map is not blocked."""
    if replica.geometry is None or not _is_blocked(replica, pose):
        return []
    x, y = replica.geometry.centre(*replica.geometry.cell(pose.x, pose.y))
    half = 0.5 * replica.geometry.resolution + 1e-6
    return [(x + a * half, y + b * half) for a in (-1, 1) for b in (-1, 1)]


_STEP_M: Final = 0.05
"""Distance between the places on the way ahead that are looked up in the map."""
_CERTAIN_M: Final = 0.15
"""The planner keeps paths so far from blocked places that a smaller standard deviation of the pose does not matter."""
_WAY_M: Final = 0.5
"""The direction of the way is that of its next metres, ..."""
_ALONG_SHARE: Final = 0.3
"""... of which this share lies in the direction in which the pose is uncertain; else it leads neither way there."""


class PreparedMap(NamedTuple):
    """A snapshot of the map, its cells, and the fields of its static map for localization."""

    snapshot: MapSnapshot
    decoded: DecodedMap
    fields: MapFields


def prepare_map(snapshot: MapSnapshot, localizer: Localizer) -> PreparedMap:
    """Decode a snapshot and compute its fields, some 0.4 s for 2000 x 1200 cells; raises `MapError` when it is invalid.

    It changes nothing and may run on any thread. Each result can be loaded once.
    """
    decoded = decode_map(snapshot)
    return PreparedMap(snapshot, decoded, localizer.fields_of(decoded.static, decoded.geometry))


class Navigation:
    """Selects between the fog's map and paths, and those of the robot itself. `now` is s of its monotonic clock."""

    def __init__(
        self,
        config: AgentConfig,
        map_follower: MapFollower,
        driving: PathDriving,
        localizer: Localizer,
        find_profile: FindProfile,
    ) -> None:
        self._config = config
        self._find_profile = find_profile
        self._fog = map_follower
        self._places = BlockedPlaces()
        self._driving = driving
        self._localizer = localizer
        self._onboard: OwnPlanner | None = None
        self._own_plans = 0
        """Number of the robot's own last plan: no other path gets it, of whatever profile."""
        self._fog_heard_at = 0.0
        self.profile: Profile = FOG
        """How the robot navigates."""

    # --- messages of the fog ---

    def handlers(self) -> Mapping[ch.Channel, Handler]:
        """Return the handlers of all subscribed channels; of channels with `{robot}` the robot's own only."""
        return {
            ch.MAP_DELTA: self._on_delta,
            ch.MAP_HEARTBEAT: self._on_heartbeat,
            **self._places.handlers(),
            ch.ROBOT_GOAL: self._on_goal,
            ch.ROBOT_PATH: self._on_path,
            ch.ROBOT_RELEASE: self._on_release,
        }

    def _on_delta(self, _ids: Ids, delta: MapDelta, at: Moment) -> Sequence[Publication]:
        """Apply a change of the fog's map, if the robot drives by it."""
        if not self.profile.onboard and self._fog.on_delta(delta, at.now) is not None:
            self._driving.check_path(self.replica, at.now)
        return ()

    def _on_heartbeat(self, _ids: Ids, heartbeat: MapHeartbeat, at: Moment) -> Sequence[Publication]:
        """Record that the fog's map-service lives, and which version it has."""
        self._fog_heard_at = at.now
        if not self.profile.onboard:
            self._fog.on_heartbeat(heartbeat, at.now)
        return ()

    def _on_goal(self, _ids: Ids, goal: RobotGoal, at: Moment) -> Sequence[Publication]:
        self._driving.on_goal(goal, self._localizer.pose(at.now), self.replica, at)
        return ()

    def _on_path(self, _ids: Ids, path: RobotPath, at: Moment) -> Sequence[Publication]:
        """Follow a path of the fog's planner, if the robot drives by its paths."""
        if not self.profile.onboard:
            self._driving.on_path(path, self._localizer.pose(at.now), self.replica, at)
        return ()

    def _on_release(self, _ids: Ids, release: RobotRelease, at: Moment) -> Sequence[Publication]:
        """Extend such a path."""
        if not self.profile.onboard:
            self._driving.on_release(release, self.replica, at.now)
        return ()

    # --- the map ---

    @property
    def replica(self) -> Replica:
        """The costmap to drive by."""
        return self._fog.replica if self._onboard is None else self._onboard.replica

    @property
    def version(self) -> Version | None:
        """Version of this costmap; None before the first one."""
        return self.replica.version

    def age(self, now: float) -> float:
        """Return the time (s) since the costmap was confirmed to be up to date."""
        return self._fog.age(now) if self._onboard is None else self._onboard.age(now)

    def gap(self, now: float) -> float:
        """Return for how long (s) the costmap has lacked changes that are known to exist."""
        return self._fog.gap(now) if self._onboard is None else 0.0

    def wants_snapshot(self, now: float) -> bool:
        """Return whether a snapshot of the fog's map is needed: of a robot that plans for itself, only the first."""
        return self._fog.wants_snapshot(now) if not self.profile.onboard else self._fog.version is None

    def on_map_loaded(self, now: float) -> None:
        """Take over a snapshot that the follower of the fog's map has loaded.

        A robot with a costmap of its own keeps it: the snapshot was asked for before it switched to its profile.
        """
        if self._onboard is None:
            self._begin_onboard()
        self._driving.check_path(self.replica, now)

    # --- paths ---

    def search(self, now: float) -> Search | None:
        """Update the robot's own costmap, and return the search for a path, each if due; None without a search."""
        onboard, mission = self._onboard, self._driving.mission
        if onboard is None:
            return None
        impassable = self._driving.impassable(now)
        if onboard.update(self._localizer, self._closed(onboard.replica), impassable, now):
            self._driving.check_path(onboard.replica, now)
        pose, goal = self._localizer.pose(now), mission.goal
        mission.confirm(now)
        if pose is None or goal is None or not mission.active:
            return None
        return onboard.search(goal, pose, mission.follower, now)

    def on_found(self, found: Found, at: Moment) -> None:
        """Follow the path that a search found, unless the present one is as good.

        One to another goal is dropped, and one that was searched by another profile.
        """
        onboard, mission = self._onboard, self._driving.mission
        if onboard is None or not onboard.searched(found) or found.goal != mission.goal or not mission.active:
            return
        path = onboard.path(found, mission.follower, at)
        if path is None:
            # What was forgotten may have been what blocked the present path.
            self._driving.check_path(self.replica, at.now)
        else:
            self._driving.on_path(path, self._localizer.pose(at.now), self.replica, at)

    def _closed(self, replica: Replica) -> dict[str, Spans]:
        return self._places.closed(replica.geometry) if self.profile.hazards and replica.geometry is not None else {}

    # --- what the fog says of places ---

    def inside_blocked(self, pose: Pose2, reporter: ObstacleReporter, now: float) -> str | None:
        """Return the name of the blocked place that the robot is in, of those that its profile knows."""
        if self._onboard is None:
            return self._places.containing(pose, self.replica, reporter, now)
        return self._places.named(pose, self.replica) if self.profile.hazards else None

    def inside_watched(self, pose: Pose2) -> bool:
        """Whether what blocks the place of a robot is sensors alone, which also tell when it is clear again."""
        return self._places.only_watched(pose, self.replica)

    def blocked_ahead(self, pose: Pose2, way: float, reporter: ObstacleReporter, now: float) -> str | None:
        """Return the name of a blocked place that the body would reach, `way` m straight ahead; None at 0 m."""
        if way <= 0.0:
            return None
        radius = self._config.radius
        steps = 2 + int((way + radius) / _STEP_M), 2 + int(2.0 * radius / _STEP_M)
        for along in np.linspace(0.0, way + radius, steps[0]):
            for aside in np.linspace(-radius, radius, steps[1]):
                place = pose.compose(Pose2(float(along), float(aside), 0.0))
                if (name := self.inside_blocked(place, reporter, now)) is not None:
                    return name
        return None

    def near_blocked(self, pose: Pose2) -> str | None:
        """Return the name of a blocked area or zone that the robot may be in: on its way, by two standard deviations.

        What lies behind it does not count, so that it may drive away.
        """
        spread, follower = self._localizer.uncertainty, self._driving.mission.follower
        if spread.along < _CERTAIN_M or follower is None or not self.profile.hazards:
            return None
        points, _ = follower.released_ahead(_WAY_M)
        way, axis = points[-1] - points[0], np.array(spread.axis)
        farther = float(way @ axis)
        if not abs(farther) > _ALONG_SHARE * math.hypot(*way):
            return None
        reach = math.copysign(2.0 * spread.along, farther)
        for shift in np.linspace(0.0, reach, 2 + int(2.0 * spread.along / _STEP_M))[1:]:
            place = Pose2(pose.x + shift * spread.axis[0], pose.y + shift * spread.axis[1], pose.theta)
            if (name := self._places.named(place, self.replica)) is not None:
                return name
        return None

    def caution(self, pose: Pose2, now: float) -> Reason | None:
        """Return why the robot must drive slowly where it is; None when it need not."""
        if not self.profile.hazards:
            return None
        silent = now - self._fog_heard_at
        if self.profile.onboard and silent > self._config.safety.map_late:
            return Reason(ReasonCode.HAZARDS_OLD, f"the fog's hazards are {silent:.1f} s old")
        return self._places.caution(pose)

    # --- profiles ---

    def switch(self, name: ProfileName, *, at_rest: bool) -> Reason | None:
        """Navigate by another profile; return why not, None when it is done. The present path is dropped."""
        if not at_rest:
            return Reason(RefusalCode.DRIVING, "the robot is driving: disable it first")
        try:
            self.profile = self._find_profile(name)
        except ProfileError as error:
            return Reason(RefusalCode.NO_PROFILE, str(error))
        self._driving.configure(self.profile.motion(self._config.motion))
        self._begin_onboard()
        return None

    def _begin_onboard(self) -> None:
        """Begin anew with a costmap and a planner of the robot's own, or with none: as its profile says."""
        if self._onboard is not None:
            self._own_plans = self._onboard.plans
        self._onboard = None
        if self.profile.planner is not None and self._fog.version is not None:
            radius = self._config.footprint.inscribed_radius
            self._onboard = self.profile.planner(self._fog.replica, radius, self._own_plans)
