"""From batches of samples to whole scans, for any rotating lidar, whether it repeats them, and as it is mounted. Pure.

Apart from `robot_agent.hardware`, which the guardian imports, too: digests bring a library of cryptography with them
that takes 3.7 MB of memory.
"""

from __future__ import annotations

import hashlib
import math
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeVar

import numpy as np

from fog_kernels.lidar import Batch, batch
from robot_agent.hardware import LaserScan, LidarSamples

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from fog_contracts.messages import Reason
    from robot_agent.device_signature import SerialSettings
    from robot_agent.hardware import LidarDriver, LidarEvents, LidarTraits

_SECTORS: Final = 36
_SECTORS_NEEDED: Final = 33
_SAMPLES_MAX: Final = 4096
_ARRIVAL_GAP_S: Final = 0.5
_REMEMBERED_SCANS: Final = 64


class Samples(NamedTuple):
    """A batch of n samples in order of arrival; the boundaries between batches have no meaning.

    clockwise_rad: float64[n], clockwise seen from above, 0 straight ahead, in [0, 2 pi).
    ranges_m: float64[n], nan for no return. quality: uint8[n].
    """

    clockwise_rad: NDArray[np.float64]
    ranges_m: NDArray[np.float64]
    quality: NDArray[np.uint8]


class ScanBuilder:
    """Samples -> whole scans. A scan runs from one boundary to the next and must cover nearly all directions.

    `incomplete` counts scans that were discarded because samples were missing; the samples before the first
    boundary do not count.
    """

    def __init__(self) -> None:
        self._pieces: list[Samples] = []
        self._times: list[NDArray[np.float64]] = []
        self._count = 0
        self._newest: list[Batch] = []
        self._started = False
        self._last_arrival: float | None = None
        self._repeats = RepeatCounter()
        self.incomplete = 0

    def feed(self, samples: Samples, boundaries: Iterable[int], now: float) -> list[LaserScan]:
        """Add a batch that arrived at `now` (s, monotonic); return the scans that it completes.

        `boundaries` are the indices, in order, of the samples with which a new scan begins.
        """
        count = len(samples.ranges_m)
        newest = batch(samples.clockwise_rad, samples.ranges_m, self._arrived_before(now), now)
        times = newest.times
        self._newest.append(newest)
        scans: list[LaserScan] = []
        begin = 0
        for boundary in boundaries:
            self._append(samples, times, begin, boundary)
            scans.extend(self._finish())
            begin = boundary
            self._started = True
        self._append(samples, times, begin, count)
        return scans

    def take_samples(self) -> LidarSamples | None:
        """Return all samples since the last call, be their scan whole or not; None without any."""
        newest, self._newest = self._newest, []
        if not any(part.times.size for part in newest):
            return None
        if len(newest) == 1:
            times, angles, ranges = newest[0]
        else:
            times, angles, ranges = (np.concatenate(fields) for fields in zip(*newest, strict=True))
        return LidarSamples(
            angles_rad=angles,
            ranges_m=ranges,
            started_at=float(times[0]),
            ended_at=float(times[-1]),
        )

    def reset(self) -> None:
        """Discard the incomplete scan, after a gap or a restart."""
        self._clear()
        self._newest = []
        self._started = False
        self._last_arrival = None

    def _arrived_before(self, now: float) -> float:
        """Return when the batch before this one arrived; after a gap all of this one count as arrived `now`."""
        before, self._last_arrival = self._last_arrival, now
        return before if before is not None and 0.0 <= now - before <= _ARRIVAL_GAP_S else now

    def _append(self, samples: Samples, times: NDArray[np.float64], begin: int, end: int) -> None:
        if not self._started or begin == end:
            return
        part = slice(begin, end)
        self._pieces.append(Samples(samples.clockwise_rad[part], samples.ranges_m[part], samples.quality[part]))
        self._times.append(times[part])
        self._count += end - begin
        if self._count > _SAMPLES_MAX:
            self.incomplete += 1
            self._clear()
            self._started = False

    def _clear(self) -> None:
        self._pieces, self._times, self._count = [], [], 0

    def _finish(self) -> list[LaserScan]:
        if not self._count:
            return []
        clockwise, ranges, quality = (np.concatenate(fields) for fields in zip(*self._pieces, strict=True))
        times = np.concatenate(self._times)
        self._clear()
        sectors = np.bincount((clockwise * (_SECTORS / (2.0 * np.pi))).astype(np.int64), minlength=_SECTORS)
        if np.count_nonzero(sectors) < _SECTORS_NEEDED:
            self.incomplete += 1
            return []
        return [
            LaserScan(
                angles_rad=_counter_clockwise(clockwise),
                ranges_m=ranges,
                quality=quality,
                started_at=float(times[0]),
                ended_at=float(times[-1]),
                repeats=self._repeats.count(clockwise, ranges, quality),
            )
        ]


def _counter_clockwise(clockwise: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return clockwise angles (rad; in [0, 2 pi)) as counter-clockwise ones in (-pi, pi]."""
    return np.where(clockwise < np.pi, 0.0, 2.0 * np.pi) - clockwise


class RepeatCounter:
    """Counts how many scans in a row repeat earlier ones, from the raw fields that a driver decoded.

    The last 64 scans are remembered by their digests: noise never repeats a scan, a replayed buffer of up to 64 does.
    """

    def __init__(self) -> None:
        self._digests: deque[bytes] = deque(maxlen=_REMEMBERED_SCANS)
        self._repeats = 1

    def count(self, *fields: NDArray[np.generic]) -> int:
        """Return 1 for a new scan; for one that equals an earlier one, 1 more than for the scan before it."""
        digest = hashlib.blake2b(digest_size=16)
        for field in fields:
            digest.update(field.tobytes())
        self._repeats = self._repeats + 1 if digest.digest() in self._digests else 1
        self._digests.append(digest.digest())
        return self._repeats


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
        """Return the scan with true angles and times, those samples masked that are in a masked direction.

        They stay in their places, because the times of the others follow from their order.
        """
        angles = _wrapped(-scan.angles_rad) if self.mirrored else scan.angles_rad
        masked = self.masked(angles)
        return replace(
            scan,
            angles_rad=angles,
            ranges_m=np.where(masked, np.nan, scan.ranges_m),
            quality=np.where(masked, np.uint8(0), scan.quality),
            started_at=scan.started_at - self.latency_s,
            ended_at=scan.ended_at - self.latency_s,
            masked=masked if masked.any() else None,
        )

    def apply_to_samples(self, samples: LidarSamples) -> LidarSamples:
        """Return the samples with true angles and times, those of masked directions without a return.

        They stay in their places, as in `apply`.
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
