"""When the guardian looks at its base and sends heartbeats, and when the watchdog gives it up as hung. Pure.

The watchdog uses this too, so it imports almost nothing.

Waiting for the bytes of a base whose wheel turns would wake the process for each piece of a frame, which some adapters
pass on every millisecond; a look at each frame costs twice as much as one at two. A look at any other time than just
after the second frame would let a frame wait for longer: so each look comes a little earlier than the last one, until
one comes too early.

Frames may come more slowly than the driver of the base says, by a clock of its own or a busy line. Then nearly every
look would come too early and be repeated, so looks that do make the period longer, by half at most, and others bring
it back.
"""

from __future__ import annotations

import math
from typing import Final

FRAMES: Final = 2
"""Frames of one look. The first of two waits for the second one: for no longer than any frame may wait that is looked
for once a frame, at no particular moment."""
UNKNOWN_S: Final = 0.015
"""Period of the looks at a base of which the rate of its frames is not known, or that sends none."""
EARLIER_S: Final = 0.0003
"""Each look comes so much earlier."""
LATER_S: Final = 0.002
"""After a look that came too early, another one follows so much later."""
LONGER_S: Final = 0.0001
SHORTER_S: Final = 0.00002
"""The period grows by the one for each look that came too early, and shrinks by the other with one that did not: in
balance one of six comes too early, as where the period is right."""
TRIES: Final = 4
"""So often, at most: the frame may be damaged, or the base silent. Once a base is, one look each `UNKNOWN_S` is enough
until it sends again: a busy computer, or line, keeps frames back for many times as long as all tries take."""


class FrameClock:
    """The looks at one base; `now` is s of the guardian's clock, `frame_s` s between two frames (0: not known)."""

    def __init__(self, frame_s: float) -> None:
        self._shortest = FRAMES * frame_s
        self._period = self._shortest
        self._missing = FRAMES
        self._tries = 0
        self._silent = False
        self._due = 0.0

    def begin(self, now: float) -> None:
        """Begin: a wheel turns."""
        self._due = now
        self._silent = False
        self._expect()

    def wait(self, now: float) -> float:
        """Return the time (s) until the next look."""
        return max(0.0, self._due - now)

    def on_look(self, frames: int, now: float) -> None:
        """Take notice of how many whole frames the look at `now` has found, be it due or not."""
        self._missing -= frames
        if now < self._due:
            return
        if not self._period:
            self._due = now + UNKNOWN_S
        elif self._missing <= 0:
            self._learn()
            self._silent = False
            # After a pause of the machine there is nothing to catch up with.
            self._due = max(self._due + self._period, now + 0.5 * self._period) - EARLIER_S
            self._expect()
        elif self._tries < TRIES and not (self._silent and self._missing == FRAMES):
            self._tries += 1
            self._due = now + LATER_S
        else:
            self._due = now + UNKNOWN_S
            self._silent = self._missing == FRAMES
            self._expect()

    def _learn(self) -> None:
        """Adapt the period to when both frames had come; a third one shows that it is too long."""
        if self._missing < 0:
            self._period = self._shortest
        else:
            change = self._tries * LONGER_S if self._tries else -SHORTER_S
            self._period = min(max(self._period + change, self._shortest), 1.5 * self._shortest)

    def _expect(self) -> None:
        self._missing, self._tries = FRAMES, 0


HEARTBEAT_MIN_S: Final = 0.07
"""No two heartbeats are nearer to one another: they share the guardian's wake-ups for base and agent."""
HEARTBEAT_MAX_S: Final = 0.105
"""The longest pause that the guardian leaves between two, however commands and frames wake it: a little more than that
between two commands to a robot that stands, so that these alone wake its guardian."""
LATENESS_S: Final = 0.095
"""Real seconds by which the machine may delay a heartbeat or the watchdog.

Programs of normal priority get 50 ms of each second before any with a real-time priority, by the kernel's own rule.
"""


def silence_limit(speed: float) -> float:
    """Return the real seconds without a heartbeat after which the guardian is killed: 0.2 at speed 1.

    speed: simulated over wall time. It shortens the pauses, but no delay of the machine.
    """
    return HEARTBEAT_MAX_S / speed + LATENESS_S


class Heartbeats:
    """The times of one guardian's heartbeats; `now` is s of its clock."""

    def __init__(self) -> None:
        self._sent_at = -math.inf

    def wait(self, longest: float, now: float) -> float:
        """Return how long (s) the guardian may wait for events: `longest`, or until a heartbeat has to be sent."""
        return max(0.0, min(longest, self._sent_at + HEARTBEAT_MAX_S - now))

    def is_due(self, now: float) -> bool:
        """Return whether to send one now; if so, it counts as sent."""
        if now - self._sent_at < HEARTBEAT_MIN_S:
            return False
        self._sent_at = now
        return True
