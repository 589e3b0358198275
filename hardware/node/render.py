"""Draws `docs/images/node-case.png` from `case.scad`: the node on its wall, and what is in it, pulled apart.

Needs OpenSCAD (`apt-get install openscad`). Run: python hardware/node/render.py
"""

import re
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

HERE: Final = Path(__file__).parent
PICTURE: Final = HERE.parents[1] / "docs" / "images" / "node-case.png"
_PIXELS_PER_MM: Final = 7.0
_SMOOTHING: Final = 2
"""The picture is drawn this much larger and then reduced."""
_SHADES: Final = (0.55, 0.5)
"""Brightness of a surface that looks away from the light, and how much brighter one is that faces it."""
_LIGHT: Final = np.array([-0.5, 0.45, 0.75])
_VIEW: Final = (216.0, 26.0)
"""From where everything is seen: azimuth and elevation in degrees."""
_EDGE: Final = 0.45
"""Brightness of the lines where a part ends, or its surface bends."""
_BEND: Final = 0.85
"""Cosine of the angle from which on a bend is drawn."""

_TEXT: Final = 20
_MARGINS: Final = (20, 20, 110, 20)
"""For the names: left, above, right and below, in pixels."""

_FAR: Final = -1e9
"""Depth (mm) of the background."""

_PLASTIC: Final = (236, 232, 222)
_BOARD: Final = (44, 120, 168)
_STEEL: Final = (198, 202, 208)
_DARK: Final = (70, 72, 76)


@dataclass(frozen=True)
class Label:
    """A part's name: at a point of it (mm), and how far from there the text begins (pixels, y downwards)."""

    text: str
    at: tuple[float, float, float]
    offset: tuple[float, float]


@dataclass(frozen=True)
class Part:
    """A part of `case.scad`, its colour, and what it is pulled away from the wall with."""

    name: str
    colour: tuple[int, int, int]
    group: str
    label: Label | None = None


_PULL: Final = {"screws": -30.0, "plate": 0.0, "mcu": 75.0, "sonars": 150.0, "body": 235.0}
"""How far the parts of each group are pulled away from the wall (mm), in the picture of the parts."""
_PARTS: Final = (
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
        Label("body: printed in\none piece; the sonars\nlook out of its faces", (45.0, 20.0, 40.4), (-60.0, -140.0)),
    ),
)


def triangles(part: str) -> NDArray[np.float64]:
    """Return a part's surface in mm, shape (n, 3 corners, 3 coordinates)."""
    with tempfile.TemporaryDirectory() as folder:
        stl = Path(folder) / "part.stl"
        command = ["openscad", "-D", f'part="{part}"', "-o", str(stl), str(HERE / "case.scad")]
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

    def __init__(self, corners: NDArray[np.float64]) -> None:
        """`corners` (mm, n x 3) are what has to be inside."""
        self._rotation = view(*_VIEW)
        seen = corners @ self._rotation.T
        self._low = seen[:, :2].min(axis=0) - 4.0
        width, height = np.ceil((seen[:, :2].max(axis=0) + 4.0 - self._low) * _PIXELS_PER_MM).astype(int)
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
            pixels = np.column_stack([(corners[:, :2] - self._low) * _PIXELS_PER_MM, corners[:, 2]])
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
        column, row = (x - self._low[0]) * _PIXELS_PER_MM, height - (y - self._low[1]) * _PIXELS_PER_MM
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


def draw(surfaces: dict[str, NDArray[np.float64]], pull: dict[str, float]) -> tuple[Image.Image, Canvas]:
    """Return the picture of all parts, each pulled away from the wall by what its group is (mm; default: not)."""
    moved = {part.name: surfaces[part.name] + np.array([0.0, pull.get(part.group, 0.0), 0.0]) for part in _PARTS}
    canvas = Canvas(np.concatenate([surface.reshape(-1, 3) for surface in moved.values()]))
    for number, part in enumerate(_PARTS, start=1):
        canvas.add(moved[part.name], part.colour, number)
    return canvas.picture(), canvas


def labelled(picture: Image.Image, canvas: Canvas) -> Image.Image:
    """Return the picture of the pulled parts with their names, and a line from each name to its part."""
    left, top, right, bottom = _MARGINS
    sheet = Image.new("RGB", (picture.width + left + right, picture.height + top + bottom), "white")
    sheet.paste(picture, (left, top))
    drawing, font = ImageDraw.Draw(sheet), ImageFont.load_default(_TEXT)
    for part in _PARTS:
        if part.label is None:
            continue
        x, y = canvas.place(np.array(part.label.at) + np.array([0.0, _PULL[part.group], 0.0]))
        x, y = x + left, y + top
        text_x, text_y = x + part.label.offset[0], y + part.label.offset[1]
        box = drawing.multiline_textbbox((text_x, text_y), part.label.text, font=font)
        end_y = box[1] - 6 if text_y > y else box[3] + 6
        drawing.line([(x, y), (min(max(x, box[0]), box[2]), end_y)], fill=(90, 90, 90), width=2)
        drawing.ellipse([x - 4, y - 4, x + 4, y + 4], fill=(90, 90, 90))
        drawing.multiline_text((text_x, text_y), part.label.text, fill="black", font=font)
    return sheet


def main() -> None:
    """Draw the assembled node and its parts side by side."""
    with ThreadPoolExecutor(2) as threads:  # each runs a program
        names = [part.name for part in _PARTS]
        surfaces = dict(zip(names, threads.map(triangles, names), strict=True))
    pictures = [draw(surfaces, {})[0], labelled(*draw(surfaces, _PULL))]
    sheet = Image.new("RGB", (sum(p.width for p in pictures), max(p.height for p in pictures)), "white")
    left = 0
    for picture in pictures:
        sheet.paste(picture, (left, (sheet.height - picture.height) // 2))
        left += picture.width
    sheet.save(PICTURE, optimize=True)


if __name__ == "__main__":
    main()
