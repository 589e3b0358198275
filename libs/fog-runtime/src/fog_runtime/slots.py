"""One-slot queues for inputs of which only the latest matters (pose, scan, costmap, path)."""

import asyncio
import math
from typing import Generic, TypeVar

T = TypeVar("T")


class Slot(Generic[T]):
    """Holds the newest value and when it arrived, by the receiver's own monotonic clock.

    For one event loop: call `put` only on the loop's thread.
    """

    def __init__(self) -> None:
        self._value: T | None = None
        self._arrived_at = -math.inf
        self._count = 0
        self._waiters: list[asyncio.Future[None]] = []

    @property
    def count(self) -> int:
        """How many values were put so far."""
        return self._count

    def put(self, value: T, now: float) -> None:
        """Replace the value and wake all waiters."""
        self._value = value
        self._arrived_at = now
        self._count += 1
        waiters, self._waiters = self._waiters, []
        for waiter in waiters:
            if not waiter.done():
                waiter.set_result(None)

    def get(self) -> T | None:
        """Return the newest value, however old, or None before the first."""
        return self._value

    def age(self, now: float) -> float:
        """Seconds since the newest value arrived; infinite before the first."""
        return now - self._arrived_at

    def fresh(self, now: float, max_age: float | None) -> bool:
        """Whether there is a value not older than `max_age` seconds (None: of any age)."""
        return self._count > 0 and (max_age is None or self.age(now) <= max_age)

    async def wait(self) -> T:
        """Wait for a newer value than the current one, and return the newest."""
        waiter = asyncio.get_running_loop().create_future()
        self._waiters.append(waiter)
        try:
            await waiter
        finally:
            if waiter in self._waiters:
                self._waiters.remove(waiter)
        assert self._value is not None
        return self._value
