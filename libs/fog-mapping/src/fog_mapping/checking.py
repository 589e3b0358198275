"""What a robot would trip over in a map: places that it can't reach, gaps that it can't pass, holes in the walls."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from scipy import ndimage

from fog_contracts.costs import FREE, LETHAL, UNKNOWN

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from fog_contracts.grid import StaticMap

_SPECK_CELLS: Final = 2
"""Fewer returns than a table's leg gives."""
_LEAST_ISLAND_M2: Final = 0.05
_LEAST_REGION_M2: Final = 0.5
"""Smaller nooks are niches, not places where anybody drives to."""
_NAMED: Final = 5
_ALL_AROUND: Final = np.ones((3, 3), bool)


class Finding(NamedTuple):
    """What is wrong with a map: a word for it, a sentence, the remedy, and the places (x, y; m) if it has some."""

    kind: str
    text: str
    remedy: str
    places: Sequence[tuple[float, float]] = ()


def check_cells(static: StaticMap, radius: float) -> Iterator[Finding]:
    """Yield what is wrong with the cells of a map for a robot of `radius` (m)."""
    cells, geometry = static.cells, static.geometry
    for value, name, remedy in (
        (FREE, "free", "Are the thresholds or `negate` wrong?"),
        (LETHAL, "occupied", "Are the thresholds wrong, or was the map drawn without walls?"),
        (UNKNOWN, "unknown", "Is what was never seen drawn as free? Draw it grey (205 of 255)"),
    ):
        if not (cells == value).any():
            yield Finding(f"no-{name}", f"no cell is {name}", remedy)
    free = cells == FREE
    if not free.any():
        return
    # For ways what lies beyond the edge is as solid as a wall, for leaks it is open.
    distance = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] * geometry.resolution
    labels, count = ndimage.label(free)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    main = int(np.argmax(sizes))
    where = _Places(static, distance)
    yield from _leaks(_Places(static, ndimage.distance_transform_edt(free) * geometry.resolution), labels == main)
    yield from _islands(where, labels, sizes, main)
    yield from _narrow(where, labels == main, radius)
    yield from _specks(where, cells)


class _Places:
    """A map's distances (m) from each free cell to what is not free, and names of places."""

    def __init__(self, static: StaticMap, distance: NDArray[np.float64]) -> None:
        self.geometry, self.distance = static.geometry, distance

    def place(self, row: float, column: float) -> tuple[float, float]:
        x, y = self.geometry.centre(round(column), round(row))
        return round(x, 2), round(y, 2)

    def deepest(self, mask: NDArray[np.bool_]) -> tuple[int, int]:
        """Return the cell (row, column) of a mask that is farthest from any wall."""
        row, column = np.unravel_index(int(np.argmax(np.where(mask, self.distance, -1.0))), mask.shape)
        return int(row), int(column)

    def bottleneck(
        self, inside: tuple[int, int], outside: NDArray[np.bool_], among: NDArray[np.bool_]
    ) -> tuple[float, tuple[float, float]]:
        """Return half the width (m) of the widest way from a cell to any of a mask, and its narrowest place.

        By bisection for the distance from walls at which the way is cut.
        """
        low, high = 0.0, float(self.distance[inside])
        while high - low > 0.25 * self.geometry.resolution:
            middle = 0.5 * (low + high)
            labels, _ = ndimage.label(among & (self.distance > middle))
            reached = labels[inside] > 0 and bool((labels[outside] == labels[inside]).any())
            low, high = (middle, high) if reached else (low, middle)
        cut, _ = ndimage.label(among & (self.distance > high))
        near = cut == cut[inside] if cut[inside] else np.zeros_like(among)
        near[inside] = True
        joined, _ = ndimage.label(among & (self.distance > low))
        rim = (joined == joined[inside]) & (self.distance <= high) & ndimage.binary_dilation(near, iterations=2)
        if not rim.any():
            rim = near
        # Of all places where the two parts could meet, the one from which the other is least far.
        beyond = ndimage.distance_transform_edt(~((joined == joined[inside]) & ~near & ~rim | outside))
        row, column = np.unravel_index(int(np.argmin(np.where(rim, beyond, np.inf))), rim.shape)
        return low, self.place(float(row), float(column))


def _leaks(where: _Places, main: NDArray[np.bool_]) -> Iterator[Finding]:
    border = np.zeros_like(main)
    border[[0, -1]] = border[:, [0, -1]] = True
    leaking = main & border
    if not leaking.any():
        return
    inner = main & (ndimage.distance_transform_edt(~leaking) * where.geometry.resolution > 1.0)
    if not inner.any():
        inner = main
    half, place = where.bottleneck(where.deepest(inner), leaking, main)
    yield Finding(
        "leak",
        f"free floor reaches the map's edge, through an opening of about {2.0 * half:.2f} m",
        "Close it: fognav map clean MAP.yaml wall ...; or is `negate` wrong?",
        [place],
    )


def _islands(where: _Places, labels: NDArray[np.int32], sizes: NDArray[np.int64], main: int) -> Iterator[Finding]:
    cell = where.geometry.resolution**2
    others = [int(k) for k in np.argsort(-sizes, kind="stable") if k != main and sizes[k] * cell >= _LEAST_ISLAND_M2]
    if others:
        boxes = ndimage.find_objects(labels)
        places = []
        for number in others[:_NAMED]:
            rows, columns = boxes[number - 1]
            inside = np.argwhere(labels[rows, columns] == number)
            row, column = inside[len(inside) // 2]
            places.append(where.place(rows.start + row, columns.start + column))
        area = sum(int(sizes[number]) for number in others) * cell
        yield Finding(
            "island",
            f"{len(others)} free islands ({area:.1f} m2) are joined to the rest by no free floor",
            "Open the way (fognav map clean MAP.yaml free ...), or leave all out: fognav map clean MAP.yaml islands",
            places,
        )


def _narrow(where: _Places, main: NDArray[np.bool_], radius: float) -> Iterator[Finding]:
    cell = where.geometry.resolution**2
    labels, count = ndimage.label(main & (where.distance > radius))
    if not count:
        yield Finding("narrow", f"a robot of {radius:g} m radius stands nowhere", "Is `resolution` or --radius wrong?")
        return
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    largest = int(np.argmax(sizes))
    rest = [int(k) for k in np.argsort(-sizes, kind="stable") if k != largest and sizes[k] * cell >= _LEAST_REGION_M2]
    reachable = labels == largest
    for number in rest[:_NAMED]:
        half, place = where.bottleneck(where.deepest(labels == number), reachable, main)
        yield Finding(
            "narrow",
            f"{sizes[number] * cell:.1f} m2 lie behind an opening of about {2.0 * half:.2f} m, narrower than the "
            f"robot ({2.0 * radius:.2f} m)",
            "Is it as narrow as that? Else erase what stands in it; a robot will not go there",
            [place],
        )
    if len(rest) > _NAMED:
        yield Finding("narrow", f"{len(rest) - _NAMED} more places lie behind such openings", "Remedy these first")


def _specks(where: _Places, cells: NDArray[np.uint8]) -> Iterator[Finding]:
    labels, lone = _labelled_specks(cells)
    if lone:
        centres = ndimage.center_of_mass(np.ones_like(labels), labels, lone[:_NAMED])
        yield Finding(
            "speckles",
            f"{len(lone)} specks of {_SPECK_CELLS} cells or fewer stand on free floor",
            "Are they people or noise? Erase all: fognav map clean MAP.yaml speckles",
            [where.place(row, column) for row, column in centres],
        )


def _labelled_specks(cells: NDArray[np.uint8]) -> tuple[NDArray[np.int32], list[int]]:
    """Return labels of what is occupied, and those of the specks."""
    labels, count = ndimage.label(cells == LETHAL, _ALL_AROUND)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    small = np.flatnonzero(sizes <= _SPECK_CELLS)
    small = small[small > 0]
    if not len(small):
        return labels, []
    # Only what stands amid free floor: dots between unknown cells are in nobody's way.
    unfree = ndimage.maximum_filter((cells == UNKNOWN).astype(np.uint8), 3)
    return labels, small[ndimage.maximum(unfree, labels, small) == 0].tolist()


def specks(cells: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return where a map's specks are: single occupied cells or pairs amid free floor."""
    labels, lone = _labelled_specks(cells)
    return np.isin(labels, lone)


def islands(cells: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return where a map's free floor is that no free floor joins to the largest part."""
    labels, _ = ndimage.label(cells == FREE)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    outside: NDArray[np.bool_] = (labels > 0) & (labels != int(np.argmax(sizes)))
    return outside


def odd_resolution(resolution: float) -> str | None:
    """Return what is odd about a resolution (m per cell), or None."""
    if not 0.01 <= resolution <= 0.25:
        return f"{resolution:g} m per cell is {'finer' if resolution < 0.01 else 'coarser'} than robots can use"
    if not math.isclose(resolution * 1000.0, round(resolution * 1000.0), abs_tol=1e-6):
        return f"{resolution!r} m per cell is no whole number of millimetres"
    return None
