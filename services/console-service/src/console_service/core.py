"""Turns what the fog says into events: the state of everything as a compacted log. Pure.

What channels tell is taken from them. What only the hazard-aggregator's REST has (areas with their overrides, the
health of nodes, all alerts) is fetched by the service, soon after a message that says that it has changed: `wanted`.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec

from console_service.areas import ShownAreas
from console_service.log import CompactedLog
from console_service.tiles import TiledMap
from console_service.views import FloorRobot, PathView, Thing, VitalsView, ZoneView, scan_view
from fog_contracts import channels as ch
from fog_contracts.handlers import Fence
from fog_contracts.messages import GoalView, MapGeometry, MapInfo, PlanView, RobotSummary

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from console_service.tiles import TileJob
    from fog_contracts.handlers import Handler, Ids, Moment, Publication
    from fog_contracts.messages import (
        AlertList,
        AreaDefinition,
        AreaHazard,
        AreaState,
        HazardArea,
        MapDelta,
        MapHeartbeat,
        PlaceSet,
        RobotGoal,
        RobotObstacles,
        RobotPath,
        RobotPose,
        RobotRelease,
        RobotState,
        RobotVitals,
        ZoneSet,
    )
    from fog_contracts.replica import DecodedMap
    from fog_contracts.site import RobotSite

Fetched = Literal["area", "node", "alert"]

POSE_PERIOD_S: Final = 0.1
"""The shortest time between two poses of a robot."""
_EARLY_S: Final = 0.02
"""How much earlier one may come: robots send as often themselves."""
REFRESH_S: Final = 10.0
"""How often what always changes (`VOLATILE`) is told when nothing else does."""
VOLATILE: Final[Mapping[str, Sequence[str]]] = {"area": ("rest_s",), "node": ("age_s", "heard", "received", "ignored")}
FORGET_S: Final = 600.0
"""A robot that is not of the site is forgotten after so long without a message of it, or about it."""
RECORDS: Final = 200
"""Entries of the audit trail that a new reader gets."""
VITALS: Final = 300
"""Vitals of each robot that are kept: ten minutes of them."""
FAULTS: Final = 2_000
"""Faults of robots, and their ends, that are remembered."""


@dataclass
class _Robot:
    described: RobotSite | None = None
    state: RobotState | None = None
    goal: RobotGoal | None = None
    path: RobotPath | None = None
    obstacles: RobotObstacles | None = None
    pending: RobotPose | None = None
    pose_at: float = -math.inf
    heard: float = -math.inf
    """When it said something itself."""
    told: float = -math.inf
    """When anybody last spoke of it: the planner goes on about a robot that is off."""
    vitals: deque[VitalsView] = field(default_factory=lambda: deque(maxlen=VITALS))


class Fault(msgspec.Struct, frozen=True):
    """A robot's fault began or ended (`began`) at `at` (s since the epoch), and why, in words that `codes` identify."""

    at: float
    robot: str
    began: bool
    reasons: list[str]
    codes: list[str]


class ConsoleCore:
    """Messages in; the state of everything, in `log`, out."""

    def __init__(
        self,
        site: str,
        run: str,
        *,
        robots: Collection[RobotSite] = (),
        nodes: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        """Begin with these robots of the site, of which nothing was heard yet; `run` as in `CompactedLog`.

        nodes: by id, what the site says of them (JSON): where they hang, and their sonars.
        """
        self.site = site
        self._nodes = nodes or {}
        self.log = CompactedLog(run)
        self.faults: deque[Fault] = deque(maxlen=FAULTS)
        self.wanted: dict[Fetched, None] = {}
        """What is to be fetched soon; whoever fetches it removes it first."""
        self._fence = Fence()
        self._map = TiledMap()
        self._robots: dict[str, _Robot] = {}
        self._fetched: dict[Fetched, dict[str, Any]] = {"area": {}, "node": {}, "alert": {}}
        self._refreshed: dict[tuple[str, str], tuple[bytes, float]] = {}
        self._shown = ShownAreas()
        self._records: deque[str] = deque()
        for robot in robots:
            self._robots[robot.id] = _Robot(described=robot)
            self._put_robot(robot.id)

    def handlers(self) -> Mapping[ch.Channel, Handler]:
        """Return the handler of every channel that the console-service subscribes to."""
        return self._fence.guarded(
            {
                ch.MAP_DELTA: self._on_delta,
                ch.MAP_HEARTBEAT: self._on_heartbeat,
                ch.HAZARD: self._on_shown,
                ch.ZONES: self._on_zones,
                ch.PLACES: self._on_places,
                ch.ROBOT_GOAL: self._on_goal,
                ch.ROBOT_PATH: self._on_path,
                ch.ROBOT_RELEASE: self._on_release,
                ch.ROBOT_POSE: self._on_pose,
                ch.ROBOT_STATE: self._on_state,
                ch.ROBOT_OBSTACLES: self._on_obstacles,
                ch.ROBOT_VITALS: self._on_vitals,
                ch.AREA_HAZARD: self._on_hazard,
                ch.AREA_DEFINITION: self._on_definition,
                ch.NODE_AVAILABILITY: self._on_availability,
                ch.AGGREGATOR_ALERTS: self._on_alerts,
            }
        )

    def tick(self, at: Moment) -> Sequence[Publication]:
        """Advance to `at`; nothing is ever published."""
        self._tell_areas(at.now)
        for robot, known in list(self._robots.items()):
            if known.pending is not None and at.now - known.pose_at >= POSE_PERIOD_S:
                self._put_pose(robot, known, known.pending, at.now)
            if known.described is None and at.now - known.told > FORGET_S:
                del self._robots[robot]
                for event in ("robot", "pose", "path", "obstacles", "vitals"):
                    self._remove(event, robot, at.now)
        self.log.prune(at.now)
        return ()

    # --- The map ----------------------------------------------------------------------------------------------------

    def _on_delta(self, _ids: Ids, delta: MapDelta, at: Moment) -> Sequence[Publication]:
        self._map.on_delta(delta, at.now)
        self._put_map()
        return ()

    def _on_heartbeat(self, _ids: Ids, heartbeat: MapHeartbeat, at: Moment) -> Sequence[Publication]:
        self._map.on_heartbeat(heartbeat, at.now)
        self._shown.on_heartbeat(at.now - self._map.delay_s)
        self._tell_areas(at.now)
        self._put_map()
        return ()

    def wants_snapshot(self, now: float) -> bool:
        """Whether a snapshot of the map is needed."""
        return self._map.wants_snapshot(now)

    def load(self, decoded: DecodedMap, now: float) -> None:
        """Load a snapshot of the map; raises `MapError` and changes nothing when it is outdated."""
        if gone := self._map.load(decoded, now):
            for column, row in gone:
                self.log.forget("costmap", f"{column},{row}")
            self.log.begin_anew()
        self._fence.raise_to(ch.MAP, decoded.version.epoch)
        self._put_map()

    def tile_jobs(self, most: int) -> list[TileJob]:
        """Return up to `most` tiles to be encoded: run each on any thread, then `add_tile` it."""
        return self._map.jobs(most)

    def add_tile(self, job: TileJob) -> None:
        """Take over a tile that was encoded."""
        if self._map.add(job) and job.data is not None:
            column, row = job.tile
            self.log.put("costmap", f"{column},{row}", job.data)

    def _put_map(self) -> None:
        version, g = self._map.version, self._map.geometry
        if version is not None and g is not None:
            geometry = MapGeometry(
                width=g.width, height=g.height, resolution=g.resolution, origin_x=g.origin_x, origin_y=g.origin_y
            )
            view = MapInfo(site=self.site, geometry=geometry, epoch=version.epoch, seq=version.seq)
            self.log.put("map", "", msgspec.json.encode(view))

    # --- Zones ------------------------------------------------------------------------------------------------------

    def _on_zones(self, _ids: Ids, zones: ZoneSet, at: Moment) -> Sequence[Publication]:
        active = set(zones.active)
        found = {
            zone.id: ZoneView(**{n: getattr(zone, n) for n in zone.__struct_fields__}, active=zone.id in active)
            for zone in zones.zones
        }
        self._put_all("zone", found, at.now)
        return ()

    # --- Robots -----------------------------------------------------------------------------------------------------

    def _robot(self, ids: Ids, at: Moment) -> tuple[str, _Robot]:
        """Return the robot that a message is about, whoever sent it."""
        robot = ids["robot"]
        known = self._robots.setdefault(robot, _Robot())
        known.told = at.now
        return robot, known

    def _hear(self, ids: Ids, at: Moment) -> tuple[str, _Robot]:
        """Return the robot that has sent a message."""
        robot, known = self._robot(ids, at)
        known.heard = at.now
        return robot, known

    def _on_pose(self, ids: Ids, pose: RobotPose, at: Moment) -> Sequence[Publication]:
        robot, known = self._hear(ids, at)
        if at.now - known.pose_at >= POSE_PERIOD_S - _EARLY_S:
            self._put_pose(robot, known, pose, at.now)
        else:
            known.pending = pose
        return ()

    def _put_pose(self, robot: str, known: _Robot, pose: RobotPose, now: float) -> None:
        known.pending, known.pose_at = None, now
        self._put("pose", robot, pose)

    def _on_state(self, ids: Ids, state: RobotState, at: Moment) -> Sequence[Publication]:
        robot, known = self._hear(ids, at)
        before = known.state is not None and known.state.mode == "FAULT"
        if (state.mode == "FAULT") != before:
            why = ([], []) if before else (list(state.reasons), list(state.codes))
            self.faults.append(Fault(at.stamp, robot, not before, *why))
        known.state = state
        self._put_robot(robot)
        return ()

    def _on_goal(self, ids: Ids, goal: RobotGoal, at: Moment) -> Sequence[Publication]:
        robot, known = self._robot(ids, at)
        known.goal = goal
        if goal.pose is None:
            known.path = None
            self._remove("path", robot, at.now)
        self._put_robot(robot)
        return ()

    def _on_path(self, ids: Ids, path: RobotPath, at: Moment) -> Sequence[Publication]:
        robot, known = self._robot(ids, at)
        known.path = path
        view = PathView(plan_id=path.plan_id, points=path.points, released_length=path.released_length)
        self._put("path", robot, view)
        self._put_robot(robot)
        return ()

    def _on_release(self, ids: Ids, release: RobotRelease, at: Moment) -> Sequence[Publication]:
        robot, known = self._robot(ids, at)
        if known.path is not None:
            known.path = known.path.after(release)
            self._put_robot(robot)
        return ()

    def _on_obstacles(self, ids: Ids, obstacles: RobotObstacles, at: Moment) -> Sequence[Publication]:
        robot, known = self._hear(ids, at)
        known.obstacles = obstacles
        self._put("obstacles", robot, obstacles)
        return ()

    def _on_vitals(self, ids: Ids, vitals: RobotVitals, at: Moment) -> Sequence[Publication]:
        robot, known = self._hear(ids, at)
        view = VitalsView(
            stamp=at.stamp,  # this service's clock, by which all robots and what is replayed can be compared
            cpu=vitals.cpu,
            wifi_dbm=vitals.wifi_dbm,
            battery=None if known.state is None else known.state.battery,
        )
        known.vitals.append(view)
        self._put("vitals", robot, view)
        return ()

    def vitals(self, robot: str) -> list[VitalsView]:
        """Return how a robot did in the last ten minutes, oldest first."""
        known = self._robots.get(robot)
        return [] if known is None else list(known.vitals)

    def floor(self, now: float) -> tuple[list[FloorRobot], dict[AreaState, list[str]]]:
        """Return the robots of this floor at `now` (s, monotonic), and its areas by what they count as, sorted."""
        robots = [
            FloorRobot(
                id=robot,
                age_s=None if known.heard == -math.inf else round(now - known.heard, 1),
                mode=None if known.state is None else known.state.mode,
                enabled=None if known.state is None else known.state.enabled,
                codes=[] if known.state is None else list(known.state.codes),
            )
            for robot, known in sorted(self._robots.items())
        ]
        areas: dict[AreaState, list[str]] = {}
        for area, value in sorted(self._fetched["area"].items()):
            areas.setdefault(self._shown.state(area, value.get("hazard")), []).append(area)
        return robots, areas

    def scan(self, robot: str) -> bytes | None:
        """Return what a robot's lidar sees by its last report, as an event's data; None if it told no view."""
        known = self._robots.get(robot)
        if known is None or known.obstacles is None or known.obstacles.view is None:
            return None
        view = scan_view(known.obstacles.view, known.obstacles.stamp)
        return msgspec.json.encode(Thing(id=robot, value=view))

    def _put_robot(self, robot: str) -> None:
        known = self._robots[robot]
        view = RobotSummary(
            id=robot,
            configured=known.described is not None,
            state=known.state,
            goal=GoalView.of(robot, known.goal),
            plan=PlanView.of(known.path),
            out_of_service=None if known.goal is None else known.goal.out_of_service,
            start=None if known.described is None else known.described.start,
            dock=None if known.described is None else known.described.dock,
        )
        self._put("robot", robot, view)

    # --- Areas, nodes, alerts: fetched, and told at once where a message has it --------------------------------------

    def _on_hazard(self, ids: Ids, hazard: AreaHazard, at: Moment) -> Sequence[Publication]:
        area = self._fetched["area"].get(ids["area"])
        if area is not None:
            area["hazard"] = msgspec.to_builtins(hazard)
            self._put_fetched("area", ids["area"], area, at.now)
        self.wanted.update(dict.fromkeys(("area", "node")))
        return ()

    def _on_shown(self, ids: Ids, shown: HazardArea, at: Moment) -> Sequence[Publication]:
        self._shown.on_hazard(ids["area"], shown)
        if (area := self._fetched["area"].get(ids["area"])) is not None:
            self._put_fetched("area", ids["area"], area, at.now)
        return ()

    def _tell_areas(self, now: float) -> None:
        """Tell all areas anew if the map-service has fallen silent, or is heard again."""
        if self._shown.has_turned(now):
            for area, value in self._fetched["area"].items():
                self._put_fetched("area", area, value, now)

    def _on_definition(self, _ids: Ids, _definition: AreaDefinition, _at: Moment) -> Sequence[Publication]:
        self.wanted["area"] = None
        return ()

    def _on_availability(self, _ids: Ids, _text: str, _at: Moment) -> Sequence[Publication]:
        self.wanted["node"] = None
        return ()

    def _on_alerts(self, _ids: Ids, _alerts: AlertList, _at: Moment) -> Sequence[Publication]:
        self.wanted["alert"] = None
        return ()

    @property
    def areas(self) -> list[str]:
        """The ids of all areas."""
        return list(self._fetched["area"])

    def on_fetched(self, event: Fetched, found: Mapping[str, Any], now: float) -> None:
        """Take over all things of one kind by their ids, as REST has them, without those that are gone."""
        known = self._fetched[event]
        if event == "node":
            found = {thing: {**self._nodes.get(value["id"], {}), **value} for thing, value in found.items()}
        elif event == "area":
            for area, value in found.items():
                value["hazard"] = _newer(value.get("hazard"), known.get(area, {}).get("hazard"))
        for thing in known.keys() - found.keys():
            self._remove(event, thing, now)
            self._refreshed.pop((event, thing), None)
        self._fetched[event] = dict(found)
        for thing, value in found.items():
            self._put_fetched(event, thing, value, now)

    def _put_fetched(self, event: Fetched, thing: str, value: Any, now: float) -> None:  # noqa: ANN401  # JSON
        """Tell a thing if it has changed, or if what always changes in it was told long ago."""
        if event == "area":
            value = {**value, "on_map": self._shown.view(thing, value.get("hazard"))}
        lasting = msgspec.json.encode(_without(value, VOLATILE.get(event, ())))
        before, told_at = self._refreshed.get((event, thing), (b"", -math.inf))
        if lasting != before or (event in VOLATILE and now - told_at >= REFRESH_S):
            self._refreshed[event, thing] = lasting, now
            self._put(event, thing, value)

    # --- Places and the audit trail ---------------------------------------------------------------------------------

    def on_places(self, places: Mapping[str, Any], now: float) -> None:
        """Take over all places."""
        self._put_all("place", places, now)

    def _on_places(self, _ids: Ids, heard: PlaceSet, at: Moment) -> Sequence[Publication]:
        self.on_places(heard.places, at.now)
        return ()

    def on_record(self, name: str, record: msgspec.Struct) -> None:
        """Take over the next entry of the audit trail, by its name."""
        self.log.put("record", name, msgspec.json.encode(record))
        self._records.append(name)
        if len(self._records) > RECORDS:
            self.log.forget("record", self._records.popleft())

    # --- The log ----------------------------------------------------------------------------------------------------

    def _put(self, event: str, thing: str, value: Any) -> None:  # noqa: ANN401  # whatever becomes JSON
        self.log.put(event, thing, msgspec.json.encode(Thing(id=thing, value=value)))

    def _put_all(self, event: str, found: Mapping[str, Any], now: float) -> None:
        for thing in [each for each in self.log.things(event) if each not in found]:
            self._remove(event, thing, now)
        for thing, value in found.items():
            self._put(event, thing, value)

    def _remove(self, event: str, thing: str, now: float) -> None:
        self.log.remove(event, thing, msgspec.json.encode(Thing(id=thing, value=None)), now)


def _newer(found: Any, known: Any) -> Any:  # noqa: ANN401  # JSON
    """Return the later one of an area's hazards: the answer of REST may be older than a message."""
    if found is None or known is None:
        return found
    return known if (known["epoch"], known["seq"]) > (found["epoch"], found["seq"]) else found


def _without(value: Any, names: Sequence[str]) -> Any:  # noqa: ANN401  # JSON
    if not isinstance(value, dict):
        return value
    return {name: _without(part, names) for name, part in value.items() if name not in names}
