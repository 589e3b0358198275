"""From decisions, 5 a second, to wheel commands, 20 a second, within what the safety gate allows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from robot_agent.guardian.link import WheelCommand
from robot_agent.safety.wheel_limits import limit_wheels, ramp_down

if TYPE_CHECKING:
    from collections.abc import Callable

    from robot_agent.config import AgentConfig
    from robot_agent.motion.local_planner import Decision
    from robot_agent.safety.gate import SafetyOutputs
    from robot_agent.safety.stop_field import Wheels

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
        """Return the wheel speeds to send at `now` (s, monotonic); `guard` has the last word on them."""
        dt = 0.0 if self._streamed_at is None else min(max(now - self._streamed_at, 0.0), _STEP_MAX_S)
        self._streamed_at = now
        limits, safety = self._config.motion.limits, self._config.safety
        # A decision is as old as its inputs, so a hung control loop stops the robot too.
        decision = self.decision
        if decision is not None and now - decision.made_at > self._config.decision_max_age:
            decision = None
        if outputs.stop == "none" and decision is None:
            self.speeds = ramp_down(self.speeds, dt, limits.wheel_max / safety.ramp)
        else:
            self.speeds = limit_wheels(
                (0.0, 0.0) if decision is None else (decision.left, decision.right),
                self.speeds,
                outputs,
                dt,
                acceleration=limits.acc_v,
                wheel_speed=limits.wheel_max,
                config=safety,
            )
        self.speeds = guard(self.speeds, now)
        self.following = decision is not None and outputs.stop == "none"
        self._seq += 1
        reset, self._reset_pending = self._reset_pending, False
        return WheelCommand(seq=self._seq, left=self.speeds[0], right=self.speeds[1], reset=reset)
