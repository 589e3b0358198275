"""From one speed to the next without slip or jolt: acceleration and jerk are limited, and braking is never delayed.

Pure. Wheels that start to slip falsify the odometry, and a jolt tips what the robot carries.
"""

from __future__ import annotations

import math
from typing import NamedTuple


class Limits(NamedTuple):
    """Largest acceleration of a speed (m/s2 or rad/s2), and how fast that may change (m/s3 or rad/s3)."""

    acceleration: float
    jerk: float


def approach(speed: float, wanted: float, rate: float, dt: float, limits: Limits) -> tuple[float, float]:
    """Return the speed `dt` s later on the way to `wanted`, and the acceleration at which it grows (0 while braking).

    speed, wanted: m/s or rad/s, positive or negative. rate: what the step before returned, 0 at the beginning.
    Growth begins and ends gently. Slowing down is limited by the acceleration alone, and a reversal passes through
    standstill.
    """
    if dt <= 0.0 or speed == wanted:
        return speed, rate
    if speed * wanted < 0.0 or abs(wanted) < abs(speed):
        rest = 0.0 if speed * wanted < 0.0 else wanted
        step = min(limits.acceleration * dt, abs(rest - speed))
        return speed + math.copysign(step, rest - speed), 0.0
    lacking = wanted - speed
    before = max(math.copysign(rate, rate * lacking), 0.0)
    ending = math.sqrt(2.0 * limits.jerk * abs(lacking))
    grown = min(before + limits.jerk * dt, ending, limits.acceleration)
    if grown * dt >= abs(lacking):
        return wanted, math.copysign(grown, lacking)
    return speed + math.copysign(grown * dt, lacking), math.copysign(grown, lacking)
