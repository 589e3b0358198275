"""From decisions, 5 a second, to wheel commands, 20 a second, within what the safety gate allows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from robot_agent.guardian.link import WheelCommand
from robot_agent.safety.gate import limit_wheels, ramp_down

if TYPE_CHECKING:
    from robot_agent.config import AgentConfig
    from robot_agent.motion.local_planner import Decision
    from robot_agent.safety.gate import SafetyOutputs

_LONGEST_STEP_S: Final = 0.2
"""After a longer pause the wheels change by no more than within this time."""


class WheelControl:
    """Streams the newest decision, or a ramp to rest when there is none that is fresh."""

    def __init__(self, config: AgentConfig) -> None:
        self._config = config
        self.decision: Decision | None = None
        """What the dynamic window chose last; None while the robot is not to follow a path."""
        self.speeds = (0.0, 0.0)
        """Of the left and right wheel, m/s, as last streamed."""
        self.follows = False
        """Whether the last command follows a decision."""
        self._seq = 0
        self._streamed_at: float | None = None
        self._reset_base = False

    @property
    def at_rest(self) -> bool:
        """Whether the last command was to stand."""
        return self.speeds == (0.0, 0.0)

    def pass_reset(self) -> None:
        """Have the next command pass an operator's reset on to the guardian."""
        self._reset_base = True

    def command(self, verdict: SafetyOutputs, now: float) -> WheelCommand:
        """Return the wheel speeds to send at `now` (s, monotonic)."""
        dt = 0.0 if self._streamed_at is None else min(max(now - self._streamed_at, 0.0), _LONGEST_STEP_S)
        self._streamed_at = now
        motion, safety = self._config.motion, self._config.safety
        # A decision counts by the age of what it rests on, so a hung control loop stops the robot too.
        decision = self.decision
        if decision is not None and now - decision.made_at > self._config.decision_max_age:
            decision = None
        if verdict.stop == "none" and decision is None:
            self.speeds = ramp_down(self.speeds, dt, motion.wheel_speed / safety.ramp)
        else:
            self.speeds = limit_wheels(
                (0.0, 0.0) if decision is None else (decision.left, decision.right),
                self.speeds,
                verdict,
                dt,
                acceleration=motion.acceleration,
                wheel_speed=motion.wheel_speed,
                config=safety,
            )
        self.follows = decision is not None and verdict.stop == "none"
        self._seq += 1
        reset, self._reset_base = self._reset_base, False
        return WheelCommand(seq=self._seq, left=self.speeds[0], right=self.speeds[1], reset=reset)
