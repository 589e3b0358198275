"""Measures the localization: one cycle of the particle filter, matching a scan, and searching a whole floor."""

from __future__ import annotations

import math
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numba import njit

from fog_kernels import amcl
from robot_agent.config import LocalizationConfig
from robot_agent.localization.map_fields import MapFields, map_fields
from robot_agent.localization.pose import Pose2
from robot_agent.localization.relocalization import Relocalization
from robot_agent.localization.scans import DeskewedScan, match_scan

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from fog_contracts.grid import StaticMap

_PLACE: Final = Pose2(50.0, 8.0, 0.3)
_SPREAD: Final = (0.2, 0.2, 0.1)
_STEP: Final = (0.02, 0.1, 0.03)
"""Motion of one cycle: rotation (rad), translation (m), rotation (rad)."""
_LIDAR_M: Final = 12.0


@njit(nogil=True)
def _plain_scores(poses: Any, field: Any, inverse: Any, ends: Any, out: Any) -> None:  # noqa: ANN401  # compiled
    """Score pose by pose and beam by beam, as the method is written down: what the kernel is compared to."""
    for i in range(poses.shape[0]):
        cos, sin = math.cos(poses[i, 2]), math.sin(poses[i, 2])
        match = 0.0
        for k in range(ends.shape[0]):
            column = math.floor((poses[i, 0] + cos * ends[k, 0] - sin * ends[k, 1]) * inverse)
            row = math.floor((poses[i, 1] + sin * ends[k, 0] + cos * ends[k, 1]) * inverse)
            if 0 <= column < field.shape[1] and 0 <= row < field.shape[0]:
                match += field[row, column]
        out[i] = match / ends.shape[0]


class _Cycle:
    """The particles and the scan of one cycle, and its steps."""

    def __init__(self, fields: MapFields, particles: int, beams: int, seed: int) -> None:
        self._fields = fields
        self._config = LocalizationConfig(particles_min=particles, particles_max=particles)
        rng = np.random.default_rng(seed)
        poses = np.array(_PLACE) + rng.standard_normal((particles, 3)) * _SPREAD
        x, y, theta = (np.ascontiguousarray(poses[:, i], np.float32) for i in range(3))
        self._particles = x, y, theta
        self._state = amcl.rng_state(seed)
        self.points = view(fields, beams)
        self._weights = np.full(particles, 1.0 / particles)
        self.weigh()

    def move(self) -> None:
        """Move copies of the particles."""
        x, y, theta = (values.copy() for values in self._particles)
        amcl.motion_update(x, y, theta, *_STEP, self._config.alphas, self._state)

    def weigh(self) -> None:
        """Weight the particles by the scan."""
        scores = self._fields.agreements(self._poses(), self.points, self._fields.fine)
        self._weights = np.exp(self._config.sharpness * (scores - scores.max()))

    def weigh_plainly(self) -> None:
        """Weight them by the reference."""
        scores = np.zeros(len(self._weights))
        poses, geometry = self._poses() - (*self._origin(), 0.0), self._fields.geometry
        _plain_scores(poses, self._fields.fine, 1.0 / geometry.resolution, self.points, scores)
        scores /= self._fields.best_likelihood
        self._weights = np.exp(self._config.sharpness * (scores - scores.max()))

    def cluster(self) -> None:
        """Estimate the pose."""
        amcl.clusters(*self._particles, self._weights, self._config.bin_xy, self._config.bin_theta)

    def resample(self) -> None:
        """Draw new particles."""
        config = self._config
        amcl.resample(
            *self._particles, self._weights, config.particles_min, config.particles_max, config.kld_error, self._state
        )

    def run(self, weigh: Callable[[], None]) -> None:
        """Run one whole cycle."""
        self.move()
        weigh()
        self.cluster()
        self.resample()

    def _poses(self) -> NDArray[np.float64]:
        return np.column_stack(self._particles).astype(np.float64)

    def _origin(self) -> tuple[float, float]:
        return self._fields.geometry.origin_x, self._fields.geometry.origin_y


def view(fields: MapFields, beams: int) -> NDArray[np.float64]:
    """Return what a lidar sees at the measured place: points (n, 2; m, frame `base`)."""
    angles = np.linspace(-math.pi, math.pi, beams, endpoint=False)
    ranges = fields.ranges(_PLACE.x, _PLACE.y, angles + _PLACE.theta, _LIDAR_M)
    hit = np.isfinite(ranges)
    return np.column_stack((ranges[hit] * np.cos(angles[hit]), ranges[hit] * np.sin(angles[hit])))


def measure(floor: StaticMap, particles: int, beams: int, repeats: int, seed: int) -> dict[str, float | int]:
    """Return the figures, in ms, medians of `repeats`; the search of the floor is measured once.

    A cycle and the same with the plain scores alternate, so that both see the same load.
    """
    fields = map_fields(floor.cells, floor.geometry, LocalizationConfig())
    cycle = _Cycle(fields, particles, beams, seed)
    cycle.weigh_plainly()  # compiles it
    whole: list[float] = []
    plain: list[float] = []
    for _ in range(repeats):
        whole.append(_timed(partial(cycle.run, cycle.weigh)))
        plain.append(_timed(partial(cycle.run, cycle.weigh_plainly)))
    steps = {"move": cycle.move, "score": cycle.weigh, "clusters": cycle.cluster, "resample": cycle.resample}
    covariance, points = np.diag(np.square(_SPREAD)), view(fields, 180)
    return {
        "cells": floor.geometry.width * floor.geometry.height,
        "cycle_ms": _median(whole),
        "reference_cycle_ms": _median(plain),
        "ratio": round(float(np.median(whole) / np.median(plain)), 3),
        **{f"{name}_ms": _median([_timed(step) for _ in range(repeats)]) for name, step in steps.items()},
        "match_ms": _median([_timed(partial(match_scan, fields, _PLACE, covariance, points)) for _ in range(repeats)]),
        "search_ms": round(_timed(partial(_search, fields)), 1),
    }


def _search(fields: MapFields) -> None:
    relocalization = Relocalization(LocalizationConfig())
    relocalization.begin(DeskewedScan(view(fields, 360), Pose2(0.0, 0.0, 0.0), 0.0), fields)
    while relocalization.searching:
        relocalization.advance(fields)


def _median(times: list[float]) -> float:
    return round(float(np.median(times)), 3)


def _timed(function: Callable[[], object]) -> float:
    begun = time.perf_counter()
    function()
    return (time.perf_counter() - begun) * 1000.0
