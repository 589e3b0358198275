"""The guardian's decisions: which bytes go to the base, and when the wheels must stop. Pure; time is an argument.

The guardian trusts no other process. A command of the agent moves the wheels only while it is fresh; bumper, cliff,
wheel drop, a base that leaves its driving mode or falls silent stop them with their sensor frame, latched until the
agent passes on an operator's reset. A base may keep its last velocity when the host is silent, so "stop" is always a
command, repeated. Only the silence of a base that has not moved since it was woken is a fault no longer than it lasts:
such a base is woken again.

The agent latches a fault too as soon as it receives the guardian's, so the fault survives the end of either process.
When both end, the robot starts in INIT, and an operator must enable it as after any boot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

from fog_contracts.messages import SENTENCE_MAX, Reason
from robot_agent.guardian.base import Attempt, BaseSleep, FaultCode, FeedbackPolicy, Revival, fault_of
from robot_agent.guardian.link import WHEEL_SPEED_MAX_M_S, BaseFeedback, WheelCommand
from robot_agent.guardian.maneuvers import Maneuvers, Situation
from robot_agent.hardware import ASLEEP, NO_FRESH_COMMAND, ON_CHARGER, DockingDriver

if TYPE_CHECKING:
    from robot_agent.hardware import BaseDriver, BaseReading, BaseStatus

COMMAND_FRESH_S: Final = 0.2
"""A command older than this does not move a wheel."""
REPEAT_S: Final = 0.05
"""Period of repeating an unchanged wheel command: a byte may have been lost."""
RETAKE_S: Final = 0.3
"""Period of taking control again, twice each time. A base needs some 20 ms for each change of its mode: one that is
told all the time is never seen in its driving mode for long."""
SETTLED_S: Final = 0.2
"""What a base reports counts so long after control was taken: it changes its modes, and frames are read late."""
CONTACT_S: Final = 0.5
"""A charger's contacts that touch for a moment do not count."""
_NEVER: Final = -math.inf
STEP_S: Final = 0.06
"""Longest time step of acceleration: after a pause the guardian must not catch up in one step."""


@dataclass(frozen=True)
class Limits:
    """Limits of a command: wheel speed and mean speed in m/s, acceleration of a wheel in m/s2."""

    wheel: float = WHEEL_SPEED_MAX_M_S
    linear: float = 0.31
    acceleration: float = 1.65

    def scaled(self, left: float, right: float, base: float) -> tuple[float, float]:
        """Return wheel speeds within the limits, and that of the `base` (m/s); one factor for both keeps the curve."""
        fastest = max(abs(left), abs(right))
        excess = max(1.0, abs(left + right) / 2 / self.linear, fastest / min(self.wheel, base))
        return left / excess, right / excess


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
    charging_since: float | None = None
    restrained: bool = False
    """Whether it may drive by itself, or without its own protection: it has not reported its driving mode since."""
    takes: int = 0
    """How often control was taken since."""
    moved: bool = False
    """Whether a wheel was told to turn, or might turn by itself, since it was woken."""
    silence: Reason | None = None
    """The fault of a base that fell silent before it moved, until its next frame."""
    harmless: BaseStatus | None = None
    """The status that was checked last, if it is no fault, whatever the time: of an awake base without a maneuver."""

    def blocked_for(self, now: float) -> float:
        """Return for how long (s) a wheel motor has been drawing too much current."""
        if self.reading is None or not self.reading.status.overcurrent:
            self.overcurrent_since = None
            return 0.0
        if self.overcurrent_since is None:
            self.overcurrent_since = now
        return now - self.overcurrent_since


@dataclass
class GuardianCore:
    """One base, one agent. Pass it bytes, commands and time; write the bytes that it returns."""

    driver: BaseDriver
    limits: Limits = field(default_factory=Limits)
    run_id: str = "guardian"
    """Tells this run of the guardian from any other."""

    def __post_init__(self) -> None:
        self._base = _Base()
        self._revival = Revival(self.driver.awakening)
        self._command: WheelCommand | None = None
        self._command_at = _NEVER
        self._latched: Reason | None = None
        self._bumped = False
        """Whether the latched fault is a pressed bumper."""
        self._maneuvers = Maneuvers(self.driver)
        self._sleep = BaseSleep(self.driver)
        self._wheels = (0.0, 0.0)
        self._sent: tuple[float, float] | None = None
        self._sent_at = _NEVER
        self._stepped_at: float | None = None
        self._feedback = FeedbackPolicy()
        self.frames = 0
        """Number of valid frames of the base."""

    @property
    def latched(self) -> Reason | None:
        """The fault that stops the wheels until a reset; None without one."""
        return self._latched

    @property
    def moving(self) -> bool:
        """Whether a wheel is told to turn, or the base may turn one by itself."""
        return self._wheels != (0.0, 0.0) or self._maneuvers.running is not None

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
        base, stop = self._base, b""
        feedbacks: list[BaseFeedback] = []
        reading = self.driver.next_event()
        while reading is not None:
            self.frames += 1
            base.reading, base.reading_at, base.silence = reading, now, None
            self._revival.on_answer()
            stop += self._check(reading.status, now)
            following = self.driver.next_event()
            # Of several that came together and say the same, the newest is reported.
            if following is None or following.status is not reading.status:
                state = (self._latched, base.awake, self._maneuvers.running, self._maneuvers.problem)
                if self._feedback.is_due(reading, state, now, moving=self._wheels != (0.0, 0.0)):
                    feedbacks.append(self._report(reading, now))
            reading = following
        if not base.awake and not self._sleep.asleep:
            stop += self.driver.respond()
        return Output(stop, tuple(feedbacks))

    def on_command(self, command: WheelCommand, now: float) -> Output:
        """Handle the agent's command; with `reset` also clear a latched fault and wake the base again."""
        self._command, self._command_at = command, now
        if command.reset and self._latched is not None:
            self._latched, self._bumped = None, False
            self._maneuvers.end()
            self._base.awake = False
            return Output(self._wake(now))
        if self._sleep.asleep or (command.rest and self._base.awake):
            return self._rest(command, now)
        return self._drive(now)

    def _rest(self, command: WheelCommand, now: float) -> Output:
        """Put the base to sleep, leave it asleep, or wake it; one that moves, charges or has a fault goes on."""
        if self._sleep.asleep:
            if command.rest:
                return Output()
            self._base.awake, self._base.woken_at = False, None
            return Output(attempt=self._sleep.end())
        if self.moving or self._latched is not None or self._charging(now) or not (data := self._sleep.begin(now)):
            return self._drive(now)
        self._base.awake = False
        return Output(data)

    def on_agent_lost(self, now: float) -> Output:
        """Discard the agent's last command: its link is lost."""
        self._command = None
        return self._drive(now)

    def tick(self, now: float) -> Output:
        """Advance time (50 Hz while `moving`, else 15 Hz or more): stale commands, a silent base, repeated stops."""
        base, timing = self._base, self.driver.timing
        if self._sleep.asleep:
            # One that its button or its schedule has woken is stopped by this, and answers; others hear nothing.
            return Output(self._wake(now) if self._sleep.ask(now) else b"", self._reminder(now))
        if not base.awake:
            return self._bring_up(now)
        silent = now - base.reading_at
        if silent > timing.frame_timeout:
            sentence = f"the base has sent no valid frame for {silent:.1f} s: check cable and power"
            reason = Reason(FaultCode.BASE_SILENT, sentence)
            if not base.moved and self._latched is None:
                # Nothing that must be stopped has begun, so it is waited for as at its start (docs/safety.md).
                base.awake, base.silence = False, reason
                return Output(self._wake(now), self._reminder(now))
            stop = self._latch(reason, now)
            if self._is_unheard(now):
                stop += self._take_back(now)  # it may have left its driving mode
            return Output(stop, self._reminder(now))
        return self._drive(now)

    def _bring_up(self, now: float) -> Output:
        """Bring a base into its driving mode that is not, or may not be, in it; keep it at rest meanwhile."""
        base = self._base
        due = base.woken_at is None or now - base.woken_at > self.driver.timing.wake_timeout
        if due and self._charging(now):
            base.restrained = False  # on its charger it has been told often enough
        if self._is_unheard(now):
            base.restrained = True
            if due:  # its stream may be off
                base.woken_at = now
                return Output(self.driver.wake() + self._restrain(now), self._reminder(now))
        # A base that does not drive on its charger is left alone there: waking it would only disturb the charging.
        if due and (not self._charging(now) or self._is_unknown()):
            return Output(self._wake(now), self._reminder(now), self._attempt(now))
        # The last command may have been lost, and the base may still roll at an old speed.
        pause = RETAKE_S if base.restrained and base.takes % 2 == 0 else REPEAT_S
        return Output(self._restrain(now) if now - self._sent_at >= pause else b"", self._reminder(now))

    def stop_command(self) -> bytes:
        """Return the bytes that stop the wheels at an orderly end of the guardian; the base stays awake."""
        reading, by_itself = self._base.reading, self._maneuvers.running is not None or self._base.restrained
        if not by_itself or reading is None or not isinstance(self.driver, DockingDriver):
            return self.driver.drive(0.0, 0.0)
        return self.driver.take_control(charging=reading.status.charging)

    def _attempt(self, now: float) -> Attempt | None:
        """Return what to try on a base from which nothing has come since it was woken last."""
        if now - self._base.reading_at <= self.driver.timing.wake_timeout:
            return None
        attempt = self._revival.attempt(now)
        if attempt is not None and attempt.baud is not None:
            self.driver.use_baud(attempt.baud)
            self._base.woken_at = None
        return attempt

    def _is_unheard(self, now: float) -> bool:
        """Return whether a base is silent under a latched fault: it is brought into its driving mode again and again.

        Waking alone would leave it in another one, waiting for frames that do not come.
        """
        silent = now - self._base.reading_at > self.driver.timing.wake_timeout
        return self._latched is not None and silent and isinstance(self.driver, DockingDriver)

    def _is_unknown(self) -> bool:
        """Return whether a base that finds its dock was never woken: one that sends since before may be in any mode.

        In its driving mode it would not charge, and could not leave its dock. On its charger it is only brought out of
        that mode when it is woken.
        """
        return self._base.woken_at is None and isinstance(self.driver, DockingDriver)

    def _charging(self, now: float) -> bool:
        fresh = now - self._base.reading_at <= self.driver.timing.frame_timeout
        return fresh and self._base.reading is not None and self._base.reading.status.charging

    def _wake(self, now: float) -> bytes:
        self._base.woken_at, self._base.restrained, self._base.moved = now, False, False
        self._wheels, self._sent, self._sent_at = (0.0, 0.0), (0.0, 0.0), now
        return self.driver.wake()

    def _check(self, status: BaseStatus, now: float) -> bytes:
        base = self._base
        if status is base.harmless and base.awake and self._maneuvers.running is None:
            return b""
        base.harmless = None
        if self._sleep.asleep:
            # What arrives at first was on its way when the base was put to sleep.
            return self._wake(now) if self._sleep.on_frame(now) else b""
        if self._bumped and (status.cliff or status.wheel_drop):
            self._bumped = False  # it was lifted, or stands at an edge: what it bumped into is no longer before it
        if not base.awake:
            current = base.woken_at is not None and now - base.woken_at >= self.driver.timing.ignored_after_wake
            if base.restrained:
                current = now - self._sent_at >= SETTLED_S
            if not current or status.mode_problem is not None:
                return b""
            base.awake, base.restrained, base.overcurrent_since, self._stepped_at = True, False, None, now
        backing = self._maneuvers.is_running("back_off")
        if self._latched is not None and not backing:
            # Some stay in their driving mode on their charger, too, and do not charge in it.
            left = status.mode_problem is not None or status.charging
            return self._take_back(now) if left and isinstance(self.driver, DockingDriver) else b""
        fault = fault_of(status, base.blocked_for(now), bumper=not self._maneuvers.expects_bumper(status))
        if fault is None:
            # The current of a motor is a fault by its duration, and a charger calls for another mode by its.
            lasting = status.overcurrent or status.charging or self._maneuvers.running is not None
            base.harmless = None if lasting else status
            return self._take_back(now) if self._stays_on_charger(status, now) else b""
        if backing:
            self._latched = None  # the new fault is no bump
        return self._latch(fault, now)

    def _stays_on_charger(self, status: BaseStatus, now: float) -> bool:
        """Return whether an awake base has come to a charger and stays in its driving mode: it does not charge so."""
        base = self._base
        if not status.charging or self._maneuvers.running is not None:
            base.charging_since = None
        elif base.charging_since is None:
            base.charging_since = now
        since = base.charging_since
        return since is not None and now - since >= CONTACT_S and isinstance(self.driver, DockingDriver)

    def _take_back(self, now: float) -> bytes:
        """Return the bytes that bring a base into its driving mode, wheels at rest; on its charger, to charge.

        In a mode of its own it ignores zero speeds, and its button or its schedule would let it drive off.
        """
        base = self._base
        base.awake, base.woken_at, base.restrained, base.takes = False, now, True, 0
        return self._restrain(now)

    def _latch(self, reason: Reason, now: float) -> bytes:
        first = self._latched is None
        if first:
            # A driver's own words may fill the whole field.
            self._latched, self._bumped = Reason(reason.code, reason[:SENTENCE_MAX]), reason.code == FaultCode.BUMPER
        if self._maneuvers.running is not None:
            return self._end_maneuver(now)
        self._wheels, self._stepped_at = (0.0, 0.0), now
        if not first and self._sent == self._wheels and now - self._sent_at < REPEAT_S:
            return b""
        return self._send(self._wheels, now)

    def _maneuver(self, now: float) -> bytes:
        """Begin or end the maneuver that the agent asks for, or no longer does; return the bytes for it."""
        base, maneuvers, command = self._base, self._maneuvers, self._fresh_command(now)
        if base.reading is None:
            return b""
        if maneuvers.running is not None:
            return self._end_maneuver(now) if maneuvers.is_over(command, base.reading, now) else b""
        if command is None:
            return b""
        moving = self._wheels != (0.0, 0.0)
        situation = Situation(base.awake, moving, self._latched is not None, self._bumped)
        data = maneuvers.begin(command.maneuver, base.reading, situation, now)
        if maneuvers.is_running("leave_dock"):
            # Its own protection is off from now on, so every frame counts.
            base.awake, base.restrained, base.overcurrent_since, self._stepped_at = True, False, None, now
        return data

    def _end_maneuver(self, now: float) -> bytes:
        """End the maneuver with the wheels at rest."""
        by_wheels = self._maneuvers.is_running("back_off")
        self._maneuvers.end()
        self._wheels, self._stepped_at = (0.0, 0.0), now
        return self._send(self._wheels, now) if by_wheels else self._take_back(now)

    def _restrain(self, now: float) -> bytes:
        """Return the bytes that keep the wheels at rest of a base that is not in its driving mode yet."""
        if not (self._base.restrained and isinstance(self.driver, DockingDriver)):
            return self._send((0.0, 0.0), now)
        self._sent, self._sent_at = (0.0, 0.0), now
        self._base.takes += 1
        reading = self._base.reading
        return self.driver.take_control(charging=reading is not None and reading.status.charging)

    def _drive(self, now: float) -> Output:
        begun = self._maneuver(now)
        self._base.moved |= self._maneuvers.running is not None
        if not self._base.awake or self._maneuvers.is_running("seek_dock"):
            return Output(begun)
        elapsed = 0.0 if self._stepped_at is None else max(0.0, min(now - self._stepped_at, STEP_S))
        self._stepped_at = now
        left, right = self._target(now)
        gain = self.limits.acceleration * elapsed
        self._wheels = _slew(self._wheels[0], left, gain), _slew(self._wheels[1], right, gain)
        if self._wheels == self._sent and now - self._sent_at < REPEAT_S:
            return Output(begun)
        return Output(begun + self._send(self._wheels, now))

    def _target(self, now: float) -> tuple[float, float]:
        command = self._fresh_command(now)
        if command is not None and self._maneuvers.running is not None:
            return self._maneuvers.wheels(command.left, command.right)
        if command is None or self._latched is not None or self._charging(now):
            return 0.0, 0.0
        return self.limits.scaled(command.left, command.right, self.driver.drive_train.wheel_speed_max_m_s)

    def _fresh_command(self, now: float) -> WheelCommand | None:
        return self._command if now - self._command_at <= COMMAND_FRESH_S else None

    def _send(self, wheels: tuple[float, float], now: float) -> bytes:
        self._sent, self._sent_at = wheels, now
        self._base.moved |= wheels != (0.0, 0.0)
        return self.driver.drive(*wheels)

    def _reminder(self, now: float) -> tuple[BaseFeedback, ...]:
        """Repeat the last frame while the base is silent, so that the agent gets the reason."""
        reading = self._base.reading
        return () if reading is None or not self._feedback.is_overdue(now) else (self._report(reading, now),)

    def _report(self, reading: BaseReading, now: float) -> BaseFeedback:
        fault = self._latched or self._base.silence
        return BaseFeedback(
            seq=self._feedback.on_report(reading, now),
            status=reading.status,
            odometry=reading.odometry,
            fault=None if fault is None else str(fault),
            fault_code="" if fault is None else fault.code,
            stopped=self._stopped(now),
            corrupted=self.corrupted,
            bumped=self._bumped,
            passing=self._latched is None and self._base.silence is not None,
            at=now,
            guardian=self.run_id,
            travel_wrap_m=self.driver.drive_train.travel_wrap_m,
        )

    def _stopped(self, now: float) -> str | None:
        """Return why the wheels are kept at zero whatever the agent requests; None: they are not."""
        fresh = self._fresh_command(now) is not None
        if fresh and self._maneuvers.running is not None:
            return None
        if self._maneuvers.problem is not None or self._sleep.asleep:
            return self._maneuvers.problem or ASLEEP
        if self._charging(now):
            return ON_CHARGER
        if not self._base.awake:
            return "the base is not ready to drive yet"
        return None if fresh else NO_FRESH_COMMAND


def _slew(current: float, target: float, gain: float) -> float:
    """Limit the growth of a wheel's speed; slowing down is not limited, reversing passes through zero."""
    if current * target < 0:
        current = 0.0
    if abs(target) <= abs(current):
        return target
    return min(target, current + gain) if target > 0 else max(target, current - gain)
