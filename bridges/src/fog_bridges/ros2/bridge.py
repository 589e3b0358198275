"""Tells robots of ROS 2 what a floor knows, and takes goals from them.

What blocks goes out at once, what clears at most twice a second. Whoever comes late is given the map and the masks at
once. A floor that falls silent becomes slow everywhere, as it does for the floor's own robots.
"""

from __future__ import annotations

import asyncio
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from fog_bridges.floor import Request
from fog_bridges.heard import Heard
from fog_bridges.ros2 import messages as ros
from fog_bridges.ros2.advice import GOAL_TYPE, Advice
from fog_bridges.ros2.others import Others, thing_id
from fog_bridges.ros2.wire import RosMessage, Topic, WireError
from fog_contracts import channels as ch
from fog_contracts.codec import ContractError
from fog_contracts.costs import DEGRADED_SPEED
from fog_contracts.follower import MapFollower
from fog_contracts.grid import Window
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
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from fog_bridges.floor import Floor
    from fog_bridges.ros2.dds import DdsSession, DdsWire
    from fog_bridges.ros2.rmf import Traffic
    from fog_bridges.ros2.session import RosSession, ZenohWire
    from fog_contracts.grid import GridGeometry
    from fog_contracts.messages import Reported, Zone
    from fog_runtime.clock import Clock
    from fog_runtime.credentials import Credentials

CLEARING_S: Final = 0.5
"""The shortest time between two masks of which the later one blocks nothing new."""
SILENT_S: Final = 2.0
"""A map that nobody has confirmed for so long is old: the whole floor becomes slow."""
TICK_S: Final = 0.1
SNAPSHOT_TIMEOUT_S: Final = 3.0
GOALS_AT_ONCE: Final = 20
GOAL_MAX_AGE_S: Final = 10.0
"""An older goal is refused: who sent it may have forgotten it."""
MAP_TYPE: Final = "nav_msgs/msg/OccupancyGrid"
INFO_TYPE: Final = "nav2_msgs/msg/CostmapFilterInfo"
POSE_TYPE: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"
TF_TYPE: Final = "tf2_msgs/msg/TFMessage"
OBSTACLES_TYPE: Final = "rmf_obstacle_msgs/msg/Obstacles"
LANES_TYPE: Final = "rmf_fleet_msgs/msg/LaneRequest"
LIMITS_TYPE: Final = "rmf_fleet_msgs/msg/SpeedLimitRequest"

_log = logs.get("ros2")


class Ros2Bridge:
    """The adapter for ROS 2."""

    name: Final = "ros2"

    def __init__(  # both sides that it connects
        self, site: str, wire: ZenohWire | DdsWire, connect: Sequence[str], own: Credentials,
        others: Mapping[str, float], traffic: Traffic | None = None,
    ) -> None:  # fmt: skip
        """Serve those who are reached by `wire`; `connect` are the floor's routers, for whom `own` are.

        `others` are the robots of others, each with its radius (m); `traffic` has the lanes of Open-RMF's fleets.
        """
        self._others, self._traffic = others, traffic
        self._site = site
        self._wire = wire
        self._connect = connect
        self._own = own
        self._problem = "not connected yet"

    @property
    def problem(self) -> str:
        """Why ROS is told nothing; empty while it is."""
        return self._problem and (self._wire.problem or self._problem)

    def on_event(self, name: str, data: dict[str, Any]) -> None:
        """Do nothing: the floor's own channels are faster than its console."""

    def on_lost(self) -> None:
        """Do nothing, likewise."""

    async def run(self, floor: Floor, clock: Clock) -> None:
        """Connect, and do all until cancelled."""
        session = await self._wire.opened(f"fognav_{ros.ros_name(self._site)}", clock)
        self._wire.problem = ""
        opened = ZenohEdge.open(
            connect=self._connect, clock=clock, role=ch.BRIDGE, id=self._site, site=self._site, credentials=self._own
        )
        try:
            async with opened as fog, asyncio.TaskGroup() as tasks:
                level = "" if self._traffic is None else self._traffic.level
                relay = Relay(fog, session, floor, clock, Others(self._others, level), self._traffic)
                relay.subscribe()
                tasks.create_task(relay.snapshot_loop(), name="snapshot")
                tasks.create_task(relay.map_loop(), name="map")
                tasks.create_task(relay.goal_loop(), name="goals")
                tasks.create_task(relay.advice.loop(), name="advice")
                async for _ in ticker(clock, TICK_S):
                    self._problem = _problem(fog, session, relay)
        finally:
            session.close()


def _problem(fog: ZenohEdge, session: RosSession | DdsSession, relay: Relay) -> str:
    if not fog.connected:
        return "the floor's router is not connected"
    if session.problem:
        return session.problem
    if relay.map_age_s > SILENT_S:
        return "the map-service is silent: the whole floor is slow"
    return ""


class Relay:
    """What is told between a floor and a node of ROS; its loops are tasks of the adapter."""

    def __init__(  # both sides, and what they tell each other by
        self,
        fog: ZenohEdge,
        session: RosSession | DdsSession,
        floor: Floor,
        clock: Clock,
        others: Others,
        traffic: Traffic | None = None,
    ) -> None:
        """Pass on what `fog` hears on `session`, goals to `floor`, and robots of others to the map."""
        self._fog = fog
        self._session = session
        self._floor = floor
        self._clock = clock
        base = f"fognav/{ros.ros_name(fog.site)}"
        self._map = Topic(f"{base}/map", MAP_TYPE, latched=True)
        self._keepout = Topic(f"{base}/keepout_mask", MAP_TYPE, latched=True)
        self._speed = Topic(f"{base}/speed_mask", MAP_TYPE, latched=True)
        self._markers = Topic(f"{base}/hazards", "visualization_msgs/msg/MarkerArray", latched=True)
        self._infos = {
            ros.KEEPOUT: (Topic(f"{base}/keepout_filter_info", INFO_TYPE, latched=True), self._keepout.name),
            ros.SPEED: (Topic(f"{base}/speed_filter_info", INFO_TYPE, latched=True), self._speed.name),
        }
        self._follower = MapFollower()
        self._geometry: GridGeometry | None = None
        self._static: NDArray[np.uint8] = np.zeros((0, 0), np.uint8)
        self._told: dict[Topic, NDArray[np.int8]] = {}
        self._window: Window | None = None
        """The part of the floor that keepout masks have: all that was ever blocked, so that it is cleared, too."""
        self._told_at = 0.0
        self._dirty: set[Topic] = set()
        """The masks that may have changed."""
        self._is_slow = False
        self._hazards: dict[str, HazardArea] = {}
        self._zones = ZoneSet(epoch=0, seq=0, zones=[], active=[])
        self._others, self._traffic = others, traffic
        self.advice = Advice(session, floor, clock, others)
        self._penalties: NDArray[np.int8] | None = None
        """What the zones in force add to the keepout mask; None: to be computed anew, as is `_closed`."""
        self._closed: NDArray[np.bool_] | None = None
        self._driving: dict[str, str | None] = {}
        """The goal that each robot has, by its last state."""
        self._heard = Heard()
        self._stopped: set[str] = set()
        """Robots that wait for an operator."""
        self._goals: asyncio.Queue[tuple[str, float, Request]] = asyncio.Queue(GOALS_AT_ONCE)

    def subscribe(self) -> None:
        """Register subscriptions, and tell what the masks are."""
        fog = self._fog
        fog.subscribe(ch.MAP_DELTA, MapDelta, self._on_delta)
        fog.subscribe(ch.MAP_HEARTBEAT, MapHeartbeat, lambda _, beat: self._follower.on_heartbeat(beat, self._now()))
        fog.subscribe(ch.HAZARD, HazardArea, self._on_hazard)
        fog.subscribe(ch.ZONES, ZoneSet, self._on_zones)
        fog.subscribe(ch.ROBOT_STATE, RobotState, self._on_state)
        fog.subscribe(ch.ROBOT_POSE, RobotPose, self._on_pose)
        fog.subscribe(ch.ROBOT_PATH, RobotPath, self._on_path)
        fog.subscribe(ch.ROBOT_OBSTACLES, RobotObstacles, self._on_view)
        for name in self._others.radii:
            self._session.subscribe(Topic(f"{name}/amcl_pose", POSE_TYPE), partial(self._on_other_pose, name))
            self._session.subscribe(Topic(f"{name}/tf", TF_TYPE), partial(self._on_other_tf, name))
        self.advice.subscribe()
        self._session.subscribe(Topic("rmf_obstacles", OBSTACLES_TYPE), self._on_obstacles)
        for kind, (topic, mask) in self._infos.items():
            self._session.publish(topic, ros.filter_info(kind, mask, self._stamp()), self._stamp())

    async def snapshot_loop(self) -> None:
        """Fetch the map whenever its deltas alone do not lead to the newest one."""
        async for now in ticker(self._clock, TICK_S):
            if self._follower.wants_snapshot(now):
                await self._load()

    async def map_loop(self) -> None:
        """Tell what has changed, and what has become old: also while a snapshot is waited for."""
        async for _ in ticker(self._clock, TICK_S):
            if self._others.moves_away(self._now()):
                self._dirty.add(self._keepout)
            self._tell_masks()

    async def goal_loop(self) -> None:
        """Pass on goals, one after the other."""
        while True:
            robot, arrived, request = await self._goals.get()
            waited = self._now() - arrived
            if waited > GOAL_MAX_AGE_S:
                self._session.refuse("old", f"{robot}/goal_pose", f"it has waited for {waited:.0f} s: send it again")
            elif refusal := self._refusal(robot) or await self._floor.send(request):
                self._session.refuse("goal", f"{robot}/goal_pose", refusal)

    # --- The map ------------------------------------------------------------------------------------------------------

    async def _load(self) -> None:
        try:
            snapshot = await self._fog.query(ch.MAP_SNAPSHOT, None, MapSnapshot, SNAPSHOT_TIMEOUT_S)
            if snapshot is None:
                return  # the map-service does not answer: readiness says so
            loaded = await asyncio.to_thread(partial(decode_map, snapshot))
            self._follower.on_snapshot(loaded, self._now())
        except (MapError, ContractError) as error:
            _log.warning("map_refused", reason=str(error))
            return
        self._dirty |= {self._keepout, self._speed}

    def _on_delta(self, _: Mapping[str, str], delta: MapDelta) -> None:
        if (applied := self._follower.on_delta(delta, self._now())) is not None:
            self._dirty |= {self._keepout if layer == "cost" else self._speed for layer, _ in applied.windows}
            self._tell_masks()

    def _tell_masks(self) -> None:
        """Publish the masks that have changed: at once if they block more, a little later otherwise."""
        replica, now, stamp = self._follower.replica, self._now(), self._stamp()
        if replica.geometry is None:
            return
        if replica.static is not self._static:  # a snapshot was loaded: another map may have the same geometry
            same = replica.geometry == self._geometry and np.array_equal(replica.static, self._static)
            self._static = replica.static
            if not same:
                self._geometry, self._told, self._window = replica.geometry, {}, None
                self._dirty |= {self._keepout, self._speed}
                self._penalties = self._closed = None
                told = ros.grid(ros.map_values(replica.static), replica.geometry, stamp)
                self._session.publish(self._map, told, stamp)
                self._tell_markers()
        is_slow = self.map_age_s > SILENT_S
        if is_slow != self._is_slow:
            self._is_slow = is_slow
            self._dirty.add(self._speed)
        if not self._dirty:
            self._tell_traffic()
            return
        limit = DEGRADED_SPEED / 100.0 if is_slow else None
        fresh = {}
        if self._keepout in self._dirty:
            fresh[self._keepout] = self._keepout_mask(replica.cost, replica.geometry)
        if self._speed in self._dirty:
            fresh[self._speed] = ros.speed_values(replica.speed, limit)
        changed = {topic: values for topic, values in fresh.items() if self._differs(topic, values)}
        if now - self._told_at < CLEARING_S and not any(map(self._blocks_more, changed, changed.values())):
            return
        self._dirty.clear()
        for topic, values in changed.items():
            self._told[topic], self._told_at = values, now
            self._session.publish(topic, ros.grid(values, replica.geometry, stamp, self._part(topic, values)), stamp)
        self._tell_traffic()

    def _part(self, topic: Topic, values: NDArray[np.int8]) -> Window | None:
        """Return which part of the floor a mask has; None: all of it."""
        if topic != self._keepout:
            return None
        self._window = ros.covering(values, self._window)
        return self._window or Window(0, 0, 1, 1)

    def _tell_traffic(self) -> None:
        """Tell Open-RMF which lanes are closed or slow, by the masks that were told, and what stands there."""
        traffic, geometry, now, stamp = self._traffic, self._geometry, self._now(), self._stamp()
        if traffic is None or geometry is None or not {self._keepout, self._speed} <= self._told.keys():
            return
        if traffic.update(self._told[self._keepout], self._told[self._speed], geometry, now):
            for request in traffic.lane_requests():
                self._session.publish(Topic("lane_closure_requests", LANES_TYPE), request, stamp)
            for request in traffic.speed_requests():
                self._session.publish(Topic("speed_limit_requests", LIMITS_TYPE), request, stamp)
            told = traffic.obstacles(self._hazards, self._in_force(), geometry, stamp)
            self._session.publish(Topic("rmf_obstacles", OBSTACLES_TYPE), told, stamp)

    def _keepout_mask(self, cost: NDArray[np.uint8], geometry: GridGeometry) -> NDArray[np.int8]:
        mask = ros.keepout_values(cost, self._static)
        if self._others.radii:
            if self._closed is None:
                self._closed = ros.closed_cells(self._hazards.values(), self._in_force(), geometry)
            mask = self._others.without_robots(mask, geometry, self._closed)
        if self._penalties is None:
            self._penalties = ros.penalty_values(self._in_force(), geometry)
        return np.maximum(mask, self._penalties) if self._penalties.size else mask

    def _differs(self, topic: Topic, values: NDArray[np.int8]) -> bool:
        return topic not in self._told or not np.array_equal(self._told[topic], values)

    def _blocks_more(self, topic: Topic, values: NDArray[np.int8]) -> bool:
        """Whether a mask forbids somewhere what the one before allowed."""
        before = self._told.get(topic)
        if before is None:
            return True
        if topic == self._keepout:
            return bool(np.any(values > before))
        return bool(np.any((values != 0) & ((before == 0) | (values < before))))

    @property
    def map_age_s(self) -> float:
        """How long ago the map was confirmed last (s)."""
        return self._follower.age(self._now())

    # --- Hazards, zones and robots ------------------------------------------------------------------------------------

    def _on_hazard(self, ids: Mapping[str, str], hazard: HazardArea) -> None:
        self._hazards[ids["area"]] = hazard
        self._closed = None
        self._dirty.add(self._keepout)
        self._tell_markers()

    def _on_zones(self, _: Mapping[str, str], zones: ZoneSet) -> None:
        self._zones = zones
        self._penalties = self._closed = None
        self._dirty.add(self._keepout)
        self._tell_markers()

    def _in_force(self) -> list[Zone]:
        active = set(self._zones.active)
        return [zone for zone in self._zones.zones if zone.id in active]

    def _tell_markers(self) -> None:
        stamp = self._stamp()
        self._session.publish(self._markers, ros.markers(self._hazards, self._in_force(), self._geometry, stamp), stamp)

    def _on_state(self, ids: Mapping[str, str], state: RobotState) -> None:
        robot = ids["robot"]
        if robot not in self._driving:
            goal = Topic(f"{ros.ros_name(robot)}/goal_pose", GOAL_TYPE)
            self._session.subscribe(goal, partial(self._on_goal, robot), GOAL_MAX_AGE_S)
        self._heard.hear(robot, self._now())
        (self._stopped.discard if state.enabled and not state.awaits_operator else self._stopped.add)(robot)
        goal_id = None if state.goal_reached else state.goal_id
        if goal_id is None and self._driving.get(robot) is not None:
            self._tell(robot, "plan", "nav_msgs/msg/Path", ros.path(None, self._stamp()))
        self._driving[robot] = goal_id
        self._tell(robot, "battery_state", "sensor_msgs/msg/BatteryState", ros.battery(state, self._stamp()))

    def _on_pose(self, ids: Mapping[str, str], pose: RobotPose) -> None:
        robot = ids["robot"]
        if not pose.localized:
            return  # no place is better than a wrong one
        self._session.publish(
            Topic("tf", "tf2_msgs/msg/TFMessage"),
            ros.transform(pose.x, pose.y, pose.theta, f"{ros.ros_name(robot)}/base_footprint", pose.stamp),
            self._stamp(),
        )
        self._tell(robot, "pose", "geometry_msgs/msg/PoseWithCovarianceStamped", ros.robot_pose(pose))

    def _on_path(self, ids: Mapping[str, str], path: RobotPath) -> None:
        self._tell(ids["robot"], "plan", "nav_msgs/msg/Path", ros.path(path, self._stamp()))

    def _on_view(self, ids: Mapping[str, str], seen: RobotObstacles) -> None:
        if (view := seen.view) is not None:
            robot, stamp = ids["robot"], self._stamp()
            frame = ros.transform(view.x, view.y, 0.0, f"{ros.ros_name(robot)}/view", stamp)
            self._session.publish(Topic("tf", TF_TYPE), frame, stamp)
            self._tell(robot, "scan", "sensor_msgs/msg/LaserScan", ros.scan(view, robot, stamp))

    def _tell(self, robot: str, name: str, kind: str, message: object) -> None:
        self._session.publish(Topic(f"{ros.ros_name(robot)}/{name}", kind), message, self._stamp())

    def _on_goal(self, robot: str, goal: RosMessage) -> None:
        x, y = goal.pose.position.x, goal.pose.position.y
        theta = ros.heading(goal.pose.orientation)
        if goal.header.frame_id not in ("", ros.MAP_FRAME):
            frame = goal.header.frame_id[:40]
            raise WireError(f"a goal in the frame {frame!r}: send it in {ros.MAP_FRAME!r}", "frame")
        if not np.isfinite((x, y)).all():
            raise WireError(f"a goal at ({x}, {y})")
        if refusal := self._refusal(robot):
            raise WireError(refusal, "goal")
        pose = {"x": x, "y": y} | ({} if theta is None else {"theta": theta})
        request = Request("PUT", f"/api/v1/robots/{robot}/goal", {"pose": pose})
        try:
            self._goals.put_nowait((robot, self._now(), request))
        except asyncio.QueueFull:
            raise WireError(f"{GOALS_AT_ONCE} goals wait already", "too_many") from None

    def _refusal(self, robot: str) -> str:
        return self._heard.refusal(robot, self._now(), waits=robot in self._stopped)

    # --- Robots of others, and obstacles ------------------------------------------------------------------------------

    def _on_other_pose(self, name: str, told: RosMessage) -> None:
        self._report(thing_id(name), self._others.on_pose(name, told, self._now()))

    def _on_other_tf(self, name: str, told: RosMessage) -> None:
        self._report(thing_id(name), self._others.on_transforms(name, told, self._now()))

    def _on_obstacles(self, told: RosMessage) -> None:
        def refuse(error: WireError) -> None:
            self._session.refuse(error.reason, "rmf_obstacles", str(error))

        for thing, report in self._others.on_obstacles(told, self._now(), refuse):
            self._report(thing, report)

    def _report(self, thing: str, report: Reported | None) -> None:
        if report is not None:
            self._fog.publish(ch.REPORTED, report, thing=thing)

    def _now(self) -> float:
        return self._clock.now()

    def _stamp(self) -> float:
        return self._clock.stamp()
