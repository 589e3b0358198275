"""The guardian's decisions: which bytes go to the base, and when the wheels must stop. Pure; time is an argument.

The guardian trusts no other process. A command of the agent moves the wheels only while it is fresh; bumper, cliff,
wheel drop, a base that leaves its driving mode or falls silent stop them within one sensor frame, latched until the
agent passes on an operator's reset. A base may keep its last velocity when the host is silent, so "stop" is always a
command, repeated.

The agent latches a fault too as soon as it receives the guardian's, so the fault survives the end of either process.
When both end, the robot starts in INIT, and an operator must enable it as after any boot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from fog_contracts.messages import SENTENCE_MAX
from robot_agent.guardian.link import WHEEL_SPEED_MAX_M_S, BaseFeedback, WheelCommand
from robot_agent.guardian.revival import Attempt, Revival
from robot_agent.hardware import NO_FRESH_COMMAND

if TYPE_CHECKING:
    from robot_agent.hardware import BaseDriver, BaseReading, BaseStatus, WheelOdometry

COMMAND_FRESH_S: Final = 0.2
"""A command older than this does not move a wheel."""
OVERCURRENT_S: Final = 0.3
"""A motor that starts on a carpet draws a high current for a moment; a blocked one keeps drawing it."""
REPEAT_S: Final = 0.05
"""Period of repeating an unchanged wheel command: a byte may have been lost."""
FEEDBACK_S: Final = 0.045
"""The agent gets every third sensor frame while the wheels turn, and every change immediately."""
FEEDBACK_AT_REST_S: Final = 0.09
"""And every seventh while they do not: an idle robot shall cost little."""
_NEVER: Final = -math.inf
STEP_S: Final = 0.06
"""Longest time step of acceleration: after a pause the guardian must not catch up in one step."""


@dataclass(frozen=True)
class Limits:
    """Limits of a command: wheel speed and mean speed in m/s, acceleration of a wheel in m/s2."""

    wheel: float = WHEEL_SPEED_MAX_M_S
    linear: float = 0.31
    acceleration: float = 1.65


class Output(NamedTuple):
    """Result of an input: bytes for the base, feedback for the agent, and what to try on a silent base."""

    data: bytes = b""
    feedback: tuple[BaseFeedback, ...] = ()
    attempt: Attempt | None = None


@dataclass
class _Base:
    """State of the base."""

    reading: BaseReading | None = None
    reading_at: float = _NEVER
    awake: bool = False
    woken_at: float | None = None
    overcurrent_since: float | None = None


@dataclass
class GuardianCore:
    """One base, one agent. Pass it bytes, commands and time; write the bytes that it returns."""

    driver: BaseDriver
    limits: Limits = field(default_factory=Limits)

    def __post_init__(self) -> None:
        self._wheel_limit = min(self.limits.wheel, self.driver.drive_train.wheel_speed_max_m_s)
        self._base = _Base()
        self._revival = Revival(self.driver.awakening)
        self._command: WheelCommand | None = None
        self._command_at = _NEVER
        self._latched: str | None = None
        self._wheels = (0.0, 0.0)
        self._sent: tuple[float, float] | None = None
        self._sent_at = _NEVER
        self._stepped_at: float | None = None
        self._feedback_at = _NEVER
        self._feedback_key: object = None
        self._told_status: BaseStatus | None = None
        self._told_alarms: BaseStatus | None = None
        self._feedback_odometry: WheelOdometry | None = None
        self._seq = 0

    @property
    def latched(self) -> str | None:
        """The fault that stops the wheels until a reset; None without one."""
        return self._latched

    @property
    def moving(self) -> bool:
        """Whether a wheel is told to turn."""
        return self._wheels != (0.0, 0.0)

    @property
    def unanswered(self) -> str | None:
        """Why there is no base at all, once all that may help was tried; None while there is hope."""
        return self._revival.problem

    @property
    def corrupted(self) -> int:
        """Number of damaged sensor frames."""
        return self.driver.corrupted

    def on_bytes(self, data: bytes, now: float) -> Output:
        """Handle bytes of the base; a frame that demands a stop returns the stop immediately."""
        self.driver.receive_data(data, now)
        feedbacks: list[BaseFeedback] = []
        stop = b""
        while (reading := self.driver.next_event()) is not None:
            self._base.reading, self._base.reading_at = reading, now
            self._revival.on_answer()
            stop += self._check(reading.status, now)
            feedback = self._feedback(reading, now)
            if feedback is not None:
                feedbacks.append(feedback)
        if not self._base.awake:
            stop += self.driver.respond()
        return Output(stop, tuple(feedbacks))

    def on_command(self, command: WheelCommand, now: float) -> Output:
        """Handle the agent's command; with `reset` also clear a latched fault and wake the base again."""
        self._command, self._command_at = command, now
        if command.reset and self._latched is not None:
            self._latched = None
            self._base.awake = False
            return Output(self._wake(now))
        return self._drive(now)

    def on_agent_lost(self, now: float) -> Output:
        """Discard the agent's last command: its link is lost."""
        self._command = None
        return self._drive(now)

    def tick(self, now: float) -> Output:
        """Advance time (50 Hz while `moving`, else 15 Hz or more): stale commands, a silent base, repeated stops."""
        base, timing = self._base, self.driver.timing
        if not base.awake:
            due = base.woken_at is None or now - base.woken_at > timing.wake_timeout
            # A base that does not drive on its charger is left alone there: waking it would only disturb the charging.
            if due and not self._charging(now):
                return Output(self._wake(now), self._reminder(now), self._attempt(now))
            # The wake command may have been lost, and the base may still roll at an old speed.
            repeat = now - self._sent_at >= REPEAT_S
            return Output(self._send((0.0, 0.0), now) if repeat else b"", self._reminder(now))
        silent = now - base.reading_at
        if silent > timing.frame_timeout:
            data = self._latch(f"the base has sent no valid frame for {silent:.1f} s: check cable and power", now)
            return Output(data, self._reminder(now))
        return self._drive(now)

    def stop_command(self) -> bytes:
        """Return the bytes that stop the wheels at an orderly end of the guardian; the base stays awake."""
        return self.driver.drive(0.0, 0.0)

    def _attempt(self, now: float) -> Attempt | None:
        """Return what to try on a base from which nothing has come since it was woken last."""
        if now - self._base.reading_at <= self.driver.timing.wake_timeout:
            return None
        attempt = self._revival.attempt(now)
        if attempt is not None and attempt.baud is not None:
            self.driver.use_baud(attempt.baud)
            self._base.woken_at = None
        return attempt

    def _charging(self, now: float) -> bool:
        base = self._base
        fresh = now - base.reading_at <= self.driver.timing.frame_timeout
        return base.reading is not None and fresh and base.reading.status.charging

    def _wake(self, now: float) -> bytes:
        self._base.woken_at = now
        self._wheels, self._sent, self._sent_at = (0.0, 0.0), (0.0, 0.0), now
        return self.driver.wake()

    def _check(self, status: BaseStatus, now: float) -> bytes:
        base = self._base
        if not base.awake:
            current = base.woken_at is not None and now - base.woken_at >= self.driver.timing.ignored_after_wake
            if not current or status.mode_problem is not None:
                return b""
            base.awake, base.overcurrent_since, self._stepped_at = True, None, now
        if self._latched is not None:
            return b""
        if not status.overcurrent:
            base.overcurrent_since = None
        elif base.overcurrent_since is None:
            base.overcurrent_since = now
        fault = self._fault(status, now)
        return b"" if fault is None else self._latch(fault, now)

    def _fault(self, status: BaseStatus, now: float) -> str | None:
        """Return the fault that an awake base reports and that must stop the wheels; None without one."""
        # A base may leave its driving mode by itself on cliff or wheel drop, which are the more precise reason.
        if status.cliff:
            return "a cliff sensor sees no floor"
        if status.wheel_drop:
            return "a wheel has dropped: the robot was lifted or hangs over an edge"
        if status.bumper:
            both = status.bumper_left and status.bumper_right
            side = "both sides" if both else "left" if status.bumper_left else "right"
            return f"the bumper is pressed ({side})"
        since = self._base.overcurrent_since
        if since is not None and now - since >= OVERCURRENT_S:
            return "a wheel motor draws too much current: it is blocked"
        if status.mode_problem is not None:
            return f"the base left its driving mode: {status.mode_problem}"
        return None

    def _latch(self, reason: str, now: float) -> bytes:
        first = self._latched is None
        if first:
            self._latched = reason[:SENTENCE_MAX]  # a driver's own words may fill the whole field
        self._wheels, self._stepped_at = (0.0, 0.0), now
        if not first and self._sent == self._wheels and now - self._sent_at < REPEAT_S:
            return b""
        return self._send(self._wheels, now)

    def _drive(self, now: float) -> Output:
        if not self._base.awake:
            return Output()
        elapsed = 0.0 if self._stepped_at is None else max(0.0, min(now - self._stepped_at, STEP_S))
        self._stepped_at = now
        target = self._target(now)
        gain = self.limits.acceleration * elapsed
        left = _slew(self._wheels[0], target[0], gain)
        right = _slew(self._wheels[1], target[1], gain)
        self._wheels = (left, right)
        if self._wheels == self._sent and now - self._sent_at < REPEAT_S:
            return Output()
        return Output(self._send(self._wheels, now))

    def _target(self, now: float) -> tuple[float, float]:
        command = self._fresh_command(now)
        if command is None or self._latched is not None or self._charging(now):
            return 0.0, 0.0
        left, right = command.left, command.right
        mean = abs(left + right) / 2
        fastest = max(abs(left), abs(right))
        # One factor for both wheels keeps the curve of the command.
        excess = max(1.0, mean / self.limits.linear, fastest / self._wheel_limit)
        return left / excess, right / excess

    def _fresh_command(self, now: float) -> WheelCommand | None:
        return self._command if now - self._command_at <= COMMAND_FRESH_S else None

    def _send(self, wheels: tuple[float, float], now: float) -> bytes:
        self._sent, self._sent_at = wheels, now
        return self.driver.drive(*wheels)

    def _feedback(self, reading: BaseReading, now: float) -> BaseFeedback | None:
        if reading.status is not self._told_status:
            self._told_status = reading.status
            # Any change counts but that of measurements, which change all the time.
            self._told_alarms = msgspec.structs.replace(reading.status, battery=None, power=None, proximity=())
        key = (self._told_alarms, self._latched, self._base.awake)
        rests = reading.odometry == self._feedback_odometry and self._wheels == (0.0, 0.0)
        period = FEEDBACK_AT_REST_S if rests else FEEDBACK_S
        if key == self._feedback_key and now - self._feedback_at < period:
            return None
        self._feedback_key = key
        return self._report(reading, now)

    def _reminder(self, now: float) -> tuple[BaseFeedback, ...]:
        """Repeat the last frame while the base is silent, so that the agent gets the reason."""
        reading = self._base.reading
        return () if reading is None or now - self._feedback_at < FEEDBACK_S else (self._report(reading, now),)

    def _report(self, reading: BaseReading, now: float) -> BaseFeedback:
        self._seq += 1
        self._feedback_at, self._feedback_odometry = now, reading.odometry
        stopped = None
        if not self._base.awake:
            stopped = "the base is on its charger" if self._charging(now) else "the base is not ready to drive yet"
        elif self._charging(now):
            stopped = "the base is on its charger, where it does not drive: take it off first"
        elif self._fresh_command(now) is None:
            stopped = NO_FRESH_COMMAND
        return BaseFeedback(
            seq=self._seq,
            status=reading.status,
            odometry=reading.odometry,
            fault=self._latched,
            stopped=stopped,
            corrupted=self.corrupted,
        )


def _slew(current: float, target: float, gain: float) -> float:
    """Limit the growth of a wheel's speed; slowing down is not limited, reversing passes through zero."""
    if current * target < 0:
        current = 0.0
    if abs(target) <= abs(current):
        return target
    return min(target, current + gain) if target > 0 else max(target, current - gain)
