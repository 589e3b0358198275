"""Settings of a robot that are valid one by one and make no sense together: they are refused before anything moves.

Without numpy: the agent looks at them before it loads that.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from robot_agent.hardware import DockingDriver, SleepingDriver
from robot_agent.sight import BLIND_SHARE, SECTORS, TRAVEL_HALF_RAD

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_runtime.configuration.robot_file import RobotFile
    from robot_agent.footprint import Footprint
    from robot_agent.hardware import BaseDriver, LidarTraits

_SECTOR_MIN_RAD: Final = 0.005
"""Less is no sector: a lidar's samples are farther apart."""
_STEPS: Final = 20
"""Directions of a sector that are looked at, 0.25 degrees apart."""
_AXLE_SHARE: Final = 0.8
"""An axle as measured by turns is longer than the true one, by up to a fifth with soft wheels."""

Sector = tuple[float, float]


def refuse_contradictions(robot: RobotFile, base: BaseDriver) -> None:
    """Raise `SettingsError` for settings that contradict one another or the base."""
    _refuse_masks(robot)
    _refuse_speed(robot, base)
    _refuse_power(robot, base)


def refuse_body(robot: RobotFile, base: BaseDriver, footprint: Footprint) -> None:
    """Raise `SettingsError` for a lidar or wheels outside of the body's outline.

    What sticks out hits what the stop field takes for free, and would be the first to do so.
    """
    lidar = robot.settings.lidar
    outside = footprint.outside_by(lidar.x_m, lidar.y_m)
    if outside > 0.0:
        raise robot.error(
            "lidar.y_m" if abs(lidar.y_m) > abs(lidar.x_m) else "lidar.x_m",
            f"the lidar's axis ({lidar.x_m:g}, {lidar.y_m:g}) is {outside:.3f} m outside of the robot's body, so what "
            "carries it would hit obstacles that the robot believes to pass",
            "Correct x_m and y_m, or let `footprint` of [body] (without one: the site's `radius`) include the lidar",
        )
    half = 0.5 * base.drive_train.axle_m
    outside = max(footprint.outside_by(0.0, side * _AXLE_SHARE * half) for side in (1.0, -1.0))
    if outside > 0.0:
        raise robot.error(
            "body.footprint",
            f"the body's outline does not include the wheels, {half:.3f} m to the left and right of the middle of "
            "their axle",
            "Correct it (without one: the site's `radius`), or `axle_m` of [base.options]",
        )


def remarks(robot: RobotFile, lidar: LidarTraits, footprint: Footprint) -> list[str]:
    """Return what a person may not expect of settings that are no mistake."""
    told = []
    inside, place = -footprint.outside_by(robot.settings.lidar.x_m, robot.settings.lidar.y_m), "lidar.x_m and lidar.y_m"
    if 0.0 <= inside < lidar.range_min_m:
        told.append(
            f"{place}: the lidar measures from {lidar.range_min_m:g} m on, and the body's rim is only {inside:.2f} m "
            "from it: what stands within the rest when the robot is started, or comes in there from aside, it does not "
            "see. Keep that free, or mount the lidar farther from the rim"
        )
    if _hidden(robot.settings.lidar.masks, math.pi) >= BLIND_SHARE:
        told.append("lidar.masks hide the way behind: the robot never drives backwards, nor off a dock")
    if robot.settings.power.rest_base and not lidar.can_rest:
        told.append(
            "power.rest_base has no effect: the motor of this lidar can't be switched, so the robot never rests"
        )
    return told


def _refuse_masks(robot: RobotFile) -> None:
    masks = robot.settings.lidar.masks
    for number, (begin, end) in enumerate(masks, 1):
        width = (end - begin) % math.tau
        if min(width, math.tau - width) < _SECTOR_MIN_RAD:
            raise robot.error(
                "lidar.masks",
                f"mask {number}, [{begin:g}, {end:g}], ends where it begins: that is no direction, or all of them",
                "Give the directions between which the lidar sees the robot itself, counter-clockwise",
            )
    hidden = _hidden(masks, 0.0)
    if hidden >= BLIND_SHARE:
        raise robot.error(
            "lidar.masks",
            f"the masks hide {100 * hidden:.0f} % of the directions within {TRAVEL_HALF_RAD:g} rad of straight ahead, "
            f"and from {100 * BLIND_SHARE:.0f} % on the robot never drives",
            "A mask goes counter-clockwise from its first direction to its second, in the robot's frame (0 ahead): "
            "correct it, or mount the lidar where it sees what is ahead",
        )


def _hidden(masks: Sequence[Sector], heading: float) -> float:
    """Return which share of the sectors of travel is masked whole; `heading`: of the travel, in the robot's frame."""
    width = math.tau / SECTORS
    begins = [sector * width - math.pi for sector in range(SECTORS)]
    travel = [begin for begin in begins if _apart(begin + 0.5 * width, heading) <= TRAVEL_HALF_RAD]
    hidden = [
        all(_is_masked(begin + (step + 0.5) / _STEPS * width, masks) for step in range(_STEPS)) for begin in travel
    ]
    return sum(hidden) / len(travel)


def _is_masked(direction: float, masks: Sequence[Sector]) -> bool:
    return any((direction - begin) % math.tau <= (end - begin) % math.tau for begin, end in masks)


def _apart(one: float, other: float) -> float:
    return abs(math.remainder(one - other, math.tau))


def _refuse_speed(robot: RobotFile, base: BaseDriver) -> None:
    speed, top = robot.settings.motion.speed_m_s, base.drive_train.wheel_speed_max_m_s
    if speed > top:
        raise robot.error(
            "motion.speed_m_s",
            f"{speed:g} m/s is more than the base's wheels can do, {top:g} m/s",
            f"Set it to {top:g} or less, or correct the top speed in [base.options]",
        )


def _refuse_power(robot: RobotFile, base: BaseDriver) -> None:
    power, driver = robot.settings.power, robot.settings.base.driver
    if power.dock_below > 0.0 and not isinstance(base, DockingDriver):
        raise robot.error(
            "power.dock_below",
            f"{power.dock_below:g}, but a {driver} does not drive into a dock by itself",
            "Set it to 0: `low_fraction` announces a low battery",
        )
    if not power.rest_base:
        return
    if not isinstance(base, SleepingDriver):
        raise robot.error("power.rest_base", f"true, but a {driver} can't be put to sleep", "Set it to false")
    if base.awakening.line is None:
        raise robot.error(
            "power.rest_base",
            "true, but no control line could wake the base again, so it would be left awake",
            "Set `brc` of [base.options] to the adapter's line that is wired to the BRC pin, or rest_base to false",
        )
    if power.rest_after_s == 0.0:
        raise robot.error(
            "power.rest_base",
            "true, but with rest_after_s = 0 the robot never rests",
            "Set rest_after_s to the idle time after which it does, or rest_base to false",
        )
