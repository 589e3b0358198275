"""From scans to a map: the trajectory, its loops, the graph that agrees with both, and the grid that all scans show."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_contracts.grid import GridGeometry, StaticMap
from fog_kernels.matching import BeamCounts
from fog_mapping.loops import LoopSearch, Searched
from fog_mapping.pose_graph import solve
from fog_mapping.poses import place
from fog_mapping.trajectory import against_odometry, match_in_order, refuse_mirrored, settle

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

    from fog_mapping.loops import Loop
    from fog_mapping.scans import Scan
    from fog_mapping.trajectory import AgainstOdometry

_CERTAIN_M: Final = (2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 64.0)
"""What is certain to so much (m) is looked for, round by round."""
_MARGIN_M: Final = 1.0
_MAX_CELLS: Final = 40_000_000


class Trajectory(NamedTuple):
    """Poses (n, 3; m, rad) of scans, the first at the origin, and what they rest on.

    loops: those found, with how much each counts in the end (0: it contradicts the rest). ambiguous: pairs of
    stretches that fit at several places, so that none counts. against: how the scans moved against the odometry.
    """

    poses: NDArray[np.float64]
    loops: list[tuple[Loop, float]]
    ambiguous: int
    against: AgainstOdometry | None


def find_trajectory(
    scans: Sequence[Scan],
    *,
    jobs: int = 1,
    without: Sequence[tuple[int, int]] = (),
    on_progress: Callable[[str, float], None] = lambda *_: None,
) -> Trajectory:
    """Return where scans were taken; the same for the same arguments, whatever `jobs` (threads).

    without: pairs of scans (by their place in `scans`) that are no loop. `on_progress` is called
    with what is done now, and the share of it. Raises `ValueError` for fewer than two scans, and for mirrored ones.
    """
    if len(scans) < 2:
        raise ValueError(f"a map needs two scans or more between which the robot has moved, not {len(scans)}")
    refuse_mirrored(scans)
    poses, edges = match_in_order(scans, lambda done: on_progress("matching scans", done / len(scans)))
    against, weights = against_odometry(scans, edges), np.ones(len(edges))
    search = LoopSearch(scans, poses, without, jobs)
    way, found = list(edges), Searched([], [], 0, changed=False)
    for number, most in enumerate(_CERTAIN_M):
        what = f"looking for loops, round {number + 1}"
        found = search.search(poses, edges, weights, most, partial(on_progress, what))
        edges = way + found.edges
        if found.changed:
            poses, weights, _ = solve(poses, edges)
    poses = settle(scans, poses)
    counted = weights[len(way) :].tolist()
    return Trajectory(poses, list(zip(found.loops, counted, strict=True)), found.ambiguous, against)


def draw(rays: Iterable[tuple[NDArray[np.float64], NDArray[np.float64]]], resolution: float) -> StaticMap:
    """Return the map that scans show: their poses (3,), and where their beams end as seen from these (n, 2; m).

    Each scan counts once in a cell. What most scans look through was no wall: people and things that have moved are
    left out. Raises `ValueError` for a map that is too large.
    """
    # Placed twice rather than kept: all points of a long log would take as much memory as its scans.
    taken = list(rays)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for pose, points in taken:
        seen = np.vstack((place(pose, points), pose[:2]))
        low, high = np.minimum(low, seen.min(axis=0)), np.maximum(high, seen.max(axis=0))
    low = np.floor((low - _MARGIN_M) / resolution) * resolution
    width, height = np.ceil((high + _MARGIN_M - low) / resolution).astype(int).tolist()
    if width * height > _MAX_CELLS:
        raise ValueError(
            f"the map would have {width} x {height} cells. Choose a coarser --resolution, if a building of "
            f"{width * resolution:.0f} x {height * resolution:.0f} m is right; else are ranges and odometry in metres?"
        )
    counts = BeamCounts((height, width), resolution, float(low[0]), float(low[1]))
    for pose, points in taken:
        counts.add(float(pose[0]), float(pose[1]), place(pose, points))
    return StaticMap(GridGeometry(width, height, resolution, float(low[0]), float(low[1])), counts.cells())
