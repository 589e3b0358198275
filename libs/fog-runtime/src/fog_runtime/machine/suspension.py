"""Notices that the computer was suspended: the boot-time clock counts on, the monotonic clock does not."""

import time
from collections.abc import Callable
from typing import Final

_NOTICED_S: Final = 0.2
"""Shorter differences are the time between the readings of the two clocks."""


def _boot_time() -> float:
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class SuspensionMonitor:
    """Compares the two clocks (s) at each call."""

    def __init__(
        self, monotonic: Callable[[], float] = time.monotonic, boot_time: Callable[[], float] = _boot_time
    ) -> None:
        self._monotonic = monotonic
        self._boot_time = boot_time
        self._offset = boot_time() - monotonic()

    def suspended(self) -> float:
        """Return for how long (s) the computer was suspended since the last call; 0 if it was not."""
        offset = self._boot_time() - self._monotonic()
        seconds, self._offset = offset - self._offset, offset
        return seconds if seconds >= _NOTICED_S else 0.0
