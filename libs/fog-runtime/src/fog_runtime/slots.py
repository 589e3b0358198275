"""One-slot channels for inputs of which only the latest counts (pose, scan, costmap, path): no queue can grow."""

import asyncio
import math
from typing import Generic, TypeVar

T = TypeVar("T")


class Slot(Generic[T]):
    """Holds the newest value and when it came, by the receiver's own monotonic clock.

    Belongs to one event loop: `put` is called on the loop's thread only.
    """

    def __init__(self) -> None:
        self._value: T | None = None
        self._at = -math.inf
        self._count = 0
        self._waiters: list[asyncio.Future[None]] = []

    @property
    def count(self) -> int:
        """How many values were put so far."""
        return self._count

    def put(self, value: T, now: float) -> None:
        """Replace the value; whoever waits is woken."""
        self._value = value
        self._at = now
        self._count += 1
        waiters, self._waiters = self._waiters, []
        for waiter in waiters:
            if not waiter.done():
                waiter.set_result(None)

    def get(self) -> T | None:
        """Return the newest value, however old, or None when there was none yet."""
        return self._value

    def age(self, now: float) -> float:
        """Seconds since the newest value came; infinite when none did."""
        return now - self._at

    def fresh(self, now: float, max_age: float | None) -> bool:
        """Whether there is a value not older than `max_age` seconds (None: any value is fresh enough)."""
        return self._count > 0 and (max_age is None or self.age(now) <= max_age)

    async def wait(self) -> T:
        """Wait for a value newer than the one that is there now, and return the newest."""
        waiter = asyncio.get_running_loop().create_future()
        self._waiters.append(waiter)
        try:
            await waiter
        finally:
            if waiter in self._waiters:
                self._waiters.remove(waiter)
        assert self._value is not None
        return self._value
