"""A picture of a map on which others draw: free cells white, occupied black, unknown grey."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Final

import numpy as np
from PIL import Image, ImageDraw

from fog_contracts.costs import FREE, LETHAL
from fog_runtime.files import SHARED, atomic_write
from fognav.output import WrongUseError

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from fog_contracts.grid import StaticMap

_SIDE_PX: Final = 1600
_UNKNOWN_SHADE: Final = 200

Colour = tuple[int, int, int]


class MapPicture:
    """A map as a picture whose longer side has about 1600 pixels; all drawing takes metres of frame `map`."""

    def __init__(self, map_: StaticMap) -> None:
        self._geometry = map_.geometry
        self._scale = max(1, _SIDE_PX // max(map_.geometry.width, map_.geometry.height))
        shades = np.full(map_.cells.shape, _UNKNOWN_SHADE, np.uint8)
        shades[map_.cells == FREE], shades[map_.cells == LETHAL] = 255, 0
        enlarged = np.kron(shades[::-1], np.ones((self._scale, self._scale), np.uint8))
        self._image = Image.fromarray(enlarged).convert("RGB")
        self._draw = ImageDraw.Draw(self._image)

    def _pixel(self, point: tuple[float, float]) -> tuple[float, float]:
        geometry = self._geometry
        column, row = (
            (point[0] - geometry.origin_x) / geometry.resolution,
            (point[1] - geometry.origin_y) / geometry.resolution,
        )
        return column * self._scale, (geometry.height - row) * self._scale

    def line(self, points: Iterable[tuple[float, float]], colour: Colour, width: int = 2) -> None:
        """Draw a line through points, `width` pixels wide."""
        self._draw.line([self._pixel(point) for point in points], fill=colour, width=width)

    def dot(self, point: tuple[float, float], colour: Colour, radius: int = 3) -> None:
        """Draw a dot with a radius in pixels."""
        x, y = self._pixel(point)
        self._draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)

    def area(self, ring: Iterable[tuple[float, float]], outline: Colour, fill: Colour | None = None) -> None:
        """Draw a polygon."""
        self._draw.polygon([self._pixel(point) for point in ring], fill=fill, outline=outline)

    def write(self, file: Path) -> None:
        """Write the picture as PNG; raises `WrongUseError` if the file can't be written."""
        data = io.BytesIO()
        self._image.save(data, format="PNG")
        try:
            atomic_write(file, data.getvalue(), mode=SHARED)
        except OSError as error:
            raise WrongUseError(f"{file} can't be written: {error.strerror}. Name another file") from error
