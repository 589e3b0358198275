"""Robots of Fognav as Open-RMF's free_fleet sees robots of Nav2: on the keys of zenoh-bridge-ros2dds, without ROS.

Plain CDR, no attachment: `ROBOT/tf`, `ROBOT/battery_state`, and the action `ROBOT/navigate_to_pose/_action/...` with
goal, result, cancellation and feedback. Source: free_fleet@002505fd, its adapter for Nav2 and its example programs.

What an operator of Fognav does wins: a robot that waits for one, or has a mission of one, takes no goal, and a
cancellation ends missions of this bridge only. The adapter takes a canceled goal for one that is done, and plans anew
for one that is aborted: so a goal is canceled by the adapter's own word only.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final
from uuid import uuid4

import numpy as np
import zenoh

from fog_bridges.floor import REFUSED, Request
from fog_bridges.heard import Heard
from fog_bridges.ros2 import messages as ros
from fog_bridges.ros2.wire import TYPES, RosMessage, WireError, decoded_as
from fog_contracts import channels as ch
from fog_contracts.messages import RobotPose, RobotState
from fog_runtime import logs
from fog_runtime.clock import ticker
from fog_runtime.transports.zenoh_edge import ZenohEdge

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from fog_bridges.floor import Answer, Floor
    from fog_runtime.clock import Clock
    from fog_runtime.credentials import Credentials

UNKNOWN, EXECUTING, SUCCEEDED, CANCELED, ABORTED = 0, 2, 4, 5, 6
"""States of a goal (action_msgs/GoalStatus)."""
CANCEL_NONE, CANCEL_REJECTED, CANCEL_UNKNOWN_GOAL, CANCEL_GOAL_TERMINATED = 0, 1, 2, 3
"""Return codes of action_msgs/CancelGoal."""
FEEDBACK_S: Final = 0.5
SPEED_M_S: Final = 0.3
"""What the remaining time is estimated by."""
UNSEEN_S: Final = 10.0
"""A mission that neither robot nor planner tell of for so long is over; the planner tells of it each 5 s."""
REMEMBERED: Final = 200
"""So many ends of missions, and states of earlier goals, are known."""
WAITING_MAX: Final = 50
REQUEST_MAX: Final = 4096
"""A longer request (bytes) is refused unread."""
RETRY_S: Final = 1.0
_NO_GOAL: Final = bytes(16)
_NO_ROUTER: Final = "free_fleet's router is not connected"
_UNCERTAIN: Final = ("", "service_silent", "store_uncertain")
"""Problems of requests that may have been carried out."""
_GONE: Final = ("no_mission", "mission_changed")
_SECONDS_MAX: Final = 2**31 - 1
_ACTION: Final = "navigate_to_pose/_action"
_log = logs.get("free_fleet")


class Planned:
    """What the planner says of missions, as the console tells it."""

    def __init__(self) -> None:
        self._missions: dict[str, str] = {}
        """The mission of each robot that has one."""
        self._ends: dict[str, bool] = {}
        """The latest missions that have ended, and whether they were reached."""
        self._begun: dict[str, str] = {}
        """By robot, the mission that this bridge has begun, in an earlier run, too; none where somebody else has."""

    def on_event(self, name: str, data: dict[str, Any]) -> None:
        """Take in an event of the floor."""
        if name == "hello" and data["fresh"]:
            self._missions.clear()
        elif name == "robot":
            goal = (data["value"] or {}).get("goal") or {}
            self._missions[data["id"]] = goal.get("goal_id", "")
        elif name == "record" and data["kind"] == "mission":
            before, after = (((data[each] or {}).get("goal") or {}).get("goal_id") for each in ("before", "after"))
            if before and before != after:
                _remember(self._ends, before, data["action"] == "reached")
            if after and after != before:
                self._begun[data["id"]] = after if data["who"].endswith(f"/{FreeFleetBridge.name}") else ""

    def on_lost(self) -> None:
        """Take in that nobody knows which robot has a mission."""
        self._missions.clear()

    def has(self, robot: str, mission: str) -> bool:
        """Whether a mission is a robot's."""
        return self._missions.get(robot) == mission

    def left(self, robot: str) -> str:
        """Return a robot's mission, if this bridge has begun it; empty without one."""
        mission = self._begun.get(robot, "")
        return mission if mission and self.has(robot, mission) else ""

    def end_of(self, mission: str) -> bool | None:
        """Return whether a mission was reached (True) or ended by somebody (False); None: neither is known."""
        return self._ends.get(mission)


@dataclass
class Mission:
    """The latest goal that somebody gave a robot by this bridge; times are those of a monotonic clock (s)."""

    goal: bytes
    """Its id, 16 bytes that whoever sent it has drawn."""
    mission: str
    """Its id on the floor."""
    begun: float
    seen: float
    """When the robot or the planner had it last."""
    status: int = EXECUTING

    def follow(self, robot: str, state: RobotState, planned: Planned, now: float) -> None:
        """Find out whether it goes on: a robot without it may only have been started anew, and is told it again.

        One that nobody told of for long may have been out of sight only, so that it is no end yet.
        """
        if self.status in (SUCCEEDED, CANCELED):
            return
        has_it, end = state.goal_id == self.mission, planned.end_of(self.mission)
        if end or (has_it and state.goal_reached):
            self.status = SUCCEEDED
        elif end is False:
            self.status = ABORTED  # by an operator, or for another goal
        else:
            if has_it or planned.has(robot, self.mission):
                self.seen = now
            self.status = EXECUTING if now - self.seen < UNSEEN_S else ABORTED


class FreeFleetBridge:
    """The adapter for free_fleet."""

    name: Final = "free-fleet"

    def __init__(self, site: str, config: zenoh.Config, connect: Sequence[str], own: Credentials) -> None:
        """Serve robots on the router that `config` connects to; `connect` are the floor's, for whom `own` are."""
        self._site, self._config, self._connect, self._own = site, config, connect, own
        self._planned = Planned()
        self.problem = "not connected yet"
        """Why free_fleet is told nothing; empty while it is."""

    def on_event(self, name: str, data: dict[str, Any]) -> None:
        """Take in an event of the floor: of missions only, all else its own channels tell faster."""
        self._planned.on_event(name, data)

    def on_lost(self) -> None:
        """Take in that nobody knows the floor's state."""
        self._planned.on_lost()

    async def run(self, floor: Floor, clock: Clock) -> None:
        """Connect, and do all until cancelled."""
        session = await self._opened()
        opened = ZenohEdge.open(
            connect=self._connect, clock=clock, role=ch.BRIDGE, id=f"{self._site}-fleet"[: ch.ID_MAX], site=self._site,
            credentials=self._own,
        )  # fmt: skip
        try:
            async with opened as fog, asyncio.TaskGroup() as tasks:
                fleet = Fleet(session, floor, clock, tasks, self._planned)
                fog.subscribe(ch.ROBOT_STATE, RobotState, lambda ids, state: fleet.on_state(ids["robot"], state))
                fog.subscribe(ch.ROBOT_POSE, RobotPose, lambda ids, pose: fleet.on_pose(ids["robot"], pose))
                async for _ in ticker(clock, FEEDBACK_S):
                    fleet.tell_feedback()
                    info = session.info
                    connected = bool(info.routers_zid() or info.peers_zid())
                    self.problem = "" if connected else _NO_ROUTER
                    if not fog.connected:
                        self.problem = "the floor's router is not connected"
        finally:
            session.close()  # type: ignore[no-untyped-call]  # zenoh's stub has no types for it

    async def _opened(self) -> zenoh.Session:
        """Open a session once the router is there; afterwards it connects again by itself."""
        while True:
            try:
                return await asyncio.to_thread(zenoh.open, self._config)
            except zenoh.ZError as error:
                self.problem = f"{_NO_ROUTER}: {error}"
            await asyncio.sleep(RETRY_S)


class Fleet:
    """The robots that are served: each is from its first state on."""

    def __init__(
        self, session: zenoh.Session, floor: Floor, clock: Clock, tasks: asyncio.TaskGroup, planned: Planned
    ) -> None:
        """Serve robots on `session`, and pass their goals on to `floor`, of whose missions `planned` tells."""
        self._session, self._floor, self._clock, self._tasks = session, floor, clock, tasks
        self._planned = planned
        self._loop = asyncio.get_running_loop()
        self._limited = logs.RateLimited(_log)
        self._held: dict[str, list[object]] = {}
        self._poses: dict[str, RobotPose] = {}
        self._states: dict[str, RobotState] = {}
        self._heard = Heard()
        self._missions: dict[str, Mission] = {}
        self._earlier: dict[tuple[str, bytes], int] = {}
        """What became of goals before a robot's latest."""
        self._locks: dict[str, asyncio.Lock] = {}
        """A robot's goals and cancellations are carried out one after the other."""
        self._waiting = 0

    def on_pose(self, robot: str, pose: RobotPose) -> None:
        """Tell where a robot is, in frames without its name: free_fleet adds that."""
        self._poses[robot] = pose
        if not pose.localized:
            return  # no place is better than a wrong one
        told = ros.transform(pose.x, pose.y, pose.theta, "base_footprint", pose.stamp)
        self._put(robot, "tf", told, "tf2_msgs/msg/TFMessage")

    def on_state(self, robot: str, state: RobotState) -> None:
        """Tell a robot's battery, and follow its mission."""
        self._states[robot] = state
        self._heard.hear(robot, self._clock.now())
        if robot not in self._held:
            self._locks[robot] = asyncio.Lock()
            served: dict[str, Callable[[str, bytes], Awaitable[bytes]]] = {
                "send_goal": self._send_goal, "get_result": self._get_result, "cancel_goal": self._cancel,
            }  # fmt: skip
            self._held[robot] = [
                self._session.declare_queryable(
                    f"{ros.ros_name(robot)}/{_ACTION}/{name}", partial(self._on_query, robot, name, answer)
                )
                for name, answer in served.items()
            ]
        self._followed(robot)
        if state.battery is not None:  # the adapter hands on any number, and NaN; it takes 1.0 without one
            self._put(robot, "battery_state", ros.battery(state, self._clock.stamp()), "sensor_msgs/msg/BatteryState")

    def tell_feedback(self) -> None:
        """Tell how far robots have to go."""
        for robot in self._missions:
            mission, state, pose = self._followed(robot), self._states[robot], self._poses.get(robot)
            if mission is None or mission.status != EXECUTING or pose is None or state.goal_distance is None:
                continue
            stamp = self._clock.stamp()
            where = ros.message(
                "geometry_msgs/msg/PoseStamped", header=ros.header(stamp), pose=ros.pose(pose.x, pose.y, pose.theta)
            )
            told = ros.message(
                "fognav_msgs/msg/GoalFeedback", goal_id=np.frombuffer(mission.goal, np.uint8), current_pose=where,
                navigation_time=_duration(self._clock.now() - mission.begun),
                estimated_time_remaining=_duration(state.goal_distance / SPEED_M_S), number_of_recoveries=0,
                distance_remaining=state.goal_distance,
            )  # fmt: skip
            self._put(robot, f"{_ACTION}/feedback", told, "fognav_msgs/msg/GoalFeedback")

    def _followed(self, robot: str) -> Mission | None:
        """Return a robot's mission with its present status; None if this bridge has begun none.

        One of an earlier run has no goal's id until somebody asks for its result.
        """
        mission = self._missions.get(robot)
        if mission is None and (left := self._planned.left(robot)):
            now = self._clock.now()
            mission = self._missions[robot] = Mission(_NO_GOAL, left, begun=now, seen=now)
        if mission is not None:
            mission.follow(robot, self._states[robot], self._planned, self._clock.now())
        return mission

    def _put(self, robot: str, name: str, message: RosMessage, kind: str) -> None:
        try:
            self._session.put(
                f"{ros.ros_name(robot)}/{name}", bytes(TYPES.serialize_cdr(message, kind)),
                congestion_control=zenoh.CongestionControl.DROP,
            )  # fmt: skip
        except zenoh.ZError as error:
            self._limited.warning("message_dropped", name, self._clock.now(), robot=robot, reason=str(error))

    # --- Goals ------------------------------------------------------------------------------------------------------

    def _on_query(
        self, robot: str, name: str, answer: Callable[[str, bytes], Awaitable[bytes]], query: zenoh.Query
    ) -> None:
        """Take a request, on a thread of zenoh."""
        if self._loop.is_closed():
            return
        if "*" in str(query.key_expr):  # it asks every robot at once
            self._refuse("wildcard", robot, name, f"{query.key_expr}: name one robot")
            query.reply_err(b"name one robot")
            return
        if query.payload is not None and len(query.payload) > REQUEST_MAX:
            self._refuse("too_long", robot, name, f"{len(query.payload)} bytes, and {REQUEST_MAX} is the limit")
            query.reply_err(b"too long")
            return
        payload = b"" if query.payload is None else query.payload.to_bytes()
        if self._waiting >= WAITING_MAX:
            self._refuse("too_many", robot, name, f"{WAITING_MAX} requests wait already")
            query.reply_err(b"too many requests wait")
            return
        self._waiting += 1
        self._loop.call_soon_threadsafe(self._begin, robot, name, answer, query, payload)

    def _begin(
        self, robot: str, name: str, answer: Callable[[str, bytes], Awaitable[bytes]], query: zenoh.Query, data: bytes
    ) -> None:
        async def reply() -> None:
            try:
                query.reply(query.key_expr, await answer(robot, data))
            except WireError as error:
                self._refuse(error.reason, robot, name, str(error))
                query.reply_err(str(error).encode())
            finally:
                self._waiting -= 1

        self._tasks.create_task(reply(), name=f"{robot} {name}")

    def _refuse(self, reason: str, robot: str, name: str, words: str) -> None:
        REFUSED.labels(FreeFleetBridge.name, reason).inc()
        self._limited.warning("request_refused", f"{name} {reason}", self._clock.now(), robot=robot, request=name,
                              reason=words)  # fmt: skip

    async def _send_goal(self, robot: str, data: bytes) -> bytes:
        """Send a robot to a pose; a goal that the floor refuses is not accepted."""
        asked = decoded_as("fognav_msgs/msg/SendGoal", data)
        x, y, frame = asked.pose.pose.position.x, asked.pose.pose.position.y, asked.pose.header.frame_id
        if frame not in ("", ros.MAP_FRAME):
            raise WireError(f"a goal in the frame {frame[:40]!r}: send it in {ros.MAP_FRAME!r}", "frame")
        if not np.isfinite((x, y)).all():
            raise WireError(f"a goal at ({x}, {y})")
        theta = ros.heading(asked.pose.pose.orientation)
        pose = {"x": x, "y": y} | ({} if theta is None else {"theta": theta})
        async with self._locks[robot]:
            refusal = await self._begin_mission(robot, bytes(asked.goal_id), pose)
        if refusal:
            self._refuse("goal", robot, "send_goal", refusal)
        accepted = ros.message("fognav_msgs/msg/GoalAccepted", accepted=not refusal, stamp=self._time())
        return bytes(TYPES.serialize_cdr(accepted, "fognav_msgs/msg/GoalAccepted"))

    async def _begin_mission(self, robot: str, goal: bytes, pose: dict[str, float]) -> str:
        """Begin a mission in the place of this bridge's own, never of another's; return why not, empty if it has."""
        state, own = self._states[robot], self._followed(robot)
        waits = not state.enabled or state.awaits_operator
        if refusal := self._heard.refusal(robot, self._clock.now(), waits=waits):
            return refusal
        told = None
        if own is not None and own.status in (EXECUTING, ABORTED):  # the floor knows whether it still has it
            told = await self._put_goal(robot, pose, {"If-Match": f'"{own.mission}"'})
        if told is None or told.problem in _GONE:
            told = await self._put_goal(robot, pose, {"If-None-Match": "*"})
        goal_id = None if told.refusal else told.body.get("goal_id")
        if goal_id is None:
            return told.refusal or "the floor's answer names no mission"
        if own is not None:
            is_replaced = own.status == EXECUTING
            _remember(self._earlier, (robot, own.goal), ABORTED if is_replaced else own.status)
        now = self._clock.now()
        self._missions[robot] = Mission(goal, str(goal_id), begun=now, seen=now)
        return ""

    async def _put_goal(self, robot: str, pose: dict[str, float], condition: dict[str, str]) -> Answer:
        headers = condition | {"Idempotency-Key": uuid4().hex}
        request = Request("PUT", f"/api/v1/robots/{robot}/goal", {"pose": pose}, headers)
        told = await self._floor.ask(request)
        if told.refusal and told.problem in _UNCERTAIN:
            told = await self._floor.ask(request)  # by the same key: carried out once
        return told

    async def _get_result(self, robot: str, data: bytes) -> bytes:
        """Tell a goal's state at once: whoever asked would wait for nothing else meanwhile, and asks again."""
        asked = bytes(decoded_as("fognav_msgs/msg/GetResult", data).goal_id)
        mission = self._followed(robot)
        if mission is not None and mission.goal == _NO_GOAL and (robot, asked) not in self._earlier:
            mission.goal = asked  # free_fleet asks for the goal that it gave last: before the bridge's start, this one
        is_latest = mission is not None and mission.goal == asked
        status = mission.status if mission is not None and is_latest else self._earlier.get((robot, asked), UNKNOWN)
        result = ros.message("fognav_msgs/msg/GoalResult", status=status)
        return bytes(TYPES.serialize_cdr(result, "fognav_msgs/msg/GoalResult"))

    async def _cancel(self, robot: str, data: bytes) -> bytes:
        """End a robot's mission: the one that is named, or, with an id of zeros, whichever this bridge has begun."""
        asked = bytes(decoded_as("fognav_msgs/msg/GoalInfo", data).goal_id)
        async with self._locks[robot]:
            code, ended = await self._end_mission(robot, asked)
        told = ros.message("fognav_msgs/msg/GoalsCanceled", return_code=code, goals_canceling=ended)
        return bytes(TYPES.serialize_cdr(told, "fognav_msgs/msg/GoalsCanceled"))

    async def _end_mission(self, robot: str, asked: bytes) -> tuple[int, list[RosMessage]]:
        """End the mission of this bridge that is meant; return a code of action_msgs/CancelGoal, and what has ended."""
        mission = self._followed(robot)
        is_meant = mission is not None and asked in (_NO_GOAL, mission.goal)
        if mission is not None and is_meant and mission.status in (EXECUTING, ABORTED):
            # Also of one that seems to be over the floor decides: its robot may only have been out of sight.
            condition = {"If-Match": f'"{mission.mission}"'}
            told = await self._floor.ask(Request("DELETE", f"/api/v1/robots/{robot}/goal", headers=condition))
            if told.refusal and told.problem not in _GONE:
                self._refuse("goal", robot, "cancel_goal", told.refusal)
                return CANCEL_REJECTED, []
            if not told.refusal or mission.status == EXECUTING:
                mission.status = CANCELED
                goal = np.frombuffer(mission.goal, np.uint8)
                return CANCEL_NONE, [ros.message("fognav_msgs/msg/GoalInfo", goal_id=goal, stamp=self._time())]
        if asked != _NO_GOAL:
            return CANCEL_GOAL_TERMINATED if is_meant else CANCEL_UNKNOWN_GOAL, []
        state = self._states[robot]
        if state.goal_id is None or state.goal_reached or (mission is not None and state.goal_id == mission.mission):
            return CANCEL_NONE, []
        self._refuse("goal", robot, "cancel_goal", "it drives for somebody else: an operator of Fognav ends that")
        return CANCEL_REJECTED, []

    def _time(self) -> RosMessage:
        return ros.header(self._clock.stamp()).stamp


def _duration(seconds: float) -> RosMessage:
    seconds = min(max(0.0, seconds), _SECONDS_MAX)
    whole = int(seconds)
    return ros.message("builtin_interfaces/msg/Duration", sec=whole, nanosec=int((seconds - whole) * 1e9))


def _remember(kept: dict[Any, Any], key: object, value: object) -> None:
    """Set a value, and drop the oldest of too many."""
    kept.pop(key, None)
    kept[key] = value
    if len(kept) > REMEMBERED:
        del kept[next(iter(kept))]
