"""Shows a floor live to Foxglove: its costmap, hazards, zones, and where its robots are, go and look.

Viewers come by the console's address (`/api/v1/foxglove`), by a token of the role `viewer`. They change nothing.
"""

from __future__ import annotations

import asyncio
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import msgspec
from foxglove import messages as fox
from starlette.routing import WebSocketRoute

from fog_bridges.foxglove import messages
from fog_bridges.foxglove.protocol import Schema
from fog_bridges.foxglove.viewers import ROUTE, Viewers
from fog_contracts import channels as ch
from fog_contracts.codec import ContractError, json_schema
from fog_contracts.follower import MapFollower
from fog_contracts.messages import (
    HazardArea,
    MapDelta,
    MapHeartbeat,
    MapSnapshot,
    RobotObstacles,
    RobotPath,
    RobotPose,
    RobotState,
    ZoneSet,
)
from fog_contracts.replica import MapError, decode_map
from fog_runtime import logs
from fog_runtime.clock import ticker
from fog_runtime.transports.zenoh_edge import ZenohEdge

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from fog_bridges.floor import Floor
    from fog_bridges.foxglove.protocol import Value
    from fog_contracts.grid import GridGeometry
    from fog_contracts.replica import Replica
    from fog_runtime.clock import Clock
    from fog_runtime.credentials import Credentials

TICK_S: Final = 0.1
SNAPSHOT_TIMEOUT_S: Final = 3.0
_log = logs.get("map")


class FollowedMap:
    """A copy of the costmap that stays up to date while `run` runs."""

    def __init__(self, fog: ZenohEdge, clock: Clock, on_change: Callable[[], object]) -> None:
        """Call `on_change` whenever the copy has changed."""
        self._fog = fog
        self._clock = clock
        self._on_change = on_change
        self._follower = MapFollower()

    @property
    def replica(self) -> Replica:
        """The copy."""
        return self._follower.replica

    @property
    def age_s(self) -> float:
        """How long ago the map was confirmed last (s)."""
        return self._follower.age(self._clock.now())

    async def run(self) -> None:
        """Subscribe, and fetch the map whenever its deltas alone do not lead to the newest one. Never returns."""
        self._fog.subscribe(ch.MAP_DELTA, MapDelta, self._on_delta)
        self._fog.subscribe(ch.MAP_HEARTBEAT, MapHeartbeat, self._on_heartbeat)
        async for now in ticker(self._clock, TICK_S):
            if self._follower.wants_snapshot(now):
                await self._load()

    async def _load(self) -> None:
        try:
            snapshot = await self._fog.query(ch.MAP_SNAPSHOT, None, MapSnapshot, SNAPSHOT_TIMEOUT_S)
            if snapshot is None:
                return  # the map-service does not answer: readiness says so
            loaded = await asyncio.to_thread(partial(decode_map, snapshot))
            self._follower.on_snapshot(loaded, self._clock.now())
        except (MapError, ContractError) as error:
            _log.warning("map_refused", reason=str(error))
            return
        self._on_change()

    def _on_delta(self, _: Mapping[str, str], delta: MapDelta) -> None:
        if self._follower.on_delta(delta, self._clock.now()) is not None:
            self._on_change()

    def _on_heartbeat(self, _: Mapping[str, str], heartbeat: MapHeartbeat) -> None:
        self._follower.on_heartbeat(heartbeat, self._clock.now())


COSTMAP_S: Final = 0.5
"""The shortest time between two costmaps; what changes meanwhile is in the next one."""
SILENT_S: Final = 2.0
"""A map that nobody has confirmed for so long is old."""
_PROTOBUF: Final = "protobuf"
_STATE: Final = Schema("fognav.RobotState", "jsonschema", json_schema(RobotState))


def _schema(kind: Any) -> Schema:  # noqa: ANN401  # each of the SDK's messages, which have no base class
    found = kind.get_schema()
    return Schema(found.name, found.encoding, found.data)


_GRID: Final = _schema(fox.Grid)
_SCENE: Final = _schema(fox.SceneUpdate)
_POSE: Final = _schema(fox.PoseInFrame)
_TRANSFORM: Final = _schema(fox.FrameTransform)
_PATH: Final = _schema(fox.PosesInFrame)
_SCAN: Final = _schema(fox.LaserScan)


class FoxgloveBridge:
    """The adapter for Foxglove."""

    name: Final = "foxglove"

    def __init__(self, site: str, connect: Sequence[str], own: Credentials) -> None:
        """Show the floor of the routers `connect`, for whom `own` are."""
        self._site = site
        self._connect = connect
        self._own = own
        self._shown: Shown | None = None
        self._viewers = Viewers(f"Fognav {site}", lambda: {} if self._shown is None else self._shown.parameters())
        self.routes: Final = [WebSocketRoute(ROUTE, self._viewers.serve)]
        """What the bridge serves over HTTP."""
        self.problem = "not connected yet"
        """Why viewers see nothing, or nothing new; empty while they do."""

    def on_event(self, name: str, data: dict[str, Any]) -> None:
        """Do nothing: the floor's own channels are faster than its console."""

    def on_lost(self) -> None:
        """Do nothing, likewise."""

    async def run(self, floor: Floor, clock: Clock) -> None:
        """Connect, and do all until cancelled."""
        self._viewers.floor = floor
        opened = ZenohEdge.open(
            connect=self._connect, clock=clock, role=ch.BRIDGE, id=f"{self._site}-foxglove", site=self._site,
            credentials=self._own,
        )  # fmt: skip
        async with opened as fog, asyncio.TaskGroup() as tasks:
            shown = self._shown = Shown(fog, self._viewers, clock)
            tasks.create_task(shown.map.run(), name="map")
            async for _ in ticker(clock, COSTMAP_S):
                shown.show_map()
                self.problem = ""
                if not fog.connected:
                    self.problem = "the floor's router is not connected"
                elif shown.map.age_s > SILENT_S:
                    self.problem = "the map-service is silent: the costmap is old"


class Shown:
    """What of a floor is shown, and the newest of it."""

    def __init__(self, fog: ZenohEdge, viewers: Viewers, clock: Clock) -> None:
        """Show to `viewers` what `fog` hears."""
        self._site = fog.site
        self._viewers = viewers
        self._clock = clock
        self._is_dirty = False
        self._hazards: dict[str, HazardArea] = {}
        self._zones = ZoneSet(epoch=0, seq=0, zones=[], active=[])
        self._states: dict[str, RobotState] = {}
        self._drawn_on: GridGeometry | None = None
        """The map of whose cells the zones are drawn."""
        self.map = FollowedMap(fog, clock, self._on_map)
        fog.subscribe(ch.HAZARD, HazardArea, self._on_hazard)
        fog.subscribe(ch.ZONES, ZoneSet, self._on_zones)
        fog.subscribe(ch.ROBOT_POSE, RobotPose, self._on_pose)
        fog.subscribe(ch.ROBOT_PATH, RobotPath, self._on_path)
        fog.subscribe(ch.ROBOT_STATE, RobotState, self._on_state)
        fog.subscribe(ch.ROBOT_OBSTACLES, RobotObstacles, self._on_obstacles)

    def parameters(self) -> Mapping[str, Value]:
        """Return what can be read besides messages."""
        version, geometry = self.map.replica.version, self.map.replica.geometry
        values: dict[str, Value] = {"site": self._site}
        if version is not None and geometry is not None:
            values |= {
                "map.epoch": version.epoch, "map.seq": version.seq, "map.age_s": min(self.map.age_s, 1e9),
                "map.resolution": geometry.resolution, "map.width": geometry.width, "map.height": geometry.height,
            }  # fmt: skip
        values |= {f"areas.{area}.state": hazard.hazard.state for area, hazard in self._hazards.items()}
        for robot, state in self._states.items():
            values |= {f"robots.{robot}.mode": state.mode, f"robots.{robot}.enabled": state.enabled}
            if state.battery is not None:
                values[f"robots.{robot}.battery"] = state.battery
        return values

    def show_map(self) -> None:
        """Show the costmap if it has changed since."""
        replica, stamp = self.map.replica, self._clock.stamp()
        if self._is_dirty and replica.geometry is not None:
            self._is_dirty = False
            make = partial(messages.costmap, replica.cost, replica.geometry, stamp)
            self._viewers.post("/costmap", _PROTOBUF, _GRID, make, stamp)

    def _on_map(self) -> None:
        self._is_dirty = True
        if self.map.replica.geometry != self._drawn_on:
            self._show_zones()

    def _on_hazard(self, ids: Mapping[str, str], hazard: HazardArea) -> None:
        self._hazards[ids["area"]] = hazard
        stamp = self._clock.stamp()
        make = partial(messages.hazards, dict(self._hazards), stamp)
        self._viewers.post("/hazards", _PROTOBUF, _SCENE, make, stamp)

    def _on_zones(self, _: Mapping[str, str], zones: ZoneSet) -> None:
        self._zones = zones
        self._show_zones()

    def _show_zones(self) -> None:
        if (geometry := self.map.replica.geometry) is None:
            return
        self._drawn_on = geometry
        active, stamp = set(self._zones.active), self._clock.stamp()
        in_force = [zone for zone in self._zones.zones if zone.id in active]
        make = partial(messages.zones, in_force, geometry, stamp)
        self._viewers.post("/zones", _PROTOBUF, _SCENE, make, stamp)

    def _on_pose(self, ids: Mapping[str, str], pose: RobotPose) -> None:
        robot = ids["robot"]
        self._show(robot, "transform", _TRANSFORM, partial(messages.transform, pose, robot), pose.stamp)
        self._show(robot, "pose", _POSE, partial(messages.pose, pose), pose.stamp)
        self._show(robot, "shape", _SCENE, partial(messages.robot_shape, pose, robot), pose.stamp)

    def _on_path(self, ids: Mapping[str, str], path: RobotPath) -> None:
        stamp = self._clock.stamp()
        self._show(ids["robot"], "path", _PATH, partial(messages.path, path, stamp), stamp)

    def _on_state(self, ids: Mapping[str, str], state: RobotState) -> None:
        robot = ids["robot"]
        self._states[robot] = state
        make = partial(msgspec.json.encode, state)
        self._viewers.post(f"/robots/{robot}/state", "json", _STATE, make, self._clock.stamp())

    def _on_obstacles(self, ids: Mapping[str, str], obstacles: RobotObstacles) -> None:
        if obstacles.view is not None:
            self._show(ids["robot"], "scan", _SCAN, partial(messages.scan, obstacles), obstacles.stamp)

    def _show(self, robot: str, what: str, schema: Schema, make: partial[bytes], stamp: float) -> None:
        self._viewers.post(f"/robots/{robot}/{what}", _PROTOBUF, schema, make, stamp)
