"""What a robot does that gets no further: it waits, turns to its path, backs up along its trail, and tries again. Pure.

`step` is a state machine, `recovery_speeds` makes its moves where the body keeps its distance from all that map and
lidar know, `Trail` is the way just driven, and `Recoveries` connects them. The moves at one place are numbered, so that
they have an end: afterwards the robot holds, and the planner learns of the place. The stop field guards the moves like
any other command, so a direction that the lidar does not see is not driven into.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import numpy as np

from fog_contracts.costs import UNKNOWN
from fog_kernels.course import distances
from robot_agent.localization.pose import wrap
from robot_agent.motion.path_follower import at_speed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.messages import ReasonCode
    from fog_kernels.clearance import Clearance
    from fog_kernels.robot import Body
    from robot_agent.localization.pose import Pose2
    from robot_agent.motion.path_follower import PathFollower

Kind = Literal["turn", "back"]


class Attempt(NamedTuple):
    """One move of the series: turn in place towards the path, or back up for `length` m."""

    kind: Kind
    length: float = 0.0


SERIES: Final = (Attempt("turn"), Attempt("back", 0.15), Attempt("turn"), Attempt("back", 0.3))
"""The moves at one place, each followed by another try to drive on."""
PATIENCE_S: Final = 4.0
"""What blocks the path may go away by itself: the robot waits so long without progress before each move."""
MOVE_MAX_S: Final = 5.0
"""A move that takes longer is given up: the stop field may forbid it."""
ALIGNED_RAD: Final = 0.1
"""A robot that heads so nearly along its path has turned."""
WORTH_TURNING_RAD: Final = 0.25
WORTH_BACKING_M: Final = 0.06
"""A smaller turn, or less of a trail, changes nothing."""
SAME_PLACE_M: Final = 0.6
"""Within this distance of where its series began a robot is still stuck at the same place."""


class Situation(NamedTuple):
    """Where the robot is (m, in a frame that does not jump), and for how long (s) it has made no progress.

    error: how far (rad) its path leads to the left of its heading. trail: m that it could back up.
    refused: whether the move that runs can't go on because there is no room.
    """

    place: tuple[float, float]
    stuck_for: float
    error: float
    trail: float
    refused: bool = False


@dataclass(frozen=True, slots=True)
class Recovery:
    """State of the machine: moves begun at this place, the one that runs with its begin (s), and where it all began.

    until: length of trail (m) at which backing up ends.
    """

    begun: int = 0
    running: Attempt | None = None
    since: float = 0.0
    until: float = 0.0
    origin: tuple[float, float] | None = None


def step(state: Recovery, seen: Situation, now: float) -> Recovery:
    """Return the state at `now` (s, monotonic); call it with each decision while the robot may drive."""
    if state.origin is not None and math.dist(state.origin, seen.place) > SAME_PLACE_M:
        return Recovery()
    if state.running is not None:
        return replace(state, running=None) if _over(state, state.running, seen, now) else state
    if seen.stuck_for < PATIENCE_S:
        return state
    for number in range(state.begun, len(SERIES)):
        attempt = SERIES[number]
        if _worth(attempt, seen):
            return Recovery(
                begun=number + 1,
                running=attempt,
                since=now,
                until=max(seen.trail - attempt.length, 0.0),
                origin=state.origin or seen.place,
            )
    return replace(state, begun=len(SERIES), origin=state.origin or seen.place)


def _worth(attempt: Attempt, seen: Situation) -> bool:
    """Whether a move would change anything."""
    if attempt.kind == "turn":
        return abs(seen.error) >= WORTH_TURNING_RAD
    return seen.trail >= WORTH_BACKING_M


def _over(state: Recovery, running: Attempt, seen: Situation, now: float) -> bool:
    """Whether the move that runs is done, or is given up."""
    if seen.refused or now - state.since >= MOVE_MAX_S:
        return True
    return abs(seen.error) <= ALIGNED_RAD if running.kind == "turn" else seen.trail <= state.until


BACK_M_S: Final = 0.08
_TURN_RAD_S: Final = 0.6
_SLOWEST_RAD_S: Final = 1e-3
_GAIN_PER_S: Final = 2.0
_AIM_M: Final = 0.15
"""The robot aims at the point of its trail this far behind it."""
_HERE_M: Final = 0.005
"""A point of the trail that is nearer than this is where the robot stands."""
_ASIDE_RAD: Final = 0.3
"""If its trail leads farther to a side than this, the robot first turns its back on it."""
_LOOK_M: Final = 0.1
"""How far behind must be free: more than a period and braking take."""
_LOOK_RAD: Final = 0.35
_STEPS: Final = 10
_ROUNDING_M: Final = 1e-3
_RIM: Final = np.array([(0.0, 0.0), *((math.cos(turn), math.sin(turn)) for turn in np.arange(16) * math.tau / 16)]).T
"""(2, 17): where a disc of radius 1 is looked at: its centre, and its rim every 7 cm of a body of 0.17 m."""


class RecoveryMove(NamedTuple):
    """A move to make: turn to `heading` (rad), or back up along `trail` (n, 2; m), nearest point first; frame `map`."""

    heading: float | None = None
    trail: NDArray[np.float64] | None = None


def recovery_speeds(
    move: RecoveryMove, pose: Pose2, around: Clearance, body: Body, padding: float, cap: float
) -> tuple[float, float] | None:
    """Return v, w (m/s, rad/s) of a move now, None where there is no room for it.

    pose: the robot in `map`. padding: m that the body keeps from everything; one that is nearer must not come nearer
    still. cap: the fastest that the robot may go (m/s).
    """
    v, w = _wanted(move, pose, cap)
    return (v, w) if _has_room(pose, v, w, around, body, padding) else None


def clearances(
    around: Clearance, body: Body, poses: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Return how far (n; m) the body at poses x, y, theta (each n; frame `map`) is from everything.

    0 where any part of it is off the map or over cells that nobody knows.
    """
    x, y, theta = (values[:, None] for values in poses)
    cos, sin = np.cos(theta), np.sin(theta)
    discs = body.discs if len(body.discs) else np.array([(0.0, 0.0, body.circumscribed)])
    ahead, left, radius = discs.T
    centre_x, centre_y = x + cos * ahead - sin * left, y + sin * ahead + cos * left
    centres = np.column_stack((centre_x.ravel(), centre_y.ravel()))
    away = distances(around, centres).reshape(centre_x.shape) - radius
    rim_x, rim_y = _RIM[:, None, :] * radius[:, None]
    known = _known(around, centre_x[..., None] + rim_x, centre_y[..., None] + rim_y).all(axis=2)
    least: NDArray[np.float64] = np.where(known, away, 0.0).min(axis=1)
    return least


def _known(around: Clearance, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which points (m) are on the map and in cells that somebody knows."""
    last = len(around.cost) - 1
    column = np.floor((x - around.origin_x) / around.resolution).astype(np.int64)
    row = np.floor((y - around.origin_y) / around.resolution).astype(np.int64)
    inside = (column >= 0) & (row >= 0) & (column <= last) & (row <= last)
    known: NDArray[np.bool_] = inside & (around.cost[row.clip(0, last), column.clip(0, last)] != UNKNOWN)
    return known


def _wanted(move: RecoveryMove, pose: Pose2, cap: float) -> tuple[float, float]:
    if move.heading is not None:
        return 0.0, _turn(wrap(move.heading - pose.theta))
    if move.trail is None or len(move.trail) == 0:
        return 0.0, 0.0
    behind = pose.inverse_transform(move.trail)
    along = np.hypot(behind[:, 0], behind[:, 1])
    far = np.flatnonzero(along >= _AIM_M)
    point = far[0] if len(far) else -1
    if along[point] < _HERE_M:
        return 0.0, 0.0  # no direction leads to where the robot is
    x, y = (float(value) for value in behind[point])
    aside = math.atan2(-y, -x)
    if abs(aside) > _ASIDE_RAD:
        return 0.0, _turn(aside)
    v = -min(BACK_M_S, cap)
    # The arc that touches the robot's heading and passes through the point.
    return v, v * 2.0 * y / (x * x + y * y)


def _turn(error: float) -> float:
    rate = min(_TURN_RAD_S, _GAIN_PER_S * abs(error))
    return math.copysign(rate, error) if rate > _SLOWEST_RAD_S else 0.0


def _has_room(pose: Pose2, v: float, w: float, around: Clearance, body: Body, padding: float) -> bool:
    """Whether the body keeps its padding, or what it has of it, on the arc until it could have stopped."""
    if v == 0.0 and w == 0.0:
        return True
    reach = _LOOK_M / abs(v) if v else _LOOK_RAD / abs(w)
    times = np.linspace(0.0, reach, _STEPS + 1)
    turned = w * times
    middle = pose.theta + 0.5 * turned
    chord = v * times * np.sinc(0.5 * turned / math.pi)
    kept = clearances(
        around, body, (pose.x + chord * np.cos(middle), pose.y + chord * np.sin(middle), pose.theta + turned)
    )
    return bool((kept[1:] >= min(padding, float(kept[0])) - _ROUNDING_M).all())


LENGTH_M: Final = 0.6
"""Longer ago something may have come."""
_TRAIL_SPACING_M: Final = 0.02


class Trail:
    """The last places of the robot, the newest one last."""

    def __init__(self) -> None:
        self._places: list[tuple[float, float]] = []

    @property
    def length(self) -> float:
        """Metres of it."""
        return _TRAIL_SPACING_M * max(len(self._places) - 1, 0)

    def clear(self) -> None:
        """Forget it: the robot may have been moved by others."""
        self._places.clear()

    def add(self, pose: Pose2) -> None:
        """Record where the robot is; on its way back it takes up what it passes again."""
        places, here = self._places, (pose.x, pose.y)
        if not places:
            places.append(here)
        back = False
        while len(places) > 1 and math.dist(places[-2], here) < math.dist(places[-1], here):
            places.pop()
            back = True
        away = math.dist(places[-1], here)
        if back or away < _TRAIL_SPACING_M:
            return
        x, y = places[-1]
        for step in range(1, int(away / _TRAIL_SPACING_M) + 1):
            share = step * _TRAIL_SPACING_M / away
            places.append((x + share * (pose.x - x), y + share * (pose.y - y)))
        del places[: -round(LENGTH_M / _TRAIL_SPACING_M) - 1]

    def behind(self, pose: Pose2) -> NDArray[np.float64]:
        """Return its points (n, 2; m) in `base` of a robot at `pose`, the nearest one first."""
        if not self._places:
            return np.zeros((0, 2))
        return pose.inverse_transform(np.array(self._places[::-1]))


_TURN_AIM_M: Final = 0.3
"""The robot turns towards the point of its path this far ahead."""


class Recoveries:
    """The recovery of one robot, and the trail that it backs up along."""

    def __init__(self) -> None:
        self._state = Recovery()
        self._trail = Trail()
        self._refused = False

    def reset(self) -> None:
        """Forget trail and moves: the robot is stopped, and may be moved by others meanwhile."""
        self._state = Recovery()
        self._trail.clear()
        self._refused = False

    def due(self, follower: PathFollower, pose: Pose2, odom: Pose2, cap: float, now: float) -> RecoveryMove | None:
        """Return the move to make now, None to follow the path; call it with each decision.

        pose, odom: the robot in `map` and `odom`. cap: the fastest that it may go (m/s). now: s, monotonic. While a
        move runs, the time without progress does not count.
        """
        self._trail.add(odom)
        points, _ = follower.released_ahead(_TURN_AIM_M)
        heading = math.atan2(points[-1][1] - pose.y, points[-1][0] - pose.x)
        seen = Situation(
            place=(odom.x, odom.y),
            stuck_for=follower.stuck_for(now) * at_speed(cap),
            error=wrap(heading - pose.theta),
            trail=self._trail.length,
            refused=self._refused,
        )
        self._state, self._refused = step(self._state, seen, now), False
        if self._state.running is None:
            return None
        follower.restart_progress_timer(now)
        if self._state.running.kind == "turn":
            return RecoveryMove(heading=heading)
        return RecoveryMove(trail=pose.transform(self._trail.behind(odom)))

    def on_decision(self, blocked: ReasonCode | None) -> None:
        """Record whether the move that runs could be made; `blocked`: why the newest decision does not let it."""
        self._refused = self._state.running is not None and blocked is not None
