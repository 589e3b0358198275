"""Whether a sender of heartbeats lives, judged by the receiver's own monotonic clock. Pure; time is an argument.

A heartbeat that arrives is not yet a sign of life: a broker that was frozen delivers what it has queued, and the sender
may be dead by then. So each heartbeat carries its sender's monotonic clock. The difference between the two clocks is
unknown, but no heartbeat can arrive before it was sent: the smallest difference seen is that of the fastest heartbeat,
and whatever one takes longer is its delay, which counts as age. No wall clock is involved.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from fog_contracts.messages import Sent

CLOCK_DRIFT: Final = 5e-4
"""How much faster one host's monotonic clock may run than the other's: crystals 1e-4, and nothing slews them."""
MAX_CLOCKS: Final = 8
"""Senders' clocks that are remembered; one that was forgotten begins anew."""
LATE_S: Final = 0.25
"""A sender that is not trusted yet must start anew when a heartbeat was this much (s) faster than those before."""
GAP_S: Final = 3.0
PIECE_S: Final = 2.5
JITTER_S: Final = 0.6
"""Messages come steadily when no two are further apart than the gap, and the fastest one of each piece of time takes no
longer, or shorter, by more than this (s) than that of the piece before: a radio holds back single ones all the time,
and a clock that is slewed as fast as chrony does, by 8.3 %, adds up to half of it."""


class DelayEstimator:
    """How much longer (s) each message of one sender takes than its fastest one, by the two monotonic clocks.

    With `steady_s` the sender's clock may run at any rate, as one does that is slewed: of messages that have come
    steadily for so long (s), the fastest one took no time, whatever faster ones there were before.
    """

    def __init__(self, steady_s: float = math.inf) -> None:
        self._pieces = 0 if steady_s == math.inf else round(steady_s / PIECE_S)
        self._fastest: deque[float] = deque(maxlen=self._pieces)  # of each whole piece since when they come steadily
        self._piece_at = -math.inf
        self._piece = math.inf
        self._offset = math.inf
        self._offset_at = 0.0
        self.faster_by = 0.0
        """By how much (s) the latest message was faster than all before; infinite for the first."""

    def update(self, sent: float, now: float) -> float:
        """Return the delay of a message that was sent at `sent` of the sender's clock (s) and arrives `now`."""
        offset = now - sent
        if self._pieces:
            self._follow(offset, now)
        known = self._offset + CLOCK_DRIFT * (now - self._offset_at) if self._offset < math.inf else math.inf
        self.faster_by = max(0.0, known - offset)
        self._offset, self._offset_at = min(known, offset), now
        return offset - self._offset

    def _follow(self, offset: float, now: float) -> None:
        """Forget the fastest message of all when later ones came steadily, without a gap in which a queue forms."""
        if now - self._offset_at > GAP_S:
            self._fastest.clear()
            self._piece_at, self._piece = now, math.inf
        self._piece = min(self._piece, offset)
        if now - self._piece_at < PIECE_S:
            return
        if self._fastest and abs(self._piece - self._fastest[-1]) > JITTER_S:
            self._fastest.clear()
        self._fastest.append(self._piece)
        self._piece_at, self._piece = now, math.inf
        if len(self._fastest) == self._pieces:
            self._offset = min(self._fastest)


class Delays:
    """How much longer (s) messages of a service take than its fastest ones, whichever of its processes sends them.

    Each clock of a sender (`messages.Sent`) is compared by itself: processes of one host share one, so that a restart
    or a change of the leader there does not make late messages look timely.
    """

    def __init__(self) -> None:
        self._clocks: dict[int, DelayEstimator] = {}

    def update(self, sent: Sent | None, now: float) -> float:
        """Return the delay of a message that arrives `now`; 0 for one that does not say when it was sent."""
        if sent is None:
            return 0.0
        clock, uptime = sent
        # Taken out and put back: the one that was silent for longest is the first.
        estimator = self._clocks.pop(clock, None) or DelayEstimator()
        self._clocks[clock] = estimator
        if len(self._clocks) > MAX_CLOCKS:
            del self._clocks[next(iter(self._clocks))]
        return estimator.update(uptime, now)


class HeartbeatWatch:
    """Watches one sender, from its first heartbeat on.

    It is trusted once its heartbeats have kept arriving for `trusted_after_s`, so that heartbeats that were queued
    and arrive all at once prove nothing. Its age is the time since its latest heartbeat was sent, not since it arrived.
    """

    def __init__(self, max_age_s: float, *, trusted_after_s: float) -> None:
        self._max_age_s = max_age_s
        self._trusted_after_s = trusted_after_s
        self._delay = DelayEstimator()
        self._since = math.inf
        self._trusted = False
        self._latest_sent = -math.inf
        self.delay_s = 0.0
        """How much longer (s) the latest heartbeat took than the fastest one."""

    def on_heartbeat(self, uptime: float, now: float) -> None:
        """Handle a heartbeat that was sent at `uptime` of the sender's monotonic clock (s) and arrives `now`."""
        if self.age(now) > self._max_age_s:
            self._trusted, self._since = False, now
        self.delay_s = self._delay.update(uptime, now)
        if self._delay.faster_by > LATE_S and not self._trusted:
            self._since = now  # this one shows that those before were late
        self._latest_sent = max(self._latest_sent, now - self.delay_s)
        if self._latest_sent - self._since >= self._trusted_after_s:
            self._trusted = True

    def age(self, now: float) -> float:
        """Return the time (s) since the latest heartbeat was sent; infinite before the first."""
        return now - self._latest_sent

    def alive(self, now: float) -> bool:
        """Whether the sender is trusted and its latest heartbeat young enough."""
        return self._trusted and self.age(now) <= self._max_age_s
