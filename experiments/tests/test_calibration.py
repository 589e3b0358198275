"""`fognav calibrate` on simulated robots that are not as their settings say, and on drives that tell too little."""

from __future__ import annotations

import json
import math
import subprocess
import sys

import numpy as np
import pytest

from fog_runtime.configuration.robot_file import parse_robot
from fog_runtime.record import Recorder
from fognav_experiments.bench.calibration import Body, measure, random_body, recording
from robot_agent.agent.recording.input_log import TOPIC_OF_ENTRY
from robot_agent.calibration import CalibrationError, Calibrator

STRAIGHT = (0.12, 0.0, 16.0)
LEFT, RIGHT = (0.0, 0.5, 14.0), (0.0, -0.5, 14.0)
BACK = (-0.12, 0.0, 16.0)
TOML = '[base]\ndriver = "roomba600"\n[base.options]\naxle_m = 0.235  # by a ruler\n[lidar]\ndriver = "rplidar-a1"\n'


def calibrator_of(walk, body=None, seed=3) -> Calibrator:
    rng, made = np.random.default_rng(seed), Calibrator()
    for entry in recording(body or random_body(rng), rng, walk):
        made.take(entry)
    return made


def write(file, body, seed, walk=None) -> None:
    rng = np.random.default_rng(seed)
    with Recorder(file) as recorder:
        for number, entry in enumerate(recording(body, rng, *([walk] if walk else []))):
            recorder.write_entry(TOPIC_OF_ENTRY[type(entry)], entry, number)


def test_wheels_axle_and_lidar_of_wrong_bodies_are_found():
    found = measure(2)
    assert found["mirrored_wrong"] == 0
    worst = found["worst"]
    assert max(worst["left"], worst["right"], worst["axle"]) < 0.004
    assert max(worst["x"], worst["y"]) < 0.005
    assert worst["yaw"] < math.radians(0.3)
    assert found["intervals_true"] > 0.6


@pytest.mark.drive
@pytest.mark.timeout(300)
def test_eight_bodies_up_to_15_percent_wrong_are_found_and_intervals_are_honest():
    found = measure(8)
    assert found["mirrored_wrong"] == 0
    assert max(found["worst"][name] for name in ("left", "right", "axle")) < 0.0035
    assert max(found["worst"][name] for name in ("x", "y")) < 0.005
    assert found["worst"]["yaw"] < math.radians(0.3)
    assert 0.9 <= found["intervals_true"] <= 0.99


@pytest.mark.parametrize(
    ("walk", "missing"),
    [
        ([STRAIGHT, BACK], ["turn in place to the left", "turn in place to the right"]),
        ([LEFT, RIGHT], ["drive straight ahead or back"]),
        ([(0.1, 0.4, 40.0)], ["turn in place to the right", "drive straight ahead or back"]),
        ([STRAIGHT, BACK, LEFT], ["turn in place to the right"]),
    ],
)
def test_a_drive_that_tells_too_little_is_refused_with_the_movement_that_is_missing(walk, missing):
    with pytest.raises(CalibrationError) as refused:
        calibrator_of(walk).solve()
    for sentence in missing:
        assert sentence in str(refused.value)
    assert str(refused.value).count("are driven") == len(missing)


def test_a_drive_in_an_empty_hall_is_refused(monkeypatch):
    monkeypatch.setattr("fognav_experiments.bench.calibration._cast", lambda *ray: np.full(len(ray[1]), np.inf))
    with pytest.raises(CalibrationError, match="pairs of scans fit each other"):
        calibrator_of([STRAIGHT, BACK, LEFT, RIGHT]).solve()


def test_the_command_writes_what_an_independent_square_agrees_with_and_keeps_the_old_values(tmp_path):
    body = Body(left=1.04, right=1.05, axle=1.09, x=0.04, y=-0.02, yaw=0.1, latency=0.0, mirrored=False)
    log, square, settings = tmp_path / "drive.mcap", tmp_path / "square.mcap", tmp_path / "robot.toml"
    write(log, body, 5)
    # A square by its own settings: it ends somewhere near its start, and which way is what the wheels must tell.
    turn = (math.pi / 2) * 1.09 / 1.045 / 0.5
    write(square, body, 6, [(0.0, 0.0, 1.0), *[(0.12, 0.0, 7.0), (0.0, 0.5, turn)] * 4, (0.0, 0.0, 1.0)])
    settings.write_text(TOML, "utf-8")
    command = [sys.executable, "-m", "fognav", "calibrate", str(log), "--robot-file", str(settings)]
    run = subprocess.run(
        [*command, "--write", "--accept", str(square), "--json"], check=True, stdout=subprocess.PIPE, timeout=120.0
    )
    told = json.loads(run.stdout)
    assert told["wheel_left_mm"]["value"] == pytest.approx(72.0 * 1.04, rel=0.004)
    low, high = told["axle_m"]["interval"]
    assert low < 0.235 * 1.09 < high
    assert told["end_error_m"] < 0.05 < told["end_error_before_m"]
    text = settings.read_text("utf-8")
    written = parse_robot(text, settings, {}).settings
    assert written.base.options["axle_m"] == pytest.approx(0.235 * 1.09, rel=0.004)
    assert written.odometry.wheel_ratio == pytest.approx(1.05 / 1.04, rel=0.004)
    assert "before: 0.235" in text
    assert f"({log.name} " in text
    # A robot with these settings has nothing to calibrate: what is found again are the same values.
    again = subprocess.run([*command, "--json"], check=True, stdout=subprocess.PIPE, timeout=120.0)
    assert json.loads(again.stdout)["axle_m"] == told["axle_m"]


def test_a_square_of_another_robot_contradicts_and_nothing_is_written(tmp_path):
    body = Body(left=1.0, right=1.0, axle=1.0, x=0.0, y=0.0, yaw=0.0, latency=0.0, mirrored=False)
    log, square, settings = tmp_path / "drive.mcap", tmp_path / "square.mcap", tmp_path / "robot.toml"
    write(log, body._replace(axle=1.1), 5)
    write(square, body, 6, [(0.0, 0.0, 1.0), *[(0.12, 0.0, 7.0), (0.0, 0.5, math.pi)] * 4, (0.0, 0.0, 1.0)])
    settings.write_text(TOML, "utf-8")
    run = subprocess.run(
        [sys.executable, "-m", "fognav", "calibrate", str(log), "--robot-file", str(settings), "--write",
         "--accept", str(square)],
        check=False, stderr=subprocess.PIPE, timeout=120.0,
    )  # fmt: skip
    assert run.returncode == 1
    assert b"contradicts it" in run.stderr
    assert settings.read_text("utf-8") == TOML
