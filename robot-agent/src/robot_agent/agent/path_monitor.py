"""Whether the path may still be driven: the plan may be older than the robot's map, or lead where it gets no further.

A path must not be driven when it is blocked near the robot, or for longer than the planner needs to replan, or when it
was planned on another map, or on a version of the map that does not reach the robot.

A robot that may drive and gets no further holds, says why, and reports the place ahead as an obstacle. Otherwise one
before a gap that its body does not fit through would stand there for ever: the planner's map shows it as open, and
nothing that the lidar sees there is new.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_contracts.costs import INSCRIBED
from fog_contracts.messages import Reason, ReasonCode
from robot_agent.agent.mission import PATH_MAX_M
from robot_agent.motion.path_follower import at_speed, first_blocked

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.messages import RobotPath
    from fog_contracts.replica import Replica, Version
    from robot_agent.agent.mission import Mission, PathId
    from robot_agent.motion.path_follower import PathFollower
    from robot_agent.safety.gate import SafetyOutputs

BLOCK_NEAR_M: Final = 3.0
"""A blocked path this near stops the robot at once; farther away the planner gets `PLANNER_GRACE_S` to replan."""
OFF_PATH_M: Final = 1.1
"""A robot this far off its path waits for another one: nobody planned what lies between. From a little less on, 1.0 m,
the planner plans anew."""
PLANNER_GRACE_S: Final = 1.0
"""How long the planner may take for a path on the newest map."""
MAP_GRACE_S: Final = 1.0
"""How long the version of the map that a path was planned on may take to reach the robot."""


class _Blockage(NamedTuple):
    """Where along the path (m from its start) it is blocked, and the reason to report."""

    position: float
    reason: Reason


class _Awaited(NamedTuple):
    """A version of the map that a path names and the robot lacks, and since when (s)."""

    epoch: int
    seq: int
    since: float


class PathMonitor:
    """Compares the path that is followed with the robot's replica of the map."""

    def __init__(self) -> None:
        self._checked: tuple[Version, PathId] | None = None
        self._blockage: _Blockage | None = None
        self._blocked_since: float | None = None
        self._other_map_since: float | None = None
        self._awaited: _Awaited | None = None

    def begin(self) -> None:
        """Begin to monitor a new path. One that replaces a blocked path gets no new grace period."""
        self._blockage = self._checked = None

    def reset(self) -> None:
        """Forget the path: there is none to monitor."""
        self._blockage = self._blocked_since = self._other_map_since = self._awaited = None

    def check(self, mission: Mission, replica: Replica, now: float) -> None:
        """Look for a blockage along the path whenever path or map may have changed; cheap when neither did."""
        path_id, follower, path = mission.path_id, mission.follower, mission.path
        if path_id is None or path is None or follower is None or replica.version is None:
            self._clear()
            return
        if self._checked == (replica.version, path_id):
            return
        self._checked = (replica.version, path_id)
        self._blockage = _find_blockage(path, follower, replica, replica.version)
        if self._blockage is None:
            self._clear()
        elif self._blocked_since is None:
            self._blocked_since = now

    def problem(self, mission: Mission, version: Version | None, now: float) -> Reason | None:
        """Return why the path must not be driven; None when it may. Call it steadily: it measures durations."""
        path = mission.path
        if path is None or not mission.active:
            return None
        if self._is_of_other_map(path, version, now):
            return Reason(ReasonCode.PATH_OF_OTHER_MAP, "the path was planned on another map than the robot's")
        if (unfit := _unfit(path, mission.follower)) is not None:
            return unfit
        if version is not None and self._is_ahead_of_map(path, version, now):
            sentence = f"the path was planned on version {path.map_seq} of the map; the robot has version {version.seq}"
            return Reason(ReasonCode.PATH_NEWER_THAN_MAP, sentence)
        if self._blockage is None or self._blocked_since is None:
            return None
        progress = mission.follower.progress if mission.follower else 0.0
        near = self._blockage.position - progress <= BLOCK_NEAR_M
        return self._blockage.reason if near or now - self._blocked_since > PLANNER_GRACE_S else None

    def _clear(self) -> None:
        self._blockage = self._blocked_since = None

    def _is_of_other_map(self, path: RobotPath, version: Version | None, now: float) -> bool:
        if version is None or path.map_epoch == version.epoch:
            self._other_map_since = None
            return False
        if self._other_map_since is None:
            self._other_map_since = now
        return now - self._other_map_since > PLANNER_GRACE_S

    def _is_ahead_of_map(self, path: RobotPath, version: Version, now: float) -> bool:
        """Return whether the robot's map lacks a version of its path for too long.

        Newer paths may name newer versions meanwhile: each is awaited from when the one before has arrived.
        """
        if path.map_epoch != version.epoch or path.map_seq <= version.seq:
            self._awaited = None
            return False
        if self._awaited is None or self._awaited.epoch != version.epoch or self._awaited.seq <= version.seq:
            self._awaited = _Awaited(version.epoch, path.map_seq, now)
        return now - self._awaited.since > MAP_GRACE_S


def _unfit(path: RobotPath, follower: PathFollower | None) -> Reason | None:
    """Return why a robot where it is can't follow the path, on any map; None when it can."""
    if path.refusal is not None:
        return Reason(ReasonCode.PATH_REFUSED, f"the planner finds no path: {path.refusal.reason}")
    if follower is None:
        sentence = f"the path is longer than {PATH_MAX_M:.0f} m: send the robot to a place on its way first"
        return Reason(ReasonCode.PATH_TOO_LONG, sentence) if path.points else None
    if follower.distance > OFF_PATH_M:
        sentence = f"the robot is {follower.distance:.1f} m off its path, and waits for one that begins where it is"
        return Reason(ReasonCode.PATH_LEFT, sentence)
    return None


def _find_blockage(path: RobotPath, follower: PathFollower, replica: Replica, version: Version) -> _Blockage | None:
    """Return the first blockage of the rest of the path on the robot's map; None without one."""
    assert replica.geometry is not None
    same_map = path.map_epoch == version.epoch
    if same_map and path.map_seq > version.seq:
        # Checked as soon as the robot's map has caught up; `problem` limits how long it may lag.
        return None
    # A planner that knew this map may lead the robot out through cells that its lidar reported as an obstacle.
    known = same_map and path.map_seq == version.seq
    ahead = first_blocked(replica.cost, replica.geometry, follower, known_to_planner=known)
    if ahead is None:
        return None
    column, row = replica.geometry.cell(*follower.points[-1])
    goal_blocked = replica.geometry.contains_cell(column, row) and replica.cost[row, column] >= INSCRIBED
    subject = "the goal is blocked" if goal_blocked else f"the path is blocked {ahead:.1f} m ahead"
    reason = Reason(ReasonCode.PATH_BLOCKED, f"{subject} on the newest map; waiting for a new plan")
    return _Blockage(follower.progress + ahead, reason)


_AHEAD_M: Final = 0.28
"""How far ahead of the robot's rim the place is: what is nearer counts as the robot itself on the master costmap."""
_BAR_M: Final = (-0.2, -0.1, 0.0, 0.1, 0.2)
"""Where across the path the place is reported: inflated, it closes a gap that is too narrow for the body."""
_DIRECTION_M: Final = 0.05
"""Length of path from which its direction is taken."""
_RELEASED_END_M: Final = 0.3
"""This near to the end of what is released a robot waits for more: it is not stuck."""
_REPORTED_S: Final = 120.0
"""How long the place is reported: afterwards the lidar's view clears it, and the way is tried again."""

_TRIES_S: Final = 5.0
"""A robot that was hindered tries to get free: so long after that it may still get a little further."""

_NOWHERE: Final = np.zeros((0, 2))
_NEVER: Final = -math.inf


class _Standstill(NamedTuple):
    """The path on which the robot got no further, and the reason."""

    path_id: PathId | None
    reason: Reason


class ProgressMonitor:
    """Watches the progress along the path; times are seconds of the robot's monotonic clock.

    stuck_after: s without progress after which a robot that may drive holds. radius: m, of a circle around its body.
    """

    def __init__(self, stuck_after: float, radius: float) -> None:
        self._stuck_after = stuck_after
        self._ahead = radius + _AHEAD_M
        self._standstill: _Standstill | None = None
        self._hindrance: Reason | None = None
        self._hindered_at = _NEVER
        self._place, self._reported_until = _NOWHERE, _NEVER

    def problem(
        self, mission: Mission, hindrance: Reason | None, safety: SafetyOutputs, now: float, *, cap: float = math.inf
    ) -> Reason | None:
        """Return why the robot must hold until a new plan or goal; None while it gets on. Call it steadily.

        hindrance: what keeps the wheels from turning now. safety: the gate's last outputs. A robot that they stop is
        not stuck, and one that an operator disables begins anew. cap: the fastest that it may go (m/s).
        """
        self._forget_if_over(mission, safety)
        if hindrance is not None:
            # It comes and goes while the robot looks for a way: the last one counts.
            self._hindrance, self._hindered_at = hindrance, now
        follower = mission.follower
        if follower is None or not mission.active:
            return None
        if not safety.mission_may_drive or _waits_for_release(follower):
            follower.restart_progress_timer(now)
        if self._standstill is None and follower.stuck_for(now) * at_speed(cap) > self._stuck_after:
            self._hold(mission.path_id, follower, now)
        return None if self._standstill is None else self._standstill.reason

    def impassable(self, now: float) -> NDArray[np.float64]:
        """Return the points (n, 2; m, frame `map`) of the last place that the robot could not pass, for 120 s."""
        return self._place if now <= self._reported_until else _NOWHERE

    def _hold(self, path_id: PathId | None, follower: PathFollower, now: float) -> None:
        """Record a standstill with what hindered the robot last, and the place ahead, unless the lidar is the cause."""
        recent = now - self._hindered_at <= follower.stuck_for(now) + _TRIES_S
        hindrance = self._hindrance if recent else None
        because = f": {hindrance}" if hindrance is not None else ""
        reason = f"no progress along the path for {follower.stuck_for(now):.0f} s{because}"
        self._standstill = _Standstill(path_id, Reason(ReasonCode.NO_PROGRESS, reason))
        if hindrance is None or hindrance.code is not ReasonCode.LIDAR_BLIND:
            self._place, self._reported_until = _bar_across(follower, self._ahead), now + _REPORTED_S

    def _forget_if_over(self, mission: Mission, safety: SafetyOutputs) -> None:
        """Forget the standstill of another path, of a goal that has ended, and of a robot that was disabled."""
        standstill = self._standstill
        if standstill is None:
            return
        if not mission.active or safety.mode == "INIT" or standstill.path_id != mission.path_id:
            self._standstill = None


def _waits_for_release(follower: PathFollower) -> bool:
    """Whether the robot has come to the end of what the planner has released, which is not the end of the path."""
    return follower.released < follower.length and follower.released_remaining <= _RELEASED_END_M


def _bar_across(follower: PathFollower, ahead: float) -> NDArray[np.float64]:
    """Return a bar of points across the path, `ahead` m from the robot; none if the path ends before that."""
    if follower.remaining < ahead:
        return _NOWHERE
    at = follower.progress + np.array((ahead - _DIRECTION_M, ahead))
    xs, ys = (np.interp(at, follower.along, follower.points[:, i]) for i in (0, 1))
    direction = math.atan2(ys[1] - ys[0], xs[1] - xs[0])
    across = np.array(_BAR_M)
    return np.column_stack((xs[1] - across * math.sin(direction), ys[1] + across * math.cos(direction)))
