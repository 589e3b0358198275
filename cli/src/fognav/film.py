"""A film of the same drive in several setups, side by side: what each robot knows, where it drives, and how far."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from PIL import Image, ImageDraw, ImageFont

from fog_contracts import channels as ch
from fog_contracts.bus import Bus
from fog_contracts.costs import FREE, LETHAL
from fog_contracts.messages import Pose
from fognav_experiments.lockstep import run_lockstep
from fognav_sim.barrier import barrier_across
from fognav_sim.drive.hazard import HazardRequest

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from fog_contracts.handlers import Ids, Moment, Publication
    from fog_contracts.messages import HazardArea, PointXY, ProfileName, RobotPath, SimTruth
    from fog_runtime.site import LoadedSite
    from fognav_experiments.comparison.draws import RouteDraw

FRAME_S: Final = 4.0
"""Simulated time from one picture to the next."""
SHOWN_S: Final = 0.1
"""How long a picture is shown; the last one for much longer."""
_LAST_S: Final = 4.0
_WIDTH_PX: Final = 480
_TITLE_PX: Final = 34
_WORDS: Final[dict[ProfileName, str]] = {
    "default": "on its own: it finds the obstacle by its lidar",
    "full": "told of the obstacle, it plans itself",
    "fog": "Fognav: a sensor on the wall saw the obstacle",
}
_PALETTE: Final = (
    (255, 255, 255), (40, 40, 40), (215, 215, 215), (217, 130, 43), (42, 157, 92), (59, 125, 216), (208, 40, 40),
    (246, 178, 178), (120, 120, 120),
)  # fmt: skip
"""White, walls, unknown, tracks of the setups, obstacle, blocked area, places."""
_WHITE, _WALL, _UNKNOWN, _DEFAULT, _FOG, _FULL, _RED, _PINK, _GREY = range(len(_PALETTE))
_COLOUR: Final[dict[ProfileName, int]] = {"default": _DEFAULT, "full": _FULL, "fog": _FOG}


class UnfinishedDriveError(RuntimeError):
    """A drive that has no end to show; the message says in which setup, and what happened."""


@dataclass
class Recording:
    """One drive as it was seen on the channels: times in s from the goal on, positions in m, frame `map`."""

    setup: ProfileName
    poses: list[tuple[float, PointXY]] = field(default_factory=list)
    paths: list[tuple[float, list[PointXY]]] = field(default_factory=list)
    blocked: list[tuple[float, str, bool]] = field(default_factory=list)
    barrier_at: float = math.inf
    time_s: float = 0.0
    distance_m: float = 0.0


def record(site: LoadedSite, drawn: RouteDraw, setup: ProfileName) -> Recording:
    """Drive a drawn route in lockstep, and keep what the film shows; raises `UnfinishedDriveError`."""
    film, bus, clock = Recording(setup), Bus(site.site.id), [0.0]

    def on_truth(_ids: Ids, truth: SimTruth, at: Moment) -> Sequence[Publication]:
        clock[0] = at.now
        film.poses.append((at.now, (truth.x, truth.y)))
        return ()

    def on_path(_ids: Ids, path: RobotPath, at: Moment) -> Sequence[Publication]:
        film.paths.append((at.now, [(x, y) for x, y in path.points]))
        return ()

    def on_hazard(ids: Ids, area: HazardArea, at: Moment) -> Sequence[Publication]:
        film.blocked.append((at.now, ids["area"], area.hazard.state == "blocked"))
        return ()

    bus.subscribe({ch.SIM_TRUTH: on_truth, ch.HAZARD: on_hazard})
    if setup == "fog":
        bus.subscribe({ch.ROBOT_PATH: on_path})
    origin, goal = (site.site.places[name] for name in (drawn.route.start, drawn.route.goal))
    start = Pose(x=origin.x, y=origin.y, theta=drawn.theta if origin.theta is None else origin.theta)
    hazard = HazardRequest(area=drawn.area, trigger_m=drawn.trigger_m)
    result = run_lockstep(
        site, start, goal, drawn.seed, hazard, watched=setup != "default", profile=setup, bus=bus
    )  # fmt: skip
    if result.time_s is None:
        raise UnfinishedDriveError(f"the robot of setup {setup} did not reach its goal: {result.outcome}")
    film.time_s, film.distance_m = result.time_s, result.distance_m
    began = clock[0] - film.time_s
    appears = (event.time_s for event in result.events if event.description.startswith("barrier appears"))
    film.barrier_at = next(appears, math.inf)
    film.poses = [(t - began, xy) for t, xy in film.poses if t >= began]
    film.paths = [(t - began, points) for t, points in film.paths]
    film.blocked = [(t - began, area, blocked) for t, area, blocked in film.blocked]
    return film


class Film:
    """Draws recordings of the same drive side by side."""

    def __init__(self, site: LoadedSite, drawn: RouteDraw, recordings: Sequence[Recording]) -> None:
        self._recordings = recordings
        self._drawn = drawn
        self._areas = {area.id: area for area in site.site.areas}
        self._ends = [site.site.places[name] for name in (drawn.route.start, drawn.route.goal)]
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
        end = max(recording.time_s for recording in self._recordings)
        times = [number * FRAME_S for number in range(math.ceil(end / FRAME_S) + 1)]
        pictures = [self._picture(time_s) for time_s in times]
        shown = [round(1000 * SHOWN_S)] * (len(pictures) - 1) + [round(1000 * _LAST_S)]
        pictures[0].save(file, save_all=True, append_images=pictures[1:], duration=shown, loop=0, optimize=False)
        return file.stat().st_size

    def _picture(self, time_s: float) -> Image.Image:
        width = _WIDTH_PX * len(self._recordings)
        picture = Image.new("P", (width, self._height + _TITLE_PX), _WHITE)
        picture.putpalette([value for colour in _PALETTE for value in colour])
        for number, recording in enumerate(self._recordings):
            panel = self._panel(recording, min(time_s, recording.time_s))
            picture.paste(panel, (number * _WIDTH_PX, _TITLE_PX))
            self._title(picture, number, recording, time_s)
        return picture

    def _title(self, picture: Image.Image, number: int, recording: Recording, time_s: float) -> None:
        draw, left = ImageDraw.Draw(picture), number * _WIDTH_PX + 8
        done = time_s >= recording.time_s
        now = min(time_s, recording.time_s)
        driven = recording.distance_m if done else _length([xy for t, xy in recording.poses if t <= now])
        draw.text((left, 2), _WORDS[recording.setup], fill=_COLOUR[recording.setup], font=ImageFont.load_default(14))
        mark = "at its goal" if done else "under way"
        draw.text((left, 18), f"{driven:5.0f} m  {now:5.0f} s  {mark}", fill=_WALL, font=ImageFont.load_default(13))

    def _panel(self, recording: Recording, time_s: float) -> Image.Image:
        panel = self._floor.copy()
        draw = ImageDraw.Draw(panel)
        state = {area: blocked for at, area, blocked in recording.blocked if at <= time_s}
        if recording.setup != "default":
            for area in (name for name, blocked in state.items() if blocked):
                draw.polygon([self._pixel(point) for point in self._areas[area].polygon], fill=_PINK)
        if time_s >= recording.barrier_at:
            draw.polygon([self._pixel(point) for point in self._barrier], fill=_RED)
        colour = _COLOUR[recording.setup]
        path = next((points for at, points in reversed(recording.paths) if at <= time_s), [])
        if len(path) > 1 and time_s < recording.time_s:
            draw.line([self._pixel(point) for point in path], fill=_GREY, width=1)
        track = [self._pixel(xy) for at, xy in recording.poses if at <= time_s]
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


def _length(points: Sequence[PointXY]) -> float:
    return sum(math.dist(a, b) for a, b in itertools.pairwise(points))
