"""From decisions, 5 a second, to wheel commands, 20 a second, within what the safety gate allows.

From one speed to the next without slip or jolt: acceleration and jerk are limited, and braking is never delayed. Wheels
that start to slip falsify the odometry, and a jolt tips what the robot carries.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

from robot_agent.guardian.link import WheelCommand
from robot_agent.motion.local_planner import twist, wheels
from robot_agent.safety.gate import capped, limit_wheels, ramp_down

if TYPE_CHECKING:
    from collections.abc import Callable

    from robot_agent.config import AgentConfig
    from robot_agent.motion.local_planner import Decision
    from robot_agent.safety.gate import SafetyOutputs
    from robot_agent.safety.stop_field import Wheels


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


_SAME_M_S: Final = 1e-6
"""Wheel speeds nearer than this are the same."""
_STEP_MAX_S: Final = 0.2
"""After a longer pause the wheel speeds change by no more than within this time."""


class WheelControl:
    """Turns the newest decision into wheel commands, or ramps to rest without a fresh one."""

    def __init__(self, config: AgentConfig) -> None:
        self._config = config
        self.decision: Decision | None = None
        """The newest decision; None while the robot must not follow a path."""
        self.speeds = (0.0, 0.0)
        """Speeds of the left and right wheel (m/s) in the last command."""
        self.following = False
        """Whether the last command follows a decision."""
        motion = config.motion
        self._advance = Limits(motion.limits.acc_v, motion.jerk_v)
        self._turn = Limits(motion.limits.acc_w, motion.jerk_w)
        self._rates = (0.0, 0.0)
        """Accelerations (m/s2, rad/s2) at which advance and turn grow in the last command."""
        self._seq = 0
        self._streamed_at: float | None = None
        self._reset_pending = False

    @property
    def at_rest(self) -> bool:
        """Whether the last command was zero."""
        return self.speeds == (0.0, 0.0)

    def pass_reset(self) -> None:
        """Pass an operator's reset on to the guardian with the next command."""
        self._reset_pending = True

    def command(self, outputs: SafetyOutputs, guard: Callable[[Wheels, float], Wheels], now: float) -> WheelCommand:
        """Return the wheel speeds to send at `now` (s, monotonic); `guard` limits them last."""
        dt = 0.0 if self._streamed_at is None else min(max(now - self._streamed_at, 0.0), _STEP_MAX_S)
        self._streamed_at = now
        limits, safety, last = self._config.motion.limits, self._config.safety, self.speeds
        decision = self._usable_decision(now)
        wanted = last
        if outputs.stop == "none" and decision is None:
            self.speeds = ramp_down(last, dt, limits.wheel_max / safety.ramp)
        else:
            if decision is not None:
                wanted = self._smoothed((decision.left, decision.right), outputs.cap, dt)
            self.speeds = limit_wheels(
                wanted,
                last,
                outputs,
                dt,
                acceleration=limits.acc_v + 0.5 * limits.axle * limits.acc_w,
                wheel_speed=limits.wheel_max,
                config=safety,
            )
        self.speeds = guard(self.speeds, now)
        if math.dist(self.speeds, wanted) > _SAME_M_S:
            self._rates = (0.0, 0.0)  # who was slowed down starts gently again
        self.following = decision is not None and outputs.stop == "none"
        return self._next()

    def repeat(self, now: float) -> WheelCommand:
        """Return the last wheel speeds again, to be sent at `now` (s, monotonic); of wheels at rest only."""
        self._streamed_at = now
        return self._next()

    def _next(self) -> WheelCommand:
        self._seq += 1
        reset, self._reset_pending = self._reset_pending, False
        # The base turns each wheel by its counter. Divided by the larger share of both: neither gets faster by it.
        left, right = self._config.drive_train.shares
        least = min(left, right)
        return WheelCommand(
            seq=self._seq, left=self.speeds[0] * least / left, right=self.speeds[1] * least / right, reset=reset
        )

    def _usable_decision(self, now: float) -> Decision | None:
        """Return the newest decision; None when it is too old, or one of its speeds is no number."""
        decision = self.decision
        if decision is None or not (math.isfinite(decision.left) and math.isfinite(decision.right)):
            return None
        # A decision is as old as its inputs, so a hung control loop stops the robot too.
        return None if now - decision.made_at > self._config.decision_max_age else decision

    def _smoothed(self, requested: Wheels, cap: float, dt: float) -> Wheels:
        """Return the wheel speeds (m/s) on the way to those requested, within acceleration and jerk."""
        limits = self._config.motion.limits
        v, w = twist(*self.speeds, limits.axle)
        to_v, to_w = twist(*capped(requested, cap, limits.wheel_max), limits.axle)
        v, advance = approach(v, to_v, self._rates[0], dt, self._advance)
        w, turn = approach(w, to_w, self._rates[1], dt, self._turn)
        self._rates = advance, turn
        return wheels(v, w, limits.axle)
