"""Between the agent's core and the world: its loops, what the fog tells it, what it tells the fog."""

from __future__ import annotations

import asyncio
import math
import random
import re
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Final

from prometheus_client import Counter, Gauge

from fog_contracts import channels as ch
from fog_contracts.codec import ContractError
from fog_contracts.messages import (
    CommandReply,
    HazardArea,
    LoopHealth,
    MapDelta,
    MapHeartbeat,
    MapSnapshot,
    RobotCommand,
    RobotGoal,
    RobotPath,
    ZoneSet,
)
from fog_contracts.replica import MapError
from fog_runtime import logs, metrics
from fog_runtime.clock import Ticker
from robot_agent.agent.core import SavedPose, decide

if TYPE_CHECKING:
    from fog_contracts.messages import RobotState
    from fog_contracts.site import RobotSite
    from fog_runtime.clock import Clock
    from fog_runtime.health import Health
    from fog_runtime.zenoh_edge import ZenohEdge
    from robot_agent.agent.core import AgentCore
    from robot_agent.agent.guardian_client import GuardianClient
    from robot_agent.agent.lidar_edge import LidarEdge
    from robot_agent.agent.store import Store
    from robot_agent.guardian.link import BaseFeedback
    from robot_agent.hardware import LaserScan

STREAM_S: Final = 0.05
CONTROL_S: Final = 0.2
TELL_S: Final = 0.1
KEEP_S: Final = 1.0
ASK_S: Final = 3.0
"""How long the map-service may take for a snapshot."""
BEHIND_S: Final = 0.5
"""The copy of the map may be behind the heartbeat for this long; then its delta is taken for lost."""
SEARCH_AGAIN_S: Final = 15.0
HELD_DELTAS: Final = 256

TURNS = Counter("fognav_lidar_turns_total", "Whole turns of the lidar")
LATENESS = Gauge("fognav_loop_lateness_p99_seconds", "99th percentile of a loop's lateness", ["loop"])
MODE = Gauge("fognav_robot_mode", "1 for the mode that the robot is in", ["mode"])
_NUMBER: Final = re.compile(r"[\d.]+")

_log = logs.get("agent")


class Service:
    """The running agent; its loops are tasks of the process. The core is touched on the loop's thread only."""

    def __init__(
        self, core: AgentCore, zenoh: ZenohEdge, store: Store, clock: Clock, health: Health, *, robot: str, site: str
    ) -> None:
        self._core = core
        self._zenoh = zenoh
        self._store = store
        self._clock = clock
        self._health = health
        self._robot = robot
        self._site = site
        self._stream = Ticker(clock, STREAM_S)
        self._control = Ticker(clock, CONTROL_S)
        self._held: deque[MapDelta] = deque(maxlen=HELD_DELTAS)
        self._told: object = None
        self._told_at = self._seen_at = -math.inf
        self._mode = ""
        self._base_at = -math.inf
        self._turn_at = -math.inf
        self._base_reason = "the guardian was not found yet"
        self._kept: SavedPose | None = None
        self._searched_at = -math.inf

    # --- What the robot keeps over a restart ------------------------------------------------------------------------

    def restore(self, body: RobotSite | None) -> None:
        """Start from what was stored: the map until a newer one comes, the pose, else the site's start pose."""
        snapshot = self._store.snapshot(self._site)
        if snapshot is not None:
            try:
                self._core.load(snapshot, self._clock.now())
            except MapError as error:
                _log.warning("stored_map_refused", reason=str(error))
        saved = self._store.pose(self._site)
        if saved is None and body is not None:
            start = body.start
            saved = SavedPose(site=self._site, x=start.x, y=start.y, theta=start.theta, sigma_xy=0.25, sigma_theta=0.15)
        if saved is not None:
            self._core.restore(saved)
        _log.info("restored", map=snapshot is not None, x=saved and saved.x, y=saved and saved.y)

    async def keep_loop(self, lidar: LidarEdge) -> None:
        """Once a second: store the pose if it changed, search for one if there is none, say what is missing."""
        async for now in Ticker(self._clock, KEEP_S):
            pose = self._core.save(now)
            if pose is not None and (self._kept is None or _differs(pose, self._kept)):
                self._kept = pose
                try:
                    await asyncio.to_thread(self._store.put_pose, pose)
                except OSError as error:
                    _log.error("pose_not_stored", reason=str(error))
            self._search(now)
            self._report_health(self._clock.now(), lidar)

    def _search(self, now: float) -> None:
        """Look for the pose on the whole map when nobody told one; only at rest, before anybody enabled the robot."""
        localizer = self._core.localizer
        if localizer.status != "none" or localizer.searching or localizer.pose(now) is not None:
            return
        if self._core.verdict.mode == "INIT" and now - self._searched_at > SEARCH_AGAIN_S:
            self._searched_at = now
            if self._core.global_localization():
                _log.info("searching_pose", reason=localizer.detail)

    def _report_health(self, now: float, lidar: LidarEdge) -> None:
        core, health = self._core, self._health
        loaded = core.replica.version is not None
        health.set("map", loaded, "" if loaded else "no snapshot of the map was received yet")
        status = core.localizer.status
        health.set("pose", status in {"good", "weak"}, f"{status}: {core.localizer.detail}".rstrip(": "))
        health.set("lidar", now - self._turn_at < KEEP_S, lidar.trouble)
        base_ok = now - self._base_at < KEEP_S
        health.set("base", base_ok, "" if base_ok else self._base_reason)
        LATENESS.labels("stream").set(self._stream.p99_s)
        LATENESS.labels("control").set(self._control.p99_s)

    # --- The robot's own parts --------------------------------------------------------------------------------------

    def on_feedback(self, feedback: BaseFeedback, now: float) -> None:
        """Take what the guardian says."""
        self._base_at = now
        self._core.on_base(feedback, now)

    def on_base_lost(self, now: float, reason: str) -> None:
        """Take that the guardian, or its base, is gone."""
        self._base_reason = reason
        self._core.on_base_lost(now, reason)

    def on_scan(self, scan: LaserScan, now: float) -> None:
        """Take a whole scan of the lidar."""
        self._turn_at = now
        TURNS.inc()
        self._core.on_scan(scan, now)

    async def stream_loop(self, link: GuardianClient) -> None:
        """Judge safety and stream wheel commands at 20 Hz."""
        async for now in self._stream:
            link.send(self._core.stream(now, self._clock.stamp()))

    async def control_loop(self) -> None:
        """Decide at 5 Hz on a thread of its own, so that a decision that hangs can't hold up the stream."""
        loop = asyncio.get_running_loop()
        thread = ThreadPoolExecutor(1, thread_name_prefix="decide")
        try:
            async for now in self._control:
                job = self._core.control_job(now)
                if job is not None:
                    self._core.accept(await loop.run_in_executor(thread, decide, job), self._clock.now())
        finally:
            thread.shutdown(wait=False, cancel_futures=True)

    # --- What the fog says ------------------------------------------------------------------------------------------

    def listen(self) -> None:
        """Say what to be called for."""
        zenoh, robot = self._zenoh, self._robot
        zenoh.subscribe(ch.MAP_DELTA, MapDelta, self._on_delta)
        zenoh.subscribe(ch.MAP_HEARTBEAT, MapHeartbeat, self._on_heartbeat)
        zenoh.subscribe(ch.HAZARD, HazardArea, lambda _, hazard: self._core.on_hazard(hazard, self._clock.now()))
        zenoh.subscribe(ch.ZONES, ZoneSet, lambda _, zones: self._core.on_zones(zones, self._clock.now()))
        zenoh.subscribe(
            ch.ROBOT_GOAL, RobotGoal, lambda _, goal: self._core.on_goal(goal, self._clock.now()), robot=robot
        )
        zenoh.subscribe(ch.ROBOT_PATH, RobotPath, self._on_path, robot=robot)
        zenoh.serve(ch.ROBOT_COMMAND, self._on_command, robot=robot)

    def _on_path(self, _ids: dict[str, str], path: RobotPath) -> None:
        self._core.on_path(path, self._clock.now(), self._clock.stamp())

    def _on_command(self, _ids: dict[str, str], command: RobotCommand) -> CommandReply:
        reply = self._core.on_command(command, self._clock.now(), self._clock.stamp())
        _log.info("command", kind=command.kind, operator=command.operator, accepted=reply.accepted, reason=reply.reason)
        return reply

    def _on_delta(self, _ids: dict[str, str], delta: MapDelta) -> None:
        if self._core.needs_snapshot:
            # The snapshot under way may be older than this change.
            self._held.append(delta)
        self._core.on_delta(delta, self._clock.now())

    def _on_heartbeat(self, _ids: dict[str, str], heartbeat: MapHeartbeat) -> None:
        self._core.on_heartbeat(heartbeat, self._clock.now())

    def _wants_snapshot(self) -> bool:
        return self._core.needs_snapshot or self._core.map_gap(self._clock.now()) > BEHIND_S

    async def map_loop(self) -> None:
        """Ask for a snapshot whenever only that helps, less and less often while nobody answers."""
        failures = 0
        while True:
            await self._clock.sleep(STREAM_S if not failures else random.uniform(0.5, 1.0) * min(2.0**failures / 5, 3))
            if not self._wants_snapshot() or await self._fetch():
                failures = 0
            else:
                failures += 1

    async def _fetch(self) -> bool:
        """Ask for a snapshot and load it; False when there was none, or no good one."""
        try:
            snapshot = await self._zenoh.ask(ch.MAP_SNAPSHOT, None, MapSnapshot, ASK_S)
            if snapshot is None:
                return False
            applied = self._core.load(snapshot, self._clock.now())
        except (ContractError, MapError) as error:
            _log.warning("snapshot_refused", reason=str(error))
            return False
        held = [delta for delta in self._held if delta.epoch == snapshot.epoch]
        self._held.clear()
        for delta in held:
            self._core.on_delta(delta, self._clock.now())
        _log.info("map_loaded", epoch=applied.version.epoch, seq=applied.version.seq, deltas=len(held))
        try:
            await asyncio.to_thread(self._store.put_snapshot, snapshot)
        except OSError as error:
            _log.error("map_not_stored", reason=str(error))
        return True

    # --- What the fog hears -----------------------------------------------------------------------------------------

    async def tell_loop(self) -> None:
        """Publish the pose at 10 Hz, the state on change and at 1 Hz, obstacles at 1 Hz, and observe traces."""
        zenoh, robot = self._zenoh, self._robot
        async for now in Ticker(self._clock, TELL_S):
            stamp = self._clock.stamp()
            pose = self._core.pose(stamp, now)
            if pose is not None:
                zenoh.publish(ch.ROBOT_POSE, pose, robot=robot)
            state = self._core.state(stamp, now, self._loop_health())
            if now - self._told_at >= 1.0 - TELL_S / 2 or _news(state) != self._told:
                self._told, self._told_at = _news(state), now
                self._show_mode(state)
                zenoh.publish(ch.ROBOT_STATE, state, robot=robot)
            if now - self._seen_at >= 1.0 - TELL_S / 2:
                self._seen_at = now
                obstacles = self._core.obstacles(now, stamp)
                if obstacles is not None:
                    zenoh.publish(ch.ROBOT_OBSTACLES, obstacles, robot=robot)
            for trace in self._core.finished_traces():
                metrics.observe_trace(trace, ["deliver", "command", "total"])

    def _loop_health(self) -> LoopHealth:
        return LoopHealth(
            control_p99_s=self._control.p99_s,
            stream_p99_s=self._stream.p99_s,
            late=self._control.late + self._stream.late,
        )

    def _show_mode(self, state: RobotState) -> None:
        if state.mode == self._mode:
            return
        _log.info("mode", mode=state.mode, before=self._mode, reasons=state.reasons)
        if self._mode:
            MODE.labels(self._mode).set(0)
        MODE.labels(state.mode).set(1)
        self._mode = state.mode


def _news(state: RobotState) -> object:
    """Return what makes a state worth telling at once: all but figures that change all the time."""
    return (
        state.mode,
        state.enabled,
        state.goal_id,
        state.goal_reached,
        state.plan_id,
        state.planner_epoch,
        state.map_epoch,
        state.map_seq,
        len(state.traces),
        tuple(_NUMBER.sub("", reason) for reason in state.reasons),
    )


def _differs(new: SavedPose, old: SavedPose) -> bool:
    """Whether a pose is worth a write: storage of a small computer wears out."""
    moved = math.hypot(new.x - old.x, new.y - old.y) > 0.02
    turned = abs(math.remainder(new.theta - old.theta, math.tau)) > 0.03
    return moved or turned or abs(new.sigma_xy - old.sigma_xy) > 0.05 or abs(new.sigma_theta - old.sigma_theta) > 0.05
