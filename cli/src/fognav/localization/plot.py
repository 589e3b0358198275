"""A picture of an evaluation: the map, the reference, and the estimates coloured by their status."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Final

import numpy as np
from PIL import Image, ImageDraw

from fog_contracts.costs import FREE, LETHAL
from fog_runtime.files import atomic_write
from fognav.output import WrongUseError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from fog_contracts.grid import StaticMap
    from fognav.localization.evaluation import Sample

_SIDE_PX: Final = 1600
_COLOURS: Final = {"good": (0, 140, 60), "weak": (230, 150, 0), "lost": (210, 0, 0), "none": (210, 0, 0)}
_REFERENCE: Final = (60, 110, 230)
_ERROR: Final = (240, 120, 120)
_DOT_PX: Final = 3


def write_plot(path: Path, map_: StaticMap, samples: Sequence[Sample]) -> None:
    """Write a PNG: reference in blue, estimates green (good), orange (weak) or red, lines between the two of a scan.

    Raises `WrongUseError` if the file can't be written.
    """
    geometry = map_.geometry
    scale = max(1, _SIDE_PX // max(geometry.width, geometry.height))
    shades = np.full(map_.cells.shape, 200, np.uint8)
    shades[map_.cells == FREE], shades[map_.cells == LETHAL] = 255, 0
    picture = Image.fromarray(np.kron(shades[::-1], np.ones((scale, scale), np.uint8))).convert("RGB")
    draw = ImageDraw.Draw(picture)

    def pixel(x: float, y: float) -> tuple[float, float]:
        column, row = (x - geometry.origin_x) / geometry.resolution, (y - geometry.origin_y) / geometry.resolution
        return column * scale, (geometry.height - row) * scale

    draw.line([pixel(sample.reference.x, sample.reference.y) for sample in samples], fill=_REFERENCE, width=2)
    for sample in samples:
        if sample.estimate is None:
            continue
        x, y = pixel(sample.estimate.x, sample.estimate.y)
        draw.line([pixel(sample.reference.x, sample.reference.y), (x, y)], fill=_ERROR, width=2)
        draw.ellipse((x - _DOT_PX, y - _DOT_PX, x + _DOT_PX, y + _DOT_PX), fill=_COLOURS[sample.status])
    data = io.BytesIO()
    picture.save(data, format="PNG")
    try:
        atomic_write(path, data.getvalue())
    except OSError as error:
        raise WrongUseError(f"{path} can't be written: {error.strerror}. Name another file") from error
