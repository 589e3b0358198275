"""From a path to wheel speeds: the distances around the robot, a way round what blocks it, the dynamic window's choice.

`make_job` gathers what a decision needs; `decide` is the slow part, pure, and may run on a thread.
Frames: everything in `map`. Method: Dynamic Window Approach (Fox, Burgard and Thrun 1997) in `fog_kernels.dwa`. The
path is an elastic band (Quinlan and Khatib 1993, Elastic bands: connecting path planning and control), reduced to the
force that pushes points out of narrow places: near obstacles it gives way to the middle of what is free.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_contracts.costs import NO_SPEED_LIMIT
from fog_contracts.messages import Reason, ReasonCode
from fog_kernels.clearance import Clearance, clearance
from fog_kernels.course import beside, distances
from fog_kernels.dwa import dwa
from fog_kernels.robot import Body, cover
from robot_agent.localization.pose import Pose2, wrap
from robot_agent.motion.path_follower import free_path
from robot_agent.motion.recovery import recovery_speeds

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.costs import Inflation
    from fog_contracts.grid import GridGeometry
    from fog_kernels.robot import DwaLimits, DwaSettings
    from robot_agent.config import MotionConfig
    from robot_agent.footprint import Footprint
    from robot_agent.motion.path_follower import PathFollower
    from robot_agent.motion.recovery import RecoveryMove

_SPACING_M: Final = 0.05
_STEPS: Final = 6
_STEP_M: Final = 0.02
"""Points are pushed in so many steps of at most this length: by 12 cm in all."""
_REACH_M: Final = _STEP_M
"""Half the distance over which the slope of the distances is measured: as far as a step leads. So a step from beside
the middle of a narrow place ends on it. Measured over more, the slope fades before the middle, and the steps end
beside it; over less, they lead across it and back."""


class Course(NamedTuple):
    """A path (n, 2; m) with points (m, 2) every 5 cm, `along` it (m), and how far from everything they are (m)."""

    path: NDArray[np.float64]
    points: NDArray[np.float64]
    along: NDArray[np.float64]
    free: NDArray[np.float64]


def course(path: NDArray[np.float64], around: Clearance) -> Course:
    """Return a path (n, 2; m) with the distances from the nearest thing along it."""
    return Course(path, *beside(path, _SPACING_M, around))


def give_way(original: Course, around: Clearance, keep: float) -> Course:
    """Return the path, its points near things pushed away until they are `keep` m off or in the middle.

    Begin and end stay where they are, and so does everything beyond the window of `around`. It is the `original` one
    if no point is near anything.
    """
    _, points, along, found = original
    if not (found < keep).any():
        return original
    size = len(around.distance) * around.resolution
    corner = np.array((around.origin_x, around.origin_y))
    within = (points > corner + _REACH_M) & (points < corner + size - _REACH_M)
    inside = within[:, 0] & within[:, 1] & (along > 0.0) & (along < along[-1])
    if not (found[inside] < keep).any():
        return original
    # What the window's border cuts off must not become a step in the path.
    moved, free = points[inside], np.minimum(along[-1] - along[inside], along[inside]) / (2.0 * _SPACING_M)
    for _ in range(_STEPS):
        slope = np.column_stack(
            [
                distances(around, moved + offset) - distances(around, moved - offset)
                for offset in ((_REACH_M, 0.0), (0.0, _REACH_M))
            ]
        ) / (2.0 * _REACH_M)
        lacking = np.clip(keep - distances(around, moved), 0.0, _STEP_M)
        moved = moved + slope * (lacking * np.clip(free, 0.0, 1.0))[:, None]
    bent = points.copy()
    bent[inside] = moved
    return course(bent, around)


_AHEAD_M: Final = 2.5
"""Length of the path in a decision: more than an arc can reach, so that a detour can be found."""
_LOOK_M: Final = 1.0
"""Gaps this near are measured exactly; beyond, the cells of the map tell whether they are worth coming nearer."""
_NEAR_AHEAD_M: Final = 0.5
"""The narrowest place within this length of path decides how slowly the robot drives."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """The inputs of one decision; immutable.

    pose, v, w: where the robot is and how fast (m, rad, m/s, rad/s). path: (n, 2) m, the released rest of the path,
    starting beside the robot. ends_here: whether its last point is the goal; goal_theta: heading wanted there; arrived:
    whether the robot has come to this point already.
    cap: the gate's limit on speed (m/s). cost: uint8 (h, w), the master costmap around the robot, geometry `window`.
    lidar_points: (m, 2) m, points of the newest scans. recovery: what to do instead of following the path.
    """

    plan_id: int
    planner_epoch: int
    made_at: float
    pose: Pose2
    v: float
    w: float
    path: NDArray[np.float64]
    ends_here: bool
    goal_theta: float | None
    arrived: bool
    cap: float
    cost: NDArray[np.uint8]
    window: GridGeometry
    lidar_points: NDArray[np.float64]
    footprint: Footprint
    config: MotionConfig
    recovery: RecoveryMove | None = None


_BLOCKED: Final = {
    ReasonCode.OBSTACLE_NEAR: "an obstacle is so near that no arc is free",
    ReasonCode.NO_ROOM: "there is no room to turn or back up",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """Speeds v, w (m/s, rad/s) and the wheels' speeds (m/s) for the next period.

    `arrived`: the path's end is reached. `at_goal`: that is the goal, and its heading is reached, too. `blocked`: why
    the robot can't move although it should; its sentence is left out, because decisions are logged and read again.
    """

    plan_id: int
    planner_epoch: int
    made_at: float
    v: float = 0.0
    w: float = 0.0
    left: float = 0.0
    right: float = 0.0
    arrived: bool = False
    at_goal: bool = False
    blocked: ReasonCode | None = None

    @property
    def hindrance(self) -> Reason | None:
        """Why the robot can't move although it should, in words."""
        return None if self.blocked is None else Reason(self.blocked, _BLOCKED[self.blocked])


def wheels(v: float, w: float, axle: float) -> tuple[float, float]:
    """Return the speeds (m/s) of the left and right wheel for v (m/s) and w (rad/s)."""
    return v - 0.5 * axle * w, v + 0.5 * axle * w


def twist(left: float, right: float, axle: float) -> tuple[float, float]:
    """Return v (m/s) and w (rad/s) of wheel speeds (m/s)."""
    return 0.5 * (left + right), (right - left) / axle


def turning_at_most(v: float, w: float, rate: float) -> tuple[float, float]:
    """Return v (m/s) and w (rad/s) slowed down to this turning rate (rad/s), on the same arc."""
    share = min(1.0, rate / abs(w)) if w else 1.0
    return v * share, w * share


def decide(job: Job) -> Decision:
    """Choose the speeds for the next period; pure, a millisecond of work, releases the GIL inside its kernels."""
    config, body = job.config, body_of(job.footprint)
    window = job.window
    limits = _slower(config.limits, max(0.0, min(job.cap, config.limits.v_max)))
    around = clearance(
        job.cost,
        window.resolution,
        window.origin_x,
        window.origin_y,
        job.lidar_points,
        job.pose.x,
        job.pose.y,
        body,
        _around_body(config.inflation, body.inscribed),
        limits,
        config.arcs,
        at_least=_LOOK_M,
    )
    if job.recovery is not None:
        return _recover(job, job.recovery, around, body)
    narrowest = body.inscribed + config.arcs.padding
    path = free_path(job.path, job.cost, window, job.lidar_points, config.inflation, around, narrowest, job.pose)
    way = course(path, around)
    way = give_way(way, around, body.inscribed + config.slow_within)
    room = room_beside(way, job.pose, around, body.inscribed, config.slow_within)
    end = job.path[-1]
    goal_theta = job.goal_theta if job.ends_here else None
    tolerance = config.arrived_within if job.arrived else config.arcs.goal_tolerance
    chosen = dwa(
        job.v,
        job.w,
        *job.pose,
        around,
        way.path,
        float(end[0]),
        float(end[1]),
        goal_theta,
        body,
        _slower(limits, min(limits.v_max, config.speed_narrow + (limits.v_max - config.speed_narrow) * room)),
        _narrower(config, room, tolerance),
    )
    arrived = math.hypot(end[0] - job.pose.x, end[1] - job.pose.y) <= tolerance
    at_heading = goal_theta is None or abs(wrap(goal_theta - job.pose.theta)) <= config.arcs.heading_tolerance
    left, right = wheels(chosen.v, chosen.w, limits.axle)
    return Decision(
        plan_id=job.plan_id,
        planner_epoch=job.planner_epoch,
        made_at=job.made_at,
        v=chosen.v,
        w=chosen.w,
        left=left,
        right=right,
        arrived=arrived,
        at_goal=job.ends_here and arrived and at_heading,
        blocked=ReasonCode.OBSTACLE_NEAR if chosen.n_admissible == 0 and not arrived else None,
    )


def _recover(job: Job, move: RecoveryMove, around: Clearance, body: Body) -> Decision:
    """Return the speeds of a recovery's move."""
    chosen = recovery_speeds(move, job.pose, around, body, job.config.arcs.padding, job.cap)
    v, w = turning_at_most(*(chosen or (0.0, 0.0)), job.config.limits.w_max)
    left, right = wheels(v, w, job.config.limits.axle)
    return Decision(
        plan_id=job.plan_id,
        planner_epoch=job.planner_epoch,
        made_at=job.made_at,
        v=v,
        w=w,
        left=left,
        right=right,
        blocked=None if chosen else ReasonCode.NO_ROOM,
    )


@lru_cache(maxsize=8)
def body_of(footprint: Footprint) -> Body:
    """Return the discs of a footprint."""
    return cover(footprint.polygon)


# Most decisions are made with the same speeds and room: making and checking new settings costs more than looking
# them up.


@lru_cache(maxsize=32)
def _slower(limits: DwaLimits, v_max: float) -> DwaLimits:
    """Return the limits of the base with another highest speed (m/s)."""
    return replace(limits, v_max=v_max)


@lru_cache(maxsize=8)
def _around_body(inflation: Inflation, inscribed: float) -> Inflation:
    """Return the inflation around a body with this inscribed radius (m)."""
    return replace(inflation, inscribed_radius=inscribed)


@lru_cache(maxsize=32)
def _narrower(config: MotionConfig, room: float, tolerance: float) -> DwaSettings:
    """Return how arcs are scored with so much room (0..1): in a curve one that aims far ahead cuts the corner."""
    arcs = config.arcs
    return replace(
        arcs,
        lookahead=arcs.lookahead * max(room, config.lookahead_narrow),
        w_path=arcs.w_path * (config.path_narrow + (1.0 - config.path_narrow) * room),
        goal_tolerance=tolerance,
    )


def room_beside(way: Course, pose: Pose2, around: Clearance, inscribed: float, enough: float) -> float:
    """Return how much room there is beside the robot, and at the narrowest place of the path just ahead.

    0 when the body only just fits, 1 when there are `enough` m or more beside it. The robot's own place counts because
    it need not be on the path: one that cuts a corner, which the path passes at a distance, would be quick there.
    """
    here = float(distances(around, np.array([(pose.x, pose.y)]))[0])
    ahead = float(way.free[: way.along.searchsorted(_NEAR_AHEAD_M, "right")].min())
    return min(max((min(here, ahead) - inscribed) / enough, 0.0), 1.0)


def make_job(  # noqa: PLR0913  # a job holds all that a decision rests on
    follower: PathFollower,
    *,
    plan_id: int,
    planner_epoch: int,
    now: float,
    pose: Pose2,
    speeds: tuple[float, float],
    goal_theta: float | None,
    arrived: bool = False,
    cap: float,
    cost: NDArray[np.uint8],
    speed_limits: NDArray[np.uint8],
    geometry: GridGeometry,
    lidar_points: NDArray[np.float64],
    footprint: Footprint,
    config: MotionConfig,
    recovery: RecoveryMove | None = None,
) -> Job | None:
    """Gather the inputs of a decision; None when the robot is off the map. `lidar_points`: (m, 2) m.

    The lowest speed limit under the robot's body applies.
    """
    half = config.window
    window = geometry.window_around(pose.x - half, pose.y - half, pose.x + half, pose.y + half)
    if window.empty or not geometry.contains(pose.x, pose.y):
        return None
    path, ends_here = follower.released_ahead(_AHEAD_M)
    limit = _speed_limit(speed_limits, geometry, pose, config)
    part = geometry.part(window)
    reach = half + config.inflation.inflation_radius
    # One column after the other: numpy takes ten times as long for the same along rows of two.
    near = (np.abs(lidar_points[:, 0] - pose.x) <= reach) & (np.abs(lidar_points[:, 1] - pose.y) <= reach)
    return Job(
        plan_id=plan_id,
        planner_epoch=planner_epoch,
        made_at=now,
        pose=pose,
        v=speeds[0],
        w=speeds[1],
        path=path,
        ends_here=ends_here,
        goal_theta=goal_theta,
        arrived=arrived and ends_here,
        cap=min(cap, limit),
        cost=np.ascontiguousarray(cost[window.rows, window.columns]),
        window=part,
        lidar_points=lidar_points[near],
        footprint=footprint,
        config=config,
        recovery=recovery,
    )


def _speed_limit(speed_limits: NDArray[np.uint8], geometry: GridGeometry, pose: Pose2, config: MotionConfig) -> float:
    """Return the lowest limit (m/s) of the speed layer's cells under the robot; infinite without one."""
    r = config.inflation.inscribed_radius
    under = geometry.window_around(pose.x - r, pose.y - r, pose.x + r, pose.y + r)
    cells = speed_limits[under.rows, under.columns]
    cells = cells[cells != NO_SPEED_LIMIT]
    return float(cells.min()) / 100.0 if cells.size else math.inf
