"""Measures a robot's decision: the distances around it, and the dynamic window's choice among 25 x 35 arcs."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import DEFAULT_INFLATION, LETHAL
from fog_contracts.grid import GridGeometry
from fog_kernels.clearance import clearance
from fog_kernels.dwa import DwaLimits, DwaSettings, dwa
from fog_kernels.inflation import inflate, inflation_table
from robot_agent.config import MotionConfig
from robot_agent.footprint import Footprint
from robot_agent.localization.pose import Pose2
from robot_agent.motion.local_planner import body_of, decide, make_job
from robot_agent.motion.path_follower import PathFollower

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from fog_kernels.robot import Body

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


def measure(repeats: int) -> dict[str, float | int]:
    """Return the figures, in ms, medians of `repeats`.

    `cycle_ms`: the choice for a round body; `cycle_long_ms`: for a rectangle; `field_ms`: the distances around either;
    `decision_ms`: everything that a robot computes for one decision. `peer_ratio`: cycle_ms by that of ROS 1.
    """
    costs, points = corridor()
    figures: dict[str, float | int] = {}
    for suffix, body in (("", body_of(_ROUND)), ("_long", body_of(_LONG))):
        field, choice = _steps(costs, points, body)
        figures[f"field{suffix}_ms"] = _median(field, repeats)
        figures[f"cycle{suffix}_ms"] = _median(choice, repeats)
    follower = PathFollower(np.array([(2.0, 2.0), (2.0, 4.0)]), math.inf)
    free = np.zeros(_GRID.shape, np.uint8)
    job = make_job(
        follower, plan_id=1, planner_epoch=1, now=0.0, pose=_POSE, speeds=(0.25, 0.1), goal_theta=None, cap=0.3,
        cost=costs, speed_limits=free, geometry=_GRID, lidar_points=np.tile(points, (4, 1)), footprint=_ROUND,
        config=MotionConfig(limits=_LIMITS),
    )  # fmt: skip
    assert job is not None
    figures["decision_ms"] = _median(lambda: decide(job), repeats)
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


def _median(function: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        function()
        times.append(time.perf_counter() - begun)
    return round(float(np.median(times)) * 1000.0, 4)
