"""What the base reports, and how it is woken. Pure.

What it reports may have to stop its wheels; the agent gets every change at once, the rest at a steady rate.
On a base that does not answer: a pulse on the line that wakes it, then its other baud rates. Only a base that can be
woken again is put to sleep.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from fog_contracts.messages import Described, Reason
from robot_agent.hardware import SleepingDriver

if TYPE_CHECKING:
    from robot_agent.hardware import Awakening, BaseDriver, BaseReading, BaseStatus, WakeLine, WheelOdometry

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


ATTEMPT_S: Final = 3.0
"""Time between two attempts: longer than a pulse and the base's answer to it, and so long that pulses are never taken
for a series, by which some bases change their baud rate."""
OTHERS_AFTER: Final = 9
"""Once every rate was tried, the first one is tried so many times before each of the others: who switches the base on
may do so later, and at any of them."""


class Attempt(NamedTuple):
    """One attempt: a pulse on a control line, or another rate of the serial line."""

    line: WakeLine | None = None
    baud: int | None = None


class Revival:
    """The attempts on one base, in turn: each rate once, then mostly the first one; a pulse at each."""

    def __init__(self, awakening: Awakening) -> None:
        self._awakening = awakening
        self._bauds = awakening.bauds
        self._due_at: float | None = None
        self._attempts = 0
        self.problem: str | None = None
        """Why there is no base, once every rate was tried, and the first one again."""

    def on_answer(self) -> None:
        """Keep the rate at which the base has answered, and start over with it when the base falls silent."""
        if self._due_at is None and not self._attempts:
            return  # it has answered before, and nothing was tried since
        answered = self.baud
        self._due_at = self.problem = None
        self._bauds = (answered, *(baud for baud in self._bauds if baud != answered))
        self._attempts = 0

    @property
    def baud(self) -> int:
        """The rate that is tried now."""
        first, *others = self._bauds
        tried = self._attempts // self._per_baud
        if not others:
            return first
        if tried < len(self._bauds):
            return self._bauds[tried]
        turn = (tried - len(self._bauds)) % (OTHERS_AFTER + len(others))
        return first if turn < OTHERS_AFTER else others[turn - OTHERS_AFTER]

    @property
    def _per_baud(self) -> int:
        return 2 if self._awakening.line is not None else 1

    def attempt(self, now: float) -> Attempt | None:
        """Return what to try now on a silent base; None to wait."""
        if self._due_at is None:
            self._due_at = now + ATTEMPT_S
        if now < self._due_at:
            return None
        self._due_at = now + ATTEMPT_S
        before = self.baud
        self._attempts += 1
        # Some bases are told to speak at the first rate, while another one is tried.
        rates = len(self._bauds) if len(self._bauds) == 1 else len(self._bauds) + 1
        if self._attempts >= self._per_baud * rates:
            self.problem = self._sentence()
        if self.baud != before:
            return Attempt(baud=self.baud)
        return Attempt(line=self._awakening.line) if self._awakening.line is not None else None

    def _sentence(self) -> str:
        rates = " or ".join(str(baud) for baud in self._awakening.bauds)
        return f"the base does not answer at {rates} baud: {self._awakening.remedy}"


SETTLE_S: Final = 1.0
"""After the command frames of before may still arrive."""
ASK_S: Final = 0.5
"""Period of asking a sleeping base: its button or its schedule may have woken it, and let it drive."""
AGAIN_S: Final = 60.0
"""One that did not stay asleep is left awake for so long."""
_FIRST_QUESTIONS: Final = 4
"""One that is woken by questions may lose the first ones while it starts."""
_SLEEPS: Final = 2
"""So many sleeps in a row must end by first questions: one may have ended by a button just then."""


class BaseSleep:
    """The sleep of one base; `now` is s of a monotonic clock."""

    def __init__(self, driver: BaseDriver) -> None:
        self._driver = driver
        self.asleep = False
        self._begun_at = self._awake_until = -math.inf
        self._asked = 0
        self._ended_at_once = 0
        """How many sleeps in a row have ended by one of the first questions."""

    def begin(self, now: float) -> bytes:
        """Put it to sleep, if it can be woken again by a line; return the bytes for it."""
        if not isinstance(self._driver, SleepingDriver) or self._driver.awakening.line is None:
            return b""
        if now < self._awake_until:
            return b""
        self.asleep, self._begun_at, self._asked = True, now, 0
        return self._driver.sleep()

    def end(self) -> Attempt:
        """Wake it; return the pulse for that. Afterwards it is started as ever."""
        self.asleep = False
        return Attempt(line=self._driver.awakening.line)

    def ask(self, now: float) -> bool:
        """Return whether to wake it as if it heard, which stops it and lets it answer if it does.

        One that seems to be woken by the questions is asked no more.
        """
        if self._ended_at_once >= _SLEEPS or now < self._begun_at + SETTLE_S + self._asked * ASK_S:
            return False
        self._asked += 1
        return True

    def on_frame(self, now: float) -> bool:
        """Note that it has sent a frame; return whether it is awake: by button, schedule or question, or all along."""
        if now < self._begun_at + SETTLE_S:
            return False
        if self._ended_at_once < _SLEEPS:
            self._ended_at_once = self._ended_at_once + 1 if 1 <= self._asked <= _FIRST_QUESTIONS else 0
        self.asleep, self._awake_until = False, now + AGAIN_S
        return True
