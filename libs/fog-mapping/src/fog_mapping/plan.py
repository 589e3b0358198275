"""A map made of a drawing: the walls of a floor plan, without its texts, symbols, hatches, door leaves and arcs.

Walls are the thick strokes of a drawing, or the narrow strips between two of its lines; what is thin or lone is none.
Where all is drawn with one pen, straight lines along the axes are walls. The thickness that tells walls from lines is
found in the drawing: the first valley of the histogram of its strokes' thicknesses.

Rows of all grids here go up from the bottom, as those of maps do.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import numpy as np
from scipy import ndimage

from fog_contracts.costs import FREE, LETHAL, UNKNOWN
from fog_contracts.grid import GridGeometry, StaticMap
from fog_mapping.cleaning import wall_angle
from fog_mapping.poses import place

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Mask = NDArray[np.bool_]
    Grey = NDArray[np.float32]

Doors = Literal["open", "closed"]

PIXELS_IN_CELL: Final = 2
"""The drawing is looked at by so many pixels in a cell's side."""
_PAPER: Final = 0.15
_TINT: Final = 0.15
_COLOURLESS: Final = 100
_LEAST_PAPER: Final = 0.55
"""So much of a drawing is hardly darker, or more colourful, than its paper."""
_PAPER_BLOCK: Final = 64
_BLUR_PIXELS: Final = 0.8
_SYMBOL_M: Final = 1.2
"""Strokes that reach less far and touch no others are texts and symbols, unless they are solid."""
_SOLID: Final = 0.75
"""Of the rectangle around a pillar or a stub of wall so much is ink, of a letter less."""
_PILLAR_M: Final = 0.2
_STUB_M: Final = 0.3
_STRIPS_M: Final = 0.15, 0.3, 0.45
_STRIP_LENGTHS: Final = 3.0
"""What lies between two lines, so far apart at most and so many times as long, is the inside of a wall or window."""
_HATCH_M: Final = 0.08
_HATCHED_M: Final = 0.7
"""Strips side by side that are wider together than any wall are a hatch, or stairs."""
_STRAIGHT_M: Final = 0.8
"""No part of a door's arc is so long and straight."""
_LEAST_WALL_M: Final = 0.1
_THICKNESSES: Final = np.geomspace(0.03, 0.8, 42)
"""m; the bins of the histogram of strokes."""
_LEAST_SHARE: Final = 0.1
"""Of the length of all strokes, so much is of walls, or of lines."""
_SURELY_WALL_M: Final = 0.09
_LINE_PIXELS: Final = 2.5
"""A line of one pixel of a scan is up to so many thick."""
_SAMPLES: Final = 8000
_FARTHEST_PIXELS: Final = 24
_DOOR_M: Final = 1.3
_FRAME_M: Final = 0.6
"""A door is so wide at most, in a wall so thick at most."""
_CHINK_M: Final = 0.3
_LEAST_FLOOR_M2: Final = 1.0
_MOST_TURN: Final = math.radians(3.0)
"""A scan lies so far askew at most; a drawing that is turned more is meant to be."""
_MARGIN_CELLS: Final = 10
_ALL_AROUND: Final = np.ones((3, 3), bool)


class PlanError(ValueError):
    """A picture is no plan that a map can be made of; the message says why, and the remedy."""


class Plan(NamedTuple):
    """A plan's map, and what it was made by.

    map: (0, 0) is the lower-left corner of the walls. pose: where the frame of the picture (m, from its lower-left
    corner) lies in that of the map. wall: the least thickness (m) of walls; None where all is drawn with one pen.
    doors: how many were closed. floors: areas (m2) of floors that no way joins, largest first.
    """

    map: StaticMap
    pose: tuple[float, float, float]
    wall: float | None
    doors: int
    floors: tuple[float, ...]


def map_of_plan(
    pixels: NDArray[np.uint8],
    size: float,
    *,
    finest: float = 0.0,
    doors: Doors = "open",
    inside: tuple[float, float] | None = None,
    wall: float | None = None,
) -> Plan:
    """Return the map of a drawing: pixels (height, width, 3; RGB) of `size` (m), of which a cell's side has two.

    finest: the side (m) of a pixel of the picture, where it was finer or coarser: its thinnest lines are no thinner.
    doors: what openings become that are no wider than doors. inside: a place (m, from the picture's lower-left corner)
    on the floor that is kept, without what no way joins to it; None keeps all floors. wall: the least thickness (m) of
    a wall; None finds it in the drawing. Raises `PlanError`.
    """
    dark = _darkness(pixels)
    ink = _inked(dark) > 0.5
    askew = wall_angle(StaticMap(GridGeometry(ink.shape[1], ink.shape[0], size, 0.0, 0.0), np.where(ink, LETHAL, FREE)))
    turn = -askew if 0.5 / max(ink.shape) < abs(askew) <= _MOST_TURN else 0.0
    if turn:
        dark = _turned(dark, turn)
    walls, least = _walls(_inked(dark), size, wall, max(_SURELY_WALL_M, _LINE_PIXELS * finest))
    rows, columns = (np.flatnonzero(walls.any(axis=axis)) for axis in (1, 0))
    if len(rows) < 2 or len(columns) < 2:
        raise PlanError(
            "there are no walls in the picture: no stroke is thick or long enough. Name a picture of a floor's walls, "
            "or say by --wall how thick (m) they are at least"
        )
    gaps, count = _doors(walls, size)
    outside = _outside(walls | gaps, size)
    if doors == "closed":
        walls |= gaps
    corner = (np.array((columns[0], rows[0])) + 0.5 - 0.5 * PIXELS_IN_CELL) * size
    # The picture is turned about its middle.
    middle = 0.5 * np.array(ink.shape[::-1]) * size
    moved = place(np.array((0.0, 0.0, turn)), -middle[None])[0] + middle - corner
    pose = float(moved[0]), float(moved[1]), turn
    labels, sizes = _floors(~walls & ~outside, size)
    if not sizes:
        raise PlanError(
            f"its walls enclose no floor: ways from outside lead everywhere, wider than doors ({_DOOR_M} m). Close the "
            "outline in the picture; where walls were left out, say by --wall how thick (m) they are at least"
        )
    kept = labels > 0 if inside is None else labels == _named(inside, pose, labels, corner, size)
    cells = np.where(walls, LETHAL, np.where(kept, FREE, UNKNOWN)).astype(np.uint8)
    part = cells[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return Plan(
        _on_cells(part, size), pose, least, count if doors == "closed" else 0, tuple(sorted(sizes, reverse=True))
    )


def _darkness(pixels: NDArray[np.uint8]) -> Grey:
    """Return how much darker than the paper around it each pixel is (0..1), row 0 at the bottom."""
    # Of coloured areas the brightest channel is bright, of black ink none; a blueprint is the other way round.
    most, least = pixels[::-1].max(axis=2), pixels[::-1].min(axis=2)
    blueprint = float(np.median(least)) < 0.4 * 255.0
    bright = (255 - least if blueprint else most).astype(np.float32) / 255.0
    # The paper of a scan is not equally bright everywhere.
    height, width = bright.shape
    block = min(_PAPER_BLOCK, height, width)
    whole = bright[: height // block * block, : width // block * block]
    blocks = np.percentile(whole.reshape(height // block, block, width // block, block), 90, axis=(1, 3))
    paper = ndimage.gaussian_filter(np.maximum(blocks, 0.7 * np.percentile(blocks, 90)), 1.0, mode="nearest")
    at = [np.clip((np.arange(length) + 0.5) / block - 0.5, 0.0, None) for length in (height, width)]
    local = ndimage.map_coordinates(paper, np.meshgrid(*at, indexing="ij"), order=1, mode="nearest")
    dark: Grey = np.clip(1.0 - bright / np.maximum(local, 0.05), 0.0, 1.0).astype(np.float32)
    dark = ndimage.gaussian_filter(dark, _BLUR_PIXELS)
    share = float(((dark < _PAPER) & (blueprint | (most - least < _COLOURLESS))).mean())
    if share < _LEAST_PAPER:
        raise PlanError(
            f"the picture is no drawing: only {share:.0%} of it is plain paper, as of a photo. Name a plan of "
            "dark lines on bright paper"
        )
    return dark


def _inked(dark: Grey) -> Grey:
    """Return how much of the ink around it each pixel has (0..1): a half is the edge, also of lines finer than pixels.

    The least darkness of ink is half of N. Otsu's threshold (1979), and more than that of tinted paper.
    """
    counts, edges = np.histogram(dark, 64, (0.0, 1.0))
    middles = 0.5 * (edges[1:] + edges[:-1])
    below, total = np.cumsum(counts), int(counts.sum())
    sums = np.cumsum(counts * middles)
    with np.errstate(divide="ignore", invalid="ignore"):
        between = (sums[-1] * below / total - sums) ** 2 / (below * (total - below))
    least = max(_TINT, 0.5 * float(edges[int(np.argmax(np.nan_to_num(between, posinf=0.0))) + 1]))
    inked: Grey = dark / np.maximum(ndimage.maximum_filter(dark, 5), 2.0 * least)
    return inked


def _turned(dark: Grey, turn: float) -> Grey:
    """Return a picture turned (rad) about its middle; what comes in is paper."""
    cos, sin = math.cos(turn), math.sin(turn)
    back = np.array(((cos, -sin), (sin, cos)))  # of rows and columns
    middle = 0.5 * (np.array(dark.shape) - 1.0)
    turned: Grey = ndimage.affine_transform(dark, back, middle - back @ middle, order=1)
    return turned


def _walls(inked: Grey, size: float, least: float | None, sure: float) -> tuple[Mask, float | None]:
    """Return the walls, and from which thickness (m) on a stroke is one; None where one pen has drawn all."""
    strokes = _without_symbols(inked > 0.5, size)
    # Hatched walls are solid only after their gaps are closed, which would blur the corners of others.
    for gap in (0.0, _HATCH_M / size):
        solid = strokes | _bridged(strokes, gap, 0) | _bridged(strokes, gap, 1) if gap else strokes
        thickness = least if least is not None else _valley(_thicknesses(_soft(inked, solid), solid) * size, sure)
        # A line beside a wall, such as of a dimension, is no side of a hollow one.
        thick = None if thickness is None else _thick(_soft(inked, solid), solid, thickness, size)
        solid = solid | _strips(solid if thick is None else solid & ~_grown(thick, 3.0), size)
        if thickness is None:
            thickness = _valley(_thicknesses(_soft(inked, solid), solid) * size, sure)
        if thickness is not None:
            return _thick(_soft(inked, solid), solid, thickness, size), thickness
    return _straight(strokes, size), None


def _repaired(mask: Mask) -> Mask:
    repaired: Mask = ndimage.binary_closing(np.pad(mask, 1), _ALL_AROUND)[1:-1, 1:-1]
    return repaired


def _soft(inked: Grey, solid: Mask) -> Grey:
    """Return how solid each pixel is (0..1): a half at the edges of strokes, to know them to a part of a pixel."""
    edge = np.where(solid | (inked <= 0.5), inked, np.float32(0.0))
    soft: Grey = np.where(ndimage.binary_erosion(solid), np.float32(1.0), edge)
    return soft


def _without_symbols(ink: Mask, size: float) -> Mask:
    """Return strokes without those that reach less far than walls do, and are no pillars or stubs of walls."""
    labels, count = ndimage.label(ink, _ALL_AROUND)
    kept = np.zeros(count + 1, bool)
    areas = np.bincount(labels.ravel(), minlength=count + 1)
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        short, long = sorted((one.stop - one.start) * size for one in box)
        solid = areas[number] * size**2 >= _SOLID * short * long
        kept[number] = long >= _SYMBOL_M or (solid and (short >= _PILLAR_M or long >= _STUB_M))
    found: Mask = kept[labels]
    return found


def _strips(strokes: Mask, size: float) -> Mask:
    """Return the insides of hollow walls and windows: what is narrow and long between two strokes."""
    left, inside, hatched = strokes.copy(), np.zeros_like(strokes), np.zeros_like(strokes)
    # The narrowest first: a line is a side of its own wall, and not of what lies between this and the furniture.
    for width in _STRIPS_M:
        strip = np.zeros_like(strokes)
        for axis in (0, 1):
            labels, count = ndimage.label(_bridged(left, width / size, axis) & ~strokes & ~inside)
            areas = np.bincount(labels.ravel(), minlength=count + 1)
            long = np.array([0, *(box[1 - axis].stop - box[1 - axis].start for box in ndimage.find_objects(labels))])
            strip |= (long**2 > _STRIP_LENGTHS * areas)[labels]
        # Treads of stairs and the lines of a hatch have such strips between them, too, but side by side.
        hatched |= _opened(left | strip, _HATCHED_M / size)
        strip &= ~hatched
        inside |= strip
        left &= ~hatched & ~_grown(strip, 0.2 / size)
    # Where strips meet is what is no longer than they are wide, but closed all around.
    both = strokes | inside
    meeting = _bridged(both, _STRIPS_M[-1] / size, 0) & _bridged(both, _STRIPS_M[-1] / size, 1)
    return inside | (meeting & ~strokes & ~hatched)


def _bridged(mask: Mask, length: float, axis: int) -> Mask:
    """Return a mask with its gaps of up to a length (pixels) along an axis."""
    return _extreme(_extreme(mask, length, axis, largest=True), length, axis, largest=False)


def _opened(mask: Mask, side: float) -> Mask:
    """Return what squares fill that fit into a mask."""
    return _grown(_shrunk(mask, side), side)


def _shrunk(mask: Mask, side: float) -> Mask:
    return _extreme(_extreme(mask, side, 0, largest=False), side, 1, largest=False)


def _grown(mask: Mask, side: float) -> Mask:
    return _extreme(_extreme(mask, side, 0, largest=True), side, 1, largest=True)


def _extreme(mask: Mask, length: float, axis: int, *, largest: bool) -> Mask:
    """Return a mask grown or shrunk by half a length (pixels) along an axis; beyond its edge is what is at it."""
    run = ndimage.maximum_filter1d if largest else ndimage.minimum_filter1d
    found: Mask = run(mask.view(np.uint8), 2 * round(0.5 * length) + 1, axis=axis, mode="nearest").view(bool)
    return found


def _thicknesses(soft: Grey, solid: Mask) -> NDArray[np.float64]:
    """Return how thick (pixels) strokes are at places along them, to a part of a pixel."""
    core = ndimage.binary_erosion(solid, _ALL_AROUND)
    places = np.argwhere(core | solid & ~ndimage.binary_dilation(core, _ALL_AROUND, iterations=2))
    if not len(places):
        return np.zeros(0)
    rng = np.random.default_rng(0)
    places = places[rng.integers(len(places), size=_SAMPLES)]
    steps = np.arange(0.0, _FARTHEST_PIXELS, 0.25)
    shortest = np.full(len(places), np.inf)
    for angle in np.arange(12) * math.pi / 12.0:
        chord = np.full(len(places), -0.25)
        for along in (steps, -steps):
            at = places[:, :1] + along * math.sin(angle), places[:, 1:] + along * math.cos(angle)
            inked = ndimage.map_coordinates(soft, at, order=1, mode="constant") > 0.5
            inked[:, -1] = False
            chord += 0.25 * np.argmin(inked, axis=1)
        shortest = np.minimum(shortest, chord)
    # A thick stroke has more places in its length.
    shortest = np.maximum(shortest, 0.5)
    return rng.choice(shortest, _SAMPLES, p=(1.0 / shortest) / (1.0 / shortest).sum())


def _valley(found: NDArray[np.float64], sure: float) -> float | None:
    """Return the thickness (m) between that of lines and walls; half of it if all are walls, None if all are lines.

    sure: no lines are so thick.
    """
    if not len(found):
        return None
    counts, edges = np.histogram(np.clip(found, _THICKNESSES[0], _THICKNESSES[-1]), _THICKNESSES)
    share = ndimage.gaussian_filter1d(counts / counts.sum(), 1.0)
    below = np.cumsum(share)
    least = float(np.median(found))
    for i in range(1, len(share) - 1):
        low = 0.5 * min(share[:i].max(), share[i + 1 :].max())
        if share[i] <= min(low, share[i + 1]) and _LEAST_SHARE <= below[i] <= 1.0 - _LEAST_SHARE:
            least = float(np.median(found[found < edges[i]]))
            if least < sure:
                # The middle of the valley, as far as it is about as deep.
                floor = np.flatnonzero(share[i:] > 0.5 * (share[i] + low))[0]
                return float(math.sqrt(edges[i] * edges[i + floor]))
            break
    return 0.5 * least if least >= sure else None


def _thick(soft: Grey, solid: Mask, thickness: float, size: float) -> Mask:
    """Return the strokes that are so thick (m), to a part of a pixel, without the thin ones that join them."""
    # The middle of a line keeps so much of its darkness if it is as thick as two of the Gaussian's standard deviations.
    middles = ndimage.gaussian_filter(soft, 0.5 * thickness / size) > math.erf(math.sqrt(0.5))
    reach = max(1, round(0.5 * thickness / size) + 1)
    grown = ndimage.binary_dilation(middles & solid, _ALL_AROUND, iterations=reach, mask=solid)
    return _repaired(_without_symbols(grown, size))


def _straight(strokes: Mask, size: float) -> Mask:
    """Return the straight lines along the axes, as thick as a thin wall."""
    reach = max(1, math.ceil(0.25 * _LEAST_WALL_M / size))
    grown = ndimage.binary_dilation(strokes, _ALL_AROUND, iterations=reach)
    found: Mask = np.zeros_like(strokes)
    for axis in (0, 1):
        shorter = _extreme(grown, _STRAIGHT_M / size, axis, largest=False)
        found |= _extreme(shorter, _STRAIGHT_M / size, axis, largest=True)
    return found


def _doors(walls: Mask, size: float) -> tuple[Mask, int]:
    """Return the openings in walls along the axes that are no wider than a door, and how many there are."""
    gaps, number = np.zeros_like(walls), 0
    for axis in (0, 1):
        labels, _ = ndimage.label(_bridged(walls, _DOOR_M / size, axis) & ~walls)
        for count, box in enumerate(ndimage.find_objects(labels), start=1):
            across = box[1 - axis]
            if (across.stop - across.start) * size > _FRAME_M:
                continue
            part = labels[box] == count
            if part.mean() < _SOLID or not _leads_through(walls, box, 1 - axis):
                continue
            gaps[box] |= part
            number += 1
    return gaps, number


def _leads_through(walls: Mask, box: tuple[slice, slice], across: int) -> bool:
    """Return whether floor lies on both sides of a rectangle, along an axis."""
    for at in (box[across].start - 1, box[across].stop):
        if not 0 <= at < walls.shape[across]:
            continue
        side = list(box)
        side[across] = slice(at, at + 1)
        if walls[tuple(side)].mean() > 1.0 - _SOLID:
            return False
    return True


def _outside(closed: Mask, size: float) -> Mask:
    """Return what is joined to the edge of a drawing, by ways that are no chinks in a wall."""
    chink = _CHINK_M / size
    pad = math.ceil(chink) + 2
    labels, _ = ndimage.label(_shrunk(~np.pad(closed, pad), chink))
    outside: Mask = _grown(labels == labels[0, 0], chink)[pad:-pad, pad:-pad]
    return outside


def _floors(floor: Mask, size: float) -> tuple[NDArray[np.int32], list[float]]:
    """Return the numbers of floors that no way joins, and the area (m2) of each; what is small is none."""
    labels, count = ndimage.label(floor)
    areas = np.bincount(labels.ravel(), minlength=count + 1) * size**2
    large = areas >= _LEAST_FLOOR_M2
    large[0] = False
    return np.where(large, np.arange(count + 1), 0)[labels], areas[large].tolist()


def _named(
    inside: tuple[float, float],
    pose: tuple[float, float, float],
    labels: NDArray[np.int32],
    corner: NDArray[np.float64],
    size: float,
) -> int:
    """Return the number of the floor at a place (m) of the picture; raises `PlanError`."""
    x, y = place(np.array(pose), np.array((inside,)))[0]
    column, row = (math.floor(value) for value in (np.array((x, y)) + corner) / size)
    if not (0 <= row < labels.shape[0] and 0 <= column < labels.shape[1] and labels[row, column]):
        raise PlanError(
            f"--inside names no floor: at ({x:.2f}, {y:.2f}) m from the lower-left corner of the walls is a wall, or "
            "what no walls enclose. Name a pixel amid the floor, or close the walls in the picture"
        )
    return int(labels[row, column])


def _on_cells(part: NDArray[np.uint8], size: float) -> StaticMap:
    """Return a map of a drawing's pixels, whose first lies at (0, 0), with a margin."""
    # One pixel of each cell: walls keep their thickness wherever they lie between cells.
    cells = part[::PIXELS_IN_CELL, ::PIXELS_IN_CELL]
    cells = np.pad(cells, _MARGIN_CELLS, constant_values=UNKNOWN)
    cell = size * PIXELS_IN_CELL
    corner = -_MARGIN_CELLS * cell
    return StaticMap(GridGeometry(cells.shape[1], cells.shape[0], cell, corner, corner), cells)
