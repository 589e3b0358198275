"""A drive of hours, simulated in the map of a recorded floor: its way forth and back, with the scans of a lidar."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import FREE
from fog_kernels.raycast import cast
from fog_mapping.poses import between, compose
from fognav_experiments.lidar_logs.mapping import map_log

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from fognav_experiments.lidar_logs.logs import LogScan

_SCAN_S: Final = 0.182
_STEP_M: Final = 0.15 * _SCAN_S
_STEP_RAD: Final = 0.5 * _SCAN_S
"""An RPLidar A1, on a robot that is driven by hand."""
_BEAMS: Final = 360
_RANGE_M: Final = 12.0
_NOISE_M: Final = 0.01
_LOST: Final = 0.03
"""Share of beams that do not come back."""


def write_long_drive(log: Sequence[LogScan], count: int, file: Path) -> None:
    """Write a log (JSON lines) of `count` scans along the reference of another; its odometry is its reference.

    Raises `WrongUseError` for a log without reference.
    """
    made, rng = map_log(log, "reference", (), 0.05, 30.0), np.random.default_rng(1)
    solid, geometry = (made.map.cells != FREE).astype(np.uint8), made.map.geometry
    beams = np.arange(_BEAMS) * (math.tau / _BEAMS) - math.pi
    with file.open("w", encoding="ascii") as out:
        out.write('{"meta": "simulated", "fov_deg": 360}\n')
        for number, (x, y, theta) in enumerate(itertools.islice(_way(made.poses), count)):
            at = geometry.resolution, geometry.origin_x, geometry.origin_y, x, y
            ranges = cast(solid, *at, beams + theta, _RANGE_M) + _NOISE_M * rng.standard_normal(_BEAMS)
            ranges[rng.random(_BEAMS) < _LOST] = np.inf
            told = ",".join(f"{value:.3f}" if value < _RANGE_M else "null" for value in ranges.tolist())
            pose = f"[{x:.4f},{y:.4f},{theta:.5f}]"
            out.write(f'{{"t":{number * _SCAN_S:.3f},"odom":{pose},"ref":{pose},"ranges":[{told}]}}\n')


def _way(poses: NDArray[np.float64]) -> Iterator[list[float]]:
    """Yield the poses of a robot that goes a way forth and back, for ever."""
    for first, second in itertools.pairwise(itertools.cycle([*poses, *poses[-2:0:-1]])):
        step = between(first, second)
        parts = max(1, math.ceil(max(math.hypot(step[0], step[1]) / _STEP_M, abs(step[2]) / _STEP_RAD)))
        for part in range(parts):
            yield compose(first, part / parts * step).tolist()
