"""What a calibration has found, and what that changes in a robot's settings."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from fog_contracts.robot import RobotSettings
    from robot_agent.config import AgentConfig, LocalizationConfig
    from robot_agent.hardware import DriveTrain

Alphas = tuple[float, float, float, float]
"""Noise of the odometry, as `LocalizationConfig` has it."""

NAMES: Final = ("left", "right", "axle", "x", "y", "yaw", "latency")
"""What is found: each wheel's travel as a share of what its counter says, the axle (m), the lidar (m, m, rad), and how
much older (s) scans are than the counters that arrive with them."""
WANTED: Final = (0.003, 0.003, 0.003, 0.005, 0.005, math.radians(0.3), 0.02)
"""Half widths of intervals that are good enough: shares, of the axle too, m, m, rad, s."""
LEVEL: Final = 1.96
"""Deviations of an interval, of 95 %."""


class Figure(NamedTuple):
    """A value, and half of its interval of 95 %."""

    value: float
    half: float


class Calibration(NamedTuple):
    """What was found, by name (`NAMES`); whether the lidar's angles are mirrored, and what speaks for all this.

    steps: pairs of scans that were used. residual_m, residual_rad: rms of what the wheels say against the scans.
    noise: `alphas` that the wheels' slips amount to (`motion_noise`).
    """

    figures: dict[str, Figure]
    mirrored: bool
    steps: int
    residual_m: float
    residual_rad: float
    noise: Alphas = (0.0, 0.0, 0.0, 0.0)


def motion_noise(motions: NDArray[np.float64], errors: NDArray[np.float64], config: LocalizationConfig) -> Alphas:
    """Return the noise of a robot that moved so (n, 3; m, m, rad), and came out off by `errors` (n, 3) in its frame.

    It slips at random, so that its variance grows with the way. What the errors' own measurement is wrong by counts,
    too: most of what translations show is that.
    """
    turned = np.abs(motions[:, 2])
    ways = np.column_stack((turned, np.hypot(motions[:, 0], motions[:, 1])))
    middle = 0.5 * motions[:, 2]
    along = errors[:, 0] * np.cos(middle) - errors[:, 1] * np.sin(middle)
    turn_by_turn, turn_by_way = _by_ways(ways, errors[:, 2] ** 2)
    way_by_turn, way_by_way = _by_ways(ways, along**2)
    # The filter moves by steps of this size, and turns by half of an angle before and after each.
    way, angle = config.update_distance, config.update_angle
    return 2.0 * turn_by_turn / angle, 0.5 * turn_by_way / way, way_by_way / way, 2.0 * way_by_turn / angle


def _by_ways(ways: NDArray[np.float64], squares: NDArray[np.float64]) -> tuple[float, float]:
    """Return by how much squares (n,) grow with each of two ways (n, 2), neither less than 0."""
    both = np.linalg.lstsq(ways, squares)[0]
    if both.min() < 0.0:
        alone = (ways.T @ squares) / np.maximum((ways**2).sum(axis=0), 1e-12)
        left = [float(((squares - share * way) ** 2).sum()) for share, way in zip(alone, ways.T, strict=True)]
        both = np.where(np.arange(2) == int(np.argmin(left)), alone, 0.0)
    return float(both[0]), float(both[1])


Setting = float | bool | list[float] | list[list[float]]
"""The value of a setting."""


class Changed(NamedTuple):
    """A setting by its dotted name, its value before and now; half: of the interval, None for a choice."""

    setting: str
    before: Setting
    now: Setting
    half: float | None


def changes(found: Calibration, config: AgentConfig, settings: RobotSettings, diameter: float) -> list[Changed]:
    """Return what a calibration changes in a robot's settings, whose wheels are this large (m).

    The noise that the filter counts with only grows: it covers what this drive and this floor did not show.
    """
    left, right = found.figures["left"], found.figures["right"]
    mean, half = 0.5 * (left.value + right.value), 0.5 * math.hypot(left.half, right.half)
    ratio = right.value / left.value
    lidar, latency = settings.lidar, found.figures["latency"]
    told = [
        Changed("base.options.wheel_diameter_m", diameter, round(diameter * mean, 6), diameter * half),
        Changed("odometry.wheel_ratio", settings.odometry.wheel_ratio, round(ratio, 5), ratio * half),
        Changed("base.options.axle_m", config.drive_train.axle_m, *_rounded(found.figures["axle"], 5)),
        Changed("lidar.x_m", lidar.x_m, *_rounded(found.figures["x"], 4)),
        Changed("lidar.y_m", lidar.y_m, *_rounded(found.figures["y"], 4)),
        Changed("lidar.yaw_rad", lidar.yaw_rad, *_rounded(found.figures["yaw"], 4)),
    ]
    if found.mirrored:
        told.append(Changed("lidar.mirrored", lidar.mirrored, not lidar.mirrored, None))
    if abs(latency.value) > latency.half:
        told.append(Changed("lidar.latency_s", lidar.latency_s, *_rounded(latency, 3)))
        later = max(0.0, round(lidar.latency_s + latency.value, 3))
        told[-1] = told[-1]._replace(now=later)
    alphas = settings.odometry.alphas
    noisier = [max(was, min(2.0, round(now, 4))) for was, now in zip(alphas, found.noise, strict=True)]
    if noisier != [*alphas]:
        told.append(Changed("odometry.alphas", [*alphas], noisier, None))
    masks = [[*mask] for mask in lidar.masks]
    if (turned := [_turned(mask, found, lidar.yaw_rad) for mask in masks]) != masks:
        told.append(Changed("lidar.masks", masks, turned, None))
    return told


def _turned(mask: Sequence[float], found: Calibration, yaw: float) -> list[float]:
    """Return a mask (rad, in the robot's frame) over the same samples, whose direction was `yaw` (rad) until now."""
    ends = [end - yaw for end in mask]
    if found.mirrored:
        ends = [-ends[1], -ends[0]]
    return [round(math.remainder(end + round(found.figures["yaw"].value, 4), math.tau), 4) for end in ends]


def differing(config: AgentConfig, settings: RobotSettings, drive: DriveTrain) -> list[str]:
    """Return which of the settings that a calibration corrects are others than those that a recording was made with.

    drive: of the base by these settings.
    """
    lidar, used, recorded = settings.lidar, config.localization, config.drive_train
    pairs = {
        "base.options.wheel_diameter_m": (recorded.travel_wrap_m, drive.travel_wrap_m),
        "base.options.axle_m": (recorded.axle_m, drive.axle_m),
        "odometry.wheel_ratio": (recorded.wheel_ratio, settings.odometry.wheel_ratio),
        "lidar.x_m": (used.lidar_x, lidar.x_m),
        "lidar.y_m": (used.lidar_y, lidar.y_m),
        "lidar.yaw_rad": (used.lidar_yaw, lidar.yaw_rad),
        "lidar.mirrored": (used.lidar_mirrored, lidar.mirrored),
        "lidar.latency_s": (used.lidar_latency, lidar.latency_s),
    }
    return [
        name
        for name, (was, now) in pairs.items()
        if was is not None and not math.isclose(was, now, rel_tol=1e-6, abs_tol=1e-9)
    ]


def _rounded(figure: Figure, digits: int) -> tuple[float, float]:
    return round(figure.value, digits), figure.half
