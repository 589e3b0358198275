"""The moves of a recovery as speeds: only where the body keeps its distance from all that map and lidar know. Pure.

The stop field guards them like any other command, so a direction that the lidar does not see is not driven into.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_contracts.costs import UNKNOWN
from fog_kernels.course import distances
from robot_agent.localization.pose import wrap

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_kernels.clearance import Clearance
    from fog_kernels.robot import Body
    from robot_agent.localization.pose import Pose2

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
