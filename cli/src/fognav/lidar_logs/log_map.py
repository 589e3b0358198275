"""Maps from logs: each beam clears the cells that it passes and marks the one where it ends, at reference poses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import FREE, LETHAL, UNKNOWN
from fog_contracts.grid import GridGeometry, StaticMap
from fognav.output import WrongUseError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from fognav.lidar_logs.logs import LogScan
    from robot_agent.localization.pose import Pose2

_MARGIN_M: Final = 1.0
_OCCUPIED_SHARE: Final = 0.3
"""A cell is occupied if this share of the beams that reached it ended there: walls are grazed by many others."""
_MAX_CELLS: Final = 40_000_000


def build_map(scans: Sequence[LogScan], resolution: float, range_max: float) -> StaticMap:
    """Return the map that the scans show at their reference poses.

    resolution: m per cell; range_max: m, beams beyond it are not used. Raises `WrongUseError` without references.
    """
    ends = [(pose.x, pose.y, points) for pose, points in _rays(scans, range_max)]
    if not ends:
        raise WrongUseError("the log has no reference poses, so no map can be built from it. Use a corrected log")
    everything = np.concatenate([points for _, _, points in ends] + [np.array([(x, y) for x, y, _ in ends])])
    low = np.floor((everything.min(axis=0) - _MARGIN_M) / resolution) * resolution
    width, height = np.ceil((everything.max(axis=0) + _MARGIN_M - low) / resolution).astype(int)
    if width * height > _MAX_CELLS:
        raise WrongUseError(f"the map would have {width} x {height} cells. Choose a coarser --resolution")
    geometry = GridGeometry(int(width), int(height), resolution, float(low[0]), float(low[1]))
    hits, passes = np.zeros(geometry.shape, np.int32), np.zeros(geometry.shape, np.int32)
    for x, y, points in ends:
        _count(geometry, hits, passes, np.array((x, y)), points)
    cells = np.full(geometry.shape, UNKNOWN, np.uint8)
    cells[passes + hits > 0] = FREE
    cells[hits >= np.maximum(1.0, _OCCUPIED_SHARE * (hits + passes))] = LETHAL
    return StaticMap(geometry, cells)


def _rays(scans: Sequence[LogScan], range_max: float) -> Iterator[tuple[Pose2, NDArray[np.float64]]]:
    """Yield each scan's reference pose and where its beams end (n, 2; m, frame of the reference)."""
    for scan in scans:
        if scan.reference is None:
            continue
        used = np.isfinite(scan.ranges) & (scan.ranges <= range_max)
        ranges, angles = scan.ranges[used], scan.angles[used]
        points = np.column_stack((ranges * np.cos(angles), ranges * np.sin(angles)))
        yield scan.reference, scan.reference.transform(points)


def _count(
    geometry: GridGeometry,
    hits: NDArray[np.int32],
    passes: NDArray[np.int32],
    start: NDArray[np.float64],
    ends: NDArray[np.float64],
) -> None:
    """Add one scan's beams: each cell counts once per scan, as hit if any beam ended in it, else as passed."""
    cells, inside = geometry.cells(ends)
    hit = np.unique(cells[inside, 1] * geometry.width + cells[inside, 0])
    lengths = np.hypot(*(ends - start).T)
    steps = np.maximum(1, np.ceil(lengths / (0.5 * geometry.resolution))).astype(int)
    beams = np.repeat(np.arange(len(ends)), steps)
    along = (np.arange(steps.sum()) - np.repeat(np.cumsum(steps) - steps, steps)) / np.repeat(steps, steps)
    # The last cell or so before the end belongs to the wall.
    along = along[keep := (1.0 - along) * lengths[beams] > geometry.resolution]
    beams = beams[keep]
    points = start + along[:, None] * (ends[beams] - start)
    between, within = geometry.cells(points)
    passed = np.unique(between[within, 1] * geometry.width + between[within, 0])
    hits.ravel()[hit] += 1
    passes.ravel()[np.setdiff1d(passed, hit, assume_unique=True)] += 1
