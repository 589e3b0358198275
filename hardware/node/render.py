"""Draws `docs/images/node-case.png` from `case.scad`: the assembled node from the corridor, and its parts.

Needs OpenSCAD (`apt-get install openscad`). Run: python hardware/node/render.py
"""

import re
import subprocess
import tempfile
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

HERE: Final = Path(__file__).parent
PICTURE: Final = HERE.parents[1] / "docs" / "images" / "node-case.png"
_PIXELS_PER_MM: Final = 12.0
_SMOOTHING: Final = 2
"""The picture is drawn this much larger and then reduced."""
_BACKGROUND: Final = 255
_SHADES: Final = (95.0, 145.0)
"""Brightness of a surface that looks away from the light, and how much brighter one is that faces it."""
_LIGHT: Final = np.array([0.35, 0.5, 0.8])
_DEFINITIONS: Final = {"assembly": (152.0, 24.0), "shown_body": (-28.0, 28.0), "shown_plate": (152.0, 24.0)}
"""The parts that are drawn, each with the direction from which it is seen: azimuth and elevation in degrees."""


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


def draw(surface: NDArray[np.float64], azimuth: float, elevation: float) -> Image.Image:
    """Return a shaded picture of a surface without perspective, by a depth buffer."""
    rotation = view(azimuth, elevation)
    seen = surface @ rotation.T
    normals = np.cross(surface[:, 1] - surface[:, 0], surface[:, 2] - surface[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    light = _LIGHT @ np.linalg.inv(rotation).T
    shades = _SHADES[0] + _SHADES[1] * np.clip(normals @ (light / np.linalg.norm(light)), 0.0, 1.0)
    low = seen[:, :, :2].min(axis=(0, 1)) - 4.0
    width, height = np.ceil((seen[:, :, :2].max(axis=(0, 1)) + 4.0 - low) * _PIXELS_PER_MM).astype(int)
    picture = np.full((height, width), _BACKGROUND, dtype=np.uint8)
    depth = np.full((height, width), -np.inf)
    for corners, shade in zip(seen, shades, strict=True):
        _fill(picture, depth, np.column_stack([(corners[:, :2] - low) * _PIXELS_PER_MM, corners[:, 2]]), shade)
    image = Image.fromarray(picture[::-1])
    return image.resize((width // _SMOOTHING, height // _SMOOTHING), Image.Resampling.LANCZOS)


def _fill(picture: NDArray[np.uint8], depth: NDArray[np.float64], corners: NDArray[np.float64], shade: float) -> None:
    """Draw one triangle (pixels, and mm towards the reader) where nothing nearer has been drawn."""
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = corners
    twice_area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    if abs(twice_area) < 1e-9:
        return
    left, right = int(min(ax, bx, cx)), int(max(ax, bx, cx)) + 1
    bottom, top = int(min(ay, by, cy)), int(max(ay, by, cy)) + 1
    x, y = np.meshgrid(np.arange(left, right) + 0.5, np.arange(bottom, top) + 0.5)
    of_b = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / twice_area
    of_c = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / twice_area
    inside = (of_b >= -1e-9) & (of_c >= -1e-9) & (of_b + of_c <= 1 + 1e-9)
    z = az + of_b * (bz - az) + of_c * (cz - az)
    window = (slice(bottom, top), slice(left, right))
    nearer = inside & (z > depth[window])
    picture[window][nearer] = np.uint8(shade)
    depth[window][nearer] = z[nearer]


def main() -> None:
    """Draw all parts side by side."""
    pictures = [draw(triangles(part), *direction) for part, direction in _DEFINITIONS.items()]
    sheet = Image.new("L", (sum(p.width for p in pictures), max(p.height for p in pictures)), _BACKGROUND)
    left = 0
    for picture in pictures:
        sheet.paste(picture, (left, (sheet.height - picture.height) // 2))
        left += picture.width
    sheet.resize((sheet.width // 2, sheet.height // 2), Image.Resampling.LANCZOS).save(PICTURE, optimize=True)


if __name__ == "__main__":
    main()
