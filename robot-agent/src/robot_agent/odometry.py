"""From travel of the wheels to the robot's pose: pure functions, and one class that keeps their state."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from robot_agent.hardware import DriveTrain, WheelOdometry


class Reading(NamedTuple):
    """Counters of both wheels (m), and their time of arrival (s, the caller's monotonic clock)."""

    left_m: float
    right_m: float
    timestamp: float


class EncoderFault(NamedTuple):
    """A step that no wheel can make. It does not change the pose."""

    left_m: float
    right_m: float
    possible_m: float
    elapsed_s: float

    def __str__(self) -> str:
        return (
            f"encoders jumped by left {self.left_m:+.3f} m and right {self.right_m:+.3f} m in {self.elapsed_s:.3f} s, "
            f"{self.possible_m:.3f} m is possible: a damaged frame, a base that restarted, or a gap in its frames"
        )


class Motion(NamedTuple):
    """A plausible step: travel of the wheels in metres, and the pose (x, y in metres, theta in radians) after it.

    `skipped`: the jump before this step, if the readings since agree with it. It is not part of the pose: the base
    restarted, or the robot moved unobserved.
    """

    left_m: float
    right_m: float
    x: float
    y: float
    theta: float
    skipped: EncoderFault | None = None


class OdometryState(NamedTuple):
    """Pose in the odometry frame (metres, radians, theta not wrapped) and the readings that it is based on."""

    x: float = 0.0
    y: float = 0.0
    theta: float = 0.0
    trusted: Reading | None = None
    suspect: Reading | None = None


def wheel_travel(new_m: float, old_m: float, wrap_m: float) -> float:
    """Return the travel (m) from one reading of a counter to the next, at most half of `wrap_m` either way."""
    return math.remainder(new_m - old_m, wrap_m)


def integrate(
    x: float, y: float, theta: float, left_m: float, right_m: float, axle_m: float
) -> tuple[float, float, float]:
    """Return the pose after both wheels rolled along one arc of a circle, exact for constant speeds.

    The chord of an arc of length s and angle a is s sin(a/2)/(a/2), at the mean heading (Siegwart and Nourbakhsh,
    Introduction to Autonomous Mobile Robots, section 5.2.4, with the chord in place of the arc). Metres and radians.
    """
    rotation = (right_m - left_m) / axle_m
    half = 0.5 * rotation
    chord = 0.5 * (left_m + right_m) * (math.sin(half) / half if half else 1.0)
    return x + chord * math.cos(theta + half), y + chord * math.sin(theta + half), theta + rotation


# Frames that the host reads late arrive together: some milliseconds of motion with no time between them.
_ARRIVAL_SLACK_S: Final = 0.1
_SPEED_MARGIN: Final = 1.2


def advance(state: OdometryState, reading: Reading, drive: DriveTrain) -> tuple[OdometryState, Motion | EncoderFault]:
    """Apply one reading; return the new state, and the motion or the fault.

    The first reading only sets the zero. A step beyond what the wheels can do (top speed and a fifth, over the time
    since the last trusted reading and 0.1 s) is an EncoderFault. After one wild reading the next good one
    continues from the trusted one; if the readings after it agree with it instead (the base restarted), they become
    trusted, and the jump itself never counts as motion.
    """
    if state.trusted is None:
        return state._replace(trusted=reading), Motion(0.0, 0.0, state.x, state.y, state.theta)
    left_m, right_m, possible_m = _step(state.trusted, reading, drive)
    skipped = None
    if max(abs(left_m), abs(right_m)) > possible_m:
        fault = EncoderFault(left_m, right_m, possible_m, reading.timestamp - state.trusted.timestamp)
        skipped = fault
        if state.suspect is None:
            return state._replace(suspect=reading), fault
        left_m, right_m, possible_m = _step(state.suspect, reading, drive)
        if max(abs(left_m), abs(right_m)) > possible_m:
            return state._replace(suspect=reading), fault
    x, y, theta = integrate(state.x, state.y, state.theta, left_m, right_m, drive.axle_m)
    return OdometryState(x, y, theta, trusted=reading), Motion(left_m, right_m, x, y, theta, skipped)


def _step(old: Reading, new: Reading, drive: DriveTrain) -> tuple[float, float, float]:
    span = max(0.0, new.timestamp - old.timestamp) + _ARRIVAL_SLACK_S
    possible = _SPEED_MARGIN * drive.wheel_speed_max_m_s * span
    if possible > drive.travel_wrap_m / 4:
        # The counter may have wrapped during the gap: the step is ambiguous.
        possible = -1.0
    wrap = drive.travel_wrap_m
    return wheel_travel(new.left_m, old.left_m, wrap), wheel_travel(new.right_m, old.right_m, wrap), possible


_UNMEASURED_M: Final = (0.1, 2.0)
_UNMEASURED_RAD: Final = (0.1, 0.8)
"""Least and greatest motion expected behind a jump: a base that restarted jumps by any amount without moving."""


def possible_motion(jump: EncoderFault, drive: DriveTrain) -> tuple[float, float, str]:
    """Return how far (m, rad) the robot may have moved during a jump of its encoders, and the reason in words."""
    distance = max(abs(jump.left_m), abs(jump.right_m))
    angle = abs(jump.right_m - jump.left_m) / drive.axle_m
    return (
        min(max(distance, _UNMEASURED_M[0]), _UNMEASURED_M[1]),
        min(max(angle, _UNMEASURED_RAD[0]), _UNMEASURED_RAD[1]),
        str(jump),
    )


class Odometry:
    """The odometry of one base: `advance` with its state kept."""

    def __init__(self, drive: DriveTrain) -> None:
        self._drive = drive
        self._state = OdometryState()
        self.faults = 0

    @property
    def pose(self) -> tuple[float, float, float]:
        """(x, y, theta) in the odometry frame: metres, radians, theta not wrapped."""
        return self._state.x, self._state.y, self._state.theta

    def update(self, wheels: WheelOdometry, now: float) -> Motion | EncoderFault:
        """Apply the counters of a frame that arrived at `now` (s, monotonic)."""
        self._state, outcome = advance(self._state, Reading(wheels.left_m, wheels.right_m, now), self._drive)
        if isinstance(outcome, EncoderFault):
            self.faults += 1
        return outcome
