"""Which readings of a node are news, and when they were taken; one object per node. Pure; time is an argument.

Messages are delayed, repeated and reordered, and a broker that was frozen delivers all that it has queued at once. A
reading is placed by its node's boot, seq and uptime: its age is that of the measurement, not of its arrival.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from fog_contracts.channels import NODE_READING
from fog_contracts.liveness import DelayEstimator

if TYPE_CHECKING:
    from fog_contracts.messages import NodeReading

Rejection = Literal["duplicate", "outdated", "earlier_boot", "late", "too_soon", "implausible"]
"""Why a reading does not count."""

SILENT_S: Final = NODE_READING.max_age_s
"""A reading older than this does not count."""
FORGOTTEN_S: Final = 30.0
"""After so long a silence an earlier boot, or an older seq, is a node that repeats its numbers, and no late reading."""
MIN_PERIOD_S: Final = 0.04
"""Readings closer together are one: a node's are 45 ms apart at the least (the firmware's `kShortestUs`)."""
STEADY_S: Final = 15.0
"""A node's clock is not ours: its oscillator may be poor, or a host's NTP slews it, by up to 0.0833 s each second."""
_BOOTS: Final = 8
_SEQ_RANGE: Final = 2**32


class Taken(NamedTuple):
    """A reading that is news: when it was taken (s, the receiver's clock), and whether as a measurement of its own."""

    at: float
    counts: bool


class ReadingOrder:
    """Boot, seq and uptime of a node's latest reading."""

    def __init__(self) -> None:
        self._boots: deque[int] = deque(maxlen=_BOOTS)
        self._seq = -1
        self._uptime_s = 0.0
        self._counted_uptime_s: float | None = None
        self._delay = DelayEstimator(STEADY_S)
        self._accepted_at: float | None = None

    def place(self, reading: NodeReading, now: float) -> Taken | Rejection:
        """Return when a reading was taken that arrives `now` (s), or why it is no news.

        Boots are random numbers: one that was never heard is new. An earlier boot, or an older seq of the same boot, is
        accepted only once the node has been silent for 30 s: its clock would begin anew, and what the network held back
        for long would count as fresh. A seq has 32 bits and may wrap.
        """
        forgotten = self._accepted_at is None or now - self._accepted_at > FORGOTTEN_S
        same_boot = bool(self._boots) and self._boots[-1] == reading.boot
        if not forgotten and (problem := self._problem(reading, same_boot=same_boot)) is not None:
            return problem
        uptime_s = reading.uptime_ms / 1000
        if not same_boot or uptime_s < self._uptime_s:  # uptime begins anew, or its 32 bits have wrapped
            self._delay, self._counted_uptime_s = DelayEstimator(STEADY_S), None
        delay = self._delay.update(uptime_s, now)
        if delay > SILENT_S:
            return "late"
        if not same_boot:
            self._boots.append(reading.boot)
        self._seq, self._uptime_s, self._accepted_at = reading.seq, uptime_s, now
        counts = self._counted_uptime_s is None or uptime_s - self._counted_uptime_s >= MIN_PERIOD_S
        if counts:
            self._counted_uptime_s = uptime_s
        return Taken(now - delay, counts)

    def _problem(self, reading: NodeReading, *, same_boot: bool) -> Rejection | None:
        if not same_boot:
            return "earlier_boot" if reading.boot in self._boots else None
        ahead = (reading.seq - self._seq) % _SEQ_RANGE
        if ahead == 0:
            return "duplicate"
        return "outdated" if ahead >= _SEQ_RANGE // 2 else None
