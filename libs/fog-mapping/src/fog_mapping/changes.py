"""A drive against a map: what is gone, what is new, and what was not seen; and what has stood for several drives.

The drive's scans are matched to each other and drawn as a map of their own, which is laid onto the map; then each scan
is matched to the map's walls. What moves is looked through by most scans that reach it, and is no change.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import msgspec
import numpy as np
from scipy import ndimage

from fog_contracts.costs import FREE, LETHAL, UNKNOWN
from fog_contracts.grid import GridGeometry, Window
from fog_kernels.matching import BeamCounts, Reference
from fog_mapping.alignment import Alignment, align, wall_points
from fog_mapping.building import draw, find_trajectory
from fog_mapping.poses import compose, place

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from fog_contracts.grid import StaticMap
    from fog_mapping.scans import Scan

Kind = Literal["new", "gone"]
Box = tuple[float, float, float, float]

_NEAR_M: Final = 0.15
"""What stands so near to a wall of the map is that wall."""
_GATES: Final = np.array((0.3, 0.3, 0.2, 0.2, 0.12, 0.12))
_STAY: Final = np.diag((100.0, 100.0, 400.0))
_LEAST_SCANS: Final = 3
_LEAST_CELLS: Final = 4
_LOOKED_THROUGH: Final = 0.1
"""A wall at which at most this share of the scans ended is gone."""
_FILLED: Final = 0.9
_LOOKED_AT: Final = 0.5
"""Of the columns or rows of a thing, so many must have a cell that was seen."""
_ALL_AROUND: Final = np.ones((3, 3), bool)


class Change(msgspec.Struct, kw_only=True):
    """Something new or gone: the rectangles (left, bottom, right, top; m) of its cells, and the drives that saw it."""

    kind: Kind
    boxes: list[Box]
    drives: list[str] = []

    @property
    def box(self) -> Box:
        """The rectangle around all of it."""
        left, bottom, right, top = zip(*self.boxes, strict=True)
        return min(left), min(bottom), max(right), max(top)


class Drive(NamedTuple):
    """What a drive showed: its changes, the poses (n, 3) of its scans in the map's frame, and what it saw.

    cells: as a map, (height, width). new, gone: masks. unseen: mask of the map's free cells that no scan reached.
    """

    changes: list[Change]
    poses: NDArray[np.float64]
    alignment: Alignment
    cells: NDArray[np.uint8]
    new: NDArray[np.bool_]
    gone: NDArray[np.bool_]
    unseen: NDArray[np.bool_]


def compare(
    static: StaticMap, scans: Sequence[Scan], on_progress: Callable[[str, float], None] = lambda *_: None
) -> Drive:
    """Return what the scans of a drive show that a map does not, and the other way round.

    Raises `MisfitError` where the drive does not fit the map, and `ValueError` for scans that make no map.
    """
    found = find_trajectory(scans, jobs=os.cpu_count() or 1, on_progress=on_progress)
    geometry = static.geometry
    driven = draw(((pose, scan.points) for pose, scan in zip(found.poses, scans, strict=True)), geometry.resolution)
    alignment = align(driven, static)
    poses = compose(np.broadcast_to(np.array(alignment.pose), found.poses.shape), found.poses)
    walls = Reference(*wall_points(static))
    counts = BeamCounts(geometry.shape, geometry.resolution, geometry.origin_x, geometry.origin_y)
    for i, scan in enumerate(scans):
        pose = tuple(poses[i])
        poses[i] = walls.align(scan.points, scan.normals, pose, pose, _STAY, _GATES).pose
        counts.add(float(poses[i, 0]), float(poses[i, 1]), place(poses[i], scan.points))
    return _judged(static, counts, poses, alignment)


def _judged(static: StaticMap, counts: BeamCounts, poses: NDArray[np.float64], alignment: Alignment) -> Drive:
    cells, geometry = static.cells, static.geometry
    now, seen = counts.cells(), counts.hits + counts.passes
    stands = now == LETHAL

    def far_from(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        if not mask.any():
            return np.ones_like(mask)
        away: NDArray[np.bool_] = ndimage.distance_transform_edt(~mask) * geometry.resolution > _NEAR_M
        return away

    new = (cells == FREE) & stands & (counts.hits >= _LEAST_SCANS) & far_from(cells == LETHAL)
    looked = (counts.passes >= _LEAST_SCANS) & (counts.hits <= _LOOKED_THROUGH * seen)
    gone = (cells == LETHAL) & looked & far_from(stands)
    changes: list[Change] = []
    kinds: tuple[tuple[Kind, NDArray[np.bool_], NDArray[np.bool_]], ...] = (
        ("new", new, now == FREE),
        ("gone", gone, (cells == LETHAL) & ~ndimage.binary_dilation(gone, _ALL_AROUND)),
    )
    for kind, mask, kept in kinds:
        # Cells of one thing may miss each other by one.
        labels, count = ndimage.label(ndimage.binary_dilation(mask, _ALL_AROUND), _ALL_AROUND)
        for number in range(1, count + 1):
            part = mask & (labels == number)
            if part.sum() < _LEAST_CELLS or (kind == "new" and counts.passes[part].sum() > counts.hits[part].sum()):
                mask[part] = False
                continue
            changes.append(Change(kind=kind, boxes=list(_boxes(part, kept, geometry))))
    return Drive(changes, poses, alignment, now, new, gone, (cells == FREE) & (seen == 0))


def _boxes(part: NDArray[np.bool_], kept: NDArray[np.bool_], geometry: GridGeometry) -> Iterator[Box]:
    """Yield rectangles (m) that cover a part and hardly anything to be kept: halves where one holds too much."""
    rows, columns = (np.flatnonzero(part.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return
    window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    height, width = part[window].shape
    if max(height, width) > 2 and kept[window].mean() > 1.0 - _FILLED:
        for half in (0, 1):
            cut = np.zeros_like(part)
            if height > width:
                middle = rows[0] + height // 2
                cut[slice(middle, None) if half else slice(0, middle)] = True
            else:
                middle = columns[0] + width // 2
                cut[:, slice(middle, None) if half else slice(0, middle)] = True
            yield from _boxes(part & cut, kept, geometry)
        return
    bounds = geometry.part(Window(int(columns[0]), int(rows[0]), width, height)).bounds
    left, bottom, right, top = (round(value, 4) for value in bounds)
    yield left, bottom, right, top


class Standing(msgspec.Struct, kw_only=True):
    """What drives have shown of a map, kept from one to the next; `frame`: its cells, drives: hashes of their logs."""

    frame: GridGeometry
    drives: list[str] = []
    changes: list[Change] = []

    def add(self, name: str, drive: Drive) -> bool:
        """Count a drive; False for one that is counted already.

        What it has found again has stood for one more; what it saw, and did not find any more, is forgotten.
        """
        if name in self.drives:
            return False
        self.drives.append(name)
        before, self.changes = self.changes, []
        left = list(drive.changes)
        for change in before:
            again = [one for one in left if one.kind == change.kind and _overlap(one.box, change.box)]
            if again:
                left = [one for one in left if all(one is not other for other in again)]
                boxes = [box for one in again for box in one.boxes]
                self.changes.append(Change(kind=change.kind, boxes=boxes, drives=[*change.drives, name]))
            elif not _was_seen(change, drive, self.frame):
                self.changes.append(change)
        self.changes.extend(Change(kind=one.kind, boxes=one.boxes, drives=[name]) for one in left)
        return True

    def take(self, least: int) -> list[Change]:
        """Return what has stood for so many drives or more, and forget it."""
        taken = [one for one in self.changes if len(one.drives) >= least]
        self.changes = [one for one in self.changes if len(one.drives) < least]
        return taken


def commands_of(changes: Sequence[Change]) -> list[str]:
    """Return the lines of a cleaning file that put changes into the map."""
    words: dict[Kind, str] = {"new": "block", "gone": "erase"}
    return [
        f"{words[one.kind]} {' '.join(f'{value:g}' for value in box)}  # stood for {len(one.drives)} drives"
        for one in changes
        for box in one.boxes
    ]


def _overlap(one: Box, other: Box) -> bool:
    return all(
        one[k] - _NEAR_M < other[k + 2] and other[k] - _NEAR_M < one[k + 2] for k in (0, 1)
    )  # fmt: skip


def _was_seen(change: Change, drive: Drive, geometry: GridGeometry) -> bool:
    """Return whether a drive looked at a change: of a shut door it sees the face only."""
    for box in change.boxes:
        window = geometry.window_around(*box)
        seen = drive.cells[window.rows, window.columns] != UNKNOWN
        if seen.size and max(seen.any(axis=0).mean(), seen.any(axis=1).mean()) > _LOOKED_AT:
            return True
    return False
