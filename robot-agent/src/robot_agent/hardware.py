"""What bases and lidars are to the rest of the robot, whatever their make: neutral values and the protocols of drivers.

A driver is a protocol without I/O (as in h11): bytes and arrival times in, events out, commands out as bytes. It knows
no port and no clock, so it can be fed one byte at a time, damaged, recorded and replayed.

Units are m, rad, s; `now` is the caller's monotonic clock.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


class Twist(NamedTuple):
    """Motion of the robot's body: forward speed `v` in m/s, turning rate `w` in rad/s, counter-clockwise positive."""

    v: float
    w: float


@dataclass(frozen=True, slots=True, eq=False)
class LaserScan:
    """One whole revolution of a lidar: n samples in order of arrival.

    angles_rad: float64[n], counter-clockwise in the lidar's frame, 0 straight ahead, in (-pi, pi].
    ranges_m: float64[n], nan where nothing came back; not clipped to the rated range, because a too-near obstacle is an
    obstacle. quality: uint8[n], strength of the return on the device's own scale, 0 for none.
    started_at, ended_at: arrival of the first and last sample (s of the caller's clock), interpolated in a batch.
    repeats: how many scans in a row were identical in every decoded bit, this one included; a live lidar never gives
    two equal ones, a stuck link does.
    """

    angles_rad: NDArray[np.float64]
    ranges_m: NDArray[np.float64]
    quality: NDArray[np.uint8]
    started_at: float
    ended_at: float
    repeats: int


class RepeatCounter:
    """Counts how many scans in a row were identical, from the raw fields that a driver decoded."""

    def __init__(self) -> None:
        self._digest = b""
        self._repeats = 0

    def count(self, *fields: NDArray[np.generic]) -> int:
        """Return how many scans in a row had exactly these fields, this one included."""
        digest = hashlib.blake2b(digest_size=16)
        for field in fields:
            digest.update(field.tobytes())
        self._repeats = self._repeats + 1 if digest.digest() == self._digest else 1
        self._digest = digest.digest()
        return self._repeats
