"""What the kernels are told of a robot: its outline as discs, the limits of its base, and how its motion is chosen.

A body touches nothing if each of the discs that cover its outline has its centre farther away from everything than its
radius. Method: decomposition into discs (Ziegler and Stiller 2010, Fast collision checking for intelligent vehicle
motion planning).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_kernels import _arrays

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


MAX_STEPS = 200
"""The longest arc, in steps."""


@dataclass(frozen=True, slots=True)
class DwaLimits:
    """Limits of the base: the distance of the wheels (m), the limit of each wheel (m/s), m/s, rad/s, m/s^2, rad/s^2.

    `acc_lateral` (m/s^2) limits v * w, so that the wheels don't slip in a curve. The other defaults are the speeds and
    accelerations of the thesis that Fognav builds on.
    """

    axle: float
    wheel_max: float
    v_max: float = 0.3
    w_max: float = 2.75
    acc_v: float = 2.5
    acc_w: float = 3.2
    acc_lateral: float = 0.4

    def __post_init__(self) -> None:
        for name in ("w_max", "acc_v", "acc_w", "acc_lateral", "wheel_max", "axle"):
            _arrays.positive(getattr(self, name), name)
        if not 0.0 <= self.v_max < math.inf:
            raise ValueError(f"v_max must not be negative, not {self.v_max}")


@dataclass(frozen=True, slots=True)
class DwaSettings:
    """How arcs are sampled, rolled out and scored; lengths in metres, times in seconds.

    `period` is the time until the next decision. Weights: `w_path` per metre of distance from the path, `w_goal` per
    metre to go, `w_heading` per radian between the heading at the arc's end and the path ahead of it, `w_cost` for the
    highest cost on the arc (0..1), `w_turn` per rad/s of change in angular speed. `lookahead` is the distance ahead on
    the path of the point at which the heading aims; heading errors above `turn_in_place` are corrected by turning in
    place. Towards the goal the speed follows sqrt(2 * approach * distance).

    `padding`: the swept footprint comes no nearer than this to anything known. A robot that is nearer already, because
    something moved or the map changed, may drive at up to `escape_v` on arcs on which its clearance never shrinks and
    that regain the padding within 0.3 m; with an `escape_v` of 0 it may not move.
    """

    n_v: int = 25
    n_w: int = 35
    sim_time: float = 1.5
    dt: float = 0.1
    period: float = 0.2
    w_path: float = 2.0
    w_goal: float = 1.0
    w_heading: float = 0.25
    w_cost: float = 0.1
    w_turn: float = 0.01
    lookahead: float = 0.3
    turn_in_place: float = 1.0
    approach: float = 0.15
    goal_tolerance: float = 0.10
    heading_tolerance: float = 0.17
    escape_v: float = 0.1
    padding: float = 0.008

    def __post_init__(self) -> None:
        for name in ("sim_time", "dt", "period", "lookahead", "turn_in_place", "approach", "goal_tolerance", "padding"):
            _arrays.positive(getattr(self, name), name)
        if self.n_v < 2 or self.n_w < 3:
            raise ValueError(f"n_v must be at least 2 and n_w at least 3, not {self.n_v} and {self.n_w}")
        if self.sim_time / self.dt > MAX_STEPS:
            raise ValueError(f"sim_time / dt must not exceed {MAX_STEPS} steps")

    def horizon(self, limits: DwaLimits) -> float:
        """Return how long (s) an arc is rolled out: also long enough to brake before an obstacle at its end."""
        return max(self.sim_time, self.period + limits.v_max / limits.acc_v)


class DwaResult(NamedTuple):
    """The chosen speeds (m/s, rad/s), the score of their arc (higher is better) and the number of admissible arcs.

    With no admissible arc, or at the goal, both speeds are 0; `n_admissible` 0 means that every arc was blocked.
    """

    v: float
    w: float
    score: float
    n_admissible: int


DEFAULT_SETTINGS = DwaSettings()
