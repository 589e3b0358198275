"""Measures three cores on this machine: the map-service's, a robot's decision among its arcs, and its localization."""

from __future__ import annotations

import math
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numba import njit

from fog_contracts import channels as ch
from fog_contracts.costs import DEFAULT_INFLATION, LETHAL
from fog_contracts.grid import GridGeometry
from fog_contracts.handlers import Moment
from fog_contracts.messages import (
    VIEW_SECTORS,
    CorridorShape,
    PolygonShape,
    RectangleShape,
    RobotObstacles,
    RobotPose,
    Shape,
    View,
    Zone,
)
from fog_kernels import amcl
from fog_kernels.clearance import clearance
from fog_kernels.dwa import DwaLimits, DwaSettings, dwa
from fog_kernels.inflation import inflate, inflation_table
from map_service.core import MapCore
from map_service.registry import make_layers
from map_service.zone_times import StoredState
from map_service.zones import prepare_zone, zones_spans
from robot_agent.config import LocalizationConfig, MotionConfig
from robot_agent.footprint import Footprint
from robot_agent.localization.map_fields import MapFields, map_fields
from robot_agent.localization.pose import Pose2
from robot_agent.localization.relocalization import Relocalization
from robot_agent.localization.scans import DeskewedScan, match_scan
from robot_agent.motion.local_planner import body_of, decide, make_job
from robot_agent.motion.path_follower import PathFollower

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from fog_contracts.grid import StaticMap
    from fog_kernels.robot import Body


def _timed(function: Callable[[], object]) -> float:
    """Return how long (ms) a call takes."""
    begun = time.perf_counter()
    function()
    return (time.perf_counter() - begun) * 1000.0


def _median(times: list[float], digits: int = 3) -> float:
    return round(float(np.median(times)), digits)


# --- the map-service --------------------------------------------------------------------------------------------------

_AT: Final = Moment(0.0, 0.0)
_OBSTACLES: Final = 4_000
"""As many obstacle cells as one robot may hold."""


def worst_shapes(floor: StaticMap) -> list[Shape]:
    """Return legal shapes that take longest to check and rasterize: long outlines, many corners."""
    left, bottom, right, top = floor.geometry.bounds
    lines = min(500, int(95_000 / floor.geometry.height))
    step = (right - left - 1.0) / lines
    zigzag = [(left + 0.5 + step * i, top - 0.5 if i % 2 else bottom + 0.5) for i in range(lines)]
    radius, x, y = 0.45 * min(right - left, top - bottom), (left + right) / 2, (bottom + top) / 2
    star = [
        (x + r * math.cos(a), y + r * math.sin(a))
        for a, r in ((2 * math.pi * i / 500, radius if i % 2 else radius / 2) for i in range(500))
    ]
    whole = RectangleShape(corner=(left, bottom), opposite=(right, top))
    return [CorridorShape(line=zigzag, width=0.4), PolygonShape(points=star), whole]


def measure_costmap(floor: StaticMap, zones: int, repeats: int) -> dict[str, float | int]:
    """Return the figures, in ms, medians of `repeats` unless they are named worst."""
    core = MapCore("bench", floor, 1, layers=make_layers(floor))
    stored = random_zones(floor, zones)

    def load() -> None:
        spans, _ = zones_spans(stored, floor.geometry)
        core.load_zones(stored, _AT, StoredState(spans=spans))

    load_ms = _timed(load)
    core.tick(_AT)
    full = [_timed(core.costmap.recompute) for _ in range(repeats)]
    shapes = worst_shapes(floor)
    zone = Zone(id="worst", kind="BLOCKED", shape=shapes[-1])
    prepared = [min(_timed(partial(_prepare, shape, floor)) for _ in range(repeats)) for shape in shapes]
    portions = _commits(core, partial(core.put_zone, zone, _AT)) + _commits(
        core, partial(core.remove_zone, zone.id, _AT)
    )
    return {
        "cells": floor.geometry.width * floor.geometry.height,
        "zones": zones,
        "full_ms": round(float(np.median(full)), 3),
        "window_ms": round(float(np.median(_small_changes(core, floor, repeats))), 3),
        "worst_zone_ms": round(max(prepared), 3),
        "worst_portion_ms": round(max(portions), 3),
        "portions": len(portions),
        "load_zones_ms": round(load_ms, 1),
        "snapshot_ms": round(_timed(core.costmap.snapshot), 3),
        "worst_obstacles_ms": round(_worst_obstacles(floor), 3),
    }


def _prepare(shape: Shape, floor: StaticMap) -> None:
    prepare_zone(Zone(id="worst", kind="BLOCKED", shape=shape), floor.geometry, 0.0)


def _commits(core: MapCore, change: Callable[[], object]) -> list[float]:
    """Return the times (ms) of the portions in which a change reaches the map."""
    times = [_timed(change)]
    while core.pending:
        times.append(_timed(partial(core.continue_commit, _AT)))
    return times


def _small_changes(core: MapCore, floor: StaticMap, repeats: int) -> list[float]:
    """Return the times (ms) in which a no-go zone of 2 x 2 m becomes a delta, and so does its end."""
    left, bottom, right, top = floor.geometry.bounds
    x, y = (left + right) / 2, (bottom + top) / 2
    prepared = prepare_zone(
        Zone(id="small", kind="BLOCKED", shape=RectangleShape(corner=(x, y), opposite=(x + 2.0, y + 2.0))),
        floor.geometry,
        0.0,
    )
    put, remove = partial(core.put_zone, prepared.zone, _AT, prepared.spans), partial(core.remove_zone, "small", _AT)
    return [_timed(change) for _ in range(repeats) for change in (put, remove)]


def _worst_obstacles(floor: StaticMap) -> float:
    """Return the longest time (ms) of a robot's report beside as many obstacles as it may hold, seen and cleared."""
    core = MapCore("bench", floor, 1, layers=make_layers(floor))
    core.load_zones([], _AT)
    core.tick(_AT)
    handlers, (left, bottom, *_) = core.handlers(), floor.geometry.bounds
    step, columns = floor.geometry.resolution, min(100, floor.geometry.width)
    cells = [divmod(number, columns) for number in range(min(_OBSTACLES, columns * min(100, floor.geometry.height)))]
    points = [(left + step * (column + 0.5), bottom + step * (row + 0.5)) for row, column in cells]
    middle = points[len(points) // 2 + columns // 2]
    reports = [
        RobotObstacles(points=points[first : first + 2000], stamp=0.0, ttl=600.0)
        for first in range(0, len(points), 2000)
    ] + [
        RobotObstacles(
            points=[], stamp=0.0, ttl=600.0, view=View(x=middle[0], y=middle[1], reach=bytes([255]) * VIEW_SECTORS)
        )
        for _ in range(2)
    ]
    pose = RobotPose(
        x=middle[0], y=middle[1], theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.17, height=0.35, stamp=0.0
    )
    robot = {"robot": "r1"}
    handlers[ch.ROBOT_POSE](robot, pose, _AT)
    return max(_timed(partial(handlers[ch.ROBOT_OBSTACLES], robot, report, _AT)) for report in reports)


def random_zones(floor: StaticMap, count: int) -> list[Zone]:
    """Return zones of 5 x 5 m, anywhere on the floor, the same at each call."""
    rng = np.random.default_rng(1)
    left, bottom, right, top = floor.geometry.bounds
    corners = rng.uniform((left, bottom), (right - 5.0, top - 5.0), (count, 2)).tolist()
    shapes = [RectangleShape(corner=(x, y), opposite=(x + 5.0, y + 5.0)) for x, y in corners]
    return [
        Zone(id=f"z{number}", kind="PENALTY", factor=1.0 + number % 400 / 100, shape=shape)
        for number, shape in enumerate(shapes)
    ]


# --- a decision of the local planner ----------------------------------------------------------------------------------

PEER_MS: Final = 1.75
"""ROS 1's `base_local_planner` (commit 9ad64419, -O3) on as many arcs, checking the robot's centre; x86 server."""
_RESOLUTION: Final = 0.05
_GRID: Final = GridGeometry(80, 80, _RESOLUTION, 0.0, 0.0)
_LIMITS: Final = DwaLimits(axle=0.235, wheel_max=0.5)
_SETTINGS: Final = DwaSettings()
_POSE: Final = Pose2(2.0, 2.0, 1.5)
_ROUND: Final = Footprint.circle(0.17)
_LONG: Final = Footprint(((0.25, -0.15), (0.25, 0.15), (-0.12, 0.15), (-0.12, -0.15)))


def corridor() -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Return the costs of a corridor 1.6 m wide, and what a lidar sees in it: its walls, and a post beside the path."""
    raw = np.zeros(_GRID.shape, np.uint8)
    raw[:, :24] = raw[:, 56:] = LETHAL
    angles = np.linspace(-math.pi, math.pi, 363)
    ranges = np.minimum(0.8 / np.maximum(np.abs(np.cos(angles)), 0.05), 6.0)
    points = np.column_stack((2.0 + ranges * np.cos(angles), 2.0 + ranges * np.sin(angles)))
    post = np.array([(2.45, 2.4), (2.46, 2.41)])
    return inflate(raw, inflation_table(_RESOLUTION, DEFAULT_INFLATION)), np.vstack((points, post))


def measure_dwa(repeats: int) -> dict[str, float | int]:
    """Return the figures, in ms, medians of `repeats`.

    `cycle_ms`: the choice for a round body; `cycle_long_ms`: for a rectangle; `field_ms`: the distances around either;
    `decision_ms`: everything that a robot computes for one decision. `peer_ratio`: cycle_ms by that of ROS 1.
    """
    costs, points = corridor()
    figures: dict[str, float | int] = {}
    for suffix, body in (("", body_of(_ROUND)), ("_long", body_of(_LONG))):
        field, choice = _steps(costs, points, body)
        figures[f"field{suffix}_ms"] = _median([_timed(field) for _ in range(repeats)], 4)
        figures[f"cycle{suffix}_ms"] = _median([_timed(choice) for _ in range(repeats)], 4)
    follower = PathFollower(np.array([(2.0, 2.0), (2.0, 4.0)]), math.inf)
    free = np.zeros(_GRID.shape, np.uint8)
    job = make_job(
        follower, plan_id=1, planner_epoch=1, now=0.0, pose=_POSE, speeds=(0.25, 0.1), goal_theta=None, cap=0.3,
        cost=costs, speed_limits=free, geometry=_GRID, lidar_points=np.tile(points, (4, 1)), footprint=_ROUND,
        config=MotionConfig(limits=_LIMITS),
    )  # fmt: skip
    assert job is not None
    figures["decision_ms"] = _median([_timed(partial(decide, job)) for _ in range(repeats)], 4)
    figures["arcs"] = _SETTINGS.n_v * _SETTINGS.n_w
    figures["peer_ratio"] = round(figures["cycle_ms"] / PEER_MS, 3)
    return figures


def _steps(
    costs: NDArray[np.uint8], points: NDArray[np.float64], body: Body
) -> tuple[Callable[[], object], Callable[[], object]]:
    def field() -> object:
        return clearance(
            costs, _RESOLUTION, 0.0, 0.0, points, _POSE.x, _POSE.y, body, DEFAULT_INFLATION, _LIMITS, _SETTINGS
        )

    around = clearance(
        costs, _RESOLUTION, 0.0, 0.0, points, _POSE.x, _POSE.y, body, DEFAULT_INFLATION, _LIMITS, _SETTINGS
    )

    def choice() -> object:
        path = [(2.0, 2.0), (2.0, 4.0)]
        return dwa(0.25, 0.1, *_POSE, around, path, 2.0, 4.0, None, body, _LIMITS, _SETTINGS)

    return field, choice


# --- the localization -------------------------------------------------------------------------------------------------

_PLACE: Final = Pose2(50.0, 8.0, 0.3)
_SPREAD: Final = (0.2, 0.2, 0.1)
_STEP: Final = (0.02, 0.1, 0.03)
"""Motion of one cycle: rotation (rad), translation (m), rotation (rad)."""
_LIDAR_M: Final = 12.0


@njit(nogil=True)
def _plain_scores(poses: Any, field: Any, inverse: Any, ends: Any, out: Any) -> None:  # noqa: ANN401  # compiled
    """Score pose by pose and beam by beam, as the method is written down: what the kernel is compared to."""
    for i in range(poses.shape[0]):
        cos, sin = math.cos(poses[i, 2]), math.sin(poses[i, 2])
        match = 0.0
        for k in range(ends.shape[0]):
            column = math.floor((poses[i, 0] + cos * ends[k, 0] - sin * ends[k, 1]) * inverse)
            row = math.floor((poses[i, 1] + sin * ends[k, 0] + cos * ends[k, 1]) * inverse)
            if 0 <= column < field.shape[1] and 0 <= row < field.shape[0]:
                match += field[row, column]
        out[i] = match / ends.shape[0]


class _Cycle:
    """The particles and the scan of one cycle, and its steps."""

    def __init__(self, fields: MapFields, particles: int, beams: int, seed: int) -> None:
        self._fields = fields
        self._config = LocalizationConfig(particles_min=particles, particles_max=particles)
        rng = np.random.default_rng(seed)
        poses = np.array(_PLACE) + rng.standard_normal((particles, 3)) * _SPREAD
        x, y, theta = (np.ascontiguousarray(poses[:, i], np.float32) for i in range(3))
        self._particles = x, y, theta
        self._state = amcl.rng_state(seed)
        self.points = view(fields, beams)
        self._weights = np.full(particles, 1.0 / particles)
        self.weigh()

    def move(self) -> None:
        """Move copies of the particles."""
        x, y, theta = (values.copy() for values in self._particles)
        amcl.motion_update(x, y, theta, *_STEP, self._config.alphas, self._state)

    def weigh(self) -> None:
        """Weight the particles by the scan."""
        scores = self._fields.agreements(self._poses(), self.points, self._fields.fine)
        self._weights = np.exp(self._config.sharpness * (scores - scores.max()))

    def weigh_plainly(self) -> None:
        """Weight them by the reference."""
        scores = np.zeros(len(self._weights))
        poses, geometry = self._poses() - (*self._origin(), 0.0), self._fields.geometry
        _plain_scores(poses, self._fields.fine, 1.0 / geometry.resolution, self.points, scores)
        scores /= self._fields.best_likelihood
        self._weights = np.exp(self._config.sharpness * (scores - scores.max()))

    def cluster(self) -> None:
        """Estimate the pose."""
        amcl.clusters(*self._particles, self._weights, self._config.bin_xy, self._config.bin_theta)

    def resample(self) -> None:
        """Draw new particles."""
        config = self._config
        amcl.resample(
            *self._particles, self._weights, config.particles_min, config.particles_max, config.kld_error, self._state
        )

    def run(self, weigh: Callable[[], None]) -> None:
        """Run one whole cycle."""
        self.move()
        weigh()
        self.cluster()
        self.resample()

    def _poses(self) -> NDArray[np.float64]:
        return np.column_stack(self._particles).astype(np.float64)

    def _origin(self) -> tuple[float, float]:
        return self._fields.geometry.origin_x, self._fields.geometry.origin_y


def view(fields: MapFields, beams: int) -> NDArray[np.float64]:
    """Return what a lidar sees at the measured place: points (n, 2; m, frame `base`)."""
    angles = np.linspace(-math.pi, math.pi, beams, endpoint=False)
    ranges = fields.ranges(_PLACE.x, _PLACE.y, angles + _PLACE.theta, _LIDAR_M)
    hit = np.isfinite(ranges)
    return np.column_stack((ranges[hit] * np.cos(angles[hit]), ranges[hit] * np.sin(angles[hit])))


def measure_localization(
    floor: StaticMap, particles: int, beams: int, repeats: int, seed: int
) -> dict[str, float | int]:
    """Return the figures, in ms, medians of `repeats`; the search of the floor is measured once.

    A cycle and the same with the plain scores alternate, so that both see the same load.
    """
    fields = map_fields(floor.cells, floor.geometry, LocalizationConfig())
    cycle = _Cycle(fields, particles, beams, seed)
    cycle.weigh_plainly()  # compiles it
    whole: list[float] = []
    plain: list[float] = []
    for _ in range(repeats):
        whole.append(_timed(partial(cycle.run, cycle.weigh)))
        plain.append(_timed(partial(cycle.run, cycle.weigh_plainly)))
    steps = {"move": cycle.move, "score": cycle.weigh, "clusters": cycle.cluster, "resample": cycle.resample}
    covariance, points = np.diag(np.square(_SPREAD)), view(fields, 180)
    return {
        "cells": floor.geometry.width * floor.geometry.height,
        "cycle_ms": _median(whole),
        "reference_cycle_ms": _median(plain),
        "ratio": round(float(np.median(whole) / np.median(plain)), 3),
        **{f"{name}_ms": _median([_timed(step) for _ in range(repeats)]) for name, step in steps.items()},
        "match_ms": _median([_timed(partial(match_scan, fields, _PLACE, covariance, points)) for _ in range(repeats)]),
        "search_ms": round(_timed(partial(_search, fields)), 1),
    }


def _search(fields: MapFields) -> None:
    relocalization = Relocalization(LocalizationConfig())
    relocalization.begin(DeskewedScan(view(fields, 360), Pose2(0.0, 0.0, 0.0), 0.0), fields)
    while relocalization.searching:
        relocalization.advance(fields)
