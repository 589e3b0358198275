"""The cells of a blocked area that its sensors show free. Pure.

Only a cell that lies wholly inside one of the outlines is free, and only where these cells leave a strip of the area's
`free_width`: the morphological opening by a disc (Serra 1982). The floor around the area narrows no strip, since the
area says nothing of it; walls do.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import FREE
from fog_contracts.grid import Window

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from fog_contracts.geometry import Point
    from fog_contracts.grid import GridGeometry, StaticMap
    from fog_contracts.shapes import ShapeMask

    Mask = NDArray[np.bool_]

_POINT_M2: Final = 1e-18
"""Square of the length (m) below which an edge is a point."""


def free_cells(area: ShapeMask, outlines: Sequence[Sequence[Point]], width: float, static: StaticMap) -> Mask:
    """Return which cells of the area's window (height, width) are free, given outlines and strip width (m)."""
    geometry = static.geometry
    covered = np.zeros_like(area.mask)
    if area.window.empty:
        return covered
    for outline in outlines:
        covered |= _wholly_inside(outline, area.window, geometry)
    covered &= area.mask
    if not covered.any():
        return covered
    radius = width / 2.0 / geometry.resolution
    margin = 2 * math.floor(radius)
    grown = area.window.grown(margin)
    passable = np.zeros((grown.height, grown.width), dtype=np.bool_)
    on_map = grown.intersection(Window(0, 0, geometry.width, geometry.height))
    top, left = on_map.y - grown.y, on_map.x - grown.x
    floor = static.cells[on_map.rows, on_map.columns] == FREE
    passable[top : top + on_map.height, left : left + on_map.width] = floor
    inner = slice(margin, margin + area.window.height), slice(margin, margin + area.window.width)
    passable[inner] = (passable[inner] & ~area.mask) | covered
    return _opened(passable, radius) & covered


def _wholly_inside(outline: Sequence[Point], window: Window, geometry: GridGeometry) -> Mask:
    """Return the cells whose centre is inside (even-odd rule), half a cell's diagonal from the border or farther."""
    x = geometry.origin_x + (np.arange(window.x, window.x + window.width) + 0.5) * geometry.resolution
    y = geometry.origin_y + (np.arange(window.y, window.y + window.height) + 0.5) * geometry.resolution
    xs, ys = np.meshgrid(x, y)
    inside = np.zeros(xs.shape, dtype=np.bool_)
    nearest = np.full(xs.shape, np.inf)
    ring = [(float(px), float(py)) for px, py in outline]
    for (ax, ay), (bx, by) in zip(ring, [*ring[1:], ring[0]], strict=True):
        dx, dy = bx - ax, by - ay
        squared = dx * dx + dy * dy
        share = np.zeros(xs.shape) if squared < _POINT_M2 else ((xs - ax) * dx + (ys - ay) * dy) / squared
        share = np.clip(share, 0.0, 1.0)
        nearest = np.minimum(nearest, np.hypot(xs - ax - share * dx, ys - ay - share * dy))
        crosses = (ys < ay) != (ys < by)
        # On which side of the edge it is, without a division by what may be next to nothing.
        inside ^= crosses & (((xs - ax) * dy < (ys - ay) * dx) == (dy > 0.0))
    return inside & (nearest >= geometry.resolution * math.sqrt(0.5))


def _opened(mask: Mask, radius: float) -> Mask:
    """Return the cells of all discs (radius in cells) that fit into a mask; of its array without the margin."""
    reach = math.floor(radius)
    steps = range(-reach, reach + 1)
    disc = [(dx, dy) for dx in steps for dy in steps if dx * dx + dy * dy <= radius * radius]
    height, width = mask.shape[0] - 4 * reach, mask.shape[1] - 4 * reach
    fits = np.ones((height + 2 * reach, width + 2 * reach), dtype=np.bool_)
    for dx, dy in disc:
        fits &= mask[reach + dy :, reach + dx :][: fits.shape[0], : fits.shape[1]]
    opened = np.zeros((height, width), dtype=np.bool_)
    for dx, dy in disc:
        opened |= fits[reach + dy :, reach + dx :][:height, :width]
    return opened
