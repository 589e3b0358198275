"""What the robot decides, without touching the world: map copy, pose, path, safety gate, operators' commands.

Values and times go in, values come out. `now` is the robot's own monotonic clock (s) and judges every age; `stamp` is
the wall clock (s) and only names moments for people and traces. The edge calls `stream` 20 times a second and
runs `decide(control_job(now))` 5 times a second, on a thread if it likes, handing the decision to `accept`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from fog_contracts.commands import CommandGate
from fog_contracts.costs import INSCRIBED, LETHAL
from fog_contracts.geometry import contains_point, distance_to_segment
from fog_contracts.messages import (
    VIEW_SECTORS,
    CircleShape,
    CommandReply,
    CorridorShape,
    HazardArea,
    LoopHealth,
    MapDelta,
    MapHeartbeat,
    MapSnapshot,
    PolygonShape,
    Pose,
    RectangleShape,
    RobotCommand,
    RobotGoal,
    RobotObstacles,
    RobotPath,
    RobotPose,
    RobotState,
    Shape,
    Trace,
    View,
    Zone,
    ZoneSet,
)
from fog_contracts.replica import Applied, Outcome, Replica
from robot_agent.bases.roomba600.open_interface import EncoderFault, Odometry
from robot_agent.guardian.link import BaseFeedback, WheelCommand
from robot_agent.localization.localizer import Localizer, SavedPose
from robot_agent.motion.local_planner import Decision, Job, PathFollower, decide, first_blocked, make_job, twist
from robot_agent.safety.gate import (
    Request,
    SafetyInputs,
    SafetyOutputs,
    SafetyState,
    limit_wheels,
    ramp_down,
    step,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry
    from robot_agent.config import AgentConfig
    from robot_agent.hardware import LaserScan
    from robot_agent.localization.localizer import Pose2

__all__ = ["AgentCore", "Decision", "Job", "SavedPose", "decide"]

_NEVER: Final = -math.inf
_BLOCK_NEAR_M: Final = 3.0
"""A blocked path this near stops the robot at once; farther away the planner gets `_PLANNER_GRACE_S` to replan."""
_PLANNER_GRACE_S: Final = 1.0
_TRACES: Final = 16
_EXPLAINED_M: Final = 0.25
"""A lidar point this near to a wall of the map is that wall."""
_OBSTACLE_CELL_M: Final = 0.1
_OBSTACLE_RANGE_M: Final = 6.0
_OBSTACLE_TURN_RATE: Final = 0.5
"""Above this turning rate (rad/s) no obstacle is reported: what is left of the skew smears it."""
_COVARIANCE_FLOOR: Final = (1e-4, 1e-4, 1e-4)


class AgentCore:
    """One robot. All methods but `decide` belong on one thread."""

    def __init__(self, config: AgentConfig, seed: int = 0) -> None:
        self._config = config
        self._gate = CommandGate(config.robot, config.operator_key)
        self._replica = Replica()
        self._localizer = Localizer(config.localization, seed)
        self._odometry = Odometry()
        self._safety = SafetyState()
        self._verdict = step(self._safety, SafetyInputs(), 0.0, config.safety)[1]

        self._told: MapHeartbeat | None = None
        self._map_confirmed_at = _NEVER
        self._gap_since: float | None = None
        self._hazards: dict[str, HazardArea] = {}
        self._zones: list[Zone] = []

        self._feedback: BaseFeedback | None = None
        self._base_at = _NEVER
        self._base_silent: str | None = None
        self._reset_base = False

        self._node_at = _NEVER
        self._turn_at = _NEVER
        self._identical_turns = 1

        self._goal: RobotGoal | None = None
        self._goal_at = _NEVER
        self._cancelled: str | None = None
        self._reached: str | None = None
        self._path: RobotPath | None = None
        self._path_at = _NEVER
        self._follower: PathFollower | None = None
        self._blocked_since: float | None = None
        self._block: tuple[float, str] | None = None
        self._checked: object = None
        self._foreign_since: float | None = None

        self._decision: Decision | None = None
        self._decided_at = _NEVER
        self._wheels = (0.0, 0.0)
        self._streamed_at: float | None = None
        self._seq = 0
        self._traces: list[Trace] = []
        self._open_traces: list[Trace] = []
        self._finished: list[Trace] = []
        self._own_cells: dict[tuple[int, int], float] = {}
        self._saved: SavedPose | None = None

    # --- map ---

    @property
    def needs_snapshot(self) -> bool:
        """Whether only a snapshot can mend the copy of the map."""
        return self._replica.needs_snapshot

    @property
    def localizer(self) -> Localizer:
        """The pose estimator, for reading."""
        return self._localizer

    @property
    def replica(self) -> Replica:
        """The copy of the master costmap, for reading."""
        return self._replica

    def load(self, snapshot: MapSnapshot, now: float) -> Applied:
        """Take a snapshot, from the map-service or from disk; raises `MapError` when it is none.

        Only a heartbeat tells whether it is the newest one, so a map from disk alone does not let the robot drive.
        """
        applied = self._replica.load(snapshot)
        assert self._replica.geometry is not None
        self._localizer.load_map(self._replica.static, self._replica.geometry)
        if not self._is_behind():
            self._gap_since = None
        if self._saved is not None and self._saved.site == snapshot.site:
            self._localizer.restore(self._saved)
        self._saved = None
        self._check_path(now)
        return applied

    def on_delta(self, delta: MapDelta, now: float) -> Outcome:
        """Take one change of the map; it makes the map fresh only if no heartbeat told of a still newer one."""
        outcome = self._replica.apply(delta)
        if isinstance(outcome, Applied):
            self._weigh_map(now)
            self._check_path(now)
        elif outcome == "gap" and self._gap_since is None:
            self._gap_since = now
        return outcome

    def on_heartbeat(self, heartbeat: MapHeartbeat, now: float) -> None:
        """Take the map-service's word on which version is the newest."""
        self._told = heartbeat
        self._replica.check(heartbeat)
        self._weigh_map(now)

    def map_gap(self, now: float) -> float:
        """Return for how long (s) changes have been missing that the map-service told of; 0 when none are."""
        return 0.0 if self._gap_since is None else now - self._gap_since

    def on_hazard(self, hazard: HazardArea, now: float) -> None:
        """Take the reason behind cells: the state and place of a watched area."""
        del now
        self._hazards[hazard.hazard.area] = hazard

    def on_zones(self, zones: ZoneSet, now: float) -> None:
        """Take all operators' zones: reasons behind cells."""
        del now
        self._zones = [zone for zone in zones.zones if zone.enabled and zone.kind == "BLOCKED"]

    # --- mission ---

    def on_goal(self, goal: RobotGoal, now: float) -> None:
        """Take the mission; the same goal again changes nothing."""
        known = self._goal
        if known is not None and known.goal_id == goal.goal_id and known.pose == goal.pose:
            return
        self._goal, self._goal_at = goal, now
        if known is None or known.goal_id != goal.goal_id:
            self._reached = self._cancelled = None
            self._drop_path()

    def on_path(self, path: RobotPath, now: float, stamp: float) -> None:
        """Take a path, its extension or a refusal; one of another goal, or older than the one followed, is ignored."""
        goal = self._goal
        if goal is None or path.goal_id != goal.goal_id:
            return
        known = self._path
        age = (path.planner_epoch, path.plan_id)
        if known is not None and age < (known.planner_epoch, known.plan_id):
            return
        same = known is not None and age == (known.planner_epoch, known.plan_id)
        self._path, self._path_at = path, now
        if path.refusal is not None or not path.points:
            self._follower = None
        elif same and self._follower is not None:
            self._follower.release(path.released_length)
        else:
            self._follower = PathFollower(np.array(path.points, dtype=np.float64), path.released_length)
            self._block = None
            pose = self._localizer.pose(now)
            if pose is not None:
                self._follower.advance(pose.x, pose.y, now)
            self._open_traces = [msgspec.structs.replace(trace, path_received=stamp) for trace in path.traces]
            self._checked = None
        self._check_path(now)

    # --- robot ---

    def on_base(self, feedback: BaseFeedback, now: float) -> None:
        """Take what the guardian read from the base."""
        self._feedback, self._base_at, self._base_silent = feedback, now, None
        motion = self._odometry.update(feedback.left_ticks, feedback.right_ticks, now)
        if not isinstance(motion, EncoderFault):
            self._localizer.on_odometry(now, motion.x, motion.y, motion.theta)

    def on_base_lost(self, now: float, reason: str) -> None:
        """Take that the link to the guardian broke."""
        del now
        self._base_silent = reason

    def on_lidar_nodes(self, now: float) -> None:
        """Take that the lidar sent anything."""
        self._node_at = now

    def on_scan(self, scan: LaserScan, now: float) -> None:
        """Take a complete scan of the lidar that arrived at `now`."""
        self._turn_at = self._node_at = now
        self._identical_turns = scan.repeats
        if scan.repeats < self._config.safety.identical_turns:
            self._localizer.on_scan(scan, now)

    # --- operators ---

    def on_command(self, command: RobotCommand, now: float, stamp: float) -> CommandReply:
        """Carry out an operator's command, once, if it is signed, fresh and fits the state; else say why not."""
        refusal = self._gate.refusal(command, stamp)
        if refusal is not None:
            return CommandReply(accepted=False, reason=refusal)
        match command.kind:
            case "enable" | "disable" | "reset":
                return self._request(command.kind, now)
            case "cancel":
                return self._cancel()
            case "initial_pose":
                return self._initial_pose(command.pose)
            case "egress":
                return CommandReply(
                    accepted=False,
                    reason="this robot can't leave a blocked area by itself yet: end the block or move it by hand",
                )

    def _request(self, request: Request, now: float) -> CommandReply:
        verdict = self._judge(now, request)
        if verdict.refusal is not None:
            return CommandReply(accepted=False, reason=verdict.refusal[:500])
        if request == "reset":
            self._reset_base = True
            return CommandReply(accepted=True, reason="the fault is reset; enable the robot to let it drive")
        return CommandReply(accepted=True, reason=f"{request}d; the mode is {verdict.mode}")

    def _cancel(self) -> CommandReply:
        if self._goal is None or self._goal.pose is None:
            return CommandReply(accepted=False, reason="there is no goal to cancel")
        self._cancelled = self._goal.goal_id
        self._drop_path()
        return CommandReply(accepted=True, reason=f"the goal {self._cancelled} is cancelled on the robot")

    def _initial_pose(self, pose: Pose | None) -> CommandReply:
        geometry = self._replica.geometry
        if pose is None:
            return CommandReply(accepted=False, reason="the command carries no pose: give x, y and theta")
        if geometry is None:
            return CommandReply(accepted=False, reason="the robot has no map yet: wait until it has loaded one")
        if self._wheels != (0.0, 0.0):
            return CommandReply(accepted=False, reason="the robot is driving: disable it first")
        column, row = geometry.cell(pose.x, pose.y)
        if not geometry.contains_cell(column, row):
            return CommandReply(accepted=False, reason=f"({pose.x:.2f}, {pose.y:.2f}) lies off the map")
        if self._replica.static[row, column] == LETHAL:
            return CommandReply(accepted=False, reason=f"({pose.x:.2f}, {pose.y:.2f}) lies in a wall of the map")
        self._localizer.initial_pose(pose.x, pose.y, pose.theta)
        return CommandReply(accepted=True, reason="taken; the next turns of the lidar check it")

    # --- control ---

    @property
    def verdict(self) -> SafetyOutputs:
        """The safety gate's last verdict."""
        return self._verdict

    def control_job(self, now: float) -> Job | None:
        """Return what the next decision needs; None while there is nothing to drive to or no right to drive."""
        pose = self._localizer.pose(now)
        follower, path, replica = self._follower, self._path, self._replica
        if follower is None or path is None or pose is None or replica.geometry is None or not self._on_mission():
            return None
        follower.advance(pose.x, pose.y, now)
        if self._verdict.stop != "none":
            follower.rest_clock(now)
            return None
        seen = self._localizer.points_in_map()
        return make_job(
            follower,
            plan_id=path.plan_id,
            planner_epoch=path.planner_epoch,
            now=now,
            pose=pose,
            speeds=twist(*self._wheels, self._config.motion.axle),
            goal_theta=path.goal_theta,
            cap=self._verdict.cap,
            cost=replica.cost,
            speed_limits=replica.speed,
            geometry=replica.geometry,
            seen=np.zeros((0, 2)) if seen is None else seen,
            config=self._config.motion,
        )

    def accept(self, decision: Decision, now: float) -> None:
        """Take a decision; one for a path that is no longer followed is dropped."""
        path = self._path
        if path is None or (path.planner_epoch, path.plan_id) != (decision.planner_epoch, decision.plan_id):
            return
        if not self._on_mission():
            return
        self._decision, self._decided_at = decision, now
        if decision.at_goal:
            self._reached = path.goal_id
            self._drop_path()

    def stream(self, now: float, stamp: float) -> WheelCommand:
        """Judge safety and return the wheel speeds to send now; call it 20 times a second."""
        verdict = self._judge(now, None)
        dt = 0.0 if self._streamed_at is None else min(max(now - self._streamed_at, 0.0), 0.2)
        self._streamed_at = now
        motion, decision = self._config.motion, self._decision
        # A decision is judged by the age of what it rests on, so a hung control loop stops the robot too.
        fresh = decision is not None and now - decision.made_at <= self._config.decision_max_age
        if verdict.stop == "none" and not fresh:
            self._wheels = ramp_down(self._wheels, dt, motion.wheel_speed / self._config.safety.ramp)
        else:
            wanted = (decision.left, decision.right) if decision is not None and fresh else (0.0, 0.0)
            self._wheels = limit_wheels(
                wanted,
                self._wheels,
                verdict,
                dt,
                acceleration=motion.acceleration,
                wheel_speed=motion.wheel_speed,
                config=self._config.safety,
            )
            if fresh and verdict.stop == "none":
                self._close_traces(stamp)
        self._seq += 1
        reset, self._reset_base = self._reset_base, False
        return WheelCommand(seq=self._seq, left=self._wheels[0], right=self._wheels[1], reset=reset)

    # --- what others hear ---

    def pose(self, stamp: float, now: float) -> RobotPose | None:
        """Return the pose at `now`, None while none is known."""
        pose = self._localizer.pose(now)
        if pose is None:
            return None
        v, w = self._localizer.twist()
        covariance = self._localizer.covariance() + np.diag(_COVARIANCE_FLOOR)
        return RobotPose(
            x=pose.x,
            y=pose.y,
            theta=pose.theta,
            covariance=[float(value) for value in covariance.ravel()],
            v=min(max(v, -10.0), 10.0),
            w=min(max(w, -10.0), 10.0),
            radius=self._config.radius,
            height=self._config.height,
            stamp=stamp,
            localized=self._localizer.status in {"good", "weak"},
        )

    def state(self, stamp: float, now: float, loop: LoopHealth | None = None) -> RobotState:
        """Return what the robot is doing and why."""
        version, goal, path = self._replica.version, self._goal, self._path
        reasons = [reason[:500] for reason in (*self._verdict.reasons, *self._complaints(now))]
        mission = goal is not None and goal.pose is not None
        return RobotState(
            mode=self._verdict.mode,
            reasons=reasons,
            enabled=self._safety.enabled,
            battery=self._feedback.battery if self._feedback else None,
            goal_id=goal.goal_id if mission and goal is not None else None,
            map_epoch=version.epoch if version else 0,
            map_seq=version.seq if version else 0,
            plan_id=path.plan_id if path else None,
            planner_epoch=path.planner_epoch if path else None,
            goal_reached=mission and goal is not None and self._reached == goal.goal_id,
            goal_distance=self._follower.left if self._follower else None,
            loop=loop or LoopHealth(),
            traces=list(self._traces),
            stamp=stamp,
        )

    def finished_traces(self) -> list[Trace]:
        """Return the traces that came to their end since the last call, each once: for histograms."""
        finished, self._finished = self._finished, []
        return finished

    def obstacles(self, now: float, stamp: float) -> RobotObstacles | None:
        """Return points that the lidar sees and the map does not explain; None when it can't be told now."""
        localizer, geometry = self._localizer, self._replica.geometry
        points, sweep = localizer.points_in_map(), localizer.sweep
        pose = localizer.pose(now)
        if localizer.status != "good" or geometry is None or points is None or sweep is None or pose is None:
            return None
        if now - self._turn_at > 0.5 or abs(localizer.twist()[1]) > _OBSTACLE_TURN_RATE:
            return None
        near = np.hypot(*sweep.points.T) <= _OBSTACLE_RANGE_M
        strange = points[near & (localizer.wall_distance(points) > _EXPLAINED_M)]
        strange = strange[self._unexplained(strange, now)]
        cells, counts = np.unique(np.floor(strange / _OBSTACLE_CELL_M).astype(np.int64), axis=0, return_counts=True)
        # One beam alone may be a mixed echo off an edge.
        chosen = cells[counts >= 2]
        if len(chosen) > self._config.obstacle_limit:
            centre = (chosen + 0.5) * _OBSTACLE_CELL_M - (pose.x, pose.y)
            chosen = chosen[np.argsort(np.hypot(*centre.T), kind="stable")[: self._config.obstacle_limit]]
        ttl = self._config.obstacle_ttl
        self._own_cells = {cell: until for cell, until in self._own_cells.items() if until >= now}
        self._own_cells.update({(int(cx), int(cy)): now + ttl + 2.0 for cx, cy in chosen})
        listed = [((cx + 0.5) * _OBSTACLE_CELL_M, (cy + 0.5) * _OBSTACLE_CELL_M) for cx, cy in chosen.tolist()]
        view = _view(localizer.seen_from(), points, geometry)
        return RobotObstacles(points=listed, stamp=stamp, ttl=ttl, view=view)

    # --- restart ---

    def save(self, now: float) -> SavedPose | None:
        """Return the pose to store for a restart; None while it is not trusted."""
        return self._localizer.save(self._replica.site, now) if self._replica.site else None

    def restore(self, saved: SavedPose) -> None:
        """Start at a stored pose as soon as the map of its site is loaded; the lidar verifies it."""
        if self._replica.site == saved.site:
            self._localizer.restore(saved)
        else:
            self._saved = saved

    def global_localization(self) -> bool:
        """Search the whole map for the pose; False while map or lidar are missing. The robot must stand."""
        return self._wheels == (0.0, 0.0) and self._localizer.global_localization()

    # --- inside ---

    def _is_behind(self) -> bool:
        """Whether the copy of the map is broken, or another than the newest that a heartbeat told of."""
        told, version = self._told, self._replica.version
        if self._replica.needs_snapshot or version is None:
            return True
        return told is not None and (told.epoch != version.epoch or told.seq > version.seq)

    def _weigh_map(self, now: float) -> None:
        if not self._is_behind():
            self._map_confirmed_at, self._gap_since = now, None
        elif self._gap_since is None:
            self._gap_since = now

    def _on_mission(self) -> bool:
        goal = self._goal
        return goal is not None and goal.pose is not None and goal.goal_id not in {self._reached, self._cancelled}

    def _drop_path(self) -> None:
        self._path = self._follower = self._decision = None
        self._path_at = _NEVER
        self._block = self._blocked_since = self._foreign_since = None

    def _judge(self, now: float, request: Request | None) -> SafetyOutputs:
        self._safety, verdict = step(
            self._safety, replace(self._inputs(now), request=request), now, self._config.safety
        )
        if verdict.stop == "now" or (verdict.changed and verdict.stop != "none"):
            self._decision = None
        self._verdict = verdict
        return verdict

    def _inputs(self, now: float) -> SafetyInputs:
        feedback, follower = self._feedback, self._follower
        mission = self._on_mission()
        return SafetyInputs(
            map_loaded=self._replica.version is not None,
            map_age=now - self._map_confirmed_at,
            map_gap=self.map_gap(now),
            localization=self._localizer.status,
            localization_detail=self._localizer.detail,
            lidar_node_age=now - self._node_at,
            turn_age=now - self._turn_at,
            identical_turns=self._identical_turns,
            base_age=now - self._base_at,
            base_silent=self._base_silent,
            base_fault=feedback.fault if feedback else None,
            base_stopped=feedback.stopped if feedback else None,
            bumper=feedback is not None and feedback.bumper,
            cliff=feedback is not None and feedback.cliff,
            wheel_drop=feedback is not None and feedback.wheel_drop,
            mission=mission,
            plan_age=now - max(self._path_at, self._goal_at),
            released_left=follower.released_left if follower else 0.0,
            path_problem=self._path_problem(now) if mission else None,
            inside_blocked=self._inside_blocked(now),
            caution=self._caution(now),
        )

    def _path_problem(self, now: float) -> str | None:
        path, version = self._path, self._replica.version
        if path is None:
            return None
        if path.refusal is not None:
            return f"the planner finds no way: {path.refusal.reason}"
        if version is not None and path.map_epoch != version.epoch:
            if self._foreign_since is None:
                self._foreign_since = now
            if now - self._foreign_since > _PLANNER_GRACE_S:
                return "the path was planned on another map than the robot's"
        else:
            self._foreign_since = None
        if self._block is not None and self._blocked_since is not None:
            at, words = self._block
            progress = self._follower.progress if self._follower else 0.0
            if at - progress <= _BLOCK_NEAR_M or now - self._blocked_since > _PLANNER_GRACE_S:
                return words
        return None

    def _check_path(self, now: float) -> None:
        """Compare the path with the map copy, whenever either changed: the fog's plan may be older than its map."""
        follower, replica, path = self._follower, self._replica, self._path
        if follower is None or path is None or replica.geometry is None or replica.version is None:
            self._block = self._blocked_since = None
            return
        key = (replica.version, path.planner_epoch, path.plan_id)
        if key == self._checked:
            return
        self._checked = key
        same_map = path.map_epoch == replica.version.epoch
        if same_map and path.map_seq > replica.version.seq:
            # Judged as soon as the robot's map has caught up; how long it may lag is the gate's matter.
            self._block = self._blocked_since = None
            return
        # A planner that knew all of this map may lead the robot out over what its lidar took for an obstacle.
        known = same_map and path.map_seq == replica.version.seq
        ahead = first_blocked(replica.cost, replica.geometry, follower, led_out=known)
        if ahead is None:
            self._block = self._blocked_since = None
            return
        end = replica.geometry.cell(*follower.points[-1])
        goal_blocked = replica.geometry.contains_cell(*end) and replica.cost[end[1], end[0]] >= INSCRIBED
        what = "the goal is blocked" if goal_blocked else f"the path is blocked {ahead:.1f} m ahead"
        self._block = (follower.progress + ahead, f"{what} on the newest map; waiting for a new plan")
        if self._blocked_since is None:
            self._blocked_since = now

    def _inside_blocked(self, now: float) -> str | None:
        pose, geometry = self._localizer.pose(now), self._replica.geometry
        if pose is None or geometry is None or self._localizer.status not in {"good", "weak"}:
            return None
        column, row = geometry.cell(pose.x, pose.y)
        if not geometry.contains_cell(column, row) or self._replica.cost[row, column] != LETHAL:
            return None
        if self._replica.static[row, column] == LETHAL:
            return None  # a pose that is some centimetres off, beside a wall
        for hazard in self._hazards.values():
            if hazard.hazard.state != "clear" and contains_point(hazard.polygon, pose.x, pose.y):
                return f"the {hazard.hazard.state} area {hazard.label or hazard.hazard.area}"
        for zone in self._zones:
            if _zone_contains(zone.shape, pose.x, pose.y):
                return f"the no-go zone {zone.id}" + (f" ({zone.reason})" if zone.reason else "")
        if self._is_own(np.array([[pose.x, pose.y]]), now)[0]:
            return None
        return "a blocked part of the map"

    def _caution(self, now: float) -> str | None:
        pose = self._localizer.pose(now)
        if pose is None:
            return None
        for hazard in self._hazards.values():
            if hazard.hazard.state == "unknown" and contains_point(hazard.polygon, pose.x, pose.y):
                return f"nobody can tell whether the area {hazard.label or hazard.hazard.area} is clear"
        return None

    def _complaints(self, now: float) -> list[str]:
        """Say what hinders the robot without being the gate's matter."""
        said: list[str] = []
        if not self._on_mission() or self._verdict.stop != "none":
            return said
        decision, follower = self._decision, self._follower
        if decision is not None and decision.blocked:
            said.append(decision.blocked)
        if follower is None:
            said.append("waiting for a path")
        elif (stuck := follower.stuck_for(now)) > self._config.motion.stuck_after:
            said.append(f"no progress along the path for {stuck:.0f} s")
        return said

    def _close_traces(self, stamp: float) -> None:
        if not self._open_traces:
            return
        done = [msgspec.structs.replace(trace, first_command=stamp) for trace in self._open_traces]
        self._open_traces = []
        self._finished.extend(done)
        self._traces = [*self._traces, *done][-_TRACES:]

    def _unexplained(self, points: NDArray[np.float64], now: float) -> NDArray[np.bool_]:
        """Tell which points (n, 2) lie where nobody but this robot itself called something lethal or close to it."""
        geometry = self._replica.geometry
        assert geometry is not None
        columns = np.floor((points[:, 0] - geometry.origin_x) / geometry.resolution).astype(np.int64)
        rows = np.floor((points[:, 1] - geometry.origin_y) / geometry.resolution).astype(np.int64)
        inside = (columns >= 0) & (rows >= 0) & (columns < geometry.width) & (rows < geometry.height)
        free = np.zeros(len(points), dtype=np.bool_)
        cost = self._replica.cost[rows[inside], columns[inside]]
        known_floor = self._replica.static[rows[inside], columns[inside]] == 0
        free[inside] = known_floor & (cost < INSCRIBED)
        return free | (self._is_own(points, now) & inside)

    def _is_own(self, points: NDArray[np.float64], now: float) -> NDArray[np.bool_]:
        cells = np.floor(points / _OBSTACLE_CELL_M).astype(np.int64)
        return np.array(
            [
                any(
                    self._own_cells.get((int(cx) + dx, int(cy) + dy), _NEVER) >= now
                    for dx in (-1, 0, 1)
                    for dy in (-1, 0, 1)
                )
                for cx, cy in cells
            ],
            dtype=np.bool_,
        )


def _view(at: Pose2 | None, points: NDArray[np.float64], geometry: GridGeometry) -> View | None:
    """Return how far the points (n, 2; m, frame `map`) let the lidar see from where it was, None off the map."""
    if at is None or not geometry.contains_cell(*geometry.cell(at.x, at.y)):
        return None
    dx, dy = points[:, 0] - at.x, points[:, 1] - at.y
    sectors = np.floor(np.arctan2(dy, dx) % math.tau * (VIEW_SECTORS / math.tau)).astype(np.int64) % VIEW_SECTORS
    reach = np.full(VIEW_SECTORS, np.inf)
    np.minimum.at(reach, sectors, np.hypot(dx, dy))
    told = np.where(np.isfinite(reach), np.clip(np.floor(100.0 * reach), 0, 65_535), 0).astype(np.int64)
    return View(x=at.x, y=at.y, reach_cm=told.tolist())


def _zone_contains(shape: Shape, x: float, y: float) -> bool:
    if isinstance(shape, PolygonShape):
        return contains_point(shape.points, x, y)
    if isinstance(shape, RectangleShape):
        (x0, y0), (x1, y1) = shape.corner, shape.opposite
        return min(x0, x1) <= x <= max(x0, x1) and min(y0, y1) <= y <= max(y0, y1)
    if isinstance(shape, CircleShape):
        return math.hypot(x - shape.centre[0], y - shape.centre[1]) <= shape.radius
    assert isinstance(shape, CorridorShape)
    sides: Sequence[tuple[tuple[float, float], tuple[float, float]]] = list(
        zip(shape.line, shape.line[1:], strict=False)
    )
    return any(distance_to_segment(a, b, x, y) <= shape.width / 2 for a, b in sides)
