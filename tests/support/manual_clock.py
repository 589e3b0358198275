from __future__ import annotations

import asyncio
import heapq
import itertools


class ManualClock:
    """A clock that moves only by `advance`, for tests."""

    def __init__(self, start: float = 0.0) -> None:
        self._now = start
        self._order = itertools.count()
        self._sleepers: list[tuple[float, int, asyncio.Future[None]]] = []

    @property
    def speed(self) -> float:
        """1: a manual clock has no relation to real time."""
        return 1.0

    @property
    def id(self) -> int:
        """0."""
        return 0

    def now(self) -> float:
        """Return the seconds to which it was advanced."""
        return self._now

    def stamp(self) -> float:
        """Return the same seconds as `now`."""
        return self._now

    def real(self, seconds: float) -> float:
        """Return the seconds unchanged."""
        return seconds

    async def sleep(self, seconds: float) -> None:
        """Wait until `advance` has moved the clock by `seconds`."""
        if seconds <= 0.0:
            await asyncio.sleep(0)
            return
        woken = asyncio.get_running_loop().create_future()
        heapq.heappush(self._sleepers, (self._now + seconds, next(self._order), woken))
        await woken

    def advance(self, dt: float) -> None:
        """Advance the clock by `dt` >= 0 seconds and wake, in order, the sleepers whose time has come."""
        if dt < 0.0:
            raise ValueError(f"time does not run backwards: dt must be >= 0, not {dt}")
        self._now += dt
        while self._sleepers and self._sleepers[0][0] <= self._now:
            _, _, woken = heapq.heappop(self._sleepers)
            if not woken.done():
                woken.set_result(None)
