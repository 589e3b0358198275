"""A lidar as it is mounted: upside down, behind the robot's own posts, with a delay. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, TypeVar

import numpy as np

from robot_agent.hardware import LidarSamples

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.messages import Reason
    from robot_agent.device_signature import SerialSettings
    from robot_agent.hardware import LaserScan, LidarDriver, LidarEvents, LidarTraits


Real = TypeVar("Real", np.float32, np.float64)


@dataclass(frozen=True, slots=True, kw_only=True)
class Mounting:
    """How a lidar is mounted.

    `yaw_rad`: direction of the lidar's zero in the robot's frame. `mirrored`: it hangs upside down. `latency_s`: time
    from a measurement to its arrival. `masks`: sectors (from, to) in rad, counter-clockwise in the robot's frame, in
    which it sees only the robot.
    """

    yaw_rad: float = 0.0
    mirrored: bool = False
    latency_s: float = 0.0
    masks: tuple[tuple[float, float], ...] = ()

    @property
    def plain(self) -> bool:
        """Whether scans are right as the driver gives them."""
        return not (self.mirrored or self.latency_s or self.masks)

    def apply(self, scan: LaserScan) -> LaserScan:
        """Return the scan with true angles and times, without the samples of masked directions.

        A masked sample is left out and is not one without a return, which would mean that nothing is there.
        """
        angles = _wrapped(-scan.angles_rad) if self.mirrored else scan.angles_rad
        seen = ~self.masked(angles)
        return replace(
            scan,
            angles_rad=angles[seen],
            ranges_m=scan.ranges_m[seen],
            quality=scan.quality[seen],
            started_at=scan.started_at - self.latency_s,
            ended_at=scan.ended_at - self.latency_s,
        )

    def apply_to_samples(self, samples: LidarSamples) -> LidarSamples:
        """Return the samples with true angles and times, those of masked directions without a return.

        They stay in their places, because the times of the others follow from their order.
        """
        angles = _wrapped(-samples.angles_rad) if self.mirrored else samples.angles_rad
        ranges = np.where(self.masked(angles), np.float32(np.nan), samples.ranges_m)
        return LidarSamples(angles, ranges, samples.started_at - self.latency_s, samples.ended_at - self.latency_s)

    def masked(self, angles_rad: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return which of these angles (float64[n], frame of the lidar the right way up) lie in a masked sector."""
        masked = np.zeros(angles_rad.shape, np.bool_)
        for begin, end in self.masks:
            masked |= (angles_rad + self.yaw_rad - begin) % math.tau <= (end - begin) % math.tau
        return masked


class MountedLidar:
    """A driver whose scans are those of the mounted lidar; see `robot_agent.hardware.LidarDriver`."""

    def __init__(self, driver: LidarDriver, mounting: Mounting) -> None:
        self._driver = driver
        self._mounting = mounting

    @property
    def serial(self) -> SerialSettings:
        """Settings of its serial port."""
        return self._driver.serial

    @property
    def traits(self) -> LidarTraits:
        """Rated ranges and scan period."""
        return self._driver.traits

    @property
    def problem(self) -> Reason | Literal[""]:
        """Why there is no scan; empty while scans arrive."""
        return self._driver.problem

    @property
    def corrupted(self) -> int:
        """Number of damaged packets."""
        return self._driver.corrupted

    @property
    def stop_command(self) -> bytes:
        """Bytes that end the scan."""
        return self._driver.stop_command

    def begin(self, now: float) -> bytes:
        """Begin (again), after the port was opened; return the bytes to send."""
        return self._driver.begin(now)

    def receive(self, data: bytes, now: float) -> LidarEvents:
        """Parse bytes received at `now`."""
        events = self._driver.receive(data, now)
        samples = None if events.samples is None else self._mounting.apply_to_samples(events.samples)
        return events._replace(samples=samples, scans=tuple(map(self._mounting.apply, events.scans)))

    def tick(self, now: float) -> bytes:
        """Advance time; return the bytes to send."""
        return self._driver.tick(now)


def _wrapped(angles_rad: NDArray[Real]) -> NDArray[Real]:
    """Return the angles in (-pi, pi]."""
    return np.where(angles_rad <= -np.pi, angles_rad + angles_rad.dtype.type(math.tau), angles_rad)
