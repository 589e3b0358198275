"""The robot's outline as discs, so that a distance field answers whether it touches anything.

A body touches nothing if each of the discs that cover its outline has its centre farther away from everything than its
radius. Method: decomposition into discs (Ziegler and Stiller 2010, Fast collision checking for intelligent vehicle
motion planning).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import ArrayLike, NDArray

_ROUND_WITHIN_M: Final = 0.003
"""An outline whose corners exceed its inscribed circle by no more than this is treated as a disc."""
_EDGE_RADIUS_M: Final = 0.04
_CORNER_RADIUS_M: Final = 0.025
_EXCESS_M: Final = 0.008
"""How far the discs along an edge stick out of it: fewer discs for a larger excess."""
_SHARP_RAD: Final = math.radians(120.0)
"""Corners with a smaller inner angle get a disc of their own: those of the edges would stick out too far."""


class Body(NamedTuple):
    """A convex outline around the point between the driven wheels; m.

    `inscribed`, `circumscribed`: radii around that point. `discs`: float64 (n, 3), x, y (frame `base`) and radius of
    discs that cover the outline; none for a round body, which is the disc of the circumscribed radius.
    """

    inscribed: float
    circumscribed: float
    discs: NDArray[np.float64]

    @property
    def smallest_disc(self) -> float:
        """Radius (m) of the smallest disc that is compared with the distance field."""
        return float(self.discs[:, 2].min()) if len(self.discs) else self.inscribed


def cover(vertices: ArrayLike) -> Body:
    """Return the body of a convex outline: vertices (n, 2) in m, counter-clockwise, the origin inside.

    Raises ValueError for fewer than three vertices or an origin that isn't inside.
    """
    ring = np.asarray(vertices, dtype=np.float64)
    if ring.ndim != 2 or ring.shape[0] < 3 or ring.shape[1] != 2:
        raise ValueError(f"an outline has shape (n, 2) with at least three vertices, not {ring.shape}")
    edges = np.roll(ring, -1, axis=0) - ring
    lengths = np.hypot(edges[:, 0], edges[:, 1])
    inscribed = float(((ring[:, 0] * edges[:, 1] - ring[:, 1] * edges[:, 0]) / lengths).min())
    circumscribed = float(np.hypot(ring[:, 0], ring[:, 1]).max())
    if not inscribed > 0.0:
        raise ValueError("the point between the wheels must lie inside the outline: give it in the frame `base`")
    if circumscribed - inscribed <= _ROUND_WITHIN_M:
        return Body(circumscribed, circumscribed, np.zeros((0, 3)))
    return Body(inscribed, circumscribed, np.array(list(_discs(ring, edges / lengths[:, None], lengths, inscribed))))


def _discs(
    ring: NDArray[np.float64], along: NDArray[np.float64], lengths: NDArray[np.float64], inscribed: float
) -> Iterator[tuple[float, float, float]]:
    """Yield discs (x, y, radius) over all edges and sharp corners; `along`: the edges' unit vectors."""
    radius = min(_EDGE_RADIUS_M, inscribed)
    excess = min(_EXCESS_M, 0.5 * radius)
    half_chord = math.sqrt(2.0 * radius * excess - excess * excess)
    inner = [
        math.pi - math.acos(min(max(float(along[i - 1] @ along[i]), -1.0), 1.0)) for i in range(len(ring))
    ]  # the angle at each vertex
    for i, (vertex, direction, length) in enumerate(zip(ring, along, lengths, strict=True)):
        inwards = np.array((-direction[1], direction[0]))
        begin, end = (
            min(radius - excess if angle <= _SHARP_RAD else half_chord, 0.5 * float(length))
            for angle in (inner[i], inner[(i + 1) % len(ring)])
        )
        count = max(1, math.ceil((length - begin - end) / (2.0 * half_chord) - 1e-9) + 1)
        for place in np.linspace(begin, length - end, count):
            x, y = vertex + place * direction + (radius - excess) * inwards
            yield float(x), float(y), radius
        if inner[i] <= _SHARP_RAD:
            small = min(_CORNER_RADIUS_M, inscribed)
            bisector = direction - along[i - 1]
            x, y = vertex + small * bisector / np.hypot(*bisector)
            yield float(x), float(y), small
