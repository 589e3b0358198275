"""What the guardian decides: which bytes go to the base, and when the wheels must stand. Pure; time is an argument.

The guardian trusts nobody. A command of the agent moves the wheels only while it is fresh; bumper, cliff, wheel drop,
a base that leaves its driving mode or falls silent stop them within one sensor frame, latched until the agent passes on
an operator's reset. A base may keep its last velocity when the host is silent, so "stop" is always a command, repeated.

The agent keeps a fault of its own as soon as it hears of the latch, so either of the two may die without the fault
being forgotten. When both die, the robot starts in INIT, and an operator must enable it as after any boot.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import msgspec

from robot_agent.guardian.link import WHEEL_SPEED_MAX_M_S, BaseFeedback, WheelCommand

if TYPE_CHECKING:
    from robot_agent.hardware import BaseDriver, BaseReading, BaseStatus

COMMAND_FRESH_S: Final = 0.2
"""A command older than this does not move a wheel."""
OVERCURRENT_S: Final = 0.3
"""A wheel motor that starts on a carpet draws much for a moment; one that is blocked keeps drawing."""
REPEAT_S: Final = 0.05
"""The wheel command is repeated this often even when it does not change: a byte may have been lost."""
FEEDBACK_S: Final = 0.045
"""The agent gets every third sensor frame, and at once whatever is news."""
STEP_S: Final = 0.06
"""A wheel gains speed for at most this long at once: a guardian that was away must not make up for it in one leap."""


@dataclass(frozen=True)
class Limits:
    """What the guardian lets through: wheel speed and mean speed in m/s, gain of a wheel's speed in m/s2."""

    wheel: float = WHEEL_SPEED_MAX_M_S
    linear: float = 0.31
    acceleration: float = 3.0


@dataclass(frozen=True)
class Output:
    """What follows from an input: bytes for the base and news for the agent."""

    data: bytes = b""
    feedback: tuple[BaseFeedback, ...] = ()


@dataclass
class _Base:
    """What is known of the base."""

    reading: BaseReading | None = None
    reading_at: float = -1.0e9
    awake: bool = False
    woken_at: float | None = None
    overcurrent_since: float | None = None


@dataclass
class GuardianCore:
    """One base, one agent. Feed it bytes, commands and time; write what it returns."""

    driver: BaseDriver
    limits: Limits = field(default_factory=Limits)

    def __post_init__(self) -> None:
        self._wheel_limit = min(self.limits.wheel, self.driver.drive_train.wheel_speed_max_m_s)
        self._base = _Base()
        self._command: WheelCommand | None = None
        self._command_at = -1.0e9
        self._latched: str | None = None
        self._wheels = (0.0, 0.0)
        self._sent: tuple[float, float] | None = None
        self._sent_at = -1.0e9
        self._stepped_at: float | None = None
        self._feedback_at = -1.0e9
        self._feedback_key: object = None
        self._seq = 0

    @property
    def latched(self) -> str | None:
        """The fault that keeps the wheels still until a reset, in words."""
        return self._latched

    @property
    def corrupted(self) -> int:
        """Sensor frames that came damaged."""
        return self.driver.corrupted

    def on_bytes(self, data: bytes, now: float) -> Output:
        """Take what the base sent; a frame that calls for a stop yields the stop at once."""
        self.driver.receive_data(data, now)
        news: list[BaseFeedback] = []
        urgent = b""
        while (reading := self.driver.next_event()) is not None:
            self._base.reading, self._base.reading_at = reading, now
            urgent += self._check(reading.status, now)
            feedback = self._feedback(reading, now)
            if feedback is not None:
                news.append(feedback)
        return Output(urgent, tuple(news))

    def on_command(self, command: WheelCommand, now: float) -> Output:
        """Take the agent's command; with `reset` it also clears a latched fault and wakes the base again."""
        self._command, self._command_at = command, now
        if command.reset and self._latched is not None:
            self._latched = None
            self._base.awake = False
            return Output(self._wake(now))
        return self._drive(now)

    def on_agent_lost(self, now: float) -> Output:
        """Forget the agent's last word: its link is gone."""
        self._command = None
        return self._drive(now)

    def tick(self, now: float) -> Output:
        """Let time pass (50 Hz or more): stale commands, a silent base, repeated stops."""
        base, timing = self._base, self.driver.timing
        if not base.awake:
            due = base.woken_at is None or now - base.woken_at > timing.wake
            # A base that does not drive on its charger is left alone there: waking it would only disturb the charging.
            if due and not self._charging(now):
                return Output(self._wake(now), self._reminder(now))
            # What should wake it may have got lost, and the base may still roll as somebody else left it.
            again = now - self._sent_at >= REPEAT_S
            return Output(self._send((0.0, 0.0), now) if again else b"", self._reminder(now))
        silent = now - base.reading_at
        if silent > timing.silence:
            data = self._latch(f"the base has sent no valid frame for {silent:.1f} s: check cable and power", now)
            return Output(data, self._reminder(now))
        return self._drive(now)

    def stop_command(self) -> bytes:
        """Return the bytes that stop the wheels when the guardian ends in good order; the base stays awake."""
        return self.driver.drive(0.0, 0.0)

    def _charging(self, now: float) -> bool:
        base = self._base
        fresh = now - base.reading_at <= self.driver.timing.silence
        return base.reading is not None and fresh and base.reading.status.charging

    def _wake(self, now: float) -> bytes:
        self._base.woken_at = now
        self._wheels, self._sent, self._sent_at = (0.0, 0.0), (0.0, 0.0), now
        return self.driver.wake()

    def _check(self, status: BaseStatus, now: float) -> bytes:
        base = self._base
        if not base.awake:
            settled = base.woken_at is not None and now - base.woken_at >= self.driver.timing.settle
            if not settled or status.mode_problem is not None:
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
        """Return what a base that is awake reports and wheels must not turn with, in words; None for no such thing."""
        # A base may leave its driving mode by itself on cliff or wheel drop: those say more than the mode does.
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
        news = self._latched is None
        if news:
            self._latched = reason
        self._wheels, self._stepped_at = (0.0, 0.0), now
        if not news and self._sent == self._wheels and now - self._sent_at < REPEAT_S:
            return b""
        return self._send(self._wheels, now)

    def _drive(self, now: float) -> Output:
        if not self._base.awake:
            return Output()
        elapsed = 0.0 if self._stepped_at is None else max(0.0, min(now - self._stepped_at, STEP_S))
        self._stepped_at = now
        wanted = self._wanted(now)
        gain = self.limits.acceleration * elapsed
        left = _slew(self._wheels[0], wanted[0], gain)
        right = _slew(self._wheels[1], wanted[1], gain)
        self._wheels = (left, right)
        if self._wheels == self._sent and now - self._sent_at < REPEAT_S:
            return Output()
        return Output(self._send(self._wheels, now))

    def _wanted(self, now: float) -> tuple[float, float]:
        command = self._command
        if self._latched is not None or command is None or now - self._command_at > COMMAND_FRESH_S:
            return 0.0, 0.0
        left, right = command.left, command.right
        mean = abs(left + right) / 2
        fastest = max(abs(left), abs(right))
        # One factor for both wheels keeps the curve that the agent meant.
        scale = min(
            1.0,
            self.limits.linear / mean if mean > self.limits.linear else 1.0,
            self._wheel_limit / fastest if fastest > self._wheel_limit else 1.0,
        )
        return left * scale, right * scale

    def _send(self, wheels: tuple[float, float], now: float) -> bytes:
        self._sent, self._sent_at = wheels, now
        return self.driver.drive(*wheels)

    def _feedback(self, reading: BaseReading, now: float) -> BaseFeedback | None:
        # All that is news but the battery, which changes all the time.
        key = (msgspec.structs.replace(reading.status, battery=None), self._latched, self._base.awake)
        if key == self._feedback_key and now - self._feedback_at < FEEDBACK_S:
            return None
        self._feedback_key = key
        return self._report(reading, now)

    def _reminder(self, now: float) -> tuple[BaseFeedback, ...]:
        """Repeat the last frame while the base says nothing new, so that the agent knows what it waits for."""
        reading = self._base.reading
        return () if reading is None or now - self._feedback_at < FEEDBACK_S else (self._report(reading, now),)

    def _report(self, reading: BaseReading, now: float) -> BaseFeedback:
        self._seq += 1
        self._feedback_at = now
        stopped = None
        if not self._base.awake:
            stopped = "the base stands on its charger" if self._charging(now) else "the base is not ready to drive yet"
        elif self._command is None or now - self._command_at > COMMAND_FRESH_S:
            stopped = "no fresh command of the agent"
        return BaseFeedback(
            seq=self._seq, status=reading.status, odometry=reading.odometry, fault=self._latched, stopped=stopped
        )


def _slew(current: float, wanted: float, gain: float) -> float:
    """Limit the growth of a wheel's speed; slowing down is never held back, reversing passes through zero."""
    if current * wanted < 0:
        current = 0.0
    if abs(wanted) <= abs(current):
        return wanted
    return min(wanted, current + gain) if wanted > 0 else max(wanted, current - gain)
