"""One map laid onto another by matching of their walls, wherever their frames lie; refused where they don't fit."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from scipy import ndimage

from fog_contracts.costs import FREE, LETHAL, UNKNOWN
from fog_contracts.grid import GridGeometry, StaticMap, Window
from fog_contracts.resampling import resampled
from fog_kernels.matching import Excluded, Reference
from fog_mapping.poses import place, rotate
from fog_mapping.scans import thinned

if TYPE_CHECKING:
    from numpy.typing import NDArray

_COARSE_M: Final = 0.15
_TURN_STEP: Final = math.radians(1.0)
_POINTS: Final = 1500
_SPREAD_CELLS: Final = 3
_GATES: Final = np.array([0.5] * 4 + [0.3] * 4 + [0.15] * 6)
_LEAST_SCORE: Final = 0.2
"""A map may show so much less of a floor; to look for less takes minutes, and finds chance."""
LEAST_SHARE: Final = 0.7
"""Of the walls that both maps could see, so many must lie on each other ..."""
_MOST_RESIDUAL_M: Final = 0.075
"""... so well, or by a cell of a coarse map. At random it would be 0.087."""
_ON_WALL_M: Final = 0.15
_LEAST_POINTS: Final = 60
_RIVAL: Final = 0.97
"""Another place that fits by this share of the best leaves it open which is right."""
_ELSEWHERE: Final = 1.0, 0.2
"""m and rad: farther than that is another place."""
_MARGIN_M: Final = 1.0
_IN_PLACE: Final = (0.0, 0.0, 0.0)


class MisfitError(ValueError):
    """Two maps do not fit each other; the message says how far, and the remedy."""


class Alignment(NamedTuple):
    """Where a map's frame lies in another's (x, y in m, theta in rad), and what speaks for it.

    share: of the map's walls that lie on the other's, among those where the other knows what is there. residual: rms
    distance (m) from them.
    """

    pose: tuple[float, float, float]
    share: float
    residual: float


def wall_points(static: StaticMap) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the faces of a map's walls: points (n, 2; m) between free and occupied, and their normals."""
    free = (static.cells == FREE).astype(np.float64)
    # Thin and thick walls alike have their faces where the floor ends.
    faces = (static.cells == LETHAL) & ndimage.binary_dilation(free > 0.0)
    smooth = ndimage.gaussian_filter(free, 1.5)
    rows, columns = np.nonzero(faces)
    slopes = np.column_stack((ndimage.sobel(smooth, 1)[faces], ndimage.sobel(smooth, 0)[faces]))
    lengths = np.hypot(*slopes.T)
    normals = slopes / np.maximum(lengths, 1e-12)[:, None]
    points = static.geometry.centres(np.column_stack((columns, rows)))
    return points + 0.5 * static.geometry.resolution * normals, np.where(lengths[:, None] > 1e-3, normals, 0.0)


def align(static: StaticMap, onto: StaticMap) -> Alignment:
    """Return where the frame of a map lies in that of another, by an exhaustive search and a refinement on lines.

    Raises `MisfitError` for maps that do not fit, or fit in two ways.
    """
    points, lines = wall_points(static)
    walls, wall_lines = wall_points(onto)
    if min(len(points), len(walls)) < _LEAST_POINTS:
        raise MisfitError("one of the maps has hardly any walls. Name maps of rooms")
    centre, middle = points.mean(axis=0), 0.5 * (walls.min(axis=0) + walls.max(axis=0))
    points = points - centre
    half = float(np.hypot(*(np.ptp(walls, axis=0) + np.ptp(points, axis=0)))) / 2.0
    coarse = Reference(walls, wall_lines, _COARSE_M)
    few, _ = thinned(points, lines, _COARSE_M)
    few = np.ascontiguousarray(few[:: max(1, len(few) // _POINTS)])
    found = coarse.search(few, (float(middle[0]), float(middle[1]), 0.0), half, math.pi, _TURN_STEP, _LEAST_SCORE)
    if found is None:
        raise MisfitError(
            "the maps do not fit: nowhere as much as a fifth of the walls lie on each other. "
            "Name maps of the same floor"
        )
    fine = Reference(walls, wall_lines)
    weak = np.diag((1e-3, 1e-3, 1e-3))
    refined = fine.align(points, lines, found.pose, found.pose, weak, _GATES, sigma=0.05)
    x, y, theta = refined.pose
    shift = place(np.array((x, y, theta)), -centre[None])[0]
    pose = float(shift[0]), float(shift[1]), theta
    result = judged(static, onto, pose)
    most = max(_MOST_RESIDUAL_M, static.geometry.resolution, onto.geometry.resolution)
    if result.share < LEAST_SHARE or result.residual > most:
        raise MisfitError(
            f"the maps do not fit: at the best place ({pose[0]:.2f}, {pose[1]:.2f}, {math.degrees(theta):.1f} degrees) "
            f"{result.share:.0%} of the walls lie on each other, {1000 * result.residual:.0f} mm rms; "
            f"{LEAST_SHARE:.0%} and {1000 * most:.0f} mm are needed. Name maps of the same floor"
        )
    rival = coarse.search(
        few, found.pose, half, math.pi, _TURN_STEP, _RIVAL * found.score, Excluded(found.pose, *_ELSEWHERE)
    )
    if rival is not None:
        raise MisfitError(
            f"the maps fit in two ways, turned by {math.degrees(theta):.0f} and {math.degrees(rival.pose[2]):.0f} "
            "degrees, equally well. Record more of the floor, with what stands out"
        )
    return result


def judged(static: StaticMap, onto: StaticMap, pose: tuple[float, float, float]) -> Alignment:
    """Return how well a map lies on another: its walls where the other knows, and the other's where it knows."""
    moved = np.array(pose)
    points, _ = wall_points(static)
    other, _ = wall_points(onto)
    turned = rotate(np.array((0.0, 0.0, -pose[2])), other - moved[:2])
    near = [
        _distances(onto, place(moved, points)),
        _distances(static, turned),
    ]
    away = np.concatenate(near)
    close = away <= _ON_WALL_M
    if not close.any():
        return Alignment(pose, 0.0, math.inf)
    return Alignment(pose, float(close.mean()), float(np.sqrt(np.mean(away[close] ** 2))))


def _distances(static: StaticMap, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far (m) points are from a map's walls, of those near something that the map knows."""
    g = static.geometry
    away = ndimage.distance_transform_edt(static.cells != LETHAL) * g.resolution
    known = ndimage.binary_dilation(static.cells == FREE, iterations=_SPREAD_CELLS)
    away = np.where(known, away, np.nan)
    values: NDArray[np.float64] = g.sample(away, points, math.nan)
    found: NDArray[np.float64] = values[np.isfinite(values)]
    return found


def laid_onto(static: StaticMap, onto: StaticMap, pose: tuple[float, float, float]) -> StaticMap:
    """Return a map in the frame, and on the cells, of another; `pose` is where its frame lies there."""
    g = static.geometry
    corner = place(np.array(pose), np.array(((g.origin_x, g.origin_y),)))[0]
    return resampled(static, pose[2], (float(corner[0]), float(corner[1])), aligned_to=onto.geometry)


def in_frame_of(new: StaticMap, present: StaticMap) -> tuple[StaticMap, Alignment]:
    """Return a map in the frame of the present one, and where its own frame lies there, by matching of the walls.

    One that lies well as it is stays as it is. Raises `MisfitError` for one that fits nowhere, or in two ways.
    """
    found = judged(new, present, _IN_PLACE)
    if found.share >= LEAST_SHARE and found.residual <= present.geometry.resolution:
        return new, found
    found = align(new, present)
    return _trimmed(laid_onto(new, present, found.pose), present), found


def _trimmed(static: StaticMap, present: StaticMap) -> StaticMap:
    """Return a map without what is far from all that it knows, and off the present one.

    One that was turned has wide empty corners.
    """
    rows, columns = np.nonzero(static.cells != UNKNOWN)
    g, margin = static.geometry, math.ceil(_MARGIN_M / static.geometry.resolution)
    x, y, size = int(columns.min()), int(rows.min()), g.resolution
    known = Window(x, y, int(columns.max()) - x + 1, int(rows.max()) - y + 1).grown(margin)
    window = g.clip(known.union(g.window_around(*present.geometry.bounds)))
    origin = g.origin_x + window.x * size, g.origin_y + window.y * size
    return StaticMap(
        GridGeometry(window.width, window.height, size, *origin),
        np.ascontiguousarray(static.cells[window.rows, window.columns]),
    )
