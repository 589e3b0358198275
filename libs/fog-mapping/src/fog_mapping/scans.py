"""Scans as mapping uses them: points in the plane with the lines that they lie on, and the odometry at each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_kernels.matching import Reference, normals
from fog_mapping.poses import between, place, rotate

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

_NEAREST_M: Final = 0.1
_SURFACE_M: Final = 0.4
"""Two returns farther apart say nothing about the line of a surface."""
_LEAST_RETURNS: Final = 20
_STEP_M: Final = 0.2
_TURN_RAD: Final = 0.15


class Scan(NamedTuple):
    """Returns (n, 2; m, in the robot's frame, by bearing), their normals (n, 2), and the pose by odometry (3,).

    number: which scan of the log it is. stretch: how many breaks of the odometry lie before it, during which nobody
    knows how the robot moved.
    """

    number: int
    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    odometry: NDArray[np.float64]
    stretch: int = 0


def scan_of(
    number: int,
    angles: NDArray[np.float64],
    ranges: NDArray[np.float64],
    odometry: Sequence[float],
    range_max: float,
    stretch: int = 0,
) -> Scan | None:
    """Return a scan of ranges (m; nan: no return) at angles (rad, growing), up to `range_max`; None if it shows little.

    stretch: as in `Scan`. Raises `ValueError` for an odometry that isn't finite.
    """
    pose = np.array(odometry, np.float64)
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise ValueError(f"scan {number}: the odometry must be x, y and theta, finite, not {list(odometry)}")
    used = np.isfinite(ranges) & (ranges > _NEAREST_M) & (ranges < range_max)
    if int(used.sum()) < _LEAST_RETURNS:
        return None
    points = np.column_stack((ranges[used] * np.cos(angles[used]), ranges[used] * np.sin(angles[used])))
    return Scan(number, points, normals(points, _SURFACE_M), pose, stretch)


def keep_moved(scans: Iterable[Scan]) -> list[Scan]:
    """Return the first scan and each one after which the robot has moved or turned on by its odometry."""
    kept: list[Scan] = []
    for scan in scans:
        if not kept or has_moved(kept[-1], scan):
            kept.append(scan)
    return kept


def has_moved(before: Scan, scan: Scan) -> bool:
    """Return whether the robot has moved or turned enough between two scans, by its odometry, for both to count.

    After a break of the odometry it may have.
    """
    if before.stretch != scan.stretch:
        return True
    x, y, turn = between(before.odometry, scan.odometry)
    return bool(np.hypot(x, y) >= _STEP_M or abs(turn) >= _TURN_RAD)


def cloud(
    scans: Sequence[Scan], poses: NDArray[np.float64], numbers: Iterable[int], origin: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the points and normals of some scans at their poses, or as seen from `origin`."""
    points, lines = [], []
    for number in numbers:
        pose = poses[number] if origin is None else between(origin, poses[number])
        points.append(place(pose, scans[number].points))
        lines.append(rotate(pose, scans[number].normals))
    return np.concatenate(points), np.concatenate(lines)


def reference_of(
    scans: Sequence[Scan], poses: NDArray[np.float64], numbers: Iterable[int], origin: NDArray[np.float64] | None = None
) -> Reference:
    """Return what other scans can be matched to: some scans at their poses, or as seen from `origin`."""
    return Reference(*cloud(scans, poses, numbers, origin))


def thinned(
    points: NDArray[np.float64], lines: NDArray[np.float64], cell: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return one point of each square of `cell` (m), the first, with its normal."""
    squares = np.floor(points / cell).astype(np.int64)
    _, first = np.unique(squares[:, 0] * 1_000_003 + squares[:, 1], return_index=True)
    return points[first], lines[first]
