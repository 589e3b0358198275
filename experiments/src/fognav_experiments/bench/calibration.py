"""Robots whose wheels, axle and lidar are not as their settings say, driven around in rooms that nobody knows.

Nothing here is shared with the solver: wheels roll, slip and are counted in ticks, and each beam of a turning lidar is
cast from where the body is at that moment.
"""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from fog_contracts.messages import Pose
from fog_contracts.site import RobotSite
from robot_agent.agent.recording.input_log import LOG_KEY, BaseReceived, ScanReceived, Started
from robot_agent.calibrated import NAMES
from robot_agent.calibration import Calibrator
from robot_agent.config import agent_config
from robot_agent.guardian.link import BaseFeedback
from robot_agent.hardware import BaseStatus, DriveTrain, LaserScan, LidarTraits, WheelOdometry

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

_DT: Final = 0.005
_FRAME_S: Final = 0.015
_SCAN_S: Final = 1.0 / 5.5
_BEAMS: Final = 360
_TICKS: Final = 508.8
_COUNTS: Final = 1 << 16
_DIAMETER_M: Final = 0.072
_AXLE_M: Final = 0.235
_LAG_S: Final = 0.1
_SLIP: Final = 0.01
_WALK: Final[Sequence[tuple[float, float, float]]] = (
    (0.0, 0.0, 1.0), (0.12, 0.0, 8.0), (0.0, 0.5, 15.0), (-0.12, 0.0, 8.0), (0.0, -0.5, 15.0), (0.12, 0.4, 16.0),
    (0.12, -0.4, 16.0), (-0.1, 0.3, 12.0), (0.0, 0.6, 12.0), (0.12, 0.0, 8.0), (0.0, -0.6, 12.0), (-0.12, 0.0, 8.0),
    (0.12, -0.4, 16.0), (0.12, 0.4, 16.0), (-0.1, -0.3, 12.0), (-0.12, 0.0, 8.0), (0.12, 0.0, 16.0), (-0.12, 0.0, 16.0),
    (0.12, 0.0, 16.0), (-0.12, 0.0, 8.0), (0.0, 0.0, 1.0),
)  # fmt: skip
"""m/s, rad/s, s: what an operator drives in four minutes, by the settings."""


class Body(NamedTuple):
    """A robot as it is; wheels and axle as shares of what its settings say."""

    left: float
    right: float
    axle: float
    x: float
    y: float
    yaw: float
    latency: float
    mirrored: bool


def random_body(rng: np.random.Generator) -> Body:
    """Return a robot up to 15 % wrong, its lidar up to 8 cm off the middle, turned, and sometimes upside down."""
    wheels = 1.0 + rng.uniform(-0.13, 0.13)
    return Body(
        left=wheels * (1.0 + rng.uniform(-0.02, 0.02)),
        right=wheels * (1.0 + rng.uniform(-0.02, 0.02)),
        axle=1.0 + rng.uniform(-0.15, 0.15),
        x=rng.uniform(-0.08, 0.08),
        y=rng.uniform(-0.08, 0.08),
        yaw=rng.uniform(-0.2, 0.2) + float(rng.choice((0.0, 0.0, math.pi / 2, math.pi))),
        latency=rng.uniform(0.0, 0.03),
        mirrored=bool(rng.random() < 0.3),
    )


def recording(
    body: Body, rng: np.random.Generator, walk: Sequence[tuple[float, float, float]] = _WALK, slip: float = _SLIP
) -> Iterator[Any]:
    """Yield the entries of a drive of this body in a room of its own; its wheels slip as for `driven`."""
    lidar = LidarTraits(scan_period_s=_SCAN_S, range_min_m=0.15, range_max_m=12.0)
    wrap = _COUNTS * math.pi * _DIAMETER_M / _TICKS
    drive = DriveTrain(axle_m=_AXLE_M, wheel_speed_max_m_s=0.5, travel_wrap_m=wrap)
    site = RobotSite(id="r1", start=Pose(x=0.0, y=0.0, theta=0.0), radius=0.17)
    yield Started(config=agent_config("r1", LOG_KEY, drive, lidar, site, boot="b"), seed=0)
    walls = _room(rng)
    poses, ticks = driven(body, rng, walk, slip)
    stamps = np.arange(len(poses), dtype=np.float64) * _DT
    per_tick = math.pi * _DIAMETER_M / _TICKS
    due, scan_at, number, seq = 0.0, 0.3, 0, 0
    for step, stamp in enumerate(stamps):
        if stamp >= due:
            due += _FRAME_S
            seq += 1
            left, right = (float(count % _COUNTS) * per_tick for count in ticks[step])
            odometry = WheelOdometry(left_m=left, right_m=right)
            feedback = BaseFeedback(seq=seq, status=BaseStatus(), odometry=odometry, fault=None, stopped=None)
            yield BaseReceived(feedback=feedback, now=float(stamp) + rng.uniform(0.0, 0.002))
        if stamp >= scan_at + _SCAN_S + 0.01:
            number += 1
            yield ScanReceived.of(_scan(body, rng, walls, poses, stamps, scan_at), float(stamp) + body.latency)
            scan_at += _SCAN_S


def _room(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return walls (n, 2, 2; m) of a room with boxes in its corners, the robot near its middle."""
    width, depth = rng.uniform(3.0, 4.5), rng.uniform(2.5, 4.0)
    corners = [(-width, -depth), (width, -depth), (width, depth), (-width, depth)]
    walls = [(a, b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
    for _ in range(6):
        angle, far = rng.uniform(0.0, math.tau), rng.uniform(2.2, 2.6)
        x, y, half, turn = far * math.cos(angle), far * math.sin(angle), rng.uniform(0.1, 0.3), rng.uniform(0.0, 1.5)
        ends = [
            (x + half * math.cos(turn + k * math.pi / 2), y + half * math.sin(turn + k * math.pi / 2)) for k in range(4)
        ]
        walls += [(a, b) for a, b in zip(ends, ends[1:] + ends[:1], strict=True)]
    return np.array(walls)


def driven(
    body: Body, rng: np.random.Generator, walk: Sequence[tuple[float, float, float]], slip: float = _SLIP
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the body's poses (n, 3; m, m, rad) and its counters (n, 2), every 5 ms of a walk (m/s, rad/s, s).

    slip: deviation of the share by which each wheel rolls more or less than it counts, anew every 0.1 s.
    """
    commands = np.concatenate([np.tile((v, w), (round(seconds / _DT), 1)) for v, w, seconds in walk])
    asked = np.column_stack(
        (commands[:, 0] - commands[:, 1] * _AXLE_M / 2, commands[:, 0] + commands[:, 1] * _AXLE_M / 2)
    )
    speeds = np.empty_like(asked)
    now = np.zeros(2)
    for step, wanted in enumerate(asked):
        now = now + (wanted - now) * _DT / _LAG_S
        speeds[step] = now
    rolled = np.cumsum(speeds, axis=0) * _DT  # by the firmware's own belief
    ticks = np.floor(rolled / (math.pi * _DIAMETER_M / _TICKS) + rng.uniform(0.0, 1.0, 2)).astype(np.int64)
    rolls = 1.0 + np.repeat(slip * rng.standard_normal((len(speeds) // 20 + 1, 2)), 20, axis=0)[: len(speeds)]
    travel = speeds * _DT * (body.left, body.right) * rolls
    turned = (travel[:, 1] - travel[:, 0]) / (body.axle * _AXLE_M)
    theta = np.cumsum(turned)
    middle, ahead = theta - 0.5 * turned, travel.mean(axis=1)
    return np.column_stack((np.cumsum(ahead * np.cos(middle)), np.cumsum(ahead * np.sin(middle)), theta)), ticks


def _scan(  # the world at a moment
    body: Body,
    rng: np.random.Generator,
    walls: NDArray[np.float64],
    poses: NDArray[np.float64],
    stamps: NDArray[np.float64],
    begin: float,
) -> LaserScan:
    times = begin + _SCAN_S * np.arange(1, _BEAMS + 1) / _BEAMS
    x, y, theta = (np.interp(times, stamps, poses[:, column]) for column in range(3))
    angles = math.tau * np.arange(_BEAMS) / _BEAMS - math.pi
    from_x = x + body.x * np.cos(theta) - body.y * np.sin(theta)
    from_y = y + body.x * np.sin(theta) + body.y * np.cos(theta)
    bearing = theta + body.yaw + angles
    ranges = _cast(walls, from_x, from_y, np.cos(bearing), np.sin(bearing))
    ranges = np.minimum(ranges, 20.0)
    ranges = ranges + (0.006 + 0.004 * ranges) * rng.standard_normal(_BEAMS)
    return LaserScan(
        angles_rad=-angles if body.mirrored else angles,  # one that hangs upside down tells the other way round
        ranges_m=np.where(ranges < 12.0, ranges, np.nan),
        quality=np.full(_BEAMS, 15, np.uint8),
        started_at=begin + body.latency,
        ended_at=begin + _SCAN_S + body.latency,
        repeats=1,
    )


def _cast(
    walls: NDArray[np.float64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    cos: NDArray[np.float64],
    sin: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return how far (m) the nearest wall is along each ray."""
    ax, ay = walls[:, 0, 0][:, None], walls[:, 0, 1][:, None]
    ex, ey = walls[:, 1, 0][:, None] - ax, walls[:, 1, 1][:, None] - ay
    across = cos * ey - sin * ex
    with np.errstate(divide="ignore", invalid="ignore"):
        along = ((ax - x) * ey - (ay - y) * ex) / across
        share = ((ax - x) * sin - (ay - y) * cos) / across
    hit = (along > 0.0) & (share >= 0.0) & (share <= 1.0)
    return np.asarray(np.where(hit, along, np.inf).min(axis=0))


def measure(seeds: int, on_done: Callable[[int], object] = lambda _: None) -> dict[str, Any]:
    """Calibrate a robot for each seed; return how far off each figure is at worst, and how many intervals were true."""
    errors: dict[str, list[float]] = {name: [] for name in NAMES}
    true = asked = wrong_side = 0
    began = time.process_time()
    for seed in range(1, seeds + 1):
        rng = np.random.default_rng(seed)
        body, calibrator = random_body(rng), Calibrator()
        for entry in recording(body, rng):
            calibrator.take(entry)
        found = calibrator.solve()
        wrong_side += found.mirrored != body.mirrored
        for name, figure in found.figures.items():
            error = _error(name, figure.value, body)
            half = figure.half / _AXLE_M if name == "axle" else figure.half
            errors[name].append(error)
            asked += 1
            true += abs(error) <= half
        on_done(seed)
    return {
        "seeds": seeds,
        "cpu_s": round((time.process_time() - began) / seeds, 2),
        "worst": {name: round(max(map(abs, values)), 5) for name, values in errors.items()},
        "median": {name: round(float(np.median(np.abs(values))), 5) for name, values in errors.items()},
        "intervals_true": round(true / asked, 3),
        "mirrored_wrong": wrong_side,
    }


def _error(name: str, value: float, body: Body) -> float:
    """Return by how much a figure is off: shares of the truth for wheels and axle, else m, rad, s."""
    truth = float(getattr(body, name))
    if name == "axle":
        return value / (_AXLE_M * truth) - 1.0
    if name in {"left", "right"}:
        return value / truth - 1.0
    return math.remainder(value - truth, math.tau) if name == "yaw" else value - truth
