"""The devices of the simulated robot, of any make: byte-exact emulators, found by name.

A base or lidar comes with its emulator, and registers it by an entry point like its driver. Emulator and driver share
no code: two independent implementations of one data sheet reveal each other's errors.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, Protocol

from fog_runtime import parts
from fog_runtime.settings import SettingsError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

BASES: Final = "fognav.base_emulators"
"""Entry points that name a `BaseEmulator` class, made without arguments."""
LIDARS: Final = "fognav.lidar_emulators"
"""Entry points that name a `LidarEmulator` class, made from the world's `Measure`."""

DEFAULT_BASE: Final = "roomba600"
DEFAULT_LIDAR: Final = "rplidar-a1"

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


class LidarEmulator(SerialEmulator, Protocol):
    """A lidar. It measures the world whenever its outgoing bytes are read."""


def make_base(name: str) -> BaseEmulator:
    """Make the emulator of a base. Raises `SettingsError` for an unknown name."""
    try:
        emulator: BaseEmulator = parts.load(BASES, name, type)()
    except parts.PartError as error:
        raise SettingsError(f"FOGNAV_BASE: {error}") from error
    return emulator


def make_lidar(name: str, measure: Measure) -> LidarEmulator:
    """Make the emulator of a lidar that measures by `measure`. Raises `SettingsError` for an unknown name."""
    try:
        emulator: LidarEmulator = parts.load(LIDARS, name, type)(measure)
    except parts.PartError as error:
        raise SettingsError(f"FOGNAV_LIDAR: {error}") from error
    return emulator
