"""The robot's mission: its goal, the planner's path to it, and the progress along the path."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.geometry import PATH_SPACING_M, lengths_along, sampled
from fog_contracts.liveness import Delays
from robot_agent.motion.path_follower import PathFollower

if TYPE_CHECKING:
    from fog_contracts.messages import RobotGoal, RobotPath, RobotRelease

_NEVER: Final = -math.inf
PATH_MAX_M: Final = 2000.0
"""A longer path is not followed: with a point every few centimetres it would hold up the wheel commands."""

PathId = tuple[int, int]
"""Identity of a path: the planner's epoch and the plan's number."""


class Mission:
    """One goal at a time, and the newest path to it. Times are seconds of the robot's monotonic clock."""

    def __init__(self) -> None:
        self.goal: RobotGoal | None = None
        self.path: RobotPath | None = None
        """The newest path or refusal for the goal."""
        self.follower: PathFollower | None = None
        """Progress along the path; None while there is none to follow."""
        self._reached: str | None = None
        self._cancelled: str | None = None
        self._goal_at = _NEVER
        self._path_at = _NEVER
        self._delays = Delays()
        self._early_path: RobotPath | None = None

    @property
    def active(self) -> bool:
        """Whether there is a goal to drive to: neither reached nor cancelled."""
        return self.has_goal and self.goal is not None and self.goal.goal_id not in {self._reached, self._cancelled}

    @property
    def has_goal(self) -> bool:
        """Whether the planner has set a goal, be it reached or cancelled."""
        return self.goal is not None and self.goal.pose is not None

    @property
    def goal_id(self) -> str | None:
        """Id of the goal; None without one."""
        return self.goal.goal_id if self.goal is not None and self.goal.pose is not None else None

    @property
    def reached(self) -> bool:
        """Whether the robot has reached its goal."""
        return self.goal_id is not None and self.goal_id == self._reached

    @property
    def path_id(self) -> PathId | None:
        """Identity of the path; None without one."""
        return None if self.path is None else (self.path.planner_epoch, self.path.plan_id)

    def planner_age(self, now: float) -> float:
        """Return the age (s) of the planner's last message on goal, path or refusal; infinite without one.

        It counts from when that was sent, as far as the delays of paths and releases tell.
        """
        return now - max(self._path_at, self._goal_at)

    def on_goal(self, goal: RobotGoal, now: float) -> bool:
        """Set the goal; return whether the current path is not followed any more: the goal is another one, or over."""
        current = self.goal
        if current is not None and current.goal_id == goal.goal_id and current.pose == goal.pose:
            return False
        self.goal, self._goal_at = goal, now
        if current is not None and current.goal_id == goal.goal_id:
            if goal.pose is None:
                self.drop_path()
            return goal.pose is None
        self._reached = self._cancelled = None
        self.drop_path()
        return True

    def on_path(self, path: RobotPath, now: float) -> bool:
        """Handle a path, the same one again or a refusal; return whether a new path is followed from now on.

        A path older than the current one is ignored; the newest one for another goal, which may be about to arrive, is
        kept for `take_early_path`.
        """
        delay = self._delays.update(path.sent, now)
        if self.goal is None or path.goal_id != self.goal.goal_id:
            self._keep_early(path)
            return False
        new, current = (path.planner_epoch, path.plan_id), self.path_id
        if current is not None and new < current:
            return False
        self.path, self._path_at = path, now - delay
        if path.refusal is not None or not path.points:
            self.follower = None
            return False
        if new == current and self.follower is not None:
            self.follower.release(path.released_length)
            return False
        corners = np.array(path.points, dtype=np.float64)
        self.follower = None
        if lengths_along(corners)[-1] > PATH_MAX_M:
            return False
        self.follower = PathFollower(sampled(corners, PATH_SPACING_M), path.released_length)
        return True

    def take_early_path(self) -> RobotPath | None:
        """Return the path that came before its goal, once that is there; None if there is none."""
        path = self._early_path
        if path is None or self.goal is None or path.goal_id != self.goal.goal_id:
            return None
        self._early_path = None
        return path

    def forget_early_path(self) -> None:
        """Forget the path that came before its goal."""
        self._early_path = None

    def on_release(self, release: RobotRelease, now: float) -> None:
        """Extend the path; the release of one that the robot does not have keeps nothing alive."""
        delay = self._delays.update(release.sent, now)
        if self.path is None or self.path_id != (release.planner_epoch, release.plan_id):
            return
        self.path, self._path_at = self.path.after(release), max(self._path_at, now - delay)
        if self.follower is not None:
            self.follower.release(release.released_length)

    def confirm(self, now: float) -> None:
        """Record that the robot's own planner confirms goal and path."""
        self._path_at = now

    def reach(self) -> None:
        """Record that the robot has reached its goal."""
        self._reached = self.goal_id
        self.drop_path()

    def cancel(self) -> str | None:
        """Cancel the goal until the planner sets another; return its id, None without one."""
        if self.goal_id is None:
            return None
        self._cancelled = self.goal_id
        self.drop_path()
        return self._cancelled

    def resume(self) -> None:
        """Drive to a cancelled goal after all."""
        self._cancelled = None

    def _keep_early(self, path: RobotPath) -> None:
        known = self._early_path
        if known is None or (path.planner_epoch, path.plan_id) >= (known.planner_epoch, known.plan_id):
            self._early_path = path

    def drop_path(self) -> None:
        """Follow no path until the planner sends one again."""
        self.path = self.follower = None
        self._path_at = _NEVER
