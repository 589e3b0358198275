"""Which stops without a token are recorded one by one, and which are only counted. Pure.

Anybody may stop a robot, as often as they like. So that nobody can push the rest out of the
audit trail by that, only the first stop of each sender is an entry of its own, for some senders; what they repeat is
counted, and one entry per robot and period tells how often.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

PERIOD_S: Final = 600.0
"""How long repeated stops of a robot are counted before an entry tells of them."""
SENDERS: Final = 4
"""How many senders have entries of their own, for each robot and period; all others are counted together."""
OTHERS: Final = "others"


@dataclass
class _Period:
    begun_at: float
    senders: set[str] = field(default_factory=set)
    repeats: Counter[str] = field(default_factory=Counter)


class StopRecords:
    """Counts the stops of each robot."""

    def __init__(self) -> None:
        self._periods: dict[str, _Period] = {}

    def count(self, robot: str, sender: str, now: float) -> bool:
        """Count a stop at `now` (s, monotonic); return whether it is to be recorded by itself."""
        period = self._periods.setdefault(robot, _Period(now))
        if sender not in period.senders and len(period.senders) < SENDERS:
            period.senders.add(sender)
            return True
        self.unrecorded(robot, sender)
        return False

    def unrecorded(self, robot: str, sender: str) -> None:
        """Count a stop that has no entry of its own, because it is a repetition or could not be recorded."""
        period = self._periods[robot]
        period.repeats[sender if sender in period.senders else OTHERS] += 1

    def due(self, now: float) -> dict[str, Mapping[str, int]]:
        """Return, for each robot whose period is over, how often each sender repeated a stop; may be called again."""
        due: dict[str, Mapping[str, int]] = {}
        for robot, period in list(self._periods.items()):
            if now - period.begun_at < PERIOD_S:
                continue
            if period.repeats:
                due[robot] = dict(period.repeats)
            else:
                del self._periods[robot]
        return due

    def recorded(self, robot: str, repeats: Mapping[str, int], now: float) -> None:
        """Begin the next period of a robot whose repeated stops, as returned by `due`, are recorded now.

        Who repeated them is known, and gets no entry of its own again while going on.
        """
        period = self._periods[robot]
        later = period.repeats - Counter(repeats)
        self._periods[robot] = _Period(now, period.senders & {*repeats, *later}, later)
