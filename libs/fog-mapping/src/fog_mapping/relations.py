"""How far a trajectory is from a reference: by relations between its poses, and by the poses themselves.

Relations (Kümmerle et al. 2009) compare what lies between two poses, so that one wrong turn counts once and not in all
poses after it. Where nobody has checked relations by hand, they are taken from the log's own reference, which is a
SLAM result itself: figures by it are comparable with each other, not with published ones.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_kernels.matching import Reference
from fog_mapping.poses import between, path_lengths

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from fog_mapping.scans import Scan

_LOOP_M: Final = 1.0
"""Two poses are a loop if they are so near to each other, ..."""
_LOOP_WAY_M: Final = 20.0
"""... and the way between them is so long at least."""
_SPACINGS_M: Final = {"1 m": 1.0, "10 m": 10.0}
_AS_THEY_ARE: Final = np.array([0.2])
_FINE: Final = np.array([0.3] * 3 + [0.2] * 4 + [0.12] * 8)
_SAME_M: Final = 0.02
_TOLD: Final = 0.05
"""Along a plain corridor two scans say less than this share of what they say across."""


class RelationErrors(NamedTuple):
    """Errors of the relations between `pairs` of poses: mean and standard deviation (m), mean and largest (degrees)."""

    pairs: int
    translation_m: float
    translation_deviation_m: float
    rotation_deg: float
    rotation_worst_deg: float


def relation_errors(poses: NDArray[np.float64], reference: NDArray[np.float64]) -> dict[str, RelationErrors]:
    """Return the errors of pairs 1 m and 10 m apart along the way, and of loops; those that there are.

    poses, reference: (n, 3), of the same scans.
    """
    found = {}
    for name, (first, second) in _pairs(reference).items():
        if len(first):
            truth = between(reference[first], reference[second])
            error = between(truth, between(poses[first], poses[second]))
            moved, turned = np.hypot(error[:, 0], error[:, 1]), np.degrees(np.abs(error[:, 2]))
            found[name] = RelationErrors(
                len(first), float(moved.mean()), float(moved.std()), float(turned.mean()), float(turned.max())
            )
    return found


class ScansFit(NamedTuple):
    """How two scans 1 m apart lie on each other at the poses of a trajectory.

    residual_m: mean over `pairs` of the rms distance from each other's lines. off_m, off_deg: mean distance from where
    the two lie best by themselves, of pairs that tell it.
    """

    pairs: int
    residual_m: float
    off_m: float
    off_deg: float


def scans_fit(scans: Sequence[Scan], poses: NDArray[np.float64], reference: NDArray[np.float64]) -> list[ScansFit]:
    """Return how scans fit each other at their poses (n, 3), and at those of a reference: which knows better.

    Nothing without pairs 1 m apart.
    """
    firsts, seconds = _pairs(reference)["1 m"]
    rows = []
    for first, second in zip(firsts.tolist(), seconds.tolist(), strict=True):
        lines, scan = Reference(scans[first].points, scans[first].normals), scans[second]
        steps = [between(some[first], some[second]) for some in (poses, reference)]
        here, best = (
            [lines.align(scan.points, scan.normals, (*step,), (*step,), weak * np.eye(3), gates) for step in steps]
            for weak, gates in ((1.0, _AS_THEY_ARE), (1e-3, _FINE))
        )
        least, most = np.linalg.eigvalsh(best[0].information[:2, :2])
        told = least > _TOLD * most and math.dist(best[0].pose[:2], best[1].pose[:2]) < _SAME_M
        off = [between(np.array(best[0].pose), step) for step in steps]
        rows.append([(fit.residual, math.hypot(x, y), abs(t), told) for fit, (x, y, t) in zip(here, off, strict=True)])
    if not rows:
        return []
    found = np.array(rows, np.float64)
    told = found[:, 0, 3] > 0.0
    means = zip(
        found[:, :, 0].mean(axis=0), found[told, :, 1].mean(axis=0), found[told, :, 2].mean(axis=0), strict=True
    )
    return [ScansFit(len(rows), float(res), float(off), math.degrees(turned)) for res, off, turned in means]


def absolute_error(poses: NDArray[np.float64], reference: NDArray[np.float64]) -> float:
    """Return the rms distance (m) of the positions from the reference, moved and turned to fit it best (Horn 1987)."""
    ours, theirs = poses[:, :2] - poses[:, :2].mean(axis=0), reference[:, :2] - reference[:, :2].mean(axis=0)
    turn = math.atan2(
        float((ours[:, 0] * theirs[:, 1] - ours[:, 1] * theirs[:, 0]).sum()), float((ours * theirs).sum())
    )
    cos, sin = math.cos(turn), math.sin(turn)
    turned = np.column_stack((cos * ours[:, 0] - sin * ours[:, 1], sin * ours[:, 0] + cos * ours[:, 1]))
    return float(np.sqrt(((turned - theirs) ** 2).sum(axis=1).mean()))


def _pairs(reference: NDArray[np.float64]) -> dict[str, tuple[NDArray[np.int64], NDArray[np.int64]]]:
    way = path_lengths(reference)
    pairs = {}
    for name, spacing in _SPACINGS_M.items():
        second = np.searchsorted(way, way + spacing)
        first = np.nonzero(second < len(way))[0]
        second = second[first]
        near = way[second] - way[first] < 1.5 * spacing
        pairs[name] = (first[near], second[near])
    firsts: list[int] = []
    seconds: list[int] = []
    for i in range(len(reference)):
        away = np.hypot(*(reference[:, :2] - reference[i, :2]).T)
        again = np.nonzero((away < _LOOP_M) & (way - way[i] > _LOOP_WAY_M))[0]
        if len(again):
            # One pose of each visit: the nearest.
            for visit in np.split(again, np.nonzero(np.diff(again) > 1)[0] + 1):
                firsts.append(i)
                seconds.append(int(visit[np.argmin(away[visit])]))
    pairs["loops"] = (np.array(firsts, np.int64), np.array(seconds, np.int64))
    return pairs
