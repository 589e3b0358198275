"""Draws the printed parts of a node and a robot in `docs/images`: assembled, and what is in them, pulled apart.

Needs OpenSCAD (`apt-get install openscad`). Run: python hardware/render.py node, or robot.
"""

import re
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

HERE: Final = Path(__file__).parent
IMAGES: Final = HERE.parent / "docs" / "images"
_SMOOTHING: Final = 2
"""The picture is drawn this much larger and then reduced."""
_SHADES: Final = (0.55, 0.5)
"""Brightness of a surface that looks away from the light, and how much brighter one is that faces it."""
_LIGHT: Final = np.array([-0.5, 0.45, 0.75])
_EDGE: Final = 0.45
"""Brightness of the lines where a part ends, or its surface bends."""
_BEND: Final = 0.85
"""Cosine of the angle from which on a bend is drawn."""

_TEXT: Final = 20

_FAR: Final = -1e9
"""Depth (mm) of the background."""

_PLASTIC: Final = (236, 232, 222)
_BOARD: Final = (44, 120, 168)
_STEEL: Final = (198, 202, 208)
_DARK: Final = (70, 72, 76)
_GREY: Final = (150, 154, 160)
_GREEN: Final = (60, 140, 80)
_RED: Final = (200, 50, 45)


@dataclass(frozen=True)
class Label:
    """A part's name: at a point of it (mm), and how far from there the text begins (pixels, y downwards)."""

    text: str
    at: tuple[float, float, float]
    offset: tuple[float, float]


@dataclass(frozen=True)
class Part:
    """A part of a model's file, its colour, and what it is pulled away with; `pulled_only`: it is an option."""

    name: str
    colour: tuple[int, int, int]
    group: str
    label: Label | None = None
    pulled_only: bool = False


@dataclass(frozen=True)
class Model:
    """A file of OpenSCAD and how its parts are drawn.

    `view`: from where they are seen, azimuth and elevation in degrees. `pull`: how far the parts of each group are
    pulled apart (mm) along `direction`, where the values `pulled` are set. `margins`: for the names, left, above, right
    and below, in pixels.
    """

    file: Path
    picture: Path
    view: tuple[float, float]
    pixels_per_mm: float
    direction: tuple[float, float, float]
    pull: dict[str, float]
    margins: tuple[int, int, int, int]
    parts: tuple[Part, ...]
    pulled: tuple[str, ...] = ()


_NODE: Final = Model(
    file=HERE / "node" / "case.scad",
    picture=IMAGES / "node-case.png",
    view=(216.0, 26.0),
    pixels_per_mm=7.0,
    direction=(0.0, 1.0, 0.0),
    pull={"screws": -30.0, "plate": 0.0, "mcu": 75.0, "sonars": 150.0, "body": 235.0},
    margins=(20, 20, 110, 20),
    parts=(
        Part("shown_screws", _STEEL, "screws", Label("2 screws M3 x 8", (-48.0, 4.0, 20.0), (-30.0, 60.0))),
        Part(
            "shown_plate",
            _PLASTIC,
            "plate",
            Label("wall plate: keyholes for\nthe wall's screws, rails\nfor the board", (-20.0, 2.0, 4.0), (30.0, 90.0)),
        ),
        Part("shown_mcu", _BOARD, "mcu", Label("D1 mini, upright on its plug", (-12.9, 9.0, 8.0), (70.0, 100.0))),
        Part("shown_mcu_shield", _STEEL, "mcu"),
        Part("shown_mcu_antenna", _DARK, "mcu"),
        Part("shown_usb", _STEEL, "mcu"),
        Part("shown_cable", _DARK, "mcu", Label("USB cable, through the floor", (0.0, 11.0, -30.0), (60.0, 50.0))),
        Part(
            "shown_sonar_boards",
            _BOARD,
            "sonars",
            Label("2 HC-SR04, each turned\n12.6 degrees to its side", (40.0, 24.0, 32.0), (-20.0, -130.0)),
        ),
        Part("shown_cans", _STEEL, "sonars"),
        Part("shown_meshes", _DARK, "sonars"),
        Part(
            "shown_body",
            _PLASTIC,
            "body",
            Label(
                "body: printed in\none piece; the sonars\nlook out of its faces", (45.0, 20.0, 40.4), (-60.0, -140.0)
            ),
        ),
    ),
)

_ROBOT: Final = Model(
    file=HERE / "robot" / "decks.scad",
    picture=IMAGES / "robot-decks.png",
    view=(152.0, 27.0),
    pixels_per_mm=3.5,
    direction=(0.0, 0.0, 1.0),
    pull={
        "base": 0.0, "feet": 30.0, "lower": 60.0, "carried": 115.0, "posts": 115.0, "upper": 165.0, "lidar": 225.0,
        "roof_posts": 245.0, "roof": 290.0,
    },
    margins=(220, 20, 170, 20),
    parts=(
        Part("shown_base", _GREY, "base", Label("Roomba 600", (-130.0, 109.0, 45.0), (25.0, 50.0))),
        Part("shown_bumper", _DARK, "base"),
        Part("shown_button", _GREEN, "base", Label("CLEAN:\nin reach from ahead", (30.0, 0.0, 94.0), (-475.0, -80.0))),
        Part("shown_receiver", _GREEN, "base", Label("sees its dock:\nstays free", (150.0, 0.0, 97.0), (-280.0, 30.0))),
        Part("shown_feet", _PLASTIC, "feet", Label("4 feet, on\nDual Lock", (-60.0, 112.0, 98.0), (125.0, -20.0))),
        Part("shown_lower", _PLASTIC, "lower", Label("lower deck", (-62.0, 104.0, 104.0), (90.0, -10.0))),
        Part("shown_bank", _DARK, "carried", Label("power bank", (74.0, 40.0, 112.0), (-430.0, -20.0))),
        Part("shown_board", _GREEN, "carried", Label("Raspberry Pi", (-20.0, -30.0, 113.0), (-480.0, -60.0))),
        Part("shown_sockets", _STEEL, "carried"),
        Part("shown_adapter", _BOARD, "carried"),
        Part("shown_posts", _PLASTIC, "posts"),
        Part("shown_rods", _STEEL, "lower"),
        Part("shown_upper", _PLASTIC, "upper", Label("upper deck", (-62.0, 106.0, 150.0), (90.0, -20.0))),
        Part("shown_lidar_base", _DARK, "lidar"),
        Part("shown_lidar_head", _BOARD, "lidar", Label("RPLidar A1", (30.0, 20.0, 205.0), (-490.0, -40.0))),
        Part("shown_mushroom", _RED, "lidar", Label("mushroom switch", (-70.0, 12.0, 176.0), (150.0, -10.0))),
        Part("shown_mushroom_body", _DARK, "lidar"),
        Part("shown_roof_posts", _PLASTIC, "roof_posts", pulled_only=True),
        Part(
            "shown_roof",
            _PLASTIC,
            "roof",
            Label("roof, if you want one:\nits posts are masked", (-62.0, 106.0, 226.0), (40.0, -10.0)),
            pulled_only=True,
        ),
    ),
    pulled=("roof=true",),
)  # fmt: skip
MODELS: Final = {"node": _NODE, "robot": _ROBOT}


def triangles(file: Path, part: str, values: tuple[str, ...] = ()) -> NDArray[np.float64]:
    """Return a part's surface in mm, shape (n, 3 corners, 3 coordinates); `values`: such as `roof=true`."""
    with tempfile.TemporaryDirectory() as folder:
        stl = Path(folder) / "part.stl"
        given = [word for value in (f'part="{part}"', *values) for word in ("-D", value)]
        command = ["openscad", *given, "-o", str(stl), str(file)]
        subprocess.run(command, check=True, capture_output=True)
        corners = re.findall(r"vertex (\S+) (\S+) (\S+)", stl.read_text("ascii"))
    return np.array(corners, dtype=np.float64).reshape(-1, 3, 3)


def view(azimuth: float, elevation: float) -> NDArray[np.float64]:
    """Return the rotation into the picture: x to the right, y up, z towards the reader."""
    a, e = np.radians([azimuth, elevation])
    turn = np.array([[np.cos(a), np.sin(a), 0.0], [-np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, np.sin(e), np.cos(e)], [0.0, -np.cos(e), np.sin(e)]])
    return np.asarray(tilt @ turn, dtype=np.float64)


class Canvas:
    """A picture without perspective, by a depth buffer: colours, normals for the edges, and which part is where."""

    def __init__(self, model: Model, corners: NDArray[np.float64]) -> None:
        """`corners` (mm, n x 3) are what has to be inside."""
        self._rotation, self._scale = view(*model.view), model.pixels_per_mm
        seen = corners @ self._rotation.T
        self._low = seen[:, :2].min(axis=0) - 4.0
        width, height = np.ceil((seen[:, :2].max(axis=0) + 4.0 - self._low) * self._scale).astype(int)
        self._colours = np.full((height, width, 3), 255.0)
        self._normals = np.zeros((height, width, 3))
        self._part = np.zeros((height, width), dtype=np.int32)
        self._depth = np.full((height, width), _FAR)

    def add(self, surface: NDArray[np.float64], colour: tuple[int, int, int], number: int) -> None:
        """Draw a part's surface (mm, n x 3 x 3); `number` tells it from the other parts."""
        normals = np.cross(surface[:, 1] - surface[:, 0], surface[:, 2] - surface[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        shades = _SHADES[0] + _SHADES[1] * np.clip(normals @ (_LIGHT / np.linalg.norm(_LIGHT)), 0.0, 1.0)
        for corners, normal, shade in zip(surface @ self._rotation.T, normals, shades, strict=True):
            pixels = np.column_stack([(corners[:, :2] - self._low) * self._scale, corners[:, 2]])
            window, nearer = self._nearer(pixels)
            if window is None:
                continue
            self._colours[window][nearer] = np.minimum(255.0, np.array(colour) * shade)
            self._normals[window][nearer] = normal
            self._part[window][nearer] = number

    def _nearer(self, corners: NDArray[np.float64]) -> tuple[tuple[slice, slice] | None, NDArray[np.bool_]]:
        """Return the window of a triangle (pixels, and mm towards the reader), and where in it nothing is nearer."""
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = corners
        twice_area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if abs(twice_area) < 1e-9:
            return None, np.zeros((0, 0), dtype=np.bool_)
        left, right = int(min(ax, bx, cx)), int(max(ax, bx, cx)) + 1
        bottom, top = int(min(ay, by, cy)), int(max(ay, by, cy)) + 1
        x, y = np.meshgrid(np.arange(left, right) + 0.5, np.arange(bottom, top) + 0.5)
        of_b = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / twice_area
        of_c = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / twice_area
        inside = (of_b >= -1e-9) & (of_c >= -1e-9) & (of_b + of_c <= 1 + 1e-9)
        z = az + of_b * (bz - az) + of_c * (cz - az)
        window = (slice(bottom, top), slice(left, right))
        nearer = inside & (z > self._depth[window])
        self._depth[window][nearer] = z[nearer]
        return window, nearer

    def place(self, point: NDArray[np.float64]) -> tuple[float, float]:
        """Return where a point (mm) is in the finished picture (pixels from its upper left corner)."""
        x, y, _ = self._rotation @ point
        height = self._colours.shape[0]
        column, row = (x - self._low[0]) * self._scale, height - (y - self._low[1]) * self._scale
        return float(column / _SMOOTHING), float(row / _SMOOTHING)

    def picture(self) -> Image.Image:
        """Return the finished picture, with lines where a part ends or its surface bends."""
        edge = np.zeros(self._part.shape, dtype=np.bool_)
        for axis in (0, 1):
            other = np.roll(self._part, 1, axis=axis)
            bend = np.sum(self._normals * np.roll(self._normals, 1, axis=axis), axis=2) < _BEND
            behind = np.abs(self._depth - np.roll(self._depth, 1, axis=axis)) > 1.0
            edge |= (self._part != other) | ((self._part > 0) & (bend | behind))
        colours = np.where(edge[..., None], self._colours * _EDGE, self._colours)
        height, width = self._part.shape
        image = Image.fromarray(colours[::-1].astype(np.uint8))
        return image.resize((width // _SMOOTHING, height // _SMOOTHING), Image.Resampling.LANCZOS)


def draw(model: Model, surfaces: dict[str, NDArray[np.float64]], pull: dict[str, float]) -> tuple[Image.Image, Canvas]:
    """Return the picture of all parts that have surfaces, each pulled away by what its group is (mm; default: not)."""
    moved = {
        part: surfaces[part.name] + pull.get(part.group, 0.0) * np.array(model.direction)
        for part in model.parts
        if part.name in surfaces
    }
    canvas = Canvas(model, np.concatenate([surface.reshape(-1, 3) for surface in moved.values()]))
    for number, (part, surface) in enumerate(moved.items(), start=1):
        canvas.add(surface, part.colour, number)
    return canvas.picture(), canvas


def labelled(model: Model, picture: Image.Image, canvas: Canvas) -> Image.Image:
    """Return the picture of the pulled parts with their names, and a line from each name to its part."""
    left, top, right, bottom = model.margins
    sheet = Image.new("RGB", (picture.width + left + right, picture.height + top + bottom), "white")
    sheet.paste(picture, (left, top))
    drawing, font = ImageDraw.Draw(sheet), ImageFont.load_default(_TEXT)
    for part in model.parts:
        if part.label is None:
            continue
        x, y = canvas.place(np.array(part.label.at) + model.pull[part.group] * np.array(model.direction))
        x, y = x + left, y + top
        text_x, text_y = x + part.label.offset[0], y + part.label.offset[1]
        box = drawing.multiline_textbbox((text_x, text_y), part.label.text, font=font)
        end_y = box[1] - 6 if text_y > y else box[3] + 6
        drawing.line([(x, y), (min(max(x, box[0]), box[2]), end_y)], fill=(90, 90, 90), width=2)
        drawing.ellipse([x - 4, y - 4, x + 4, y + 4], fill=(90, 90, 90))
        drawing.multiline_text((text_x, text_y), part.label.text, fill="black", font=font)
    return sheet


def main(names: list[str]) -> int:
    """Draw the models of these names: assembled and pulled apart, side by side."""
    if not names or not set(names) <= MODELS.keys():
        print(f"name what to draw: {', '.join(MODELS)}", file=sys.stderr)
        return 2
    for model in map(MODELS.__getitem__, names):
        _draw_both(model)
    return 0


def _draw_both(model: Model) -> None:
    def computed(parts: list[str], values: tuple[str, ...]) -> dict[str, NDArray[np.float64]]:
        with ThreadPoolExecutor(2) as threads:  # each runs a program
            return dict(zip(parts, threads.map(lambda part: triangles(model.file, part, values), parts), strict=True))

    whole = computed([part.name for part in model.parts if not part.pulled_only], ())
    apart = computed([part.name for part in model.parts], model.pulled) if model.pulled else whole
    pictures = [draw(model, whole, {})[0], labelled(model, *draw(model, apart, model.pull))]
    sheet = Image.new("RGB", (sum(p.width for p in pictures), max(p.height for p in pictures)), "white")
    left = 0
    for picture in pictures:
        sheet.paste(picture, (left, (sheet.height - picture.height) // 2))
        left += picture.width
    sheet.save(model.picture, optimize=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
