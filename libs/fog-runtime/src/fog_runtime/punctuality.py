"""Whether a process answers in time, judged by another one that hears both the questions and the answers. Pure, no I/O.

A leader that is slow looks well to itself: what it receives late it answers at once, and what it sends may be lost. So
its copies judge it. Each of the map-service's heartbeats is a question; a planner says which one it has handled last
(`Leader.answered`), on the way that its paths take, once its planning thread is free. A copy compares when it heard
the question with when it heard the answer: what delays both, as a slow router does, delays nobody's answer. It judges
itself by the same measure, so that no lease goes to a copy on as slow a machine or way. Of the leader's missions it has
none: where these alone make it late, the other will be late with them, and the pauses between hand-overs grow.

Times are seconds of the judge's own monotonic clock.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from fog_contracts.messages import Sent

LATE_S: Final = 0.2
"""An answer is late after so long. Questions come every 0.1 s."""
WINDOW_S: Final = 1.0
"""Time of the questions by which a process is judged."""
MOST_LATE: Final = 0.5
"""A process is late if more than this share of these answers is: one pause of half a second is none of its state."""
QUICK_S: Final = LATE_S / 2
"""A process that answers as quickly may take over from a late one: the distance keeps two from taking turns."""
_FEWEST: Final = 5
"""Of fewer questions nobody is judged: their sender, or the way from it, is at fault."""


@dataclass(slots=True)
class _Question:
    sent: Sent
    heard_at: float
    answered_at: float = math.inf

    def waited(self, now: float) -> float:
        return min(now, self.answered_at) - self.heard_at


class Punctuality:
    """How late one process answers, since it was first `followed`."""

    def __init__(self) -> None:
        self._questions: deque[_Question] = deque()
        self._epoch = 0
        self._answers: bool | None = None
        """Whether it has answered yet; None before it was heard at all."""

    def follow(self, epoch: int) -> None:
        """Judge the process that leads with this epoch, anew if it is another one than before."""
        if epoch != self._epoch:
            self._epoch, self._answers = epoch, None
            self._questions.clear()

    def on_question(self, question: Sent, now: float) -> None:
        """Note a question, in the order of their arrival."""
        self._questions.append(_Question(question, now))
        while now - self._questions[0].heard_at > WINDOW_S + LATE_S:
            self._questions.popleft()

    def on_no_answer(self) -> None:
        """Hear it say something else. Who speaks and has never answered knows of no questions: an older version."""
        if self._answers is None:
            self._answers = False

    def on_answer(self, question: Sent, now: float) -> None:
        """Note the answer to a question, which answers those before it, too; to an unknown one, or another's: nothing.

        It may come before the question, from a process that is nearer to whoever asks: it then answers those before.
        """
        self._answers = True
        clock, uptime = question
        for index in range(len(self._questions) - 1, -1, -1):
            asked_by, asked = self._questions[index].sent
            if asked_by == clock and asked <= uptime:
                break
        else:
            return
        for each in list(self._questions)[: index + 1]:
            each.answered_at = min(each.answered_at, now)

    def waits(self, now: float) -> list[float]:
        """Return how long (s) each question waited, or has waited, that was asked `LATE_S` ago or before, in order."""
        return [each.waited(now) for each in self._questions if WINDOW_S >= now - each.heard_at - LATE_S >= 0.0]

    def median(self, now: float) -> float:
        """Return the median of these (s); NaN of fewer than `_FEWEST`."""
        waits = sorted(self.waits(now))
        return waits[len(waits) // 2] if len(waits) >= _FEWEST else math.nan

    def is_late(self, now: float) -> bool:
        """Whether too many answers came late, or have not come."""
        waits = self.waits(now)
        asked = self._answers is not False and len(waits) >= _FEWEST
        return asked and sum(wait > LATE_S for wait in waits) > MOST_LATE * len(waits)

    def is_quick(self, now: float) -> bool:
        """Whether it would answer in time what another one answers late; not while that is unknown."""
        return self.median(now) <= QUICK_S
