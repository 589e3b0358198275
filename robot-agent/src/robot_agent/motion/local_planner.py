"""From a path to wheel speeds: what is left of it, what stands in the way, and the dynamic window's choice.

`PathFollower` keeps how far along the path the robot is; `decide` is the slow part, pure, and may run on a thread.
Frames: everything in `map`. Method: Dynamic Window Approach (Fox, Burgard and Thrun 1997) in `fog_kernels.dwa`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import INSCRIBED, LETHAL, NO_SPEED_LIMIT, UNKNOWN
from fog_kernels.astar import Planner
from fog_kernels.dwa import DwaLimits, DwaSettings, dwa
from fog_kernels.inflation import InflationTable, inflate, inflation_table
from robot_agent.localization.pose import Pose2, wrap

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry
    from robot_agent.config import MotionConfig

_AHEAD_M: Final = 2.5
"""Path handed to a decision: more than an arc can reach, so that the way around something can be seen."""
_REJOIN_M: Final = 0.2
"""A detour ends this far behind the last blocked piece of the path."""
_SEARCH_BACK_M: Final = 0.5
_SEARCH_AHEAD_M: Final = 2.5
_OFF_PATH_M: Final = 1.0
_PROGRESS_M: Final = 0.1
_END_M: Final = 0.05
"""A path released to within this of its end is released whole: rounded points make another length."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """Everything that one decision needs; nothing in it changes afterwards.

    pose, v, w: where the robot is and how fast (m, rad, m/s, rad/s). path: (n, 2) m, the released rest of the path,
    starting beside the robot. ends_here: whether its last point is the goal; goal_theta: heading wanted there.
    cap: the gate's limit on speed (m/s). cost: uint8 (h, w), the master costmap around the robot, geometry `window`.
    seen: (m, 2) m, what the lidar sees.
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
    cap: float
    cost: NDArray[np.uint8]
    window: GridGeometry
    seen: NDArray[np.float64]
    config: MotionConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """Speeds (m/s, rad/s) and the wheels' (m/s) for the next period; `at_goal` when position and heading are reached.

    `blocked` says, in words, why the robot can't move although it should.
    """

    plan_id: int
    planner_epoch: int
    made_at: float
    v: float = 0.0
    w: float = 0.0
    left: float = 0.0
    right: float = 0.0
    at_goal: bool = False
    blocked: str | None = None


def wheels(v: float, w: float, axle: float) -> tuple[float, float]:
    """Return the speeds (m/s) of the left and right wheel for v (m/s) and w (rad/s)."""
    return v - 0.5 * axle * w, v + 0.5 * axle * w


def twist(left: float, right: float, axle: float) -> tuple[float, float]:
    """Return v (m/s) and w (rad/s) of wheel speeds (m/s)."""
    return 0.5 * (left + right), (right - left) / axle


def local_costs(
    cost: NDArray[np.uint8], window: GridGeometry, seen: NDArray[np.float64], table: InflationTable
) -> NDArray[np.uint8]:
    """Raise the cells of the points that the lidar sees to lethal, inflate them, and keep the higher cost.

    The master costmap is inflated already: only the lidar's own points are inflated here. Unknown cells stay so.
    """
    marks = np.zeros(cost.shape, np.uint8)
    columns = np.floor((seen[:, 0] - window.origin_x) / window.resolution).astype(np.int64)
    rows = np.floor((seen[:, 1] - window.origin_y) / window.resolution).astype(np.int64)
    inside = (columns >= 0) & (rows >= 0) & (columns < window.width) & (rows < window.height)
    marks[rows[inside], columns[inside]] = LETHAL
    return np.maximum(cost, inflate(marks, table))


def decide(job: Job) -> Decision:
    """Choose the speeds for the next period; pure, some milliseconds of work, releases the GIL inside its kernels."""
    c = job.config
    resolution = job.window.resolution
    table = inflation_table(resolution, c.inflation)
    costs = local_costs(job.cost, job.window, job.seen, table)
    limits = DwaLimits(
        v_max=max(0.0, min(job.cap, c.speed)),
        w_max=c.turn_speed,
        acc_v=c.acceleration,
        acc_w=c.turn_acceleration,
        wheel_max=c.wheel_speed,
        axle=c.axle,
    )
    settings = DwaSettings(
        n_v=c.samples_v,
        n_w=c.samples_w,
        sim_time=c.horizon,
        dt=c.step,
        period=c.period,
        goal_tolerance=c.tolerance_xy,
        heading_tolerance=c.tolerance_theta,
    )
    path = detour(job.path, costs, job.window, job.pose)
    end = job.path[-1]
    wants_theta = job.goal_theta if job.ends_here else None
    chosen = dwa(
        job.v,
        job.w,
        *job.pose,
        costs,
        resolution,
        job.window.origin_x,
        job.window.origin_y,
        path,
        float(end[0]),
        float(end[1]),
        wants_theta,
        limits,
        settings,
    )
    near = math.hypot(end[0] - job.pose.x, end[1] - job.pose.y) <= c.tolerance_xy
    turned = wants_theta is None or abs(wrap(wants_theta - job.pose.theta)) <= c.tolerance_theta
    blocked = None
    if chosen.n_admissible == 0 and not near:
        blocked = "something stands so near that no arc is free"
    left, right = wheels(chosen.v, chosen.w, c.axle)
    return Decision(
        plan_id=job.plan_id,
        planner_epoch=job.planner_epoch,
        made_at=job.made_at,
        v=chosen.v,
        w=chosen.w,
        left=left,
        right=right,
        at_goal=job.ends_here and near and turned,
        blocked=blocked,
    )


def detour(
    path: NDArray[np.float64], costs: NDArray[np.uint8], window: GridGeometry, pose: Pose2
) -> NDArray[np.float64]:
    """Lead a path (n, 2; m) around what blocks it inside the local window, if there is a way around in it.

    `costs`: uint8 (h, w) over `window`. The dynamic window alone is greedy and stops in front of whatever stands on
    its path; the exact search of the few metres at hand is the robot's own, all that lies beyond is the planner's.
    """
    route = PathFollower(path, math.inf)
    points, ahead = route.ahead(0.5 * window.resolution)
    cells = _cells_of(points, costs, window)
    bad = np.flatnonzero((cells >= INSCRIBED) & (cells != UNKNOWN))
    start = window.cell(pose.x, pose.y)
    if not len(bad) or not window.contains_cell(*start) or costs[start[1], start[0]] >= INSCRIBED:
        return path
    clear = np.flatnonzero((ahead > ahead[bad[-1]] + _REJOIN_M) & (cells < INSCRIBED))
    if not len(clear):
        return path
    rejoin = points[clear[0]]
    search = Planner(window.width, window.height)
    found = search.plan(costs, start, window.cell(float(rejoin[0]), float(rejoin[1])))
    if not found.found:
        return path
    way = search.shortcut(costs, found.cells) if len(found.cells) > 1 else found.cells.astype(np.float64)
    metres = (way + 0.5) * window.resolution + (window.origin_x, window.origin_y)
    return np.vstack((metres, path[route.along > ahead[clear[0]]]))


def _cells_of(points: NDArray[np.float64], costs: NDArray[np.uint8], geometry: GridGeometry) -> NDArray[np.uint8]:
    """Return the cost at each point (n, 2; m); unknown off the grid."""
    columns = np.floor((points[:, 0] - geometry.origin_x) / geometry.resolution).astype(np.int64)
    rows = np.floor((points[:, 1] - geometry.origin_y) / geometry.resolution).astype(np.int64)
    inside = (columns >= 0) & (rows >= 0) & (columns < geometry.width) & (rows < geometry.height)
    cells = np.full(len(points), UNKNOWN, np.uint8)
    cells[inside] = costs[rows[inside], columns[inside]]
    return cells


class PathFollower:
    """Where on its path the robot is: progress only ever looks near the last one, so a path may cross itself."""

    def __init__(self, points: NDArray[np.float64], released_length: float) -> None:
        self.points = points
        steps = np.hypot(*np.diff(points, axis=0).T) if len(points) > 1 else np.zeros(0)
        self.along = np.concatenate(([0.0], np.cumsum(steps)))
        """Metres from the path's start to each point."""
        self.released = 0.0
        self.release(released_length)
        self.progress = 0.0
        self.distance = 0.0
        """Metres from the robot to the path, as of the last `advance`."""
        self._started = False
        self._best_progress = 0.0
        self._best_at: float | None = None

    @property
    def length(self) -> float:
        """Metres of the whole path."""
        return float(self.along[-1])

    @property
    def released_left(self) -> float:
        """Metres of released path ahead of the robot."""
        return max(0.0, self.released - self.progress)

    @property
    def left(self) -> float:
        """Metres of path ahead of the robot."""
        return max(0.0, self.length - self.progress)

    def release(self, length: float) -> None:
        """Take the planner's newest word on how much of the path is released."""
        self.released = length if length < self.length - _END_M else self.length

    def advance(self, x: float, y: float, now: float) -> None:
        """Note where the robot is (m)."""
        low, high = 0.0, math.inf
        if self._started:
            low, high = self.progress - _SEARCH_BACK_M, self.progress + _SEARCH_AHEAD_M
        found = self._nearest(x, y, low, high)
        if found[1] > _OFF_PATH_M:
            found = self._nearest(x, y, 0.0, math.inf)
        self.progress, self.distance = found
        self._started = True
        if self._best_at is None or self.progress > self._best_progress + _PROGRESS_M:
            self._best_progress, self._best_at = self.progress, now

    def rest_clock(self, now: float) -> None:
        """Say that the robot stands because it must: that is no being stuck."""
        self._best_at = now

    def stuck_for(self, now: float) -> float:
        """Seconds without progress while driving was allowed."""
        return 0.0 if self._best_at is None else now - self._best_at

    def rest(self, limit: float) -> tuple[NDArray[np.float64], bool]:
        """Return the next `limit` metres of the released path (n, 2), and whether its last point is the path's end."""
        end = min(self.progress + limit, self.released)
        end = max(end, self.progress)
        inner = self.points[(self.along > self.progress) & (self.along < end)]
        points = np.vstack((self._at(self.progress), inner, self._at(end)))
        return points, end >= self.length - 1e-6

    def ahead(self, spacing: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return points (n, 2) every `spacing` metres of the rest of the path, and their distances ahead (m)."""
        count = max(2, math.ceil(self.left / spacing) + 1)
        at = np.linspace(self.progress, self.length, count)
        xs, ys = (np.interp(at, self.along, self.points[:, i]) for i in (0, 1))
        return np.column_stack((xs, ys)), at - self.progress

    def _at(self, along: float) -> NDArray[np.float64]:
        return np.array([np.interp(along, self.along, self.points[:, i]) for i in (0, 1)])

    def _nearest(self, x: float, y: float, low: float, high: float) -> tuple[float, float]:
        here = np.array([x, y])
        if len(self.points) == 1:
            return 0.0, float(np.hypot(*(self.points[0] - here)))
        steps = np.diff(self.along)
        usable = (self.along[:-1] <= high) & (self.along[1:] >= low) & (steps > 0.0)
        if not usable.any():
            return self.progress, math.inf
        start, delta, length = self.points[:-1][usable], np.diff(self.points, axis=0)[usable], steps[usable]
        part = np.clip(((here - start) * delta).sum(axis=1) / length**2, 0.0, 1.0)
        away = np.hypot(*(start + part[:, None] * delta - here).T)
        best = int(away.argmin())
        return float(self.along[:-1][usable][best] + part[best] * length[best]), float(away[best])


def make_job(
    follower: PathFollower,
    *,
    plan_id: int,
    planner_epoch: int,
    now: float,
    pose: Pose2,
    speeds: tuple[float, float],
    goal_theta: float | None,
    cap: float,
    cost: NDArray[np.uint8],
    speed_limits: NDArray[np.uint8],
    geometry: GridGeometry,
    seen: NDArray[np.float64],
    config: MotionConfig,
) -> Job | None:
    """Gather what a decision needs; None when the robot is off the map. `seen` are points (m, 2) in `map`.

    The speed layer counts where the robot's body is and a little ahead of its centre.
    """
    half = config.window
    window = geometry.window_around(pose.x - half, pose.y - half, pose.x + half, pose.y + half)
    if window.empty or not geometry.contains(pose.x, pose.y):
        return None
    path, ends_here = follower.rest(_AHEAD_M)
    limit = _speed_limit(speed_limits, geometry, pose, config)
    part = geometry.part(window)
    near = np.abs(seen - (pose.x, pose.y)).max(axis=1, initial=0.0) <= half + config.inflation.inflation_radius
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
        cap=min(cap, limit),
        cost=np.ascontiguousarray(cost[window.rows, window.columns]),
        window=part,
        seen=seen[near],
        config=config,
    )


def _speed_limit(speed_limits: NDArray[np.uint8], geometry: GridGeometry, pose: Pose2, config: MotionConfig) -> float:
    """Return the lowest limit (m/s) of the speed layer's cells under the robot; infinite without one."""
    r = config.inflation.inscribed_radius
    under = geometry.window_around(pose.x - r, pose.y - r, pose.x + r, pose.y + r)
    cells = speed_limits[under.rows, under.columns]
    cells = cells[cells != NO_SPEED_LIMIT]
    return float(cells.min()) / 100.0 if cells.size else math.inf


def first_blocked(
    cost: NDArray[np.uint8],
    geometry: GridGeometry,
    follower: PathFollower,
    skip: float = 0.5,
    *,
    led_out: bool = False,
) -> float | None:
    """Return how far ahead (m) the rest of the path first meets a cell that the robot must not enter, or None.

    Inscribed and unknown cells count beyond the first `skip` metres, where the planner may have led the robot out of a
    tight place. Lethal ones count everywhere, unless the planner knew of them too (`led_out`).
    """
    points, ahead = follower.ahead(0.5 * geometry.resolution)
    cells = _cells_of(points, cost, geometry)
    bad = (cells >= INSCRIBED) & (ahead > skip)
    if not led_out:
        bad |= cells == LETHAL
    return float(ahead[int(bad.argmax())]) if bad.any() else None
