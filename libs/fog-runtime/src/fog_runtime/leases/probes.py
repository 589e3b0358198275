"""Asks what a process needs to lead, several times a second, whether it answers: its transports and its threads.

A connection says for 10 to 15 s that it is up after nothing passes on it any more; a thread that hangs says nothing.
"""

from __future__ import annotations

import asyncio
import math
import time
from functools import partial
from typing import TYPE_CHECKING, Final

from prometheus_client import Gauge

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

PROBE_S: Final = 0.2
"""Pause between an answer and the next question (real seconds)."""

AGE: Final = Gauge(
    "fognav_answer_age_seconds",
    "Time since what this process needs to lead (broker, router, thread) was last asked something that it answered",
    ["needed"],
)


class Probes:
    """When everything that is needed last answered, by the monotonic clock; `needs`: by name, what asks it.

    A question returns whether it was answered, and is asked again only then: it may take as long as it likes.
    """

    def __init__(self, needs: Mapping[str, Callable[[], Awaitable[bool]]]) -> None:
        """Prepare; nothing has answered yet."""
        self._needs = needs
        self._started_at = time.monotonic()
        self._answered_at = dict.fromkeys(needs, -math.inf)

    def answered_at(self) -> float:
        """Return when the question was asked that was answered last, of the need for which that is longest ago.

        -inf while something has answered none.
        """
        return min(self._answered_at.values(), default=time.monotonic())

    def silent(self, seconds: float) -> list[str]:
        """Return the names of what has answered no question of the last `seconds`; none so soon after the start."""
        return [name for name in self._answered_at if self._age(name) > seconds]

    def start(self, tasks: asyncio.TaskGroup) -> None:
        """Ask, as tasks of a group, until these are cancelled."""
        for name, ask in self._needs.items():
            AGE.labels(name).set_function(partial(self._age, name))
            tasks.create_task(self._probe(name, ask), name=f"probe of {name}")

    def _age(self, name: str) -> float:
        """Return the time since the last question that was answered, or since the start."""
        return time.monotonic() - max(self._started_at, self._answered_at[name])

    async def _probe(self, name: str, ask: Callable[[], Awaitable[bool]]) -> None:
        while True:
            asked_at = time.monotonic()
            if await ask():
                self._answered_at[name] = asked_at
            await asyncio.sleep(PROBE_S)
