"""How fast the wheels may change and turn in each mode of the safety gate: caps, ramps and immediate stops. Pure."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from robot_agent.config import SafetyConfig

if TYPE_CHECKING:
    from robot_agent.safety.gate import SafetyOutputs


def limit_wheels(  # noqa: PLR0913  # the gate knows nothing of the motion's settings
    requested: tuple[float, float],
    last: tuple[float, float],
    outputs: SafetyOutputs,
    dt: float,
    *,
    acceleration: float,
    wheel_speed: float,
    config: SafetyConfig | None = None,
) -> tuple[float, float]:
    """Return the wheel speeds (left, right; m/s) that may be streamed now, `dt` s after `last` was.

    Stopped modes bring the wheels to rest, at once or along a straight ramp that ends within `config.ramp` s whatever
    the speed; the ratio of the wheels is kept, so the robot brakes along its arc. Driving modes cap the robot's speed,
    then each wheel's speed and rate of change; never does a wheel speed up while the other limits apply.
    """
    config = config or SafetyConfig()
    if outputs.stop == "immediate":
        return 0.0, 0.0
    if outputs.stop == "ramp":
        return ramp_down(last, dt, wheel_speed / config.ramp)
    left, right = requested
    if not (math.isfinite(left) and math.isfinite(right)):
        return ramp_down(last, dt, wheel_speed / config.ramp)
    target = capped(requested, outputs.cap, wheel_speed)
    change = acceleration * max(dt, 0.0)
    largest = max(abs(target[0] - last[0]), abs(target[1] - last[1]))
    if largest <= change:
        return target
    share = change / largest
    return last[0] + (target[0] - last[0]) * share, last[1] + (target[1] - last[1]) * share


def capped(requested: tuple[float, float], cap: float, wheel_speed: float) -> tuple[float, float]:
    """Return wheel speeds (m/s) of the same arc whose mean is at most `cap`, and none faster than `wheel_speed`."""
    left, right = requested
    scale = 1.0
    centre = 0.5 * abs(left + right)
    if centre > cap:
        scale = cap / centre
    fastest = max(abs(left), abs(right)) * scale
    if fastest > wheel_speed:
        scale *= wheel_speed / fastest
    return left * scale, right * scale


def ramp_down(last: tuple[float, float], dt: float, deceleration: float) -> tuple[float, float]:
    """Return wheel speeds (m/s) on the way from `last` to rest, the faster wheel slowing by `deceleration` (m/s2)."""
    fastest = max(abs(last[0]), abs(last[1]))
    slowed = fastest - deceleration * max(dt, 0.0)
    if slowed <= 1e-9:
        return 0.0, 0.0
    return last[0] * slowed / fastest, last[1] * slowed / fastest
