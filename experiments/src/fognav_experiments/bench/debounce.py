"""Compares debounce rules on recorded echoes: how soon they detect an obstacle, miss it, and raise false alarms.

A recording of an HC-SR04 is a CSV file whose second column is the measured distance in cm, and its first one the time
in s. It begins with nothing in range but the background. Each trial joins a stretch of the recorded background to one
of recorded obstacles. A share of the obstacle's echoes is replaced by the background, as if the obstacle had not
echoed, and everything passes the filter of the firmware's nodes.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from itertools import pairwise
from statistics import mean, median
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from fog_contracts.site import learned_share
from fognav_experiments.figures import Table, curves, to_markdown, write_png
from hazard_aggregator.debounce import Observation, SonarSample, make_rule
from hazard_aggregator.registry import find_rule

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from pathlib import Path

    from fog_contracts.messages import AreaState

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


STRESS_RATE: Final = 0.02
"""Share of false echoes at random ranges in the second figure of false alarms: more than any recording has."""
CALIBRATED: Final = "evidence, calibrated"
"""The rule with a sonar whose calibration has counted its false echoes."""
CALIBRATION_SAMPLES: Final = 256
"""As in the firmware: `kFreeSamples`."""
RULES: Final[Mapping[str, Mapping[str, Any]]] = {
    "consecutive": {"rule": "consecutive"},
    "n-of-m": {"rule": "n-of-m"},
    "duration": {"rule": "duration"},
    "evidence": {"rule": "evidence"},
    CALIBRATED: {"rule": "evidence"},
}
ECHO_RATES: Final = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
DEADLINE_S: Final = 2.0
"""An obstacle that is not detected so long (s) after it came is missed."""
_BEFORE: Final = 15
_AFTER_S: Final = 4.0
_BLOCK: Final = 20


class Trial(NamedTuple):
    """Times (s) from the obstacle's arrival to its detection (None: missed) and from its departure to `clear`.

    `reading_s`: from the first reading that shows it to its detection; `lost`: how often it was taken for gone;
    `known`: the share of its presence in which the area was blocked.
    """

    detected_s: float | None
    reading_s: float | None
    cleared_s: float | None
    lost: int
    known: float


def measure(
    recordings: Sequence[Recording], trials: int, hours: float, seed: int, on_rule: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Return one row per rule and echo rate; the false alarms per hour are the same in all rows of a rule."""
    rows = []
    for name, choice in RULES.items():
        on_rule(name)
        rng = np.random.default_rng(seed)
        calibrated = name == CALIBRATED
        quiet = false_alarms_per_hour(recordings, choice, hours, 0.0, rng, calibrated=calibrated)
        stressed = false_alarms_per_hour(recordings, choice, hours, STRESS_RATE, rng, calibrated=calibrated)
        learned = [calibrate(recording, 0.0, rng) if calibrated else None for recording in recordings]
        for echo_rate in ECHO_RATES:
            rng = np.random.default_rng(seed)
            pairs = list(zip(recordings, learned, strict=True))
            done = [run_trial(*pairs[i % len(pairs)], choice, echo_rate, rng) for i in range(trials)]
            rows.append(
                {"rule": name, "echo_rate": echo_rate, **_figures(done)}
                | {"false_alarms_per_h": quiet, "false_alarms_stressed_per_h": stressed}
            )
    return rows


def table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the rows as a table in Markdown."""
    names = list(rows[0])
    cells = [[str(row[name]) for name in names] for row in rows]
    return to_markdown([Table([name.replace("_", " ") for name in names], cells)]).splitlines()


def calibrate(recording: Recording, rate: float, rng: np.random.Generator) -> float:
    """Return the rate of false echoes that a node's calibration would learn on the background, with such a share."""
    measured = _stretch(recording.background, CALIBRATION_SAMPLES, rng)
    false = rng.random(CALIBRATION_SAMPLES) < rate
    near = rng.uniform(0.02, recording.limit, CALIBRATION_SAMPLES)
    samples = filtered(np.where(false, near, measured).tolist())
    return learned_share(sum(each < recording.limit for each in samples), len(samples))


def run_trial(
    recording: Recording,
    false_echo_rate: float | None,
    choice: Mapping[str, Any],
    echo_rate: float,
    rng: np.random.Generator,
) -> Trial:
    """Return the figures of one obstacle that comes, stays for 4 s and goes.

    `false_echo_rate` is the one that the sonar's calibration has shown; None: it is not calibrated.
    """
    count = round(_AFTER_S / recording.period_s)
    before = _stretch(recording.background, _BEFORE, rng)
    hidden = _stretch(recording.background, count, rng)
    seen = _stretch(recording.obstacle, count, rng)
    echoes = rng.random(count) < echo_rate
    present = [near if echo else far for near, far, echo in zip(seen, hidden, echoes, strict=True)]
    ranges = filtered([*before, *present, *_stretch(recording.background, count, rng)])
    leaves = _BEFORE + count
    rule = make_rule("", choice, find_rule)
    observed = [_observation(recording, each, false_echo_rate) for each in ranges]
    confirmed = [rule.update(each, i * recording.period_s) for i, each in enumerate(observed)]
    first = next((i for i in range(_BEFORE, leaves) if confirmed[i] == "blocked"), None)
    deadline = _BEFORE + DEADLINE_S / recording.period_s
    detected = first if first is not None and first <= deadline else None
    shown = next((i for i in range(_BEFORE, leaves) if ranges[i] < recording.limit), leaves)
    gone = next((i for i in range(leaves, len(ranges)) if confirmed[i] == "clear"), None)
    inside = [state for state in confirmed[first:leaves] if state is not None] if first is not None else []
    lost = sum(a == "blocked" and b == "clear" for a, b in pairwise(inside))
    known, state = 0, "clear"
    for each in confirmed[_BEFORE:leaves]:
        state = each or state
        known += state == "blocked"
    period = recording.period_s
    return Trial(
        None if detected is None else (detected - _BEFORE) * period,
        None if detected is None else (detected - shown) * period,
        None if gone is None else (gone - leaves) * period,
        lost,
        known / count,
    )


def false_alarms_per_hour(
    recordings: Sequence[Recording],
    choice: Mapping[str, Any],
    hours: float,
    rate: float,
    rng: np.random.Generator,
    *,
    calibrated: bool = False,
) -> float:
    """Return how often a rule finds the recorded background blocked, with so many false echoes at random ranges.

    A `calibrated` sonar learns its rate of false echoes anew for each short stretch: calibrations differ by chance, of
    their own, so that all rules have the same noise.
    """
    calibrations = np.random.default_rng(CALIBRATION_SAMPLES)
    alarms = 0
    for recording in recordings:
        rule, spikes, state = make_rule("", choice, find_rule), SpikeFilter(), "clear"
        for start in range(0, round(hours * 3600 / recording.period_s / len(recordings)), _BLOCK):
            learned = calibrate(recording, rate, calibrations) if calibrated else None
            for offset, measured in enumerate(_stretch(recording.background, _BLOCK, rng)):
                false = rng.random() < rate
                counted = spikes.update(rng.uniform(0.02, recording.limit) if false else measured)
                confirmed = rule.update(
                    _observation(recording, counted, learned), (start + offset) * recording.period_s
                )
                alarms += confirmed == "blocked" and state != "blocked"
                state = confirmed or state
    return round(alarms / hours, 3)


def _figures(trials: Sequence[Trial]) -> dict[str, Any]:
    detected = [trial.detected_s for trial in trials if trial.detected_s is not None]
    reading = [trial.reading_s for trial in trials if trial.reading_s is not None]
    cleared = [trial.cleared_s for trial in trials if trial.cleared_s is not None]
    return {
        "detection_median_ms": _ms(detected, 50),
        "detection_p95_ms": _ms(detected, 95),
        "reading_to_confirmed_median_ms": _ms(reading, 50),
        "missed_percent": round(100 * (1 - len(detected) / len(trials)), 2),
        "lost_percent": round(100 * sum(trial.lost > 0 for trial in trials) / len(trials), 2),
        "known_percent": round(100 * mean(trial.known for trial in trials), 1),
        "clear_median_ms": round(1000 * median(cleared)) if cleared else None,
    }


def _ms(times: Sequence[float], percentile: float) -> int | None:
    return round(1000 * float(np.percentile(times, percentile))) if times else None


def _observation(recording: Recording, measured: float, false_echo_rate: float | None) -> Observation:
    state: AreaState = "blocked" if measured < recording.limit else "clear"
    return Observation(state, (SonarSample(state, measured, recording.limit, false_echo_rate=false_echo_rate),))


def _stretch(ranges: Sequence[float], count: int, rng: np.random.Generator) -> list[float]:
    """Return `count` successive ranges from a random place on; after the last one the first follows."""
    start = int(rng.integers(len(ranges)))
    return [ranges[(start + i) % len(ranges)] for i in range(count)]


_PANELS: Final = (
    ("detection_median_ms", "time to detection, median, ms"),
    ("detection_p95_ms", "time to detection, 95th percentile, ms"),
    ("missed_percent", "obstacles missed for 2 s, %"),
    ("lost_percent", "obstacles lost within 4 s, %"),
    ("known_percent", "share of its 4 s an obstacle is known, %"),
)


def draw(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Write a PNG with one panel per figure, and one line per rule."""
    alarms = {row["rule"]: f"{row['rule']} ({row['false_alarms_stressed_per_h']:g} false alarms/h)" for row in rows}
    panels = {
        title: {
            name: [(100.0 * row["echo_rate"], row[key]) for row in rows if row["rule"] == rule and row[key] is not None]
            for rule, name in alarms.items()
        }
        for key, title in _PANELS
    }
    write_png(curves(panels, "echoes of the obstacle, %"), path)
