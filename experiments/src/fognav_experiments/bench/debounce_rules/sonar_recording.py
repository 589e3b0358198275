"""A recording of an HC-SR04 as a source of trials: stretches with and without an obstacle, and the node's spike filter.

The recording is a CSV file whose second column is the measured distance in cm, and its first one the time in s. It
begins with nothing in range but the background.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from itertools import pairwise
from statistics import median
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

CALIBRATION_S: Final = 5.0
"""The background's distance is the median of the first so many seconds."""
LIMIT_SHARE: Final = 0.9
"""An echo nearer than this share of the background's distance is an obstacle."""
AGREE_M: Final = 0.15
MAX_HELD: Final = 2
"""As in the firmware: `kAgreeMm` and `kMaxHeld`."""


@dataclass(frozen=True)
class Recording:
    """Ranges (m) of the background and of obstacles, in the order of their measurement.

    `limit` (m) parts them; `echo_rate` and `false_echo_rate` are the likelihoods learned from it, `samples` how many
    readings it has, and `period_s` their interval.
    """

    limit: float
    period_s: float
    background: list[float]
    obstacle: list[float]
    echo_rate: float
    false_echo_rate: float
    samples: int


def load(path: Path) -> Recording:
    """Return a recording; raises `ValueError` that names the file and what is missing in it."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))[1:]
    try:
        times, ranges = [float(row[0]) for row in rows], [float(row[1]) / 100 for row in rows]
    except (ValueError, IndexError) as error:
        raise ValueError(f"{path}: {error}: each line needs a time in s and a distance in cm") from error
    still = [r for t, r in zip(times, ranges, strict=True) if t - times[0] < CALIBRATION_S]
    if len(still) < 10:
        raise ValueError(
            f"{path}: only {len(still)} readings in the first {CALIBRATION_S:g} s: it must begin with those"
        )
    limit = LIMIT_SHARE * median(still)
    near = [i for i, measured in enumerate(ranges) if measured < limit]
    if not near or near[0] < len(still):
        raise ValueError(f"{path}: no obstacle comes nearer than {limit:.2f} m after the first {CALIBRATION_S:g} s")
    present = ranges[near[0] : near[-1] + 1]
    obstacle = [measured for measured in present if measured < limit]
    return Recording(
        limit=limit,
        period_s=median(b - a for a, b in pairwise(times)),
        background=ranges[: near[0]],
        obstacle=obstacle,
        # The rule of succession (Laplace): what did not happen in a short recording may happen.
        echo_rate=(len(obstacle) + 1) / (len(present) + 2),
        false_echo_rate=1 / (near[0] + 2),
        samples=len(ranges),
    )


def recordings_in(folder: Path) -> list[Recording]:
    """Return all recordings (`*.csv`) of a folder; raises `ValueError` without any."""
    found = [load(path) for path in sorted(folder.glob("*.csv"))]
    if not found:
        raise ValueError(f"{folder}: there is no recording (*.csv) in it")
    return found


class SpikeFilter:
    """The filter of the firmware's nodes (`spike_filter.hpp`) for ranges (m)."""

    def __init__(self) -> None:
        self._accepted: float | None = None
        self._candidate = 0.0
        self._held = 0

    def update(self, measured: float) -> float:
        """Return the range that counts: a change only when a second sample agrees with it."""
        confirmed = self._held > 0 and abs(measured - self._candidate) <= AGREE_M
        given_up = self._held >= MAX_HELD
        if self._accepted is None or confirmed or given_up or abs(measured - self._accepted) <= AGREE_M:
            self._accepted, self._held = measured, 0
        else:
            self._candidate, self._held = measured, self._held + 1
        return self._accepted


def filtered(ranges: Iterable[float]) -> Sequence[float]:
    """Return the ranges that a node's readings have."""
    spikes = SpikeFilter()
    return [spikes.update(measured) for measured in ranges]
