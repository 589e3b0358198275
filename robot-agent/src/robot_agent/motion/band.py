"""The path as an elastic band: near obstacles it gives way to the middle of what is free. Frame: `map`.

Method: elastic bands (Quinlan and Khatib 1993, Elastic bands: connecting path planning and control), reduced to the
force that pushes points out of narrow places; the planner's path gives the rest of the shape.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_kernels.course import beside, distances

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_kernels.clearance import Clearance

_SPACING_M: Final = 0.05
_STEPS: Final = 6
_STEP_M: Final = 0.02
"""Points are pushed in so many steps of at most this length: by 12 cm in all."""
_REACH_M: Final = _STEP_M
"""Half the distance over which the slope of the distances is measured: as far as a step leads. So a step from beside
the middle of a narrow place ends on it. Measured over more, the slope fades before the middle, and the steps end
beside it; over less, they lead across it and back."""


class Course(NamedTuple):
    """A path (n, 2; m) with points (m, 2) every 5 cm, `along` it (m), and how far from everything they are (m)."""

    path: NDArray[np.float64]
    points: NDArray[np.float64]
    along: NDArray[np.float64]
    free: NDArray[np.float64]


def course(path: NDArray[np.float64], around: Clearance) -> Course:
    """Return a path (n, 2; m) with the distances from the nearest thing along it."""
    return Course(path, *beside(path, _SPACING_M, around))


def give_way(original: Course, around: Clearance, keep: float) -> Course:
    """Return the path, its points near things pushed away until they are `keep` m off or in the middle.

    Begin and end stay where they are, and so does everything beyond the window of `around`. It is the `original` one
    if no point is near anything.
    """
    _, points, along, found = original
    if not (found < keep).any():
        return original
    size = len(around.distance) * around.resolution
    corner = np.array((around.origin_x, around.origin_y))
    within = (points > corner + _REACH_M) & (points < corner + size - _REACH_M)
    inside = within[:, 0] & within[:, 1] & (along > 0.0) & (along < along[-1])
    if not (found[inside] < keep).any():
        return original
    # What the window's border cuts off must not become a step in the path.
    moved, free = points[inside], np.minimum(along[-1] - along[inside], along[inside]) / (2.0 * _SPACING_M)
    for _ in range(_STEPS):
        slope = np.column_stack(
            [
                distances(around, moved + offset) - distances(around, moved - offset)
                for offset in ((_REACH_M, 0.0), (0.0, _REACH_M))
            ]
        ) / (2.0 * _REACH_M)
        lacking = np.clip(keep - distances(around, moved), 0.0, _STEP_M)
        moved = moved + slope * (lacking * np.clip(free, 0.0, 1.0))[:, None]
    bent = points.copy()
    bent[inside] = moved
    return course(bent, around)
