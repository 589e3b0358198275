"""`fognav localize` and `fognav map from-log`, on logs that a simulated robot records in a small floor."""

from __future__ import annotations

import gzip
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from fog_contracts.grid import GridGeometry, StaticMap
from fog_kernels.raycast import cast
from fog_runtime.configuration.maps import load_map, save_map
from fognav.__main__ import app
from fognav.output import WrongUseError
from fognav_experiments.lidar_logs.logs import read_log
from fognav_experiments.localization_trials import _kidnapped, is_falsely_good, track, with_noise
from robot_agent.config import LocalizationConfig
from robot_agent.localization.map_fields import map_fields
from robot_agent.localization.pose import Pose2

BEAMS = np.arange(180) * math.pi / 180.0 - math.pi / 2.0
CORNERS = [(2.0, 2.0), (11.8, 2.0), (11.8, 9.6), (7.4, 9.6), (7.4, 6.2), (3.0, 6.2), (3.0, 9.0)]


def floor() -> StaticMap:
    geometry = GridGeometry(300, 240, 0.05, 0.0, 0.0)
    cells = np.full(geometry.shape, 254, np.uint8)
    for left, bottom, right, top in [
        (1, 1, 13, 3), (11, 1, 13, 11), (3, 3, 4, 4.4), (6.5, 8.6, 11, 10.6), (6.5, 5.4, 8.3, 8.6),
        (1.6, 5.2, 6.5, 7.2), (2, 7.2, 4.2, 10.4),
    ]:  # fmt: skip
        cells[round(bottom * 20) : round(top * 20), round(left * 20) : round(right * 20)] = 0
    return StaticMap(geometry, cells)


FLOOR = floor()


def drive() -> list[Pose2]:
    """Poses each 0.25 m or 0.4 rad along the corners."""
    poses = [Pose2(*CORNERS[0], 0.0)]
    for corner in CORNERS[1:]:
        while math.dist(poses[-1][:2], corner) > 0.2:
            x, y, theta = poses[-1]
            turn = math.remainder(math.atan2(corner[1] - y, corner[0] - x) - theta, math.tau)
            if abs(turn) > 0.05:
                poses.append(Pose2(x, y, theta + max(-0.4, min(0.4, turn))))
            else:
                poses.append(poses[-1].compose(Pose2(0.25, 0.0, turn)))
    return poses


def scans(rng: np.random.Generator) -> list[tuple[Pose2, Pose2, np.ndarray]]:
    """(odometry, reference, ranges) along the drive; 81.9 is the code for no return."""
    solid, g = (FLOOR.cells == 254).astype(np.uint8), FLOOR.geometry
    odom, before, found = Pose2(5.0, -3.0, 1.0), None, []
    for pose in drive():
        if before is not None:
            step = pose.relative_to(before)
            odom = odom.compose(Pose2(step.x * 1.02, step.y, step.theta * 1.02 + 0.004 * rng.standard_normal()))
        before = pose
        ranges = cast(solid, g.resolution, 0.0, 0.0, pose.x, pose.y, BEAMS + pose.theta, 12.0)
        ranges = np.where(rng.random(180) < 0.02, 81.9, ranges + 0.01 * rng.standard_normal(180))
        found.append((odom, pose, ranges))
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    recorded = scans(np.random.default_rng(1))
    lines = [json.dumps({"meta": "synthetic", "beams": 180, "fov_deg": 180})]
    flaser = []
    for number, (odom, reference, ranges) in enumerate(recorded):
        values = [round(float(value), 3) for value in ranges]
        lines.append(json.dumps({"t": 1000.0 + number, "odom": list(odom), "ref": list(reference), "ranges": values}))
        place = " ".join(f"{value:.5f}" for value in reference)
        flaser.append(f"FLASER 180 {' '.join(map(str, values))} {place} {place} 1018930000 host 1018930000")
    (folder / "drive.jsonl.gz").write_bytes(gzip.compress("\n".join(lines).encode()))
    (folder / "drive.log").write_text("# CARMEN\nODOM 0 0 0 0 0 0 1 host 1\n" + "\n".join(flaser) + "\n")
    save_map(folder / "floor", FLOOR)
    return folder


def run(*words: object) -> tuple[int, dict]:
    done = CliRunner().invoke(app, [str(word) for word in (*words, "--json")])
    assert done.stdout, done.output
    return done.exit_code, json.loads(done.stdout)


@pytest.mark.parametrize(("log", "odometry"), [("drive.jsonl.gz", "measured"), ("drive.log", "reference with noise")])
def test_tracking_follows_the_reference(folder, log, odometry):
    png = folder / "tracking.png"
    code, found = run(
        "localize", "--map", folder / "floor.yaml", "--log", folder / log, "--scans", "even", "--png", png
    )
    assert code == 0
    assert found["odometry"] == odometry
    assert found["position_error_median_m"] < 0.04
    assert found["position_error_p95_m"] < 0.15
    assert found["heading_error_median_deg"] < 0.5
    assert found["lost_share"] == found["falsely_good_share"] == 0.0
    assert found["update_ms"] > 0.0
    with Image.open(png) as picture:
        assert len(picture.convert("RGB").getcolors(1 << 16)) > 3


def test_search_of_the_whole_map_finds_the_robot_and_stays_right(folder):
    code, found = run("localize", "--map", folder / "floor.yaml", "--log", folder / "drive.jsonl.gz", "--global")
    assert code == 0
    assert found["converged_right"]
    assert found["converged_after_scans"] <= 10
    assert found["falsely_good_share"] == 0.0
    assert found["position_error_p95_m"] < 0.15


def test_kidnapped_robot_is_found_again(folder):
    _, found = run("localize", "--map", folder / "floor.yaml", "--log", folder / "drive.jsonl.gz", "--kidnap")
    assert found["recovered_after_scans"] is not None
    assert found["recovered_after_scans"] <= 15
    assert found["falsely_good_share"] == 0.0


@pytest.mark.drive
def test_random_starts_and_kidnappings_of_a_log_are_counted(folder):
    trials = ("localize", "--map", folder / "floor.yaml", "--log", folder / "drive.jsonl.gz", "--trials", 4)
    code, starts = run(*trials, "--global")
    assert code == 0
    assert (starts["starts"], starts["scans_each"], starts["wrong"]) == (4, 10, 0)
    assert (starts["falsely_good_scans"], starts["deceived"]) == (0, [])
    assert starts["right_share"] + starts["undecided"] / 4 == 1.0
    assert starts["right_share"] >= 0.5
    code, carried = run(*trials, "--kidnap")
    assert (carried["kidnappings"], carried["scans"]) == (4, 4 * 45)
    assert carried["falsely_good_kidnappings"] == len(carried["deceived"])
    assert code == bool(carried["falsely_good_scans"])


@pytest.mark.parametrize("kinds", [[], ["--global", "--kidnap"]])
def test_trials_without_their_kind_are_refused(folder, kinds):
    words = ["localize", "--map", str(folder / "floor.yaml"), "--log", str(folder / "drive.jsonl.gz"), "--trials", "2"]
    result = CliRunner().invoke(app, [*words, *kinds])
    assert result.exit_code == 2
    assert "--global or --kidnap" in result.output


def test_log_of_another_building_is_never_good(folder, tmp_path):
    cells = FLOOR.cells.copy()
    cells[:, :] = 254
    cells[20:220, 20:280] = 0
    save_map(tmp_path / "hall", StaticMap(FLOOR.geometry, cells))
    code, found = run("localize", "--map", tmp_path / "hall.yaml", "--log", folder / "drive.jsonl.gz", "--global")
    assert (code, found["good_share"], found["converged_right"]) == (1, 0.0, False)


@pytest.mark.parametrize("log", ["drive.jsonl.gz", "drive.log"])
def test_map_of_a_log_shows_the_walls_where_they_are(folder, tmp_path, log):
    _, found = run(
        "map", "from-log", folder / log, "--out", tmp_path / "built", "--scans", "odd", "--poses", "reference"
    )
    built = load_map(tmp_path / "built.yaml")
    assert (found["width"], found["height"]) == (built.geometry.width, built.geometry.height)
    assert found["free"] + found["occupied"] + found["unknown"] == built.cells.size
    true = FLOOR.geometry.sample(FLOOR.cells, built.geometry.centres(np.argwhere(built.cells == 0)[:, ::-1]), 254)
    assert (true == 0).mean() > 0.97
    near = FLOOR.geometry.sample(_grown_walls(), built.geometry.centres(np.argwhere(built.cells == 254)[:, ::-1]), 0)
    assert near.mean() > 0.99
    assert found["occupied"] > 500


@pytest.mark.drive
def test_map_without_a_reference_is_found_by_matching_and_can_be_looked_at(folder, tmp_path):
    words = ("map", "from-log", folder / "drive.jsonl.gz", "--out", tmp_path / "built")
    code, found = run(*words, "--png", tmp_path / "loops.png", "--trajectory", tmp_path / "way.txt",
                      "--film", tmp_path / "grown.gif")  # fmt: skip
    assert code == 0
    assert found["absolute_error_m"] < 0.05
    assert found["relations"]["1 m"]["translation_m"] < 0.03
    rows = np.loadtxt(tmp_path / "way.txt")
    assert rows.shape == (found["scans"], 4)
    assert (np.diff(rows[:, 0]) > 0.0).all()
    with Image.open(tmp_path / "loops.png") as picture:
        assert picture.size == (found["width"], found["height"])
    with Image.open(tmp_path / "grown.gif") as film:
        seen = []
        for number in range(film.n_frames):
            film.seek(number)
            seen.append((np.asarray(film.convert("L")) > 250).mean())
    assert seen[0] < 0.5 * seen[-1]
    assert seen[-1] == pytest.approx(found["free"] / found["width"] / found["height"], abs=0.05)
    assert load_map(tmp_path / "built.yaml").cells.shape == (found["height"], found["width"])


def test_a_leap_of_the_clock_shifts_what_follows_and_a_single_wrong_stamp_shifts_nothing(tmp_path):
    """After a pause longer than 60 scans take, all later stamps were replaced, evenly spaced."""
    leapt = [0.2 * n + (40.0 if n >= 50 else 0.0) + 0.03 * (n % 2) for n in range(100)]
    leapt[20] = 9000.0
    lines = [json.dumps({"t": at, "odom": [0.01 * n, 0.0, 0.0], "ranges": [1.0] * 30}) for n, at in enumerate(leapt)]
    (tmp_path / "leap.jsonl").write_text("\n".join(lines) + "\n")
    log = read_log(tmp_path / "leap.jsonl")
    assert log.stamps_mended == 2
    stamps = np.array([scan.stamp for scan in log.scans])
    assert np.diff(stamps[51:]) == pytest.approx(np.diff(leapt[51:]))
    assert np.diff(stamps[21:50]) == pytest.approx(np.diff(leapt[21:50]))
    assert stamps[49] == pytest.approx(leapt[49]), "of the one wrong stamp nothing is left"


@pytest.mark.drive
def test_stamps_that_go_back_and_missing_scans_are_said_and_lose_nothing(folder, tmp_path):
    with gzip.open(folder / "drive.jsonl.gz", "rt") as file:
        lines = file.read().splitlines()
    scans = [json.loads(line) for line in lines if "ranges" in line]
    other = [line for line in lines if "ranges" not in line]
    at = np.array([scan["odom"][:2] for scan in scans])
    start = next(i for i in range(len(at)) if np.hypot(*(at[i] - at[0])) > 1.0)
    end = next(i for i in range(start, len(at)) if np.hypot(*(at[i] - at[start])) > 2.2)
    kept = scans[: start + 1] + scans[end:]
    kept[3]["t"], kept[5]["t"] = kept[1]["t"], kept[4]["t"]
    (tmp_path / "bad.jsonl").write_text("\n".join([*other, *map(json.dumps, kept)]) + "\n")
    _, found = run("map", "from-log", tmp_path / "bad.jsonl", "--out", tmp_path / "built")
    assert found["stamps_mended"] == 2
    assert len(found["gaps"]) == 1
    assert found["gaps"][0][2] > 2.0
    assert len(read_log(tmp_path / "bad.jsonl").scans) == len(kept)
    done = CliRunner().invoke(app, ["map", "from-log", str(tmp_path / "bad.jsonl"), "--out", str(tmp_path / "built")])
    said = " ".join(done.output.split())
    assert f"2 of {len(kept)} stamps go back, repeat or leap" in said
    assert "no scan tells the way: look at the map there" in said


def test_benchmark_of_mapping_measures_time_memory_and_errors_of_a_log(folder):
    code, found = run("bench", "mapping", "--log", folder / "drive.jsonl.gz")
    assert code == 0
    assert found["log"] == "drive.jsonl.gz"
    assert 0.0 < found["seconds"] < 60.0
    assert 50 < found["rss_mb"] < 4000
    assert found["relations"]["1 m"]["translation_m"] < 0.03
    assert found["scans_fit"]["matched"]["residual_m"] < 0.02
    code, found = run("bench", "mapping", "--log", folder / "drive.jsonl.gz", "--scans", 400)
    assert (code, found["log"]) == (0, "400-scans.jsonl")
    assert 50 < found["scans"] < 150, "those between which the robot has moved"
    assert found["relations"]["1 m"]["translation_m"] < 0.03


def test_benchmark_of_mapping_says_where_recordings_were_looked_for(tmp_path, monkeypatch):
    monkeypatch.setenv("FOGNAV_DATA", str(tmp_path))
    done = CliRunner().invoke(app, ["bench", "mapping"])
    assert done.exit_code == 2
    assert "Let FOGNAV_DATA name the folder of recordings" in " ".join(done.output.split())


@pytest.mark.parametrize("name", ["gone.mcap", "gone.jsonl", "gone"])
def test_log_that_is_not_there_is_named_as_such(tmp_path, name):
    done = CliRunner().invoke(app, ["map", "from-log", str(tmp_path / name), "--out", str(tmp_path / "built")])
    assert (done.exit_code, f"there is no file {tmp_path / name}" in " ".join(done.output.split())) == (2, True)


@pytest.mark.parametrize(
    ("option", "problem"),
    [
        (("--without-loop", "7"), "takes the name of a loop in the list"),
        (("--without-loop", "1-99999"), "scan 99999 is not among those used"),
        (("--png", "missing/loops.png"), "there is no folder"),
    ],
)
def test_map_that_can_not_be_made_says_why(folder, tmp_path, option, problem):
    words = ["map", "from-log", str(folder / "drive.jsonl.gz"), "--out", str(tmp_path / "built"), *option]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 2
    assert problem in " ".join(done.output.split())


def _grown_walls() -> np.ndarray:
    """Return 1 within a cell of a wall's face."""
    solid = np.pad((FLOOR.cells == 254), 1, mode="edge")
    height, width = FLOOR.cells.shape
    return np.max([solid[i : i + height, j : j + width] for i in range(3) for j in range(3)], axis=0).astype(np.uint8)


def test_constant_stamps_increase_and_codes_are_no_ranges(folder):
    log = read_log(folder / "drive.log")
    assert not log.odometry_measured
    assert np.all(np.diff([scan.stamp for scan in log.scans]) > 0.0)
    assert 0.0 < np.mean([np.isnan(scan.ranges).mean() for scan in log.scans]) < 0.1
    assert len(log.select("odd")) + len(log.select("even")) == len(log.scans)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "no scan"),
        ("FLASER 180 1 2 3\n", "line 1"),
        ('{"ranges": [1, "x"], "t": 0, "odom": [0, 0, 0]}\n', "line 1"),
        ('{"meta": "m"}\n{"t": 0, "ranges": [1], "odom": [0, 0, NaN]}\n', "line 2"),
    ],
)
def test_log_that_can_not_be_used_is_refused_with_its_line(folder, tmp_path, text, problem):
    (tmp_path / "bad.log").write_text(text)
    done = CliRunner().invoke(
        app, ["localize", "--map", str(folder / "floor.yaml"), "--log", str(tmp_path / "bad.log")]
    )
    assert done.exit_code == 2
    assert problem in done.stderr


def damaged_logs() -> dict[str, tuple[bytes, int]]:
    """Logs by what is wrong with them, each with the number of the line that can't be read."""
    line = b'{"t": 0, "odom": [0, 0, 0], "ranges": [1, 1]}\n'
    packed = bytearray(gzip.compress(100 * line, mtime=0))
    cut = bytes(packed[:-8])  # without length and checksum
    packed[10] = 0xFF  # a kind of block that does not exist
    return {
        "cut off": (cut, 101),
        "damaged gzip": (bytes(packed), 1),
        "no UTF-8": (50 * line + b'{"t": "\xff"}\n' + line, 51),
        "no object": (line + b"[1, 2]\n", 2),
        "number too large": (line + line.replace(b'"t": 0', b'"t": 1' + 400 * b"0"), 2),
    }


@pytest.mark.parametrize("damage", damaged_logs())
def test_damaged_log_is_refused_with_its_file_and_line(tmp_path, damage):
    content, number = damaged_logs()[damage]
    (tmp_path / "bad.jsonl.gz").write_bytes(content)
    with pytest.raises(WrongUseError, match=rf"bad\.jsonl\.gz, line {number}\b"):
        read_log(tmp_path / "bad.jsonl.gz")


@pytest.mark.drive
@pytest.mark.data
def test_recorded_floor_with_real_odometry_meets_its_targets(data_dir, tmp_path):
    log = data_dir / "lidar_logs" / "intel_odom_ref_scan.jsonl.gz"
    if not log.is_file():
        pytest.skip(f"{log} does not exist")
    run("map", "from-log", log, "--out", tmp_path / "intel", "--scans", "odd", "--poses", "reference")
    code, found = run("localize", "--map", tmp_path / "intel.yaml", "--log", log, "--scans", "even")
    assert code == 0
    assert found["odometry"] == "measured"
    assert found["position_error_median_m"] <= 0.04
    assert found["position_error_p95_m"] <= 0.15
    assert found["heading_error_median_deg"] <= 0.5
    assert found["lost_share"] == found["falsely_good_share"] == 0.0
    for first in (10, 260):
        _, found = run(
            "localize", "--map", tmp_path / "intel.yaml", "--log", log, "--scans", "even", "--global",
            "--first", first, "--count", 10,
        )  # fmt: skip
        assert found["converged_right"]
        assert found["falsely_good_share"] == 0.0


@pytest.mark.data
@pytest.mark.parametrize("name", ["seattle-corrected.log.gz", "intel_odom_ref_scan.jsonl.gz"])
@pytest.mark.drive
def test_robot_carried_away_on_a_recorded_floor_is_never_good_elsewhere(data_dir, tmp_path, name):
    log = data_dir / "lidar_logs" / name
    if not log.is_file():
        pytest.skip(f"{log} does not exist")
    run("map", "from-log", log, "--out", tmp_path / "floor", "--scans", "odd", "--poses", "reference")
    for seed in (1, 2, 3):
        _, found = run(
            "localize", "--map", tmp_path / "floor.yaml", "--log", log, "--scans", "even", "--kidnap", "--seed", seed
        )
        assert found["falsely_good_share"] == 0.0
        assert found["recovered_after_scans"] <= 10


@pytest.mark.data
def test_robot_carried_between_places_that_look_alike_is_not_good_where_suddenly_fewer_beams_agree(data_dir, tmp_path):
    """Two thirds of the beams agree at the old place on a recorded floor, and none passes through a wall there."""
    log = data_dir / "lidar_logs" / "intel_odom_ref_scan.jsonl.gz"
    if not log.is_file():
        pytest.skip(f"{log} does not exist")
    run("map", "from-log", log, "--out", tmp_path / "floor", "--scans", "odd", "--poses", "reference")
    before, after = (read_log(log).select("even")[part] for part in (slice(48, 68), slice(402, 427)))
    last, first = before[-1], after[0]
    carried = [
        replace(
            scan,
            stamp=last.stamp + 1.0 + scan.stamp - first.stamp,
            odom=last.odom.compose(scan.odom.relative_to(first.odom)),
        )
        for scan in after
    ]
    floor, config = load_map(tmp_path / "floor.yaml"), LocalizationConfig(range_max=30.0)
    fields = map_fields(floor.cells, floor.geometry, config)
    samples = track(fields, [*before, *carried], config, seed=485191, search=False)
    assert samples[len(before) - 1].status == "good"
    assert not [sample for sample in samples if sample.status == "good" and sample.position_error > 0.5]
    assert samples[-1].status == "good"


@pytest.mark.data
def test_robot_carried_to_where_half_of_its_beams_agree_is_not_good_there_after_a_drive_either(data_dir, tmp_path):
    """The two of 100 kidnappings on a recorded floor that were falsely good 2 m after the robot had been put down."""
    log = data_dir / "lidar_logs" / "seattle-corrected.log.gz"
    if not log.is_file():
        pytest.skip(f"{log} does not exist")
    run("map", "from-log", log, "--out", tmp_path / "floor", "--scans", "odd", "--poses", "reference")
    floor, config = load_map(tmp_path / "floor.yaml"), LocalizationConfig(range_max=30.0)
    fields = map_fields(floor.cells, floor.geometry, config)
    seed, rng = 1, np.random.default_rng(1)
    scans_of_log = with_noise(read_log(log).select("even"), seed)
    excerpts = [_kidnapped(scans_of_log, rng) for _ in range(78)]
    for trial in (0, 77):
        excerpt, landed = excerpts[trial]
        samples = track(fields, excerpt, config, seed=seed + trial, search=False)[landed:]
        assert not [sample for sample in samples if is_falsely_good(sample)]
        assert samples[6].status == "good"


@pytest.mark.data
@pytest.mark.drive
def test_robot_whose_place_is_not_among_those_that_a_search_keeps_is_not_good_at_another(data_dir, tmp_path):
    """Number 8 of 20 starts in a large building: dozens of places looked alike, and a wrong one was left over."""
    log = data_dir / "lidar_logs" / "infinite-corridor-corrected.log.gz"
    if not log.is_file():
        pytest.skip(f"{log} does not exist")
    run("map", "from-log", log, "--out", tmp_path / "floor", "--scans", "odd", "--poses", "reference")
    floor, config = load_map(tmp_path / "floor.yaml"), LocalizationConfig(range_max=30.0)
    fields = map_fields(floor.cells, floor.geometry, config)
    start = with_noise(read_log(log).select("even"), 1)[239:249]
    samples = track(fields, start, config, seed=9, search=True)
    assert not [sample for sample in samples if is_falsely_good(sample)]
    assert samples[-1].status == "good"


@pytest.mark.data
def test_robot_at_rest_among_people_is_at_no_place_that_its_scan_does_not_confirm(data_dir, tmp_path):
    """Three scans in a museum that a wrong place explained much better than the robot's own: it was weak there."""
    log = data_dir / "lidar_logs" / "fhw-corrected.log.gz"
    if not log.is_file():
        pytest.skip(f"{log} does not exist")
    run("map", "from-log", log, "--out", tmp_path / "floor", "--scans", "odd", "--poses", "reference")
    floor, config = load_map(tmp_path / "floor.yaml"), LocalizationConfig(range_max=30.0)
    fields = map_fields(floor.cells, floor.geometry, config)
    seen = read_log(log).select("even")
    for number in (28, 32, 37):
        at_rest = [replace(seen[number], stamp=0.2 * repeat) for repeat in range(6)]
        samples = track(fields, at_rest, config, seed=1, search=True)
        assert {sample.status for sample in samples} == {"lost"}
        start = with_noise(seen[number : number + 15], 1)
        samples = track(fields, start, config, seed=1, search=True)
        relied = [sample for sample in samples if sample.status in {"good", "weak"}]
        assert relied
        assert max(sample.position_error for sample in relied) < 0.5
