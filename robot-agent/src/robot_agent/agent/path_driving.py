"""Driving along the planner's path: from goal and path to wheel commands, within what the safety gate allows."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from robot_agent.agent.mission import Mission
from robot_agent.agent.path_monitor import PathMonitor, ProgressMonitor
from robot_agent.agent.wheel_control import WheelControl
from robot_agent.localization.scans import RecentScans
from robot_agent.motion.local_planner import Decision, make_job, twist
from robot_agent.motion.recovery import Recoveries
from robot_agent.safety.gate import MANEUVERS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

    from fog_contracts.handlers import Moment
    from fog_contracts.messages import Reason, RobotGoal, RobotPath, RobotRelease, Trace
    from fog_contracts.replica import Replica
    from robot_agent.agent.motion_guard import MotionGuard
    from robot_agent.config import AgentConfig, MotionConfig
    from robot_agent.guardian.link import WheelCommand
    from robot_agent.localization.localizer import Localizer
    from robot_agent.localization.pose import Pose2
    from robot_agent.motion.local_planner import Job
    from robot_agent.safety.gate import SafetyOutputs, SafetyState
    from robot_agent.safety.stop_field import Wheels

_RECENT_MAX: Final = 16


class PathTraces:
    """Traces of the followed path, open until its first wheel command. Stamps are seconds since the epoch.

    `recent`: the last closed traces, for the state message.
    """

    def __init__(self) -> None:
        self.recent: list[Trace] = []
        self._open: list[Trace] = []
        self._finished: list[Trace] = []

    def begin(self, traces: Iterable[Trace], stamp: float) -> None:
        """Open the traces of a new path; those of the path before it are dropped."""
        self._open = [msgspec.structs.replace(trace, path_received=stamp) for trace in traces]

    def close(self, stamp: float) -> None:
        """Close the open traces: a wheel command follows the new path."""
        if not self._open:
            return
        closed = [msgspec.structs.replace(trace, first_command=stamp) for trace in self._open]
        self._open = []
        self._finished.extend(closed)
        self.recent = [*self.recent, *closed][-_RECENT_MAX:]

    def take_finished(self) -> list[Trace]:
        """Return the traces that were closed since the last call, each once."""
        finished, self._finished = self._finished, []
        return finished


_PAUSE_S: Final = 1.0
"""Longer than a robot takes between two looks at its path, whatever it does."""


class PathDriving:
    """The mission, its path with the blockages on it, and the decision that the wheels follow.

    `now` is s of the robot's monotonic clock.
    """

    def __init__(self, config: AgentConfig) -> None:
        self._config = config.motion
        self._footprint = config.footprint
        self.mission = Mission()
        self.wheels = WheelControl(config)
        self.traces = PathTraces()
        self._monitor = PathMonitor()
        self._progress = ProgressMonitor(config.motion.stuck_after, config.radius)
        self._scans = RecentScans()
        self._recoveries = Recoveries()
        self._arrived = False
        """Whether the last decision was made within the tolerance of the path's end."""
        self._ran_at = -math.inf
        """When (s) this was last used: steadily, unless the computer is too late."""
        self._cap = math.inf
        """The fastest (m/s) that the robot might go when the last decision was asked for."""

    def configure(self, config: MotionConfig) -> None:
        """Follow paths by another configuration from now on, and drop the present path, and one that came early."""
        self._config = config
        self.mission.forget_early_path()
        self.mission.drop_path()
        self._stop_following()

    # --- goal and path ---

    def on_goal(self, goal: RobotGoal, pose: Pose2 | None, replica: Replica, at: Moment) -> None:
        """Set the goal; the path to another goal is no longer followed, and one that came before its goal is now."""
        if self.mission.on_goal(goal, at.now):
            self._stop_following()
        if (early := self.mission.take_early_path()) is not None:
            self.on_path(early, pose, replica, at)

    def on_path(self, path: RobotPath, pose: Pose2 | None, replica: Replica, at: Moment) -> None:
        """Follow a new path from where the robot is, extend the current one that is repeated, or record a refusal."""
        mission = self.mission
        if mission.on_path(path, at.now):
            if pose is not None and mission.follower is not None:
                mission.follower.advance(pose.x, pose.y, at.now)
            self.traces.begin(path.traces, at.stamp)
            self._monitor.begin()
            self._arrived = False
        self.check_path(replica, at.now)

    def on_release(self, release: RobotRelease, replica: Replica, now: float) -> None:
        """Extend the path that the planner releases."""
        self.mission.on_release(release, now)
        self.check_path(replica, now)

    def check_path(self, replica: Replica, now: float) -> None:
        """Look for blockages along the path; call it whenever the map may have changed."""
        self._monitor.check(self.mission, replica, now)

    def path_problem(self, replica: Replica, guard: MotionGuard, safety: SafetyOutputs, now: float) -> Reason | None:
        """Return why the path must not be driven; None when it may. Call it steadily: it measures durations.

        `guard` tells what limits the wheels, `safety` what the gate allowed last.
        """
        self._notice_pause(now)
        blocked = self.wheels.decision.hindrance if self.wheels.decision else None
        standstill = self._progress.problem(self.mission, guard.reason or blocked, safety, now, cap=self._cap)
        return self._monitor.problem(self.mission, replica.version, now) or standstill

    def _notice_pause(self, now: float) -> None:
        """Restart the timer of the progress after a time in which the computer ran nothing, and the robot stood."""
        if now - self._ran_at > _PAUSE_S and self.mission.follower is not None:
            self.mission.follower.restart_progress_timer(now)
        self._ran_at = now

    def impassable(self, now: float) -> NDArray[np.float64]:
        """Return the points (n, 2; m, frame `map`) of a place that the robot could not pass, for some time."""
        return self._progress.impassable(now)

    def way(self, limit: float) -> NDArray[np.float64]:
        """Return the points (n, 2; m, frame `map`) of the next `limit` m of the path to the goal; none without one."""
        follower = self.mission.follower if self.mission.active else None
        return np.zeros((0, 2)) if follower is None else follower.next_points(limit)

    def cancel_goal(self) -> str | None:
        """Cancel the goal; return its id, None without one."""
        cancelled = self.mission.cancel()
        if cancelled is not None:
            self._stop_following()
        return cancelled

    def _stop_following(self) -> None:
        """Forget decision and blockage of the path that the mission dropped."""
        self.wheels.decision = None
        self._arrived = False
        self._monitor.reset()

    # --- decisions and wheels ---

    def job(self, localizer: Localizer, replica: Replica, safety: SafetyOutputs, now: float) -> Job | None:
        """Return the inputs of the next decision; None while there is no goal or the robot must not drive."""
        pose, odom, mission = localizer.pose(now), localizer.odom_at(now), self.mission
        follower, path = mission.follower, mission.path
        if not (safety.mission_may_drive and mission.active):
            self._recoveries.reset()
        if follower is None or path is None or not mission.active:
            return None
        if pose is None or odom is None or replica.geometry is None:
            return None
        self._notice_pause(now)
        follower.advance(pose.x, pose.y, now)
        if not safety.mission_may_drive:
            return None
        scan, scan_pose = localizer.scan, localizer.scan_pose()
        points = np.zeros((0, 2))
        if scan is not None and scan_pose is not None:
            self._scans.add(scan, now)
            points = self._scans.points(scan_pose, now)
        job = make_job(
            follower,
            plan_id=path.plan_id,
            planner_epoch=path.planner_epoch,
            now=now,
            pose=pose,
            speeds=twist(*self.wheels.speeds, self._config.limits.axle),
            goal_theta=path.goal_theta,
            arrived=self._arrived,
            cap=safety.cap,
            cost=replica.cost,
            speed_limits=replica.speed,
            geometry=replica.geometry,
            lidar_points=points,
            footprint=self._footprint,
            config=self._config,
        )
        if job is None:
            return None
        self._cap = job.cap
        recovery = None if self._arrived else self._recoveries.due(follower, pose, odom, job.cap, now)
        return job if recovery is None else replace(job, recovery=recovery)

    def accept(self, decision: Decision) -> None:
        """Drive by a decision; one for a path that is no longer followed is dropped."""
        if self.mission.path_id != (decision.planner_epoch, decision.plan_id) or not self.mission.active:
            return
        self.wheels.decision = decision
        self._arrived = decision.arrived
        self._recoveries.on_decision(decision.blocked)
        if decision.at_goal:
            self.mission.reach()
            self._stop_following()

    def busy(self, state: SafetyState, safety: SafetyOutputs) -> bool:
        """Return whether the robot moves, or will by itself: on a mission or a maneuver that it may drive."""
        return not self.wheels.at_rest or safety.mode in MANEUVERS or (state.enabled and self.mission.active)

    def obey(self, safety: SafetyOutputs) -> None:
        """Drop the decision when the safety gate stops the robot."""
        if safety.stop == "immediate" or (safety.changed and safety.stop != "none"):
            self.wheels.decision = None

    def command_directly(
        self, wheels: Wheels, safety: SafetyOutputs, guard: Callable[[Wheels, float], Wheels], now: float
    ) -> WheelCommand:
        """Return the wheel speeds to send now for these (m/s) of a maneuver, within the same limits as a path's."""
        left, right = wheels
        self.wheels.decision = Decision(plan_id=0, planner_epoch=0, made_at=now, left=left, right=right)
        return self.wheels.command(safety, guard, now)

    def command(
        self, safety: SafetyOutputs, guard: Callable[[Wheels, float], Wheels], now: float, stamp: float
    ) -> WheelCommand:
        """Return the wheel speeds to send now, within `guard`; the first ones on a new path close its traces."""
        command = self.wheels.command(safety, guard, now)
        if self.wheels.following:
            self.traces.close(stamp)
        return command
