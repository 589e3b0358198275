"""Movements that the guardian allows beyond ordinary driving, each within limits of its own. Pure.

- `seek_dock`: the base's own program drives it into its dock.
- `leave_dock`: straight back off the dock, in a mode in which the base drives although a charger is connected.
- `back_off`: straight back from what presses the bumper, although that fault is latched.

One goes on only as long as the agent asks for it by fresh commands. One that has ended can't begin again before the
agent has stopped asking, by a command without it: when the agent is silent, it has not.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

from robot_agent.hardware import DockingDriver

if TYPE_CHECKING:
    from collections.abc import Mapping

    from robot_agent.guardian.link import Maneuver, WheelCommand
    from robot_agent.hardware import BaseDriver, BaseReading, BaseStatus, WheelOdometry


class Limit(NamedTuple):
    """The longest time (s), the farthest travel of a wheel (m), and the highest speed backwards (m/s)."""

    seconds: float
    travel: float
    speed: float


LIMITS: Final[Mapping[Maneuver, Limit]] = {
    "seek_dock": Limit(60.0, 5.0, 0.0),
    "leave_dock": Limit(3.0, 0.4, 0.10),
    "back_off": Limit(4.0, 0.095, 0.05),
}
"""The wheels need a few millimetres to come to rest: a robot backs off by 0.10 m at most.

The search for the dock begins within 1 m of it; a base that goes far has something else in mind, a cleaning, say.
Leaving the dock ends here as soon as the charger's contacts part, after some centimetres; the rest of the agent's
0.3 m is ordinary driving. These bounds are for contacts that stick, or a dock that comes along.
"""
_NAMES: Final[Mapping[Maneuver, str]] = {
    "seek_dock": "the base's search for its dock", "leave_dock": "leaving the dock", "back_off": "backing off",
}  # fmt: skip


class Situation(NamedTuple):
    """The guardian's state when a maneuver shall begin.

    awake: the base obeys wheel commands. moving: a wheel is told to turn. latched: a fault is, `bumped`: by the bumper.
    """

    awake: bool
    moving: bool
    latched: bool
    bumped: bool


class Maneuvers:
    """The maneuver of one base, if one is under way; `now` is s of a monotonic clock."""

    def __init__(self, driver: BaseDriver) -> None:
        self._driver = driver
        self._wrap = driver.drive_train.travel_wrap_m
        self.running: Maneuver | None = None
        self.problem: str | None = None
        """Why the last one was ended although the agent did not stop asking for it."""
        self._ended: Maneuver | None = None
        self._begun: tuple[float, WheelOdometry] | None = None
        """When (s) the last one began, and where the wheels were."""

    def begin(self, asked: Maneuver | None, reading: BaseReading, situation: Situation, now: float) -> bytes:
        """Begin what is asked for if that is possible now; return the bytes for it. None runs."""
        if asked is None or asked != self._ended:
            self.problem = self._ended = None
        if asked is None or self._ended is not None or situation.moving:
            return b""
        data = self._opening(asked, reading.status, situation)
        if data is not None:
            self.running, self._begun = asked, (now, reading.odometry)
        return data or b""

    def _opening(self, asked: Maneuver, status: BaseStatus, situation: Situation) -> bytes | None:
        """Return the bytes that begin it; None when it can't begin."""
        if asked == "back_off":
            return b"" if situation.bumped and situation.awake else None
        if situation.latched or not isinstance(self._driver, DockingDriver):
            return None
        if asked == "seek_dock":
            return self._driver.seek_dock() if situation.awake and not status.charging else None
        return (self._driver.leave_dock() or None) if status.docked else None

    def is_running(self, kind: Maneuver) -> bool:
        """Return whether this one is under way."""
        return self.running == kind

    def is_over(self, command: WheelCommand | None, reading: BaseReading, now: float) -> bool:
        """Return whether the one that runs has to end: nobody asks for it, it is done, or a limit is reached.

        command: the agent's, None without a fresh one.
        """
        running = self.running
        assert running is not None
        assert self._begun is not None
        since, before = self._begun
        if running == "leave_dock" and not reading.status.charging:
            return True  # it is done: a silence at that moment has ended nothing
        if command is None:
            self.problem = (
                f"{_NAMES[running]} was ended because the agent sent no fresh command: find in the agent's log why it "
                "was late or gone, then order it again"
            )
            return True
        if command.maneuver != running:
            return True
        limit = LIMITS[running]
        if now - since > limit.seconds:
            self.problem = f"{_NAMES[running]} took longer than {limit.seconds:.0f} s"
        # A travel that is no number is beyond every limit.
        elif not self._travel(before, reading.odometry) < limit.travel:
            self.problem = f"{_NAMES[running]} has reached its limit of {limit.travel:.2f} m"
        return self.problem is not None

    def end(self) -> None:
        """End the one that runs."""
        self._ended, self.running = self.running, None

    def wheels(self, left: float, right: float) -> tuple[float, float]:
        """Return the wheel speeds (m/s) that the one that runs allows instead of these: straight back and slow."""
        assert self.running is not None
        speed = min(max(0.5 * (left + right), -LIMITS[self.running].speed), 0.0)
        return speed, speed

    def expects_bumper(self, status: BaseStatus) -> bool:
        """Return whether a pressed bumper is no fault now: what the robot backs off from, or the dock that it is on."""
        return self.is_running("back_off") or (self.running is not None and status.charging)

    def _travel(self, before: WheelOdometry, odometry: WheelOdometry) -> float:
        left = math.remainder(odometry.left_m - before.left_m, self._wrap)
        return max(abs(left), abs(math.remainder(odometry.right_m - before.right_m, self._wrap)))
