"""A picture of an evaluation: the map, the reference, and the estimates coloured by their status."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from fognav_experiments.map_picture import MapPicture

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from fog_contracts.grid import StaticMap
    from fognav_experiments.localization.evaluation import Sample

_COLOURS: Final = {"good": (0, 140, 60), "weak": (230, 150, 0), "lost": (210, 0, 0), "none": (210, 0, 0)}
_REFERENCE: Final = (60, 110, 230)
_ERROR: Final = (240, 120, 120)


def write_plot(path: Path, map_: StaticMap, samples: Sequence[Sample]) -> None:
    """Write a PNG: reference in blue, estimates green (good), orange (weak) or red, lines between the two of a scan.

    Raises `WrongUseError` if the file can't be written.
    """
    picture = MapPicture(map_)
    picture.line(((sample.reference.x, sample.reference.y) for sample in samples), _REFERENCE)
    for sample in samples:
        if sample.estimate is None:
            continue
        estimate = (sample.estimate.x, sample.estimate.y)
        picture.line([(sample.reference.x, sample.reference.y), estimate], _ERROR)
        picture.dot(estimate, _COLOURS[sample.status])
    picture.write(path)
