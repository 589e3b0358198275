"""CPU time by component: what the calling thread spent in it, by the kernel's account. Nothing is estimated."""

from __future__ import annotations

import time
from collections import defaultdict
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator


class CpuMeter:
    """Adds up CPU seconds by component. Work of a component within another's counts for the inner one only.

    Only the thread's own time counts: what other programs do meanwhile costs nothing, apart from what they take away of
    the processor's caches and clock.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._running: list[str] = []
        self._since = 0

    @contextmanager
    def measure(self, component: str) -> Iterator[None]:
        """Measure what runs inside as this component's."""
        self._switch(component)
        try:
            yield
        finally:
            self._switch(None)

    def _switch(self, entered: str | None) -> None:
        now = time.thread_time_ns()
        if self._running:
            self.seconds[self._running[-1]] += (now - self._since) / 1e9
        if entered is None:
            self._running.pop()
        else:
            self._running.append(entered)
        self._since = now
