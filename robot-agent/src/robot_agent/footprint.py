"""The robot's footprint, a convex polygon in the frame `base`, and in which directions it must see to drive.

Without numpy: the agent looks at its settings before it loads that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

SECTORS: Final = 72
"""Directions of the lidar, each 5 degrees wide, counter-clockwise from straight behind in `base`."""
TRAVEL_HALF_RAD: Final = 0.70
"""Directions this near to the heading are those of travel: a body of 0.17 m needs 40 degrees 0.26 m ahead."""
BLIND_SHARE: Final = 0.5
"""A robot does not drive where this share of the sectors of travel has no sample."""


Vertex = tuple[float, float]

_VERTICES_MAX: Final = 64
_REACH_MAX_M: Final = 2.0
"""No vertex is farther from the axle's centre: a number in mm or cm is noticed."""
_INSCRIBED_MIN_M: Final = 0.01
_CIRCLE_SIDES: Final = 32


class FootprintError(ValueError):
    """A footprint is refused; the message names the vertex and the remedy."""


@dataclass(frozen=True, slots=True)
class Footprint:
    """A convex polygon around the origin of `base`, which is the point between the driven wheels.

    vertices: (x, y) in m, x forward, y to the left, counter-clockwise, the last one joined to the first.

    Raises:
        FootprintError: when the vertices are no such polygon.

    """

    vertices: tuple[Vertex, ...]

    def __post_init__(self) -> None:
        """Validate the vertices."""
        if not 3 <= len(self.vertices) <= _VERTICES_MAX:
            raise FootprintError(
                f"a footprint has 3 to {_VERTICES_MAX} vertices, not {len(self.vertices)}. Give its outline's corners"
            )
        for number, (x, y) in enumerate(self.vertices, 1):
            if not math.hypot(x, y) <= _REACH_MAX_M:
                raise FootprintError(
                    f"vertex {number} ({x}, {y}) is more than {_REACH_MAX_M:.0f} m from the axle's centre. "
                    "Give metres in the frame `base`"
                )
        self._check_convex()
        if not self.inscribed_radius >= _INSCRIBED_MIN_M:
            raise FootprintError(
                f"the axle's centre (0, 0) is not at least {_INSCRIBED_MIN_M} m inside the footprint. "
                "Give the vertices relative to the point between the driven wheels"
            )

    def _check_convex(self) -> None:
        ring = (*self.vertices, *self.vertices[:2])
        for number, (a, b) in enumerate(pairwise(ring[:-1]), 1):
            if math.dist(a, b) < 1e-6:
                raise FootprintError(f"vertices {number} and {number % len(self.vertices) + 1} are equal. Remove one")
        headings = [math.atan2(b[1] - a[1], b[0] - a[0]) for a, b in pairwise(ring)]
        total = 0.0
        for number, (before, after) in enumerate(pairwise(headings), 1):
            turn = math.remainder(after - before, math.tau)
            if turn < -1e-9:
                raise FootprintError(
                    f"the footprint turns right at vertex {number % len(self.vertices) + 1}. List the vertices "
                    "counter-clockwise, and leave out those in a recess of the outline: a footprint is convex"
                )
            total += turn
        if abs(total - math.tau) > 1e-6:
            raise FootprintError("the footprint crosses itself. List the vertices in order along the outline")

    @classmethod
    def circle(cls, radius: float) -> Footprint:
        """Return a regular polygon that contains the circle of `radius` (m) and exceeds it by 0.5 % at its corners.

        Its inscribed radius is the circle's.
        """
        corner = radius / math.cos(math.pi / _CIRCLE_SIDES)
        angles = [(2 * side + 1) * math.pi / _CIRCLE_SIDES for side in range(_CIRCLE_SIDES)]
        return cls(tuple((corner * math.cos(angle), corner * math.sin(angle)) for angle in angles))

    @property
    def polygon(self) -> NDArray[np.float64]:
        """The vertices as an array, float64 (n, 2)."""
        import numpy as np  # noqa: PLC0415  # settings are checked before it is loaded

        return np.array(self.vertices, dtype=np.float64)

    @property
    def inscribed_radius(self) -> float:
        """Radius (m) of the largest circle around the axle's centre inside the footprint; negative if it is outside."""
        ring = (*self.vertices, self.vertices[0])
        return min((a[0] * b[1] - a[1] * b[0]) / math.dist(a, b) for a, b in pairwise(ring))

    @property
    def circumscribed_radius(self) -> float:
        """Radius (m) of the smallest circle around the axle's centre that contains the footprint."""
        return max(math.hypot(x, y) for x, y in self.vertices)

    def outside_by(self, x: float, y: float) -> float:
        """Return how far (m) the point is beyond the side that it is farthest beyond; inside it is negative."""
        ring = (*self.vertices, self.vertices[0])
        return max(
            ((x - a[0]) * (b[1] - a[1]) - (y - a[1]) * (b[0] - a[0])) / math.dist(a, b) for a, b in pairwise(ring)
        )
