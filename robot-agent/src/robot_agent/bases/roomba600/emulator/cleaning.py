"""The firmware's own cleaning, as far as a host has to do with it: the robot drives off without being told to."""

from __future__ import annotations

from typing import Final

_DRIVE_MM_S: Final = 300
_LEAVE_DOCK_MM_S: Final = -100


class Cleaning:
    """A cleaning, since its button, its schedule or its command began it."""

    def wheels(self, *, on_dock: bool) -> tuple[int, int]:
        """Return the speeds (mm/s) of left and right wheel: off the dock, then straight ahead."""
        speed = _LEAVE_DOCK_MM_S if on_dock else _DRIVE_MM_S
        return speed, speed
