"""What the guardian decides: which bytes go to the base, and when the wheels must stand. Pure; time is an argument.

The guardian trusts nobody. A command of the agent moves the wheels only while it is fresh; bumper, cliff, wheel drop,
an unexpected OI mode or a silent base stop them within one sensor frame, latched until the agent passes on an
operator's reset. A Roomba keeps its last velocity when the host is silent, so "stop" is always a command, repeated.

The agent keeps a fault of its own as soon as it hears of the latch, so either of the two may die without the fault
being forgotten. When both die, the robot starts in INIT, and an operator must enable it as after any boot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

from robot_agent.bases.roomba600 import open_interface as oi
from robot_agent.guardian.link import BaseFeedback, WheelCommand

COMMAND_FRESH_S: Final = 0.2
"""A command older than this does not move a wheel."""
BASE_SILENT_S: Final = 0.3
"""No valid sensor frame for this long is a fault: 20 frames of 15 ms are missing."""
HANDSHAKE_S: Final = 1.0
"""How long the base may take to report Safe mode before the handshake is sent again."""
SETTLE_S: Final = 0.1
"""Frames that come sooner after a handshake may stem from before it: they don't tell the mode that it led to."""
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

    wheel: float = 0.5
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

    frame: oi.Frame | None = None
    frame_at: float = -1.0e9
    safe: bool = False
    handshake_at: float | None = None
    overcurrent_since: float | None = None


@dataclass
class GuardianCore:
    """One base, one agent. Feed it bytes, commands and time; write what it returns."""

    limits: Limits = field(default_factory=Limits)

    def __post_init__(self) -> None:
        self._parser = oi.StreamParser(oi.GUARDIAN_STREAM)
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
        return self._parser.corrupted

    def on_bytes(self, data: bytes, now: float) -> Output:
        """Take what the base sent; a frame that calls for a stop yields the stop at once."""
        self._parser.receive_data(data)
        news: list[BaseFeedback] = []
        urgent = b""
        while (frame := self._parser.next_event()) is not None:
            self._base.frame, self._base.frame_at = frame, now
            urgent += self._judge(frame, now)
            feedback = self._feedback(frame, now)
            if feedback is not None:
                news.append(feedback)
        return Output(urgent, tuple(news))

    def on_command(self, command: WheelCommand, now: float) -> Output:
        """Take the agent's command; with `reset` it also clears a latched fault and wakes the base again."""
        self._command, self._command_at = command, now
        if command.reset and self._latched is not None:
            self._latched = None
            self._base.safe = False
            return Output(self._handshake(now))
        return self._drive(now)

    def on_agent_lost(self, now: float) -> Output:
        """Forget the agent's last word: its link is gone."""
        self._command = None
        return self._drive(now)

    def tick(self, now: float) -> Output:
        """Let time pass (50 Hz or more): stale commands, a silent base, repeated stops."""
        base = self._base
        if not base.safe:
            due = base.handshake_at is None or now - base.handshake_at > HANDSHAKE_S
            # On its charger the base falls out of Safe mode at once, and asking again would only disturb the charging.
            if due and not self._charging(now):
                return Output(self._handshake(now), self._reminder(now))
            # The handshake may have got lost, and the base may still roll as somebody else left it.
            again = now - self._sent_at >= REPEAT_S
            return Output(self._send((0.0, 0.0), now) if again else b"", self._reminder(now))
        silent = now - base.frame_at
        if silent > BASE_SILENT_S:
            data = self._latch(f"the base has sent no valid frame for {silent:.1f} s: check cable and power", now)
            return Output(data, self._reminder(now))
        return self._drive(now)

    def farewell(self) -> bytes:
        """Return the bytes that stop the wheels when the guardian ends in good order; the base stays in Safe mode."""
        return oi.drive_direct(0, 0)

    def _charging(self, now: float) -> bool:
        base = self._base
        return base.frame is not None and now - base.frame_at <= BASE_SILENT_S and base.frame.on_charger

    def _handshake(self, now: float) -> bytes:
        # Start puts the OI into Passive mode, which stops the wheels by itself; the zero after Safe is for a base
        # whose receiver was in the middle of a command and swallowed the Start.
        self._base.handshake_at = now
        self._wheels, self._sent, self._sent_at = (0.0, 0.0), (0.0, 0.0), now
        return oi.start() + oi.safe() + oi.drive_direct(0, 0) + oi.stream(oi.GUARDIAN_STREAM)

    def _judge(self, frame: oi.Frame, now: float) -> bytes:
        base = self._base
        if not base.safe:
            settled = base.handshake_at is not None and now - base.handshake_at >= SETTLE_S
            if not settled or frame.mode != oi.Mode.SAFE:
                return b""
            base.safe, base.overcurrent_since, self._stepped_at = True, None, now
        if self._latched is not None:
            return b""
        if not frame.wheel_overcurrent:
            base.overcurrent_since = None
        elif base.overcurrent_since is None:
            base.overcurrent_since = now
        # Safe mode itself falls back to Passive on cliff, wheel drop or charger: those say more than the mode does.
        if frame.cliff:
            return self._latch("a cliff sensor sees no floor", now)
        if frame.wheel_dropped:
            return self._latch("a wheel has dropped: the robot was lifted or hangs over an edge", now)
        if frame.bumped:
            side = "both sides" if frame.bump_left and frame.bump_right else "left" if frame.bump_left else "right"
            return self._latch(f"the bumper is pressed ({side})", now)
        if base.overcurrent_since is not None and now - base.overcurrent_since >= OVERCURRENT_S:
            return self._latch("a wheel motor draws too much current: it is blocked", now)
        if frame.mode != oi.Mode.SAFE:
            name = frame.mode.name if isinstance(frame.mode, oi.Mode) else str(frame.mode)
            why = "it has contact to a charger" if frame.on_charger else "by itself"
            return self._latch(f"the base left Safe mode (now {name}): {why}", now)
        return b""

    def _latch(self, reason: str, now: float) -> bytes:
        news = self._latched is None
        if news:
            self._latched = reason
        self._wheels, self._stepped_at = (0.0, 0.0), now
        if not news and self._sent == self._wheels and now - self._sent_at < REPEAT_S:
            return b""
        return self._send(self._wheels, now)

    def _drive(self, now: float) -> Output:
        base = self._base
        if not base.safe:
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
            self.limits.wheel / fastest if fastest > self.limits.wheel else 1.0,
        )
        return left * scale, right * scale

    def _send(self, wheels: tuple[float, float], now: float) -> bytes:
        self._sent, self._sent_at = wheels, now
        return oi.drive_direct(right_mm_s=round(wheels[1] * 1000), left_mm_s=round(wheels[0] * 1000))

    def _feedback(self, frame: oi.Frame, now: float) -> BaseFeedback | None:
        key = (frame.mode, frame.bumped, frame.cliff, frame.wheel_dropped, self._latched, self._base.safe)
        if key == self._feedback_key and now - self._feedback_at < FEEDBACK_S:
            return None
        self._feedback_key = key
        return self._report(frame, now)

    def _reminder(self, now: float) -> tuple[BaseFeedback, ...]:
        """Repeat the last frame while the base says nothing new, so that the agent knows what it waits for."""
        frame = self._base.frame
        return () if frame is None or now - self._feedback_at < FEEDBACK_S else (self._report(frame, now),)

    def _report(self, frame: oi.Frame, now: float) -> BaseFeedback:
        self._seq += 1
        self._feedback_at = now
        stopped = None
        if not self._base.safe:
            on_charger = "the base stands on its charger"
            stopped = on_charger if self._charging(now) else "the base is not in Safe mode yet"
        elif self._command is None or now - self._command_at > COMMAND_FRESH_S:
            stopped = "no fresh command of the agent"
        left, right = frame.encoders
        charge = frame.charge_fraction
        return BaseFeedback(
            seq=self._seq,
            left_ticks=left,
            right_ticks=right,
            oi_mode=int(frame.mode),
            bumper=frame.bumped,
            cliff=frame.cliff,
            wheel_drop=frame.wheel_dropped,
            battery=min(1.0, max(0.0, charge)) if math.isfinite(charge) else None,
            charging=frame.on_charger,
            fault=self._latched,
            stopped=stopped,
        )


def _slew(current: float, wanted: float, gain: float) -> float:
    """Limit the growth of a wheel's speed; slowing down is never held back, reversing passes through zero."""
    if current * wanted < 0:
        current = 0.0
    if abs(wanted) <= abs(current):
        return wanted
    return min(wanted, current + gain) if wanted > 0 else max(wanted, current - gain)
