"""The machine's clock, for processes that must stay small: it imports no event loop, unlike `fog_runtime.clock`."""

import time


class MachineClock:
    """The machine's clock, run `speed` times as fast; raises `ValueError` for a speed that is not positive."""

    def __init__(self, speed: float = 1.0) -> None:
        if not 0.0 < speed <= 100.0:
            raise ValueError(f"the clock's speed must lie in (0, 100], not {speed}")
        self._speed = speed

    @property
    def speed(self) -> float:
        """How many seconds of this clock pass in one real second."""
        return self._speed

    def now(self) -> float:
        """Monotonic seconds, by the hardware's own rate: what corrects the time of day does not slew them (ADR 56)."""
        return time.clock_gettime(time.CLOCK_MONOTONIC_RAW) * self._speed

    def stamp(self) -> float:
        """Seconds since the Unix epoch, times the speed."""
        return time.time() * self._speed

    def real(self, seconds: float) -> float:
        """Real seconds that `seconds` of this clock take."""
        return seconds / self._speed
