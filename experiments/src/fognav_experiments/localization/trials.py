"""Many random excerpts of one log: starts that know no pose, and robots that are carried away unnoticed."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from fognav_experiments.localization.evaluation import is_falsely_good, is_right, track

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fognav.lidar_logs.logs import LogScan
    from robot_agent.config import LocalizationConfig
    from robot_agent.localization.map_fields import MapFields

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
