"""Time until a convex body that moves along an arc first touches one of many points, in closed form.

Seen from the body, a fixed point orbits the body's instantaneous centre of rotation. The body is an intersection of
half-planes; while the point is outside one of them there is no contact, and when it leaves the outside of a half-plane
is an intersection of its orbit with a line. The search goes from one such time to the next, past all half-planes that
the point is still outside of, so it neither steps over a contact nor samples the arc (conservative advancement, as in
Mirtich 1996, with exact times of exit).
"""

# Kernels take arrays and scalars, typed by their compiled signatures.
# ruff: noqa: ANN401, PLR0913

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numba import boolean, float64, int64, njit

from fog_kernels import _arrays

if TYPE_CHECKING:
    from numpy.typing import NDArray

STRAIGHT_RAD_S: Final = 1e-4
"""A slower turning rate counts as none: within a second the body's corners deviate by less than 0.1 mm per metre."""
_TOUCH_M: Final = 1e-9


class ConvexBody(NamedTuple):
    """A convex polygon as an intersection of half-planes: a point p is inside if `normals @ p <= offsets`.

    normals: float64 (m, 2), outward unit normals. offsets: float64 (m,), m. radius: of a circle around the origin that
    contains the body, m. mitre: how far a corner moves when all sides move outwards by 1 m, at most.
    """

    normals: NDArray[np.float64]
    offsets: NDArray[np.float64]
    radius: float
    mitre: float


@njit(
    int64(_arrays.F64_GRID, _arrays.F64_FLAT, float64, float64),
    cache=True,
    nogil=True,
)
def _worst_side(normals: Any, offsets: Any, x: float, y: float) -> int:
    """Return the half-plane that a point is most outside of."""
    worst = -math.inf
    side = 0
    for j in range(offsets.size):
        distance = normals[j, 0] * x + normals[j, 1] * y - offsets[j]
        if distance > worst:
            worst = distance
            side = j
    return side


@njit(
    float64(float64, float64, float64, float64, float64, float64, float64),
    cache=True,
    nogil=True,
)
def _exit_time(nx: float, ny: float, limit: float, x: float, y: float, v: float, w: float) -> float:
    """Return after which time (s) a point at (x, y) with n (x, y) > limit comes down to the limit, or infinity."""
    if w == 0.0:
        approach = nx * v
        return (nx * x + ny * y - limit) / approach if approach > 1e-12 else math.inf
    # The orbit around (0, v / w): n . p = n . centre + radius cos(phase), the phase moving against the body's turn.
    centre_y = v / w
    radius = math.hypot(x, y - centre_y)
    level = limit - ny * centre_y
    if radius < 1e-12 or level <= -radius:
        return math.inf
    cosine = min(level / radius, 1.0)
    phase = math.atan2(y - centre_y, x) - math.atan2(ny, nx)
    if w > 0.0:
        phase = -phase
    phase -= 2.0 * math.pi * math.floor((phase + math.pi) / (2.0 * math.pi))
    return max(0.0, math.acos(cosine) - phase) / abs(w)


@njit(
    boolean(float64, float64, float64, float64, float64, float64),
    cache=True,
    nogil=True,
)
def _is_out_of_reach(x: float, y: float, radius: float, v: float, w: float, horizon: float) -> bool:
    """Whether a circle of `radius` around the origin, which travels along the arc, never comes to the point."""
    if math.hypot(x, y) > radius + abs(v) * horizon:
        return True
    if w == 0.0:
        return abs(y) > radius
    return abs(math.hypot(x, y - v / w) - abs(v / w)) > radius


@njit(
    float64(_arrays.F64_GRID, _arrays.F64_FLAT, float64, float64, float64, float64, float64, float64),
    cache=True,
    nogil=True,
)
def _contact_time(
    normals: Any, offsets: Any, x0: float, y0: float, pad: float, v: float, w: float, before: float
) -> float:
    """Return when (s) the point comes down to `pad` (m) outside the body; `before` (s) or later: not before that."""
    elapsed = 0.0
    x = x0
    y = y0
    # Each pass leaves the outside of a half-plane. Should rounding ever use up the passes, the time is too early.
    for _ in range(4 * offsets.size):
        j = _worst_side(normals, offsets, x, y)
        if normals[j, 0] * x + normals[j, 1] * y - offsets[j] - pad <= _TOUCH_M:
            break
        elapsed += max(_exit_time(normals[j, 0], normals[j, 1], offsets[j] + pad, x, y, v, w), 1e-9)
        if elapsed >= before:
            break
        if w == 0.0:
            x = x0 - v * elapsed
        else:
            cos = math.cos(w * elapsed)
            sin = math.sin(w * elapsed)
            from_centre = y0 - v / w
            x = cos * x0 + sin * from_centre
            y = cos * from_centre - sin * x0 + v / w
    return elapsed


@njit(
    int64(
        _arrays.F64_GRID,
        _arrays.F64_GRID,
        _arrays.F64_FLAT,
        float64,
        float64,
        float64,
        float64,
        float64,
        float64,
        _arrays.F64_OUT,
    ),
    cache=True,
    nogil=True,
)
def _first_contact(
    points: Any,
    normals: Any,
    offsets: Any,
    radius: float,
    margin: float,
    tolerance: float,
    v: float,
    w: float,
    horizon: float,
    out: Any,
) -> int:
    """Return the index of the point that is touched first, -1 for none, and its time (s) in out[0].

    `radius` (m) is that of a circle around the origin that contains the body with its margin.
    """
    first = horizon
    which = -1
    for i in range(points.shape[0]):
        x = points[i, 0]
        y = points[i, 1]
        if _is_out_of_reach(x, y, radius, v, w, horizon):
            continue
        j = _worst_side(normals, offsets, x, y)
        pad = min(margin, normals[j, 0] * x + normals[j, 1] * y - offsets[j] - tolerance)
        time = _contact_time(normals, offsets, x, y, pad, v, w, first)
        if time < first:
            first = time
            which = i
    out[0] = first if which >= 0 else math.inf
    return which


def half_planes(polygon: NDArray[np.float64]) -> ConvexBody:
    """Return a convex polygon (m, 2; m, counter-clockwise) as half-planes.

    Raises ValueError for another shape than (3 or more, 2).
    """
    corners = np.ascontiguousarray(polygon, dtype=np.float64)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
        raise ValueError(f"polygon must have shape (3 or more, 2), not {corners.shape}")
    sides = np.roll(corners, -1, axis=0) - corners
    normals = np.ascontiguousarray(np.column_stack((sides[:, 1], -sides[:, 0])) / np.hypot(*sides.T)[:, None])
    offsets = np.ascontiguousarray((normals * corners).sum(axis=1))
    turns = (normals * np.roll(normals, 1, axis=0)).sum(axis=1)
    mitre = float(np.sqrt(2.0 / (1.0 + turns)).max())
    return ConvexBody(normals, offsets, float(np.hypot(*corners.T).max()), mitre)


def first_contact(
    points: NDArray[np.float64],
    body: ConvexBody,
    v: float,
    w: float,
    *,
    horizon: float,
    margin: float = 0.0,
    tolerance: float = 0.0,
) -> tuple[float, int]:
    """Return when (s) a body that moves at v (m/s) and w (rad/s) first comes to a point, and the point's index.

    points: (n, 2) m in the body's frame now, finite. A point counts as touched `margin` m (not negative) outside the
    body's sides (corners stay sharp, so beyond corners it is farther). One that is nearer already, or inside, must not
    come nearer by more than `tolerance` m.
    (inf, -1) when there is no contact before `horizon` s. Raises ValueError or TypeError for wrong types or shapes.
    """
    _arrays.exact(points, np.float64, 2, "points")
    if points.shape[1] != 2:
        raise ValueError(f"points must have shape (n, 2), not {points.shape}")
    if not (math.isfinite(v) and math.isfinite(w)):
        raise ValueError(f"v and w must be finite, not {v} and {w}")
    rate = float(w) if abs(w) >= STRAIGHT_RAD_S else 0.0
    # tau / |w| times |w| may be a little more than tau.
    if abs(rate) * horizon > math.tau * (1.0 + 1e-9):
        raise ValueError(f"horizon must be at most one turn, {math.tau / abs(rate):.2f} s at {w} rad/s, not {horizon}")
    time = np.empty(1)
    index = _first_contact(
        points,
        body.normals,
        body.offsets,
        body.radius + body.mitre * float(margin),
        float(margin),
        float(tolerance),
        float(v),
        rate,
        _arrays.positive(horizon, "horizon"),
        time,
    )
    return float(time[0]), int(index)
