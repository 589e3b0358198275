"""A map of a log: its scans put where they were taken, the loops that this rests on, and both as a picture."""

from __future__ import annotations

import itertools
import math
import os
import resource
import time
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from PIL import Image, ImageDraw
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from fog_contracts.costs import FREE, LETHAL
from fog_mapping.building import draw, find_trajectory
from fog_mapping.live import LiveMap
from fog_mapping.loops import grouped
from fog_mapping.poses import between
from fog_mapping.relations import absolute_error, relation_errors
from fog_mapping.scans import keep_moved, scan_of
from fognav.output import WrongUseError, console

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from fog_contracts.grid import StaticMap
    from fog_mapping.loops import LoopGroup
    from fog_mapping.scans import Scan
    from fog_mapping.trajectory import AgainstOdometry
    from fognav_experiments.lidar_logs import Poses
    from fognav_experiments.lidar_logs.logs import LogScan

_FILM_PICTURES: Final = 100
_FILM_MS: Final = 80
_FILM_LAST_MS: Final = 4000
_FILM_PX: Final = 640
"""Width and height of a film at most."""
_FILM_ROBOT_M: Final = 0.17
_GAP_M: Final = 2.0
"""Farther on, little of what a scan shows need be what the one before it showed."""
_NOT_MOVED: Final = 0.5
_TURNED_DEG: Final = 5.0
_ODOMETRY_OFF: Final = 0.1
_COLOURS: Final = {FREE: (255, 255, 255), LETHAL: (0, 0, 0)}
_UNKNOWN_COLOUR: Final = (205, 205, 205)
_WAY_COLOUR: Final = (70, 130, 220)
_KEPT_COLOUR: Final = (30, 150, 60)
_REFUSED_COLOUR: Final = (220, 40, 40)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class MadeMap:
    """A map, the poses (n, 3; m, rad) of the `used` scans, and `reference` (n, 3) if the log has one.

    loops: None if the poses are the reference.
    """

    map: StaticMap
    used: Sequence[LogScan]
    poses: NDArray[np.float64]
    reference: NDArray[np.float64] | None
    loops: list[LoopGroup] | None
    ambiguous: int
    seconds: float
    against: AgainstOdometry | None = None

    def figures(self) -> dict[str, object]:
        """Return what the command prints as JSON, beside the map's own figures."""
        found: dict[str, object] = {
            "scans": len(self.used),
            "loops": [
                {"loop": group.name, "pairs": group.pairs, "kept": group.kept, "score": round(group.score, 3),
                 "residual_m": round(group.residual, 4), "at": [round(value, 2) for value in self._place(group)],
                 "off_reference_m": self._off_reference(group)}
                for group in self.loops or ()
            ],
            "ambiguous": self.ambiguous,
            "gaps": [[round(value, 2) for value in gap] for gap in self._gaps()],
            "breaks": [[round(value, 2) for value in pause] for pause in self._breaks()],
            "lidar_turned_deg": self.against and round(math.degrees(-self.against.turned), 1),
            "odometry_share": self.against and round(self.against.share, 3),
            "seconds": round(self.seconds, 2),
            "rss_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0),
        }  # fmt: skip
        if self.reference is not None:
            errors = relation_errors(self.poses, self.reference)
            found["absolute_error_m"] = round(absolute_error(self.poses, self.reference), 4)
            found["relations"] = {name: error._asdict() for name, error in errors.items()}
            if errors:
                pairs = sum(error.pairs for error in errors.values())
                moved = sum(error.pairs * error.translation_m for error in errors.values())
                turned = sum(error.pairs * error.rotation_deg for error in errors.values())
                found["translation_error_m"], found["rotation_error_deg"] = (
                    round(moved / pairs, 4),
                    round(turned / pairs, 4),
                )
        return found

    def lines(self) -> Iterator[str]:
        """Yield what the command prints: the loops with their evidence, and what could not be joined."""
        for group in self.loops or ():
            x, y = self._place(group)
            verdict = "" if group.kept else ": left out, it contradicts the others"
            yield (
                f"loop {group.name} at ({x:.1f}, {y:.1f}): {group.pairs} matches, score {group.score:.2f}, "
                f"{1000.0 * group.residual:.0f} mm rms{verdict}"
            )
        for before, after, moved in self._gaps():
            yield (
                f"between scans at {before:.1f} s and {after:.1f} s the odometry goes on by {moved:.1f} m: no scan "
                "tells the way: look at the map there, or drive this part again"
            )
        for before, after in self._breaks():
            yield (
                f"from {before:.1f} s to {after:.1f} s the wheels were not heard, or their counters jumped: how the "
                "robot moved meanwhile is a guess, unless a loop spans it: measure the map there, or drive it again"
            )
        yield from self._against()
        if self.loops == []:
            yield "no place was visited twice: nothing confirms the shape of this map. Drive back to where you began"
        if self.ambiguous:
            yield (
                f"{self.ambiguous} pairs of places fit each other in more than one way: they were not joined. Where "
                "the map is doubled, drive this part again with something that stands out, such as a box"
            )

    def _against(self) -> Iterator[str]:
        """Yield what is wrong with the odometry, or with where the lidar looks, by the scans."""
        if self.against is None:
            return
        turned, share = math.degrees(-self.against.turned), self.against.share
        if share < _NOT_MOVED:
            yield (
                f"where the odometry goes 1 m straight on, the scans go {share:.2f} m: this map is wrong. Does the "
                "lidar's picture move while the robot drives? Are the odometry's metres and radians right?"
            )
            return
        if abs(turned) > _TURNED_DEG:
            yield (
                f"the lidar looks {turned:.0f} degrees (counter-clockwise) away from where the log says, by the way "
                "that scans go while the robot drives straight on: correct its yaw, and make the map again"
            )
        if not 1.0 - _ODOMETRY_OFF < share < 1.0 / (1.0 - _ODOMETRY_OFF):
            yield f"the odometry tells {1.0 / share:.2f} m where the scans tell 1 m: calibrate the robot's wheels"

    def draw(self, file: Path) -> None:
        """Draw the map, the way and the loops, each with its name; raises `WrongUseError`."""
        picture = _picture(self.map)
        pen = ImageDraw.Draw(picture)
        places = _pixels(self.map, self.poses)
        pen.line(places, fill=_WAY_COLOUR)
        for group in self.loops or ():
            colour = _KEPT_COLOUR if group.kept else _REFUSED_COLOUR
            pen.line((places[group.first], places[group.second]), fill=colour, width=3)
            pen.text(places[group.first], group.name, fill=colour)
        try:
            picture.save(file)
        except (OSError, ValueError) as error:
            raise WrongUseError(f"the picture can't be written to {file}: {error}. Name another .png") from error

    def film(self, file: Path, range_max: float) -> None:
        """Write a GIF: the map as it grew while the robot drove, without loops, then this one.

        range_max: m, as the map was made with. Raises `WrongUseError`.
        """
        live, moments, way = LiveMap(self.map.geometry.resolution), [], []
        every = max(1, len(self.used) // _FILM_PICTURES)
        for number, one in enumerate(self.used):
            scan = scan_of(number, one.angles, one.ranges, one.odom, range_max, one.stretch)
            if scan is not None and live.add(scan):
                way.append(live.pose)
            if number % every == 0 and (grown := live.map()) is not None:
                moments.append((grown, np.array(way)))
        moments.append((self.map, self.poses))
        # All in the frame of the first scan, whose pose both maps begin with; the picture is as large as the last map.
        left, _, _, top = self.map.geometry.bounds
        cell, size = self.map.geometry.resolution, (self.map.geometry.width, self.map.geometry.height)
        larger = max(1, _FILM_PX // max(size))
        pictures = []
        for grown, at in moments:
            shown = _picture(grown)
            pen, places = ImageDraw.Draw(shown), _pixels(grown, at)
            pen.line(places, fill=_WAY_COLOUR)
            (x, y), r = places[-1], _FILM_ROBOT_M / cell
            pen.ellipse((x - r, y - r, x + r, y + r), fill=_WAY_COLOUR)
            picture = Image.new("RGB", size, _UNKNOWN_COLOUR)
            begins, _, _, ends = grown.geometry.bounds
            picture.paste(shown, (round((begins - left) / cell), round((top - ends) / cell)))
            if larger > 1:
                picture = picture.resize((size[0] * larger, size[1] * larger), Image.Resampling.NEAREST)
            else:
                picture.thumbnail((_FILM_PX, _FILM_PX))
            pictures.append(picture.quantize(16))
        shown_ms = [_FILM_MS] * (len(pictures) - 1) + [_FILM_LAST_MS]
        try:
            pictures[0].save(file, save_all=True, append_images=pictures[1:], duration=shown_ms, loop=0)
        except (OSError, ValueError) as error:
            raise WrongUseError(f"the film can't be written to {file}: {error}. Name another .gif") from error

    def write_trajectory(self, file: Path) -> None:
        """Write a line `stamp x y theta` (s, m, rad) for each used scan; raises `WrongUseError`."""
        rows = (
            f"{scan.stamp:.6f} {x:.4f} {y:.4f} {t:.5f}\n" for scan, (x, y, t) in zip(self.used, self.poses, strict=True)
        )
        try:
            file.write_text("".join(rows), encoding="ascii")
        except OSError as error:
            raise WrongUseError(f"{file} can't be written: {error.strerror}. Name another file") from error

    def _off_reference(self, group: LoopGroup) -> float | None:
        """Return how far (m) the second scan of a loop is, as seen from its first, from where the reference has it."""
        if self.reference is None:
            return None
        ours, theirs = (between(poses[group.first], poses[group.second]) for poses in (self.poses, self.reference))
        return round(float(np.hypot(*(ours - theirs)[:2])), 3)

    def _gaps(self) -> list[tuple[float, float, float]]:
        """Return where scans are missing: the stamps (s) around it, and how far (m) the odometry goes on meanwhile."""
        at = np.array([scan.odom[:2] for scan in self.used], np.float64)
        moved = np.hypot(*np.diff(at, axis=0).T)
        return [
            (self.used[i].stamp, self.used[i + 1].stamp, float(moved[i]))
            for i in np.nonzero(moved > _GAP_M)[0].tolist()
        ]

    def _breaks(self) -> list[tuple[float, float]]:
        """Return the stamps (s) of the scans around each break of the odometry."""
        return [
            (before.stamp, after.stamp)
            for before, after in itertools.pairwise(self.used)
            if before.stretch != after.stretch
        ]

    def _place(self, group: LoopGroup) -> tuple[float, float]:
        x, y, _ = self.poses[group.first]
        return float(x), float(y)


def _picture(made: StaticMap) -> Image.Image:
    pixels = np.full((*made.cells.shape, 3), _UNKNOWN_COLOUR, np.uint8)
    for value, colour in _COLOURS.items():
        pixels[made.cells == value] = colour
    return Image.fromarray(pixels[::-1])


def _pixels(made: StaticMap, poses: NDArray[np.float64]) -> list[tuple[float, float]]:
    """Return where poses are in the map's picture."""
    geometry = made.geometry
    at = (poses[:, :2] - (geometry.origin_x, geometry.origin_y)) / geometry.resolution
    return [(float(x), float(geometry.height - y)) for x, y in at]


def map_log(
    log: Sequence[LogScan], poses: Poses, without: Sequence[str], resolution: float, range_max: float
) -> MadeMap:
    """Return the map of a log's scans, at poses that are found by matching or at the log's reference.

    without: names of loops that are none; resolution: m per cell; range_max: m, beams beyond it are not used. Raises
    `WrongUseError`.
    """
    refused = [_pair(name) for name in without]
    started = time.process_time()
    if poses == "reference":
        return _at_reference(log, resolution, range_max)
    try:
        scans = scans_of(log, range_max)
        if not scans:
            raise WrongUseError(
                f"none of {len(log)} scans shows enough between 0.1 m and {range_max:g} m: are its ranges in metres? "
                "--range-max says up to where they are used"
            )
        place_of = {scan.number: index for index, scan in enumerate(scans)}
        pairs = [(_index(first, place_of), _index(second, place_of)) for first, second in refused]
        with progress_bar() as show:
            found = find_trajectory(scans, jobs=os.cpu_count() or 1, without=pairs, on_progress=show)
        built = draw(((pose, scan.points) for pose, scan in zip(found.poses, scans, strict=True)), resolution)
    except ValueError as error:
        raise WrongUseError(str(error)) from error
    used = [log[scan.number] for scan in scans]
    references = [one.reference for one in used if one.reference is not None]
    return MadeMap(
        map=built, used=used, poses=found.poses,
        reference=np.array(references, np.float64) if len(references) == len(used) else None,
        loops=grouped(found.loops, found.poses, [scan.number for scan in scans]), ambiguous=found.ambiguous,
        seconds=time.process_time() - started, against=found.against,
    )  # fmt: skip


def scans_of(log: Sequence[LogScan], range_max: float) -> list[Scan]:
    """Return the scans of a log between which the robot has moved; raises `ValueError` for odometry that is none."""
    return keep_moved(
        scan
        for number, one in enumerate(log)
        if (scan := scan_of(number, one.angles, one.ranges, one.odom, range_max, one.stretch)) is not None
    )


def _at_reference(log: Sequence[LogScan], resolution: float, range_max: float) -> MadeMap:
    used = [scan for scan in log if scan.reference is not None]
    if not used:
        raise WrongUseError("the log has no reference poses. Leave --poses away: they are found by matching")
    poses = np.array([scan.reference for scan in used], np.float64)
    rays = []
    for pose, scan in zip(poses, used, strict=True):
        near = np.isfinite(scan.ranges) & (scan.ranges <= range_max)
        ranges, angles = scan.ranges[near], scan.angles[near]
        rays.append((pose, np.column_stack((ranges * np.cos(angles), ranges * np.sin(angles)))))
    try:
        built = draw(rays, resolution)
    except ValueError as error:
        raise WrongUseError(str(error)) from error
    return MadeMap(map=built, used=used, poses=poses, reference=None, loops=None, ambiguous=0, seconds=0.0)


def _pair(name: str) -> tuple[int, int]:
    first, _, second = name.partition("-")
    if not (first.isdecimal() and second.isdecimal()):
        raise WrongUseError(f"--without-loop takes the name of a loop in the list, such as 12-834, not {name!r}")
    return int(first), int(second)


def _index(number: int, place_of: dict[int, int]) -> int:
    if number not in place_of:
        raise WrongUseError(
            f"--without-loop: scan {number} is not among those used. Take a name from the list of loops"
        )
    return place_of[number]


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """Yield what shows the progress: as a bar on a terminal, and nowhere else."""
    columns = TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("reading", total=1.0)
        yield lambda what, share: progress.update(task, description=what, completed=share)
