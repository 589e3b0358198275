"""What the base reports: which of it must stop its wheels, and when the agent gets it. Pure.

The agent gets every change at once, the rest at a steady rate.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import msgspec

from fog_contracts.messages import Described, Reason

if TYPE_CHECKING:
    from robot_agent.hardware import BaseReading, BaseStatus, WheelOdometry

OVERCURRENT_S: Final = 0.3
"""A motor that starts on a carpet draws a high current for a moment; a blocked one keeps drawing it."""


class FaultCode(Described):
    """What the guardian latches; a base that leaves its driving mode has identifiers of its own for that."""

    CLIFF = "cliff", "a cliff sensor sees no floor"
    WHEEL_DROP = "wheel_drop", "a wheel has dropped"
    BUMPER = "bumper", "the bumper is pressed"
    MOTOR_BLOCKED = "motor_blocked", "a wheel motor draws too much current"
    MODE_LEFT = "mode_left", "the base left its driving mode"
    BASE_SILENT = "base_silent", "the base sends no valid frame"


def fault_of(status: BaseStatus, blocked_for: float, *, bumper: bool) -> Reason | None:
    """Return the fault that an awake base reports; None without one.

    blocked_for: s for which a motor has been drawing too much current. bumper: whether a pressed one is a fault now.
    """
    # A base may leave its driving mode by itself on cliff or wheel drop, which are the more precise reason.
    if status.cliff:
        return Reason(FaultCode.CLIFF, "a cliff sensor sees no floor")
    if status.wheel_drop:
        return Reason(FaultCode.WHEEL_DROP, "a wheel has dropped: the robot was lifted or hangs over an edge")
    if status.bumper and bumper:
        both = status.bumper_left and status.bumper_right
        side = "both sides" if both else "left" if status.bumper_left else "right"
        return Reason(FaultCode.BUMPER, f"the bumper is pressed ({side})")
    if blocked_for >= OVERCURRENT_S:
        return Reason(FaultCode.MOTOR_BLOCKED, "a wheel motor draws too much current: it is blocked")
    if status.mode_problem is not None:
        sentence = f"the base left its driving mode: {status.mode_problem}"
        return Reason(status.mode_code or FaultCode.MODE_LEFT, sentence)
    return None


FEEDBACK_S: Final = 0.045
"""The agent gets every fourth sensor frame while the wheels turn, and every change immediately."""
FEEDBACK_AT_REST_S: Final = 0.09
"""And every seventh while they do not: an idle robot shall cost little."""


class FeedbackPolicy:
    """What was reported last; `now` is s of a monotonic clock."""

    def __init__(self) -> None:
        self._at = -math.inf
        self._key: object = None
        self._status: BaseStatus | None = None
        self._alarms: BaseStatus | None = None
        self._odometry: WheelOdometry | None = None
        self.seq = 0

    def is_due(self, reading: BaseReading, state: object, now: float, *, moving: bool) -> bool:
        """Return whether to report a new reading; `state`: what else is reported at once when it changes."""
        if reading.status is not self._status:
            self._status = reading.status
            # Any change counts but that of measurements, which change all the time.
            self._alarms = msgspec.structs.replace(reading.status, battery=None, power=None, proximity=())
        key = (self._alarms, state)
        rests = reading.odometry == self._odometry and not moving
        if key == self._key and now - self._at < (FEEDBACK_AT_REST_S if rests else FEEDBACK_S):
            return False
        self._key = key
        return True

    def is_overdue(self, now: float) -> bool:
        """Return whether to repeat the last reading of a base that is silent."""
        return now - self._at >= FEEDBACK_S

    def on_report(self, reading: BaseReading, now: float) -> int:
        """Record that a reading is reported; return the report's number."""
        self.seq += 1
        self._at, self._odometry = now, reading.odometry
        return self.seq
