"""A robot that may drive and gets no further holds, says why, and reports the place ahead as an obstacle.

Otherwise a robot before a gap that its body does not fit through would stand there for ever: the planner's map shows it
as open, and nothing that the lidar sees there is new.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from robot_agent.motion.path_follower import at_speed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.agent.path.mission import Mission, PathId
    from robot_agent.motion.path_follower import PathFollower
    from robot_agent.safety.gate import SafetyOutputs

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


class Hindrance(NamedTuple):
    """What keeps the wheels from turning now: in words, and whether it is the lidar's view and not the place."""

    words: str | None = None
    unseeing: bool = False


class _Standstill(NamedTuple):
    """The path on which the robot got no further, and the reason."""

    path_id: PathId | None
    reason: str


class ProgressMonitor:
    """Watches the progress along the path; times are seconds of the robot's monotonic clock.

    stuck_after: s without progress after which a robot that may drive holds. radius: m, of a circle around its body.
    """

    def __init__(self, stuck_after: float, radius: float) -> None:
        self._stuck_after = stuck_after
        self._ahead = radius + _AHEAD_M
        self._standstill: _Standstill | None = None
        self._hindrance, self._hindered_at = Hindrance(), _NEVER
        self._place, self._reported_until = _NOWHERE, _NEVER

    def problem(
        self, mission: Mission, hindrance: Hindrance, safety: SafetyOutputs, now: float, *, cap: float = math.inf
    ) -> str | None:
        """Return why the robot must hold until a new plan or goal; None while it gets on. Call it steadily.

        safety: the gate's last outputs. A robot that they stop is not stuck, and one that an operator disables begins
        anew. cap: the fastest that it may go (m/s).
        """
        self._forget_if_over(mission, safety)
        if hindrance.words is not None:
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
        hindrance = self._hindrance if recent else Hindrance()
        because = f": {hindrance.words}" if hindrance.words else ""
        reason = f"no progress along the path for {follower.stuck_for(now):.0f} s{because}"
        self._standstill = _Standstill(path_id, reason)
        if not hindrance.unseeing:
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
