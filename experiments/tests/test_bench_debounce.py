"""`fognav bench debounce`: the figures of a recording, and what it says about files that are no recordings."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from fognav.__main__ import app
from fognav_experiments.bench import debounce

HEAD = "Timestamp,Raw Distance (cm)\n"


def write(folder, ranges, name="r.csv"):
    lines = [f"{100 + 0.11 * i:.2f},{distance}\n" for i, distance in enumerate(ranges)]
    (folder / name).write_text(HEAD + "".join(lines))


def test_figures_of_a_recording_compare_the_rules_and_are_drawn(tmp_path):
    write(tmp_path, [38.0 + 0.1 * (i % 3) for i in range(60)] + [20.0 + 0.2 * (i % 5) for i in range(60)])
    picture = tmp_path / "rules.png"
    asked = ["bench", "debounce", "--recordings", str(tmp_path), "--trials", "10", "--hours", "0.02", "--json"]
    result = CliRunner().invoke(app, [*asked, "--png", str(picture)])
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert {row["rule"] for row in figures["rows"]} == set(debounce.RULES)
    by_rule = {row["rule"]: row for row in figures["rows"] if row["echo_rate"] == 1.0}
    assert by_rule["evidence"]["detection_median_ms"] < by_rule["consecutive"]["detection_median_ms"]
    assert by_rule["evidence"]["missed_percent"] == 0
    assert by_rule["evidence"]["false_alarms_per_h"] == 0
    assert 0.9 < figures["learned"][0]["echo_rate"] < 1
    with Image.open(picture) as image:
        assert len(image.getcolors(100_000)) > 5


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (None, "there is no recording"),
        (HEAD + "1,x\n", "each line needs a time in s and a distance in cm"),
        (HEAD + "1,38\n" * 3, "only 3 readings in the first 5 s"),
        (HEAD + "".join(f"{i / 10},38\n" for i in range(100)), "no obstacle comes nearer than 0.34 m"),
    ],
)
def test_folder_without_a_usable_recording_is_refused_with_the_reason(tmp_path, content, problem):
    if content is not None:
        (tmp_path / "r.csv").write_text(content)
    result = CliRunner().invoke(app, ["bench", "debounce", "--recordings", str(tmp_path)])
    assert result.exit_code == 2
    assert problem in " ".join(result.output.split())


@pytest.mark.data
def test_default_rule_confirms_recorded_obstacles_within_a_quarter_second_and_raises_no_more_alarms(data_dir):
    found = debounce.recordings_in(data_dir / "hcsr04")
    rows = debounce.measure(found, 100, 0.2, 1, lambda _: None)
    by_rule = {row["rule"]: row for row in rows if row["echo_rate"] == 1.0}
    evidence, five = by_rule["evidence"], by_rule["consecutive"]
    assert evidence["reading_to_confirmed_median_ms"] <= 220
    assert evidence["false_alarms_per_h"] <= five["false_alarms_per_h"]
    assert evidence["missed_percent"] <= five["missed_percent"]


@pytest.mark.data
@pytest.mark.parametrize("rule", ["consecutive", "evidence"])
@pytest.mark.drive
def test_table_in_the_documentation_is_what_its_command_gives(data_dir, monkeypatch, rule):
    monkeypatch.setattr(debounce, "RULES", {rule: debounce.RULES[rule]})
    rows = debounce.measure(debounce.recordings_in(data_dir / "hcsr04"), 500, 5.0, 1, lambda _: None)
    written = (Path(__file__).parents[2] / "docs" / "benchmarks.md").read_text("utf-8").splitlines()
    assert [line for line in written if line.startswith(f"| {rule} |")] == debounce.table(rows)[2:]


@pytest.mark.drive
@pytest.mark.data
def test_calibrated_sonar_with_false_echoes_raises_no_more_alarms_than_one_that_was_not(data_dir):
    found = debounce.recordings_in(data_dir / "hcsr04")
    alarms = {
        name: debounce.false_alarms_per_hour(
            found,
            debounce.RULES[name],
            5.0,
            debounce.STRESS_RATE,
            np.random.default_rng(7),
            calibrated=name == debounce.CALIBRATED,
        )
        for name in (debounce.CALIBRATED, "evidence")
    }
    assert alarms[debounce.CALIBRATED] <= alarms["evidence"]


@pytest.mark.drive
@pytest.mark.data
def test_default_rule_beats_five_in_a_row_at_every_share_of_echoes(data_dir):
    found = debounce.recordings_in(data_dir / "hcsr04")
    rows = debounce.measure(found, 150, 0.2, 1, lambda _: None)
    figures = {(row["rule"], row["echo_rate"]): row for row in rows}
    for echo_rate in debounce.ECHO_RATES:
        evidence, five = figures["evidence", echo_rate], figures["consecutive", echo_rate]
        assert evidence["detection_median_ms"] < five["detection_median_ms"]
        assert evidence["known_percent"] > five["known_percent"]
        assert all(evidence[name] <= five[name] for name in ("missed_percent", "lost_percent", "false_alarms_per_h"))
