"""CPU time by component: what the calling thread spent in it, by the kernel's account. Nothing is estimated."""

from __future__ import annotations

import time
from collections import defaultdict


class CpuMeter:
    """Adds up CPU seconds by component. Work of a component within another's counts for the inner one only.

    Only the thread's own time counts: what other programs do meanwhile costs nothing, apart from what they take away of
    the processor's caches and clock.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._running: list[str] = []
        self._since = 0
        self._components: dict[str, _Component] = {}

    def measure(self, component: str) -> _Component:
        """Return what measures the work inside a `with` as this component's; a component may enter itself again."""
        found = self._components.get(component)
        if found is None:
            found = self._components[component] = _Component(self, component)
        return found

    def enter(self, component: str) -> None:
        """Count the time from now on for this component."""
        now = time.thread_time_ns()
        if self._running:
            self.seconds[self._running[-1]] += (now - self._since) / 1e9
        self._running.append(component)
        self._since = now

    def leave(self) -> None:
        """Count the time from now on for the component that entered this one, if any."""
        now = time.thread_time_ns()
        self.seconds[self._running.pop()] += (now - self._since) / 1e9
        self._since = now


class _Component:
    """Enters and leaves a component; one object for all its work, because there is much of it in a second."""

    __slots__ = ("_meter", "_name")

    def __init__(self, meter: CpuMeter, name: str) -> None:
        self._meter = meter
        self._name = name

    def __enter__(self) -> None:
        self._meter.enter(self._name)

    def __exit__(self, *_: object) -> None:
        self._meter.leave()
