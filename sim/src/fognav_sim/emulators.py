"""The interfaces of emulators: a base's and a lidar's end of its serial line. Pure.

Emulators come with their drivers and know nothing of the simulator: they implement these protocols by their methods.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, Protocol, runtime_checkable

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

BASES: Final = "fognav.base_emulators"
"""Entry points that name a `BaseEmulator` class, made without arguments."""
LIDARS: Final = "fognav.lidar_emulators"
"""Entry points that name a `LidarEmulator` class, made from the world's `Measure`."""

Measure = Callable[["NDArray[np.float64]", float], "NDArray[np.float64]"]
"""(angles in rad, counter-clockwise in the lidar's frame; time in s) -> ranges in m, nan for no return."""


class SerialEmulator(Protocol):
    """A device's end of its serial line; `now` is any monotonic clock (s)."""

    @property
    def baud(self) -> int:
        """Speed of its line, 8N1."""

    def receive(self, data: bytes, now: float) -> None:
        """Receive bytes from the host; complete commands take effect at once."""

    def outgoing(self, now: float) -> bytes:
        """Return the bytes that the device has sent since the last call, up to `now`."""


class BaseEmulator(SerialEmulator, Protocol):
    """A base. The simulation reads its wheel speeds, moves the robot, and sets the base's encoders and sensors."""

    @property
    def axle_m(self) -> float:
        """Distance between the wheels' tracks, m."""

    @property
    def wheel_speeds_m_s(self) -> tuple[float, float]:
        """(left, right) speeds at which the motors are driven now, m/s."""

    def add_wheel_travel(self, left_m: float, right_m: float) -> None:
        """Add the distance (m) that each wheel has rolled to its encoder."""

    def set_sensors(self, *, bump_left: bool, bump_right: bool, cliff: bool) -> None:
        """Set the state of its contact sensors."""

    def tick(self, now: float, dt: float) -> None:
        """Let dt seconds pass up to `now`."""


@runtime_checkable
class DockingBase(Protocol):
    """What the emulator of a base adds if the base drives into its dock by itself."""

    def set_dock(self, ahead_m: float, aside_m: float, heading_rad: float) -> None:
        """Set where the base is, seen from where it stands on its dock.

        ahead_m: how far it has still to go along the dock's middle line. aside_m: how far it is to the left of that
        line. heading_rad: its heading, counter-clockwise from that line's direction.
        """


@runtime_checkable
class QuirkyBase(Protocol):
    """What the emulator of a base adds if single ones of its kind are known to deviate from their specification."""

    def set_quirks(self, **quirks: float) -> None:
        """Let it deviate so from now on: by names and values of its own."""


class LidarEmulator(SerialEmulator, Protocol):
    """A lidar. It measures the world whenever its outgoing bytes are read."""
