"""Evaluates the localizer on a log: errors against the reference, time lost, convergence; many excerpts; a picture."""

from __future__ import annotations

import itertools
import math
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from fognav_experiments.figures import floor, write_png
from robot_agent.hardware import LaserScan
from robot_agent.localization.localizer import Localizer
from robot_agent.localization.pose import Pose2, wrap

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from fog_contracts.grid import StaticMap
    from fognav_experiments.lidar_logs.logs import LogScan
    from robot_agent.config import LocalizationConfig
    from robot_agent.localization.map_fields import MapFields

_START_SIGMAS: Final = (0.2, 0.1)
"""Standard deviations (m, rad) of the pose at which tracking starts: the reference's."""
_FALSELY_GOOD_M: Final = 0.5
_RIGHT_M: Final = 0.5
_RIGHT_RAD: Final = 0.26
_NOISE: Final = (0.05, 0.02, 0.05)
"""Odometry noise of logs without an odometry of their own: standard deviation of translation per sqrt(m) (m), of
heading per sqrt(m) and per sqrt(rad) (rad)."""


@dataclass(frozen=True, slots=True)
class Sample:
    """The estimate at one scan (None: no pose) with its status, the reference, and the time that the scan took.

    sigma_along: m, standard deviation of the position in its least certain direction.
    """

    estimate: Pose2 | None
    status: str
    reference: Pose2
    sigma_along: float
    milliseconds: float

    @property
    def position_error(self) -> float:
        """Distance (m) from the reference; infinite without an estimate."""
        if self.estimate is None:
            return math.inf
        return math.hypot(self.estimate.x - self.reference.x, self.estimate.y - self.reference.y)

    @property
    def heading_error(self) -> float:
        """Angle (rad) from the reference; infinite without an estimate."""
        return math.inf if self.estimate is None else abs(wrap(self.estimate.theta - self.reference.theta))


def with_noise(scans: Sequence[LogScan], seed: int) -> list[LogScan]:
    """Return the scans with noise added to their odometry, as a random walk over distance and rotation."""
    rng = np.random.default_rng(seed)
    per_metre, heading_per_metre, heading_per_radian = _NOISE
    odom, noisy = scans[0].odom, [scans[0]]
    for before, scan in itertools.pairwise(scans):
        step = scan.odom.relative_to(before.odom)
        length, angle = math.hypot(step.x, step.y), abs(step.theta)
        dx, dy = rng.standard_normal(2) * per_metre * math.sqrt(length)
        dtheta = rng.standard_normal() * math.hypot(
            heading_per_metre * math.sqrt(length), heading_per_radian * math.sqrt(angle)
        )
        odom = odom.compose(Pose2(step.x + dx, step.y + 0.2 * dy, step.theta + dtheta))
        noisy.append(replace(scan, odom=odom))
    return noisy


def track(
    fields: MapFields,
    scans: Sequence[LogScan],
    config: LocalizationConfig,
    *,
    seed: int,
    search: bool,
    on_scan: Callable[[int], None] = lambda _: None,
) -> list[Sample]:
    """Run the localizer over scans with references; start at the first reference, or by a search of the whole map."""
    localizer = Localizer(config, seed)
    localizer.load_map(fields)
    samples: list[Sample] = []
    heading = scans[0].odom.theta
    for number, scan in enumerate(scans):
        assert scan.reference is not None
        heading += wrap(scan.odom.theta - heading)
        localizer.on_odometry(scan.stamp, scan.odom.x, scan.odom.y, heading)
        if not samples and not search:
            localizer.initial_pose(*scan.reference, *_START_SIGMAS)
        begun = time.perf_counter()
        localizer.on_scan(_laser_scan(scan), scan.stamp)
        if search and not samples:
            localizer.global_localization()
        milliseconds = (time.perf_counter() - begun) * 1000.0
        while localizer.searching:
            localizer.continue_search(scan.stamp)
        samples.append(
            Sample(
                localizer.pose(scan.stamp),
                localizer.status,
                scan.reference,
                localizer.uncertainty.along,
                milliseconds,
            )
        )
        on_scan(number)
    return samples


def _laser_scan(scan: LogScan) -> LaserScan:
    return LaserScan(
        angles_rad=scan.angles,
        ranges_m=scan.ranges,
        quality=np.where(np.isfinite(scan.ranges), 1, 0).astype(np.uint8),
        started_at=scan.stamp,
        ended_at=scan.stamp,
        repeats=1,
    )


def kidnapped(scans: Sequence[LogScan]) -> tuple[list[LogScan], int]:
    """Return the scans without their third quarter, of which the odometry shows nothing, and where that gap is."""
    gap, after = len(scans) // 2, 3 * len(scans) // 4
    last, first = scans[gap - 1].odom, scans[after].odom
    moved = [replace(scan, odom=last.compose(scan.odom.relative_to(first))) for scan in scans[after:]]
    return [*scans[:gap], *moved], gap


def figures(samples: Sequence[Sample], *, search: bool, gap: int | None = None) -> dict[str, object]:
    """Return the figures of an evaluation; errors count from the first scan at which there is a pose to rely on.

    A pose is relied on while its status is good or weak. `gap`: number of the first scan after a kidnapping.
    """
    relied = np.array([sample.status in {"good", "weak"} for sample in samples])
    good = np.array([sample.status == "good" for sample in samples])
    errors = np.array([sample.position_error for sample in samples])
    headings = np.degrees([sample.heading_error for sample in samples])
    converged = int(np.argmax(relied)) if relied.any() else None
    used = np.isfinite(errors)
    if search:
        used &= np.arange(len(samples)) >= (len(samples) if converged is None else converged)
    found: dict[str, object] = {
        "scans": len(samples),
        "position_error_median_m": _percentile(errors[used], 50),
        "position_error_p95_m": _percentile(errors[used], 95),
        "position_error_max_m": _percentile(errors[used], 100),
        "heading_error_median_deg": _percentile(headings[used], 50),
        "heading_error_p95_deg": _percentile(headings[used], 95),
        "lost_share": round(float(np.mean([sample.status == "lost" for sample in samples[converged or 0 :]])), 4),
        "good_share": round(float(good.mean()), 4),
        "falsely_good_share": round(float(np.mean([is_falsely_good(sample) for sample in samples])), 4),
        "converged_after_scans": None if converged is None else converged + 1,
        "converged_right": converged is not None and is_right(samples[converged]),
        "sigma_along_median_m": _percentile(np.array([sample.sigma_along for sample in samples])[used], 50),
        "update_ms": _percentile(np.array([sample.milliseconds for sample in samples]), 50),
    }
    if gap is not None:
        right = [number for number in range(gap, len(samples)) if relied[number] and is_right(samples[number])]
        found["recovered_after_scans"] = right[0] - gap + 1 if right else None
    return found


def is_right(sample: Sample) -> bool:
    """Return whether an estimate is near enough to the reference to go on from."""
    return sample.position_error <= _RIGHT_M and sample.heading_error <= _RIGHT_RAD


def is_falsely_good(sample: Sample) -> bool:
    """Return whether an estimate is good by its status and yet far from the reference."""
    return sample.status == "good" and sample.position_error > _FALSELY_GOOD_M


def _percentile(values: NDArray[np.float64], percent: float) -> float | None:
    return round(float(np.percentile(values, percent)), 4) if len(values) else None


START_SCANS: Final = 10
"""A start must be right within so many scans."""
_BEFORE: Final = 15
_AFTER: Final = 45
"""Scans before a robot is carried away, and after."""


def random_starts(
    fields: MapFields,
    scans: Sequence[LogScan],
    config: LocalizationConfig,
    *,
    trials: int,
    seed: int,
    on_trial: Callable[[int], None] = lambda _: None,
) -> dict[str, object]:
    """Start at random scans of a log without a pose; return how often the pose was right, and how often wrong.

    A start counts by the first of its scans at which there is a pose to rely on; it is deceived if any of its scans is
    falsely good.
    """
    rng = np.random.default_rng(seed)
    found = {"right": 0, "wrong": 0}
    falsely_good = 0
    deceived: list[int] = []
    for trial in range(trials):
        first = int(rng.integers(0, max(1, len(scans) - START_SCANS)))
        excerpt = scans[first : first + START_SCANS]
        samples = track(fields, excerpt, config, seed=seed + trial, search=True)
        relied = next((sample for sample in samples if sample.status in {"good", "weak"}), None)
        if relied is not None:
            found["right" if is_right(relied) else "wrong"] += 1
        deceiving = sum(map(is_falsely_good, samples))
        falsely_good += deceiving
        if deceiving:
            deceived.append(trial)
        on_trial(trial)
    return {
        "starts": trials,
        "scans_each": START_SCANS,
        "right_share": round(found["right"] / trials, 4),
        "wrong": found["wrong"],
        "undecided": trials - sum(found.values()),
        "falsely_good_scans": falsely_good,
        "deceived": deceived,
    }


def random_kidnappings(
    fields: MapFields,
    scans: Sequence[LogScan],
    config: LocalizationConfig,
    *,
    trials: int,
    seed: int,
    on_trial: Callable[[int], None] = lambda _: None,
) -> dict[str, object]:
    """Carry the robot from random scans of a log to others unnoticed; return how many scans were falsely good.

    The odometry of an excerpt goes on as if nothing had happened.
    """
    rng = np.random.default_rng(seed)
    evaluated = falsely_good = 0
    deceived: list[int] = []
    for trial in range(trials):
        excerpt, landed = _kidnapped(scans, rng)
        samples = track(fields, excerpt, config, seed=seed + trial, search=False)[landed:]
        wrong = sum(map(is_falsely_good, samples))
        evaluated, falsely_good = evaluated + len(samples), falsely_good + wrong
        if wrong:
            deceived.append(trial)
        on_trial(trial)
    return {
        "kidnappings": trials,
        "scans": evaluated,
        "falsely_good_scans": falsely_good,
        "falsely_good_kidnappings": len(deceived),
        "deceived": deceived,
    }


def _kidnapped(scans: Sequence[LogScan], rng: np.random.Generator) -> tuple[list[LogScan], int]:
    """Return an excerpt with a random kidnapping in it, and the number of the first scan after it."""
    before = min(_BEFORE, len(scans) // 2)
    begin = int(rng.integers(0, len(scans) - before))
    land = int(rng.integers(0, max(1, len(scans) - _AFTER)))
    last = scans[begin + before - 1].odom
    landing = scans[land : land + _AFTER]
    later = scans[begin + before - 1].stamp - landing[0].stamp + 1.0
    moved = [
        replace(scan, odom=last.compose(scan.odom.relative_to(landing[0].odom)), stamp=scan.stamp + later)
        for scan in landing
    ]
    return [*scans[begin : begin + before], *moved], before


_COLOURS: Final = {"good": "#008c3c", "weak": "#e69600", "lost": "#d20000", "none": "#d20000"}


def write_plot(path: Path, map_: StaticMap, samples: Sequence[Sample]) -> None:
    """Write a PNG: reference in blue, estimates green (good), orange (weak) or red, lines between the two of a scan.

    Raises `WrongUseError` if the file can't be written.
    """
    figure, axes = floor(map_)
    axes.plot([sample.reference.x for sample in samples], [sample.reference.y for sample in samples], color="#3c6ee6")
    for status, colour in _COLOURS.items():
        pairs = [(s.reference, s.estimate) for s in samples if s.estimate is not None and s.status == status]
        if pairs:
            axes.plot(*np.array([[(a.x, a.y), (b.x, b.y)] for a, b in pairs]).T, color="#f07878", linewidth=1)
            axes.scatter([b.x for _, b in pairs], [b.y for _, b in pairs], 12, color=colour, zorder=3)
    write_png(figure, path)
