"""How a robot's lidar is mounted: which sectors see the robot itself, and what a person has set by looking. Pure.

Angles are in the frame of the lidar the right way up, as the agent gives its scans, unless they are said to be the
robot's.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from fognav.robot_page.findings import SECTORS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from fog_contracts.robot import LidarSettings
    from fognav.robot_page.settings_file import Change
    from robot_agent.hardware import LaserScan

Sector = tuple[float, float]
"""From, to: rad, counter-clockwise, from in (-pi, pi]."""

_BINS: Final = 180
_INSIDE_M: Final = 0.02
"""A return so near to the outline counts as inside of it: the error of a near range."""
_NEAR_M: Final = 0.10
"""So far beyond its outline something of the robot may stick out."""
_STEADY_M: Final = 0.03
_STEADY_SHARE: Final = 0.6
"""Share of the scans with a sample there in which a part of the robot is seen: thin posts are missed now and then."""
_SCANS: Final = 60
_SCANS_LEAST: Final = 10
_TURNED_RAD: Final = 0.7
_PAD_RAD: Final = math.radians(1.5)


class OwnReturns:
    """The last scans, and where in them something near stays at one bearing and range.

    Inside of the robot's outline that is the robot itself. Beside it, only what stays while the robot turns is.
    """

    def __init__(self, outline: Sequence[tuple[float, float]], lidar: tuple[float, float, float]) -> None:
        """Take the body's convex outline (m, counter-clockwise), and the lidar's x, y, yaw in the robot's frame."""
        corners = np.array(outline)
        sides = np.roll(corners, -1, axis=0) - corners
        self._corners = corners
        self._normals = np.stack((sides[:, 1], -sides[:, 0]), axis=1) / np.hypot(*sides.T)[:, None]
        self._lidar = lidar
        self._ranges: list[NDArray[np.float64]] = []
        self._headings: list[float] = []

    def take(self, scan: LaserScan, heading: float) -> None:
        """Take a scan, at this heading (rad, not wrapped) by the wheels."""
        x, y, yaw = self._lidar
        angles = scan.angles_rad + yaw
        points = np.stack((x + scan.ranges_m * np.cos(angles), y + scan.ranges_m * np.sin(angles)), axis=1)
        # How far beyond the side that it is farthest beyond; nan without a return.
        beyond = ((points[:, None, :] - self._corners) * self._normals).sum(axis=2).max(axis=1)
        near = beyond <= _NEAR_M
        bins = _bin(scan.angles_rad)
        ranges = np.full((2, _BINS), np.nan)
        ranges[0, bins] = np.inf
        ranges[0, bins[near]] = scan.ranges_m[near]
        ranges[1, bins[near]] = beyond[near]
        self._ranges = [*self._ranges[-_SCANS + 1 :], ranges]
        self._headings = [*self._headings[-_SCANS + 1 :], heading]

    @property
    def turned(self) -> bool:
        """Whether the robot has turned enough meanwhile to tell its own parts from the room's."""
        return bool(self._headings) and max(self._headings) - min(self._headings) >= _TURNED_RAD

    def sectors(self) -> list[Sector]:
        """Return the sectors in which the lidar sees the robot itself, padded; none before enough scans came."""
        if len(self._ranges) < _SCANS_LEAST:
            return []
        ranges, beyond = np.stack(self._ranges, axis=1)
        sampled, near = ~np.isnan(ranges), np.isfinite(ranges)
        often = near.sum(axis=0) >= np.maximum(3, _STEADY_SHARE * sampled.sum(axis=0))
        own = np.zeros(_BINS, np.bool_)
        for number in np.flatnonzero(often):
            seen = near[:, number]
            low, high = np.percentile(ranges[seen, number], (10, 90))
            inside = np.median(beyond[seen, number]) <= _INSIDE_M
            own[number] = high - low <= _STEADY_M and (inside or self.turned)
        return _runs(own)


def _bin(angles: NDArray[np.float64]) -> NDArray[np.int64]:
    return np.floor((angles % math.tau) * (_BINS / math.tau)).astype(np.int64) % _BINS


def _runs(own: NDArray[np.bool_]) -> list[Sector]:
    """Return the runs of true bins around the circle as padded sectors; a gap of one bin does not part them."""
    own = own | (np.roll(own, 1) & np.roll(own, -1))
    if own.all() or not own.any():
        return []
    first = int(np.flatnonzero(~own)[0])
    width = math.tau / _BINS
    found: list[Sector] = []
    begin: int | None = None
    for number in range(first, first + _BINS + 1):
        if own[number % _BINS] and begin is None:
            begin = number
        elif not own[number % _BINS] and begin is not None:
            found.append(wrapped((begin * width - _PAD_RAD, number * width + _PAD_RAD)))
            begin = None
    return found


def wrapped(sector: Sector) -> Sector:
    """Return the same sector with its ends in (-pi, pi], rounded to a milliradian."""
    begin, end = (round(math.remainder(angle, math.tau), 3) for angle in sector)
    return begin, end


def missing_by_sector(scans: Sequence[LaserScan], yaw: float, range_max: float) -> list[float | None]:
    """Return the share of samples without a return, by sector of the robot's frame; None where no sample went.

    The first sector's middle is ahead, the others follow counter-clockwise.
    """
    if not scans:
        return [None] * SECTORS
    angles = np.concatenate([scan.angles_rad for scan in scans]) + yaw
    ranges = np.concatenate([scan.ranges_m for scan in scans])
    number = np.floor((angles / math.tau * SECTORS + 0.5) % SECTORS).astype(np.int64) % SECTORS
    sampled = np.bincount(number, minlength=SECTORS)
    without = np.bincount(number[~(ranges <= range_max)], minlength=SECTORS)
    return [float(none / all_) if all_ else None for none, all_ in zip(without, sampled, strict=True)]


def masked_sectors(masks: Sequence[Sector]) -> list[bool]:
    """Return whether masks (in the robot's frame) hide so much of each sector that no sample of it may be left."""
    inner = (np.arange(SECTORS)[:, None] + np.linspace(-0.4, 0.4, 9)) * (math.tau / SECTORS)
    hidden = np.zeros(inner.shape, np.bool_)
    for begin, end in masks:
        hidden |= (inner - begin) % math.tau <= (end - begin) % math.tau
    return [bool(sector.all()) for sector in hidden]


def changes(before: LidarSettings, yaw: float, masks: Sequence[Sector], *, mirrored: bool) -> list[Change]:
    """Return what a person's settings of the lidar change; masks in the robot's frame."""
    told: tuple[Change, ...] = (
        ("lidar.yaw_rad", before.yaw_rad, round(math.remainder(yaw, math.tau), 4)),
        ("lidar.mirrored", before.mirrored, mirrored),
        ("lidar.masks", [list(mask) for mask in before.masks], [list(wrapped(mask)) for mask in masks]),
    )
    return [change for change in told if change[1] != change[2]]
