"""Tells robots of ROS 2 what a floor knows, and takes goals from them.

What blocks goes out at once, what clears at most twice a second. Whoever comes late is given the map and the masks at
once. A floor that falls silent becomes slow everywhere, as it does for the floor's own robots.
"""

from __future__ import annotations

import asyncio
import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import zenoh
import zenoh.ext as ze
from prometheus_client import Counter

from fog_bridges.floor import Request
from fog_bridges.ros2 import messages as ros
from fog_bridges.ros2.wire import Attachment, Node, RosMessage, Topic, WireError, Writer, decoded, type_hash
from fog_contracts import channels as ch
from fog_contracts.codec import ContractError
from fog_contracts.costs import DEGRADED_SPEED
from fog_contracts.follower import MapFollower
from fog_contracts.messages import (
    HazardArea,
    MapDelta,
    MapHeartbeat,
    MapSnapshot,
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

    from numpy.typing import NDArray

    from fog_bridges.floor import Floor
    from fog_contracts.grid import GridGeometry
    from fog_runtime.clock import Clock
    from fog_runtime.credentials import Credentials

CLEARING_S: Final = 0.5
"""The shortest time between two masks of which the later one blocks nothing new."""
SILENT_S: Final = 2.0
"""A map that nobody has confirmed for so long is old: the whole floor becomes slow."""
TICK_S: Final = 0.1
SNAPSHOT_TIMEOUT_S: Final = 3.0
RETRY_S: Final = 1.0
_RETRY: Final = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5}
_NO_ROUTER: Final = "ROS's router (`ros2 run rmw_zenoh_cpp rmw_zenohd`) is not connected"
GOALS_AT_ONCE: Final = 20
MAP_TYPE: Final = "nav_msgs/msg/OccupancyGrid"
INFO_TYPE: Final = "nav2_msgs/msg/CostmapFilterInfo"
GOAL_TYPE: Final = "geometry_msgs/msg/PoseStamped"

REFUSED = Counter(
    "fognav_bridge_refused_messages_total", "Messages of other systems that were not understood", ["system", "reason"]
)
_log = logs.get("ros2")


def ros_config(source: Path | str) -> zenoh.Config:
    """Return the configuration of a session: that of a file, or that of a client of the router at an address.

    rmw_zenoh's own sessions are peers, which a router connects with one another only where they can't be reached
    directly; a client's messages always go by the router. Raises `ValueError`.
    """
    try:
        if isinstance(source, Path):
            return zenoh.Config.from_file(str(source))
        config = zenoh.Config()
        values = {
            "mode": "client", "connect/endpoints": [source], "connect/retry": _RETRY,
            "scouting/multicast/enabled": False, "timestamping/enabled": True,
        }  # fmt: skip
        for key, value in values.items():
            config.insert_json5(key, json.dumps(value))
    except zenoh.ZError as error:
        raise ValueError(f"{source} can't be used to reach ROS's router: {error}") from error
    return config


class RosSession:
    """A node of ROS on a zenoh session: publishers and subscribers with their tokens of presence.

    Subscribers' handlers are called on the event loop's thread.
    """

    def __init__(self, session: zenoh.Session, domain: int, name: str) -> None:
        """Introduce the node `name`."""
        self._session = session
        self._loop = asyncio.get_running_loop()
        self._domain = domain
        self._node = Node(domain, str(self._session.info.zid()), name)
        self._held: list[object] = [self._session.liveliness().declare_token(self._node.token)]
        self._writers: dict[Topic, tuple[Writer, Any]] = {}
        self._limited = logs.RateLimited(_log)

    @property
    def connected(self) -> bool:
        """Whether a router or a peer is connected."""
        info = self._session.info
        return bool(info.routers_zid() or info.peers_zid())

    def publish(self, topic: Topic, message: object, stamp: float) -> None:
        """Publish a message without waiting; `stamp` (s since 1970) is when."""
        if topic not in self._writers:
            self._writers[topic] = self._writer(topic)
        writer, publisher = self._writers[topic]
        payload, attachment = writer.encoded(message, int(stamp * 1e9))
        try:
            publisher.put(payload, attachment=attachment)
        except zenoh.ZError as error:
            self._limited.warning("message_dropped", topic.name, self._loop.time(), topic=topic.name, reason=str(error))

    def _writer(self, topic: Topic) -> tuple[Writer, Any]:
        token = self._node.entity("MP", topic)
        key = topic.key(self._domain)
        if topic.latched:
            publisher: Any = ze.declare_advanced_publisher(
                self._session, key, congestion_control=zenoh.CongestionControl.DROP, publisher_detection=True,
                cache=ze.CacheConfig(max_samples=1),
                sample_miss_detection=ze.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
            )  # fmt: skip
        else:
            publisher = self._session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
        self._held.append(self._session.liveliness().declare_token(token))
        return Writer(topic, token), publisher

    def subscribe(self, topic: Topic, handler: Callable[[RosMessage], object]) -> None:
        """Call a handler with each message; one of another definition of its type, or none, is counted and logged."""

        def on_sample(sample: zenoh.Sample) -> None:
            attachment = None if sample.attachment is None else sample.attachment.to_bytes()
            arrived = (str(sample.key_expr), sample.payload.to_bytes(), attachment)
            if not self._loop.is_closed():
                self._loop.call_soon_threadsafe(self._on_sample, topic, handler, *arrived)

        self._held.append(self._session.declare_subscriber(topic.any_hash(self._domain), on_sample))
        self._held.append(self._session.liveliness().declare_token(self._node.entity("MS", topic)))

    def _on_sample(
        self, topic: Topic, handler: Callable[[RosMessage], object], key: str, payload: bytes, attachment: bytes | None
    ) -> None:
        own, theirs = type_hash(topic.type), key.rpartition("/")[2]
        if theirs not in (own, "TypeHashNotSupported"):
            self.refuse("type_hash", topic.name, f"the sender's {topic.type} is {theirs}, and ours is {own}: "
                        "it was built with another version of the message's package")  # fmt: skip
            return
        try:
            Attachment.decoded(attachment or b"")
            message = decoded(topic, payload)
        except WireError as error:
            self.refuse("malformed", topic.name, str(error))
            return
        handler(message)

    def refuse(self, reason: str, topic: str, words: str) -> None:
        """Count and log a message that is not understood."""
        REFUSED.labels("ros2", reason).inc()
        self._limited.warning("message_refused", topic, self._loop.time(), topic=topic, reason=words)

    def close(self) -> None:
        """Close the session; its tokens go with it."""
        self._session.close()  # type: ignore[no-untyped-call]  # zenoh's stub has no types for it


class Ros2Bridge:
    """The adapter for ROS 2."""

    name: Final = "ros2"

    def __init__(self, site: str, config: zenoh.Config, domain: int, connect: Sequence[str], own: Credentials) -> None:
        """Serve the domain of the router that `config` connects to; `connect` are the floor's, for whom `own` are."""
        self._site = site
        self._config = config
        self._domain = domain
        self._connect = connect
        self._own = own
        self.problem = "not connected yet"
        """Why ROS is told nothing; empty while it is."""

    def on_event(self, name: str, data: dict[str, Any]) -> None:
        """Do nothing: the floor's own channels are faster than its console."""

    def on_lost(self) -> None:
        """Do nothing, likewise."""

    async def run(self, floor: Floor, clock: Clock) -> None:
        """Connect, and do all until cancelled."""
        session = RosSession(await self._opened(), self._domain, f"fognav_{ros.ros_name(self._site)}")
        opened = ZenohEdge.open(
            connect=self._connect, clock=clock, role=ch.BRIDGE, id=self._site, site=self._site, credentials=self._own
        )
        try:
            async with opened as fog, asyncio.TaskGroup() as tasks:
                relay = Relay(fog, session, floor, clock)
                relay.subscribe()
                tasks.create_task(relay.snapshot_loop(), name="snapshot")
                tasks.create_task(relay.map_loop(), name="map")
                tasks.create_task(relay.goal_loop(), name="goals")
                async for _ in ticker(clock, TICK_S):
                    self.problem = _problem(fog, session, relay)
        finally:
            session.close()

    async def _opened(self) -> zenoh.Session:
        """Open a session once the router is there; afterwards it connects again by itself."""
        while True:
            try:
                return await asyncio.to_thread(zenoh.open, self._config)
            except zenoh.ZError as error:
                self.problem = f"{_NO_ROUTER}: {error}"
            await asyncio.sleep(RETRY_S)


def _problem(fog: ZenohEdge, session: RosSession, relay: Relay) -> str:
    if not fog.connected:
        return "the floor's router is not connected"
    if not session.connected:
        return _NO_ROUTER
    if relay.map_age_s > SILENT_S:
        return "the map-service is silent: the whole floor is slow"
    return ""


class Relay:
    """What is told between a floor and a node of ROS; its loops are tasks of the adapter."""

    def __init__(self, fog: ZenohEdge, session: RosSession, floor: Floor, clock: Clock) -> None:
        """Pass on what `fog` hears on `session`, and goals to `floor`."""
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
        self._told_at = 0.0
        self._is_dirty = False
        self._is_slow = False
        self._hazards: dict[str, HazardArea] = {}
        self._zones = ZoneSet(epoch=0, seq=0, zones=[], active=[])
        self._robots: set[str] = set()
        self._goals: asyncio.Queue[tuple[str, Request]] = asyncio.Queue(GOALS_AT_ONCE)

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
            self._tell_masks()

    async def goal_loop(self) -> None:
        """Pass on goals, one after the other."""
        while True:
            robot, request = await self._goals.get()
            if refusal := await self._floor.send(request):
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
        self._is_dirty = True

    def _on_delta(self, _: Mapping[str, str], delta: MapDelta) -> None:
        if self._follower.on_delta(delta, self._now()) is not None:
            self._is_dirty = True
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
                self._geometry, self._told, self._is_dirty = replica.geometry, {}, True
                told = ros.grid(ros.map_values(replica.static), replica.geometry, stamp)
                self._session.publish(self._map, told, stamp)
                self._tell_markers()
        is_slow = self.map_age_s > SILENT_S
        if is_slow != self._is_slow:
            self._is_slow, self._is_dirty = is_slow, True
        if not self._is_dirty:
            return
        limit = DEGRADED_SPEED / 100.0 if is_slow else None
        fresh = {
            self._keepout: ros.keepout_values(replica.cost, replica.static),
            self._speed: ros.speed_values(replica.speed, limit),
        }
        changed = {topic: values for topic, values in fresh.items() if self._differs(topic, values)}
        if now - self._told_at < CLEARING_S and not any(map(self._blocks_more, changed, changed.values())):
            return
        self._is_dirty = False
        for topic, values in changed.items():
            self._told[topic], self._told_at = values, now
            self._session.publish(topic, ros.grid(values, replica.geometry, stamp), stamp)

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
        self._tell_markers()

    def _on_zones(self, _: Mapping[str, str], zones: ZoneSet) -> None:
        self._zones = zones
        self._tell_markers()

    def _tell_markers(self) -> None:
        in_force = [zone for zone in self._zones.zones if zone.id in set(self._zones.active)]
        stamp = self._stamp()
        self._session.publish(self._markers, ros.markers(self._hazards, in_force, self._geometry, stamp), stamp)

    def _on_state(self, ids: Mapping[str, str], state: RobotState) -> None:
        robot = ids["robot"]
        if robot not in self._robots:
            self._robots.add(robot)
            goal = Topic(f"{ros.ros_name(robot)}/goal_pose", GOAL_TYPE)
            self._session.subscribe(goal, partial(self._on_goal, robot))
        self._tell(robot, "battery_state", "sensor_msgs/msg/BatteryState", ros.battery(state, self._stamp()))

    def _on_pose(self, ids: Mapping[str, str], pose: RobotPose) -> None:
        robot = ids["robot"]
        self._session.publish(Topic("tf", "tf2_msgs/msg/TFMessage"), ros.transform(pose, robot), self._stamp())
        self._tell(robot, "pose", "geometry_msgs/msg/PoseWithCovarianceStamped", ros.robot_pose(pose))

    def _on_path(self, ids: Mapping[str, str], path: RobotPath) -> None:
        self._tell(ids["robot"], "plan", "nav_msgs/msg/Path", ros.path(path, self._stamp()))

    def _tell(self, robot: str, name: str, kind: str, message: object) -> None:
        self._session.publish(Topic(f"{ros.ros_name(robot)}/{name}", kind), message, self._stamp())

    def _on_goal(self, robot: str, goal: RosMessage) -> None:
        x, y = goal.pose.position.x, goal.pose.position.y
        theta = ros.heading(goal.pose.orientation)
        topic = f"{robot}/goal_pose"
        if goal.header.frame_id not in ("", ros.MAP_FRAME):
            frame = goal.header.frame_id[:40]
            self._session.refuse("frame", topic, f"a goal in the frame {frame!r}: send it in {ros.MAP_FRAME!r}")
        elif not np.isfinite((x, y)).all():
            self._session.refuse("malformed", topic, f"a goal at ({x}, {y})")
        else:
            pose = {"x": x, "y": y} | ({} if theta is None else {"theta": theta})
            try:
                self._goals.put_nowait((robot, Request("PUT", f"/api/v1/robots/{robot}/goal", {"pose": pose})))
            except asyncio.QueueFull:
                self._session.refuse("too_many", topic, f"{GOALS_AT_ONCE} goals wait already")

    def _now(self) -> float:
        return self._clock.now()

    def _stamp(self) -> float:
        return self._clock.stamp()
