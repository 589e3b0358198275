"""From travel of the wheels to the pose in `odom`: pure functions, their state, and the last seconds of poses."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_kernels.scans import Track
from robot_agent.localization.pose import Pose2

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
    wrap, (left, right) = drive.travel_wrap_m, drive.shares
    left_m, right_m = wheel_travel(new.left_m, old.left_m, wrap), wheel_travel(new.right_m, old.right_m, wrap)
    return left * left_m, right * right_m, possible


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


_HISTORY_S: Final = 3.0
_EXTRAPOLATION_S: Final = 0.15
_TWIST_OVER_S: Final = 0.15
_TWIST_MIN_S: Final = 0.03


class OdometryBuffer:
    """Poses in `odom` (m, rad; theta not wrapped) by the time (s) at which they arrived, at most 3 s of them."""

    def __init__(self) -> None:
        self._history: deque[tuple[float, float, float, float]] = deque()
        self._twist: tuple[float, float] | None = None
        """The twist by this history; None until somebody asks for it."""
        self._asked: tuple[float, Pose2 | None] = (math.nan, None)
        """The time that was asked for last, and the pose then: a tick of the agent asks for the same moment often."""

    def add(self, timestamp: float, x: float, y: float, theta: float) -> None:
        """Append a pose; one that is not newer than the last is ignored."""
        if self._history and timestamp <= self._history[-1][0]:
            return
        self._history.append((timestamp, x, y, theta))
        self._twist, self._asked = None, (math.nan, None)
        while self._history[0][0] < timestamp - _HISTORY_S:
            self._history.popleft()

    def reaches_back_to(self, timestamp: float) -> bool:
        """Whether there is a pose at this time (s) or before."""
        return bool(self._history) and self._history[0][0] <= timestamp

    def latest(self) -> Pose2 | None:
        """Return the newest pose; None before the first."""
        return Pose2(*self._history[-1][1:]) if self._history else None

    def pose(self, timestamp: float) -> Pose2 | None:
        """Return the pose at a time (s), interpolated; extrapolated by at most 0.15 s. None before the first."""
        if timestamp != self._asked[0]:
            self._asked = timestamp, self._pose(timestamp)
        return self._asked[1]

    def _pose(self, timestamp: float) -> Pose2 | None:
        if not self._history:
            return None
        last = self._history[-1]
        if timestamp > last[0]:
            return self._extrapolated(min(timestamp - last[0], _EXTRAPOLATION_S))
        # Asked for many times a second and nearly always about a moment ago: from the newest pose backwards.
        after = last
        for before in reversed(self._history):
            if before[0] <= timestamp:
                return _interpolated(before, after, timestamp)
            after = before
        return Pose2(*after[1:])

    def track(self, since: float) -> Track:
        """Return the poses that tell where the robot was from a time (s) on, as `pose` does; there must be one."""
        return Track(np.array(self._since(since)), *self.twist(), _EXTRAPOLATION_S)

    def _since(self, timestamp: float) -> list[tuple[float, float, float, float]]:
        """Return the poses from the last one at or before this time (s) on; of times before the first, all."""
        since: list[tuple[float, float, float, float]] = []
        for entry in reversed(self._history):
            since.append(entry)
            if entry[0] <= timestamp:
                break
        since.reverse()
        return since

    def _extrapolated(self, late: float) -> Pose2:
        """Return the pose `late` seconds after the newest, at the measured twist."""
        _, x, y, theta = self._history[-1]
        v, w = self.twist()
        heading = theta + 0.5 * w * late
        return Pose2(x + v * late * math.cos(heading), y + v * late * math.sin(heading), theta + w * late)

    def twist(self) -> tuple[float, float]:
        """Return forward speed (m/s) and turning rate (rad/s) over the last 0.15 s or more; zeros without that.

        Delayed readings arrive together with almost no time between them, so the interval must not begin within such a
        burst.
        """
        if self._twist is None:
            self._twist = self._measured_twist()
        return self._twist

    def _measured_twist(self) -> tuple[float, float]:
        if len(self._history) < 2:
            return 0.0, 0.0
        timestamp, x, y, theta = self._history[-1]
        earlier = (entry for entry in reversed(self._history) if entry[0] <= timestamp - _TWIST_OVER_S)
        old = next(earlier, self._history[0])
        span = timestamp - old[0]
        if span < _TWIST_MIN_S:
            return 0.0, 0.0
        heading = 0.5 * (theta + old[3])
        forward = (x - old[1]) * math.cos(heading) + (y - old[2]) * math.sin(heading)
        return forward / span, (theta - old[3]) / span


def _interpolated(
    before: tuple[float, float, float, float], after: tuple[float, float, float, float], timestamp: float
) -> Pose2:
    span = after[0] - before[0]
    share = (timestamp - before[0]) / span if span > 0.0 else 0.0
    x, y, theta = (old + share * (new - old) for old, new in zip(before[1:], after[1:], strict=True))
    return Pose2(x, y, theta)
