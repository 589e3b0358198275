"""`fognav map from-plan`: drawings become maps of their walls, and what is no drawing is refused with the remedy."""

import json
import math
import tomllib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageDraw, ImageFont
from scipy import ndimage
from small_floors import OFFICE, ROOMS, floor
from typer.testing import CliRunner

from fog_contracts.costs import FREE, LETHAL, UNKNOWN
from fog_contracts.grid import StaticMap
from fog_contracts.resampling import resampled
from fog_mapping.poses import between, place
from fog_runtime.configuration.maps import load_map, read_provenance, save_map
from fognav.__main__ import app

ESTIG = Path(__file__).parents[2] / "sites" / "estig"
PEN_M = 0.035


def run(*arguments: object):
    return CliRunner().invoke(app, ["map", *map(str, arguments)])


class Drawing:
    """A plan of a map: its walls solid or as outlines, and lines, arcs and texts by a thin pen, in metres."""

    def __init__(self, static: StaticMap, scale: float, *, hollow: bool = False) -> None:
        g = static.geometry
        self.geometry, self.scale, self.pen = g, scale, max(1, round(PEN_M * scale))
        size = round(g.width * g.resolution * scale), round(g.height * g.resolution * scale)
        walls = Image.fromarray(np.where(static.cells[::-1] == LETHAL, 0, 255).astype(np.uint8))
        self.picture = walls.resize(size, Image.Resampling.NEAREST if hollow else Image.Resampling.BILINEAR)
        if hollow:
            solid = np.asarray(self.picture) == 0
            inner = ndimage.binary_erosion(solid, np.ones((3, 3), bool), iterations=self.pen)
            pillars = ndimage.binary_opening(solid, np.ones((round(0.25 * scale),) * 2, bool))
            self.picture = Image.fromarray(np.where(solid & (pillars | ~inner), 0, 255).astype(np.uint8))
        self.draw = ImageDraw.Draw(self.picture)
        self.font = ImageFont.load_default(size=max(10.0, 0.5 * scale))

    def at(self, x: float, y: float) -> tuple[float, float]:
        g = self.geometry
        return (x - g.origin_x) * self.scale, self.picture.height - (y - g.origin_y) * self.scale

    def line(self, *points: tuple[float, float]) -> None:
        self.draw.line([self.at(*point) for point in points], fill=0, width=self.pen)

    def text(self, x: float, y: float, words: str) -> None:
        self.draw.text(self.at(x, y), words, fill=0, font=self.font, anchor="mm")

    def door(self, x: float, y: float, width: float, along: float, side: float = 1.0) -> None:
        """A leaf from its hinge, at a right angle to the wall, and its arc; `along` is the wall's angle (rad)."""
        angles = along + side * np.linspace(0.0, math.pi / 2.0, 24)
        self.line((x, y), *((x + width * math.cos(angle), y + width * math.sin(angle)) for angle in angles[::-1]))

    def scanned(self, noise: float, degrees: float) -> None:
        """Lay it askew on a scanner with grey paper, a shadow, noise and dust."""
        turned = np.asarray(self.picture.rotate(degrees, Image.Resampling.BICUBIC, fillcolor=255), float)
        rng = np.random.default_rng(7)
        shade = 235.0 - 20.0 * np.linspace(0.0, 1.0, turned.shape[1])
        seen = shade * (0.1 + 0.9 * turned / 255.0) + 255.0 * noise * rng.standard_normal(turned.shape)
        seen[rng.random(turned.shape) < 0.001] = 30.0
        self.picture = Image.fromarray(np.clip(seen, 0.0, 255.0).astype(np.uint8))

    def hatch(self, left: float, bottom: float, right: float, top: float, step: float) -> None:
        for x in np.arange(left, right, step):
            self.line((x, bottom), (x, top))
        self.line((left, bottom), (right, bottom), (right, top), (left, top), (left, bottom))

    def map(self, file: Path, *options: object) -> dict:
        self.picture.save(file)
        points = "--points", "10,20", f"{10.0 + 10.0 * self.scale},20", "--metres", 10.0
        result = run("from-plan", file, *points, "--json", *options)
        assert result.exit_code == 0, result.output
        return json.loads(result.stdout)


def plan_of_estig(scale: float, *, hollow: bool) -> tuple[StaticMap, Drawing]:
    static = load_map(ESTIG / "map.yaml")
    drawing = Drawing(static, scale, hollow=hollow)
    description = tomllib.loads((ESTIG / "floor.toml").read_text())
    width = description["doors"]["width"]
    for corridor in description["corridors"]:
        (x0, y0), (x1, y1) = corridor["from"], corridor["to"]
        along = math.atan2(y1 - y0, x1 - x0)
        cos, sin = math.cos(along), math.sin(along)
        for side, key in ((1.0, "doors_left"), (-1.0, "doors_right")):
            for number, distance in enumerate(corridor.get(key, [])):
                ahead, left = distance - width / 2.0, side * corridor["width"] / 2.0
                x, y = x0 + ahead * cos - left * sin, y0 + ahead * sin + left * cos
                drawing.door(x, y, width, along, -side)
                drawing.text(x - 2.0 * side * sin, y + 2.0 * side * cos, f"R {number:03}")
        drawing.text((x0 + x1) / 2.0, (y0 + y1) / 2.0, f"Corridor {corridor['id']}")
    return static, drawing


def near(static: StaticMap, points: np.ndarray) -> float:
    """Return the share of points that lie within 5 cm of a map's walls, a cell's half diagonal beside."""
    away = ndimage.distance_transform_edt(static.cells != LETHAL) * static.geometry.resolution
    return float((static.geometry.sample(away, points, math.inf) <= 0.05 + 1e-6).mean())


def faces(static: StaticMap) -> np.ndarray:
    """Return the centres of the wall cells that floor lies beside."""
    found = (static.cells == LETHAL) & ndimage.binary_dilation(static.cells == FREE)
    return static.geometry.centres(np.argwhere(found)[:, ::-1])


@pytest.mark.drive
@pytest.mark.parametrize(
    ("scale", "hollow", "noise", "degrees"),
    [(20.0, False, 0.05, 1.0), (45.0, False, 0.04, -0.8), (40.0, True, 0.03, 1.0)],
    ids=["coarse scan", "fine scan", "hollow walls"],
)
def test_walls_of_the_plan_of_estig_are_right_to_5_cm(tmp_path, scale, hollow, noise, degrees):
    static, drawing = plan_of_estig(scale, hollow=hollow)
    drawing.scanned(noise, degrees)
    said = drawing.map(tmp_path / "plan.png")
    made = load_map(tmp_path / "plan.yaml")
    g = static.geometry
    # From the site's frame to that of the picture, which the scanner turned about its middle, to that of the map.
    middle = 0.5 * np.array((g.width, g.height)) * g.resolution
    turn = math.radians(degrees)
    shift = place(np.array((0.0, 0.0, turn)), np.array(((g.origin_x, g.origin_y),)) * -1.0 - middle)[0] + middle
    pose = place(np.array(said["picture_pose"]), shift[None])[0]
    there = np.array((*pose, said["picture_pose"][2] + turn))
    assert near(made, place(there, faces(static))) >= 0.95
    assert near(static, place(between(there, np.zeros(3)), faces(made))) >= 0.95
    free = static.geometry.centres(np.argwhere(static.cells == FREE)[:, ::-1])
    assert (made.geometry.sample(made.cells, place(there, free), UNKNOWN) == FREE).mean() > 0.98
    outside = place(there, np.array(((-0.6, 20.0), (50.0, -0.6), (100.6, 30.0), (50.0, 55.6))))
    assert (made.geometry.sample(made.cells, outside, UNKNOWN) == UNKNOWN).all()


def office(*, hollow: bool = True) -> Drawing:
    """The plan of two rooms beside a corridor, with all that a plan has: doors, hatches, dimensions, a sofa."""
    drawing = Drawing(OFFICE, 50.0, hollow=hollow)
    drawing.door(9.0, 3.2, 1.0, 0.0)
    drawing.door(5.0, 3.2, 1.0, 0.0)
    drawing.hatch(10.5, 6.0, 12.5, 8.6, 0.12)
    drawing.line((1.0, 0.0), (14.0, 0.0))
    for x, words in ((1.0, ""), (14.0, ""), (7.5, "13.00")):
        drawing.line((x, -0.15), (x, 0.15))
        drawing.text(x, 0.3, words)
    drawing.line((4.6, 4.8), (6.4, 4.8), (6.4, 5.4), (4.6, 5.4), (4.6, 4.8))
    drawing.text(5.5, 4.4, "Office 12")
    drawing.text(10.5, 5.0, "Meeting")
    return drawing


def value(file: Path, drawing: Drawing, said: dict, *points: tuple[float, float]) -> list[int]:
    static = load_map(file)
    pixels = np.array(points) - (drawing.geometry.origin_x, drawing.geometry.origin_y)
    found = place(np.array(said["picture_pose"]), pixels)
    return static.geometry.sample(static.cells, found, UNKNOWN).tolist()


@pytest.mark.parametrize("hollow", [True, False])
def test_walls_of_a_drawing_are_kept_and_its_symbols_are_not(tmp_path, hollow):
    drawing = office(hollow=hollow)
    said = drawing.map(tmp_path / "plan.png")
    assert len(said["floors_m2"]) == 1
    made = tmp_path / "plan.yaml"
    walls = (0.9, 5.0), (7.1, 5.0), (7.9, 8.0), (4.5, 3.1), (14.1, 2.0), (8.9, 3.5)
    assert value(made, drawing, said, *walls) == [LETHAL] * len(walls)
    floors = (2.0, 8.0), (5.5, 3.1), (9.5, 3.1), (11.5, 7.0), (5.5, 4.8), (6.4, 5.0), (9.2, 3.8), (5.6, 4.4), (9.7, 3.9)
    assert value(made, drawing, said, *floors) == [FREE] * len(floors)
    outside = (7.5, 0.0), (0.3, 5.0), (7.5, 5.0)
    assert value(made, drawing, said, *outside) == [UNKNOWN] * len(outside)
    origin = read_provenance(made)
    assert (origin["metres"], origin["points"], origin["sources"][0]["file"]) == (
        10.0,
        [[10, 20], [510, 20]],
        "plan.png",
    )
    assert run("check", made).stdout == "nothing found\n"


def test_rooms_behind_closed_doors_are_dropped_where_one_floor_is_named(tmp_path):
    drawing = office()
    x, y = drawing.at(2.0, 2.0)
    said = drawing.map(tmp_path / "plan.png", "--doors", "closed", "--inside", f"{x},{y}", "--out", tmp_path / "closed")
    assert (said["doors_closed"], len(said["floors_m2"])) == (1, 2)
    made = tmp_path / "closed.yaml"
    # What leads to the other room is a passage, deeper than a wall.
    assert value(made, drawing, said, (2.0, 8.0), (5.5, 5.0), (11.0, 5.0)) == [FREE, UNKNOWN, FREE]
    assert value(made, drawing, said, (5.5, 3.1), (9.5, 3.1)) == [LETHAL, FREE]


def test_plan_by_one_pen_keeps_its_straight_lines(tmp_path):
    drawing = Drawing(floor(), 50.0)
    for corners in (((1, 1), (14, 1), (14, 9), (1, 9), (1, 1)), ((8, 1), (8, 4)), ((8, 5), (8, 9))):
        drawing.line(*corners)
    drawing.door(8.0, 4.0, 1.0, math.pi / 2.0)
    drawing.text(4.0, 5.0, "Hall")
    said = drawing.map(tmp_path / "plan.png")
    assert said["wall_m"] is None
    points = (1.0, 5.0), (8.0, 3.0), (8.0, 4.5), (4.0, 5.0), (7.3, 4.7)
    assert value(tmp_path / "plan.yaml", drawing, said, *points) == [LETHAL, LETHAL, FREE, FREE, FREE]


def test_recorded_map_is_laid_onto_the_map_of_a_plan(tmp_path):
    drawing = office(hollow=False)
    said = drawing.map(tmp_path / "plan.png")
    save_map(tmp_path / "drive", resampled(floor(*ROOMS, boxes=((11, 1, 12, 1.2),)), 0.4, (-20.0, 7.0)))
    done = run("clean", tmp_path / "drive.yaml", "--onto", tmp_path / "plan.yaml", "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["alignment"]["residual"] < 0.05
    points = (0.9, 5.0), (11.5, 1.1), (11.5, 2.0)
    assert value(tmp_path / "drive-clean.yaml", drawing, said, *points) == [LETHAL, LETHAL, FREE]
    both = run(
        "clean", tmp_path / "drive.yaml", "--onto", tmp_path / "plan.yaml", "--commands", tmp_path / "plan.clean"
    )
    assert both.exit_code == 2


def photo() -> Image.Image:
    rng = np.random.default_rng(3)
    coarse = rng.integers(0, 255, (12, 16, 3)).astype(np.uint8)
    return Image.fromarray(coarse).resize((640, 480), Image.Resampling.BICUBIC)


@pytest.mark.parametrize(
    ("picture", "options", "message"),
    [
        (None, [], "--points is missing"),
        (None, ["--points", "10,20", "--metres", "5"], "'--metres' is no point"),
        (None, ["--points", "10,20", "10,20", "--metres", "5"], "both are the same pixel"),
        (None, ["--points", "10,20", "900,20"], "lies outside of the picture, which has 640 x 480 pixels"),
        (None, ["--points", "10,20", "110,20"], "--metres is missing"),
        (None, ["--points", "10,20", "110,20", "--metres", "0"], "--metres 0 is no distance"),
        (None, ["--points", "10,20", "110,20", "--metres", "100"], "a metre of the plan has 1 pixels"),
        (None, ["--points", "10,20", "110,20", "--metres", "5"], "there are no walls in the picture"),
        (photo, ["--points", "10,20", "110,20", "--metres", "5"], "the picture is no drawing"),
        (b"%PDF-1.7", ["--points", "10,20", "110,20", "--metres", "5"], "Export the plan as PNG"),
    ],
)
def test_what_is_no_plan_or_no_scale_is_refused_with_the_remedy(tmp_path, picture, options, message):
    file = tmp_path / "plan.png"
    if isinstance(picture, bytes):
        file.write_bytes(picture)
    else:
        (photo() if picture else Image.new("L", (640, 480), 255)).save(file)
    result = run("from-plan", file, *options)
    assert result.exit_code == 2
    assert message in result.output
    assert list(tmp_path.iterdir()) == [file]


def test_plan_whose_outline_is_open_and_a_plan_named_as_the_map_are_refused(tmp_path):
    drawing = Drawing(floor(), 50.0)
    drawing.draw.line([drawing.at(1, 1), drawing.at(14, 1), drawing.at(14, 9)], fill=0, width=10)
    drawing.picture.save(tmp_path / "plan.pgm")
    words = "--points", "10,20", "510,20", "--metres", "10"
    replaced = run("from-plan", tmp_path / "plan.pgm", *words)
    assert (replaced.exit_code, "would replace the plan" in replaced.output) == (2, True)
    opened = run("from-plan", tmp_path / "plan.pgm", *words, "--out", tmp_path / "floor")
    assert (opened.exit_code, "its walls enclose no floor" in opened.output) == (2, True)
