"""A film of the same drive in several setups, from its records, and stills of one: what each robot knows and does."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from PIL import Image, ImageDraw, ImageFont

from fog_contracts.costs import FREE, LETHAL
from fognav_experiments.comparison.drives import ALONE, PROFILE_OF_SETUP, ends_of, start_of
from fognav_experiments.figures import COLOURS, write_png
from fognav_experiments.lockstep import ready
from fognav_sim.barrier import barrier_across
from fognav_sim.drive.hazard import HazardRequest

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from matplotlib.axes import Axes

    from fog_contracts.messages import PointXY
    from fog_runtime.configuration.site import LoadedSite
    from fognav_experiments.comparison.drives import RouteDraw, Setup, Timeline
    from fognav_experiments.comparison.records import Record
    from fognav_experiments.lockstep import LockstepDrive

FRAME_S: Final = 4.0
"""Simulated time from one picture to the next."""
SHOWN_S: Final = 0.1
"""How long a picture is shown; the last one for much longer."""
_LAST_S: Final = 4.0
_WIDTH_PX: Final = 480
_TITLE_PX: Final = 34
WORDS: Final[dict[Setup, str]] = {
    "default": "on its own: it finds the obstacle by its lidar",
    "lean": "on its own, at the rates of full",
    "full": "told of the obstacle, it plans itself",
    "fog": "Fognav: a sensor on the wall saw the obstacle",
}
_PALETTE: Final = (
    (255, 255, 255), (40, 40, 40), (215, 215, 215), (217, 130, 43), (42, 157, 92), (59, 125, 216), (208, 40, 40),
    (246, 178, 178), (120, 120, 120),
)  # fmt: skip
"""White, walls, unknown, tracks of the setups, obstacle, blocked area, places."""
_WHITE, _WALL, _UNKNOWN, _DEFAULT, _FOG, _FULL, _RED, _PINK, _GREY = range(len(_PALETTE))
_COLOUR: Final[dict[Setup, int]] = {"default": _DEFAULT, "lean": _DEFAULT, "full": _FULL, "fog": _FOG}


class UnfilmedDriveError(ValueError):
    """A drive that can't be shown; the message says which one, and what to do."""


class _Shown(NamedTuple):
    """A recorded drive, with what was to be seen on it."""

    record: Record
    timeline: Timeline
    time_s: float


def _shown(record: Record) -> _Shown:
    if record.timeline is None or record.time_s is None:
        raise UnfilmedDriveError(
            f"the record {record.name} has nothing to show: its drive never began, or another version made it. Remove "
            "its file, and run the experiment again"
        )
    return _Shown(record, record.timeline, record.time_s)


class Film:
    """Draws records of the same drive side by side."""

    def __init__(self, site: LoadedSite, drawn: RouteDraw, records: Sequence[Record]) -> None:
        """Draw these records of a drawn route; raises `UnfilmedDriveError` for one that shows nothing."""
        self._drives = [_shown(record) for record in records]
        self._drawn = drawn
        self._areas = {area.id: area for area in site.site.areas}
        self._ends = ends_of(site, drawn)
        self._barrier = barrier_across(self._areas[drawn.area], site.site, site.map, drawn.seed).polygon
        self._geometry = site.map.geometry
        self._scale = _WIDTH_PX / (self._geometry.width * self._geometry.resolution)
        self._height = round(self._geometry.height * self._geometry.resolution * self._scale)
        self._floor = self._draw_floor(site)

    def _draw_floor(self, site: LoadedSite) -> Image.Image:
        cells = site.map.cells[::-1]
        shades = Image.new("L", (cells.shape[1], cells.shape[0]))
        known = (cells == LETHAL) * 2 + (cells != FREE) * 1
        shades.putdata([(255, 215, 40, 40)[value] for value in known.ravel()])
        small = shades.resize((_WIDTH_PX, self._height), Image.Resampling.BOX)
        floor = Image.new("P", small.size, _WHITE)
        floor.putpalette([value for colour in _PALETTE for value in colour])
        data = small.tobytes()
        floor.putdata([_WALL if shade < 170 else _UNKNOWN if shade < 240 else _WHITE for shade in data])
        return floor

    def write(self, file: Path) -> int:
        """Write the film as GIF; return its size in bytes."""
        end = max(drive.time_s for drive in self._drives)
        times = [number * FRAME_S for number in range(math.ceil(end / FRAME_S) + 1)]
        pictures = [self._picture(time_s) for time_s in times]
        shown = [round(1000 * SHOWN_S)] * (len(pictures) - 1) + [round(1000 * _LAST_S)]
        pictures[0].save(file, save_all=True, append_images=pictures[1:], duration=shown, loop=0, optimize=False)
        return file.stat().st_size

    def _picture(self, time_s: float) -> Image.Image:
        width = _WIDTH_PX * len(self._drives)
        picture = Image.new("P", (width, self._height + _TITLE_PX), _WHITE)
        picture.putpalette([value for colour in _PALETTE for value in colour])
        for number, drive in enumerate(self._drives):
            picture.paste(self._panel(drive, min(time_s, drive.time_s)), (number * _WIDTH_PX, _TITLE_PX))
            self._title(picture, number, drive, time_s)
        return picture

    def _title(self, picture: Image.Image, number: int, drive: _Shown, time_s: float) -> None:
        draw, left, setup = ImageDraw.Draw(picture), number * _WIDTH_PX + 8, drive.record.setup
        done = time_s >= drive.time_s
        now = min(time_s, drive.time_s)
        driven = drive.record.distance_m if done else _length(drive.timeline, now)
        draw.text((left, 2), WORDS[setup], fill=_COLOUR[setup], font=ImageFont.load_default(14))
        mark = "at its goal" if done else "under way"
        draw.text((left, 18), f"{driven:5.0f} m  {now:5.0f} s  {mark}", fill=_WALL, font=ImageFont.load_default(13))

    def _panel(self, drive: _Shown, time_s: float) -> Image.Image:
        panel, seen = self._floor.copy(), drive.timeline
        draw = ImageDraw.Draw(panel)
        state = {area: blocked for at, area, blocked in seen.areas if at <= time_s}
        if drive.record.setup not in ALONE:
            for area in (name for name, blocked in state.items() if blocked):
                draw.polygon([self._pixel(point) for point in self._areas[area].polygon], fill=_PINK)
        if seen.barrier_at is not None and time_s >= seen.barrier_at:
            draw.polygon([self._pixel(point) for point in self._barrier], fill=_RED)
        colour = _COLOUR[drive.record.setup]
        path = next((points for at, points in reversed(seen.paths) if at <= time_s), [])
        if len(path) > 1 and time_s < drive.time_s:
            draw.line([self._pixel(point) for point in path], fill=_GREY, width=1)
        track = [self._pixel((x, y)) for at, x, y in seen.poses if at <= time_s]
        if len(track) > 1:
            draw.line(track, fill=colour, width=3)
        for place, letter in zip(self._ends, (self._drawn.route.start, self._drawn.route.goal), strict=True):
            x, y = self._pixel((place.x, place.y))
            draw.ellipse((x - 7, y - 7, x + 7, y + 7), fill=_GREY)
            draw.text((x - 4, y - 7), letter.upper()[:1], fill=_WHITE, font=ImageFont.load_default(11))
        if track:
            x, y = track[-1]
            draw.ellipse((x - 5, y - 5, x + 5, y + 5), fill=colour, outline=_WALL)
        return panel

    def _pixel(self, point: PointXY) -> tuple[float, float]:
        g = self._geometry
        return (point[0] - g.origin_x) * self._scale, self._height - (point[1] - g.origin_y) * self._scale


def _length(seen: Timeline, time_s: float) -> float:
    points = [(x, y) for at, x, y in seen.poses if at <= time_s]
    return sum(math.dist(a, b) for a, b in itertools.pairwise(points))


# --- stills, as figures 6.1 and 6.2 of the thesis: what each robot plans by, shortly after the start ------------------


_WAY_M: Final = 500.0


class NoStillError(ValueError):
    """A drive that did not come so far; the message says why."""


def write_stills(site: LoadedSite, drawn: RouteDraw, setups: Sequence[Setup], at_s: float, file: Path) -> None:
    """Drive a drawn route in these setups until `at_s` s after its start, and draw them above one another as PNG.

    Each shows what that robot plans by: costs (the darker, the dearer), path (red), window of its local planner (blue);
    and what is so: the blocked area (pink, where the robot was told) and the obstacle. Raises `NoStillError`.
    """
    figure = Figure(figsize=(9.0, 5.2 * len(setups)), layout="constrained")
    for axes, setup in zip(np.atleast_1d(figure.subplots(len(setups), 1)), setups, strict=True):
        run = ready(
            site, start_of(site, drawn), ends_of(site, drawn)[1], drawn.seed,
            HazardRequest(area=drawn.area, trigger_m=drawn.trigger_m),
            watched=setup not in ALONE, profile=PROFILE_OF_SETUP[setup],
        )  # fmt: skip
        while run.problem is None and run.now < run.started_at + at_s:
            run.step()
        if run.problem is not None:
            raise NoStillError(f"{setup} on run {drawn.run}, route {drawn.route.name}: {run.problem}")
        _draw(axes, run, setup, drawn)
    write_png(figure, file)


def _draw(axes: Axes, run: LockstepDrive, setup: Setup, drawn: RouteDraw) -> None:
    agent, site = run.robot.agent, run.site.site
    replica, path = agent.replica, agent.way(_WAY_M)
    assert replica.geometry is not None
    west, south, east, north = replica.geometry.bounds
    shades = np.where(replica.cost == LETHAL, 255, replica.cost // 2)
    extent = (west, east, south, north)
    axes.imshow(shades, cmap="gray_r", vmin=0, vmax=255, origin="lower", extent=extent, interpolation="nearest")
    corners = next(area.polygon for area in site.areas if area.id == drawn.area)
    if setup not in ALONE and run.hazards.get(drawn.area) == "blocked":
        axes.add_patch(Polygon(corners, facecolor="#f6a0b4", edgecolor="#b03060", alpha=0.6))
    if run.barrier is not None:
        axes.add_patch(Polygon(run.barrier.polygon, facecolor="#d02828", edgecolor="#d02828"))
    if len(path):
        axes.plot(*path.T, color="#d02828", linewidth=1.2)
    x, y, _ = run.world.pose
    half = agent.profile.window
    axes.add_patch(Rectangle((x - half, y - half), 2 * half, 2 * half, facecolor="#3b7dd8", alpha=0.35))
    axes.plot(x, y, "o", color=COLOURS[setup], markersize=5)
    for name in (drawn.route.start, drawn.route.goal):
        if (place := site.places.get(name)) is not None:
            axes.annotate(name.upper(), (place.x, place.y), weight="bold", ha="center", va="center")
    axes.set(title=f"{setup}: {WORDS[setup]}", xlabel="m", ylabel="m")
