"""`fognav calibrate` on simulated robots that are not as their settings say, and on drives that tell too little."""

from __future__ import annotations

import json
import math
import resource
import socket
import subprocess
import sys
import threading
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import pytest

from fog_runtime.configuration.robot_file import parse_robot
from fog_runtime.record import Recorder
from fognav.output import FailedError, WrongUseError
from fognav.robot_page import by_itself, calibrating
from fognav.robot_page.by_itself import SPEED_M_S, SquareDrive
from fognav.robot_page.calibrating import read, refuse_disagreement
from fognav.robot_page.view import RobotView
from fognav_experiments.bench.calibration import Body, driven, measure, random_body, recording
from robot_agent.agent import local_link
from robot_agent.agent.hand_driving import HandReply, Steer, TakeOver
from robot_agent.agent.recording.input_log import TOPIC_OF_ENTRY, BaseReceived, Published, ScanReceived, Started
from robot_agent.calibrated import NAMES, Calibration, Figure, changes
from robot_agent.calibration import CalibrationError, Calibrator
from robot_agent.hardware import WheelOdometry
from robot_agent.scan_builder import Mounting

STRAIGHT = (0.12, 0.0, 16.0)
LEFT, RIGHT = (0.0, 0.5, 14.0), (0.0, -0.5, 14.0)
BACK = (-0.12, 0.0, 16.0)
TOML = '[base]\ndriver = "roomba600"\n[base.options]\naxle_m = 0.235  # by a ruler\n[lidar]\ndriver = "rplidar-a1"\n'


def calibrator_of(walk, body=None, seed=3, slip=0.01) -> Calibrator:
    rng, made = np.random.default_rng(seed), Calibrator()
    for entry in recording(body or random_body(rng), rng, walk, slip):
        made.take(entry)
    return made


def write(file, body, seed, walk=None) -> None:
    rng = np.random.default_rng(seed)
    with Recorder(file) as recorder:
        for number, entry in enumerate(recording(body, rng, *([walk] if walk else []))):
            recorder.write_entry(TOPIC_OF_ENTRY[type(entry)], entry, number)


@pytest.mark.drive
def test_wheels_axle_and_lidar_of_wrong_bodies_are_found():
    found = measure(2)
    assert found["mirrored_wrong"] == 0
    worst = found["worst"]
    assert max(worst["left"], worst["right"], worst["axle"]) < 0.004
    assert max(worst["x"], worst["y"]) < 0.005
    assert worst["yaw"] < math.radians(0.3)
    assert found["intervals_true"] > 0.6


@pytest.mark.long
@pytest.mark.timeout(300)
def test_eight_bodies_up_to_15_percent_wrong_are_found_and_intervals_are_honest():
    found = measure(8)
    assert found["mirrored_wrong"] == 0
    assert max(found["worst"][name] for name in ("left", "right", "axle")) < 0.0035
    assert max(found["worst"][name] for name in ("x", "y")) < 0.005
    assert found["worst"]["yaw"] < math.radians(0.3)
    assert 0.9 <= found["intervals_true"] <= 0.99


@pytest.mark.drive
def test_how_much_the_wheels_slip_is_told_as_the_noise_that_the_filter_counts_with_and_only_more_is_written():
    body = Body(left=1.0, right=1.0, axle=1.0, x=0.04, y=-0.02, yaw=0.1, latency=0.0, mirrored=False)
    slip, walk = 0.08, [(0.0, 0.0, 1.0), *[STRAIGHT, BACK, LEFT, RIGHT] * 3]
    found = calibrator_of(walk, body, slip=slip).solve()
    by_turn, by_way = 0.5 * slip**2, 2.0 * 0.1 * 0.12 * slip**2 / 0.235**2 / (2.0 * 0.1)
    assert by_turn / 2 < found.noise[0] < 2 * by_turn
    assert by_way / 2 < found.noise[1] < 2 * by_way
    settings = parse_robot(f"{TOML}[odometry]\nalphas = [0.001, 0.05, 0.01, 0.05]\n", Path("robot.toml"), {}).settings
    told = {c.setting: c.now for c in changes(found, config_of(body), settings, 0.072)}
    assert told["odometry.alphas"] == [pytest.approx(found.noise[0], abs=1e-4), 0.05, 0.01, 0.05]


@pytest.mark.drive
def test_what_was_not_heard_while_the_wheels_turned_makes_no_figure_wrong():
    rng = np.random.default_rng(1)
    body, made = random_body(rng), Calibrator()
    for entry in recording(body, rng):
        if getattr(entry, "now", 0.0) < 40.0 or entry.now % 8.0 > 3.0:
            made.take(entry)
    found = made.solve()
    for name in ("left", "right", "axle"):
        truth = getattr(body, name) * (0.235 if name == "axle" else 1.0)
        assert found.figures[name].value == pytest.approx(truth, rel=0.004)
    with pytest.raises(CalibrationError, match=r"were not heard from 40\.\d s to 43\.\d s of this drive"):
        made.end_error(made.start, mirrored=False)


def test_a_drive_is_heard_while_it_is_calibrated_by(tmp_path, monkeypatch):
    """The agent's socket holds a second of what is not read."""
    path, log, heard, solved = tmp_path / "agent.sock", tmp_path / "drive.mcap", threading.Event(), []
    entries = list(recording(random_body(np.random.default_rng(1)), np.random.default_rng(1), [STRAIGHT]))
    monkeypatch.setattr(calibrating, "_progress", lambda _: str(solved.append(heard.wait(10.0))))
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(str(path))
        listener.listen()

        def serve():
            link, _ = listener.accept()
            with link:
                for entry in entries:
                    link.sendall(local_link.encode(entry))
                heard.set()

        server = threading.Thread(target=serve)
        server.start()
        with pytest.raises(FailedError, match="the agent has closed the link"):
            calibrating.record(path, log, None)
        server.join()
    assert solved == [True], "all was read before the first solution"


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


@pytest.mark.drive
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
    again = subprocess.run([*command, "--write"], check=False, stderr=subprocess.PIPE, timeout=120.0)
    assert again.returncode == 2
    assert b"another base.options.wheel_diameter_m, base.options.axle_m, odometry.wheel_ratio" in again.stderr
    assert b"record anew" in again.stderr
    assert settings.read_text("utf-8") == text, "the same factors count once"


@pytest.mark.parametrize(
    ("mirrored", "masks"), [(False, [[0.1, 0.4], [3.1, -3.0832]]), (True, [[0.0, 0.3], [-2.8, -2.7]])]
)
def test_masks_stay_on_the_same_samples_when_the_lidar_turns_out_turned_or_mirrored(mirrored, masks):
    drawn = [[0.0, 0.3], [3.0, 3.1]]
    drawn_as = f"masks = {drawn}\nyaw_rad = 0.1\n"
    settings = parse_robot(f"{TOML}{drawn_as}", Path("robot.toml"), {}).settings
    figures = dict.fromkeys(NAMES, Figure(1.0, 0.1)) | {"yaw": Figure(0.2, 0.01)}
    config = config_of(Body(left=1.0, right=1.0, axle=1.0, x=0.0, y=0.0, yaw=0.0, latency=0.0, mirrored=False))
    told = changes(Calibration(figures, mirrored, 30, 0.0, 0.0), config, settings, 0.072)
    assert [(c.before, c.now) for c in told if c.setting == "lidar.masks"] == [(drawn, masks)]


@pytest.mark.drive
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


def square_of(body, seed) -> list:
    """Entries of a square that ends near its start: two metres and a half in all."""
    turn = (math.pi / 2) * body.axle / (0.5 * (body.left + body.right)) / 0.5
    walk = [(0.0, 0.0, 1.0), *[(0.12, 0.0, 5.0), (0.0, 0.5, turn)] * 4, (0.0, 0.0, 1.0)]
    return list(recording(body, np.random.default_rng(seed), walk))


def with_settings(entries, body, latency):
    """The same drive by a robot whose settings are what its body is, but for the latency: it counts by other wheels."""
    diameter = 0.5 * (body.left + body.right)
    for entry in entries:
        match entry:
            case Started(config=config):
                drive = replace(
                    config.drive_train, axle_m=0.235 * body.axle, wheel_ratio=body.right / body.left,
                    travel_wrap_m=diameter * config.drive_train.travel_wrap_m,
                )  # fmt: skip
                lidar = replace(
                    config.localization, lidar_x=body.x, lidar_y=body.y, lidar_yaw=body.yaw, lidar_latency=latency,
                    lidar_mirrored=body.mirrored,
                )  # fmt: skip
                yield msgspec.structs.replace(entry, config=replace(config, drive_train=drive, localization=lidar))
            case BaseReceived(feedback=feedback):
                left, right = (diameter * way for way in (feedback.odometry.left_m, feedback.odometry.right_m))
                counted = msgspec.structs.replace(feedback, odometry=WheelOdometry(left_m=left, right_m=right))
                yield msgspec.structs.replace(entry, feedback=counted)
            case _:
                mounted = Mounting(mirrored=body.mirrored, latency_s=latency).apply(entry.scan())
                yield ScanReceived.of(mounted, entry.now)


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_square_driven_by_the_new_settings_says_the_same_as_one_by_the_old(tmp_path, mirrored):
    """It was judged by the old settings' factors once more, and contradicted every calibration that was right."""
    body = Body(left=1.07, right=1.09, axle=1.1, x=0.04, y=-0.02, yaw=0.1, latency=0.03, mirrored=mirrored)
    recorded, entries = Calibrator(), square_of(body, 6)
    recorded.take(entries[0])
    values = (body.left, body.right, 0.235 * body.axle, body.x, body.y, body.yaw, body.latency)
    found = Calibration(
        {name: Figure(value, 0.001) for name, value in zip(NAMES, values, strict=True)}, mirrored, 99, 0.0, 0.0
    )
    told = []
    for name, square in (("old", entries), ("new", with_settings(entries, body, 0.03))):
        with Recorder(tmp_path / f"{name}.mcap") as recorder:
            for number, entry in enumerate(square):
                recorder.write_entry(TOPIC_OF_ENTRY[type(entry)], entry, number)
        told.append(refuse_disagreement(found, recorded, tmp_path / f"{name}.mcap"))
    assert told[0]["end_error_m"] < 0.02 < told[0]["end_error_before_m"]
    for name, within in (("end_error_before_m", 0.005), ("end_error_m", 0.005), ("end_turn_deg", 0.3), ("way_m", 0.01)):
        assert told[1][name] == pytest.approx(told[0][name], abs=within)


@pytest.mark.parametrize(("off", "turned"), [(0.01, 0.0), (0.024, 0.008), (0.04, -0.004)])
def test_where_a_square_ends_is_told_finer_than_the_cells_in_which_it_is_looked_for(off, turned):
    """They are 5 cm and a degree wide, more than what a calibration has to be better by."""
    body = Body(left=1.0, right=1.0, axle=1.0, x=0.0, y=0.0, yaw=0.0, latency=0.0, mirrored=False)
    walk = [(0.0, 0.0, 2.0), (off / 0.5, turned / 0.5, 0.5), (0.0, 0.0, 2.0)]
    made, first = Calibrator(), None
    for entry in recording(body, np.random.default_rng(3), walk):
        if isinstance(entry, BaseReceived):
            first = first or entry
            made.take(msgspec.structs.replace(first, now=entry.now))  # as if it slid, and no wheel turned
        else:
            made.take(entry)
    error, turn, _ = made.end_error(made.start, mirrored=False)
    assert error == pytest.approx(off, abs=0.005)
    assert turn == pytest.approx(abs(turned), abs=0.003)


def test_a_full_disk_ends_a_calibration_with_what_to_do_and_what_was_written_can_be_read(tmp_path):
    path, log = tmp_path / "agent.sock", tmp_path / "drive.mcap"
    body = Body(left=1.0, right=1.0, axle=1.0, x=0.0, y=0.0, yaw=0.0, latency=0.0, mirrored=False)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(str(path))
        listener.listen()

        def serve():
            link, _ = listener.accept()
            with link, suppress(ConnectionError):
                for entry in recording(body, np.random.default_rng(1)):
                    link.sendall(local_link.encode(entry))

        server = threading.Thread(target=serve)
        server.start()
        run = subprocess.run(
            [sys.executable, "-m", "fognav", "calibrate", "--socket", str(path), "--out", str(log)],
            check=False, stderr=subprocess.PIPE, timeout=60.0,
            preexec_fn=partial(resource.setrlimit, resource.RLIMIT_FSIZE, (400_000, 400_000)),
        )  # fmt: skip
        server.join()
    assert run.returncode == 1
    assert b"File too large. What was recorded until now can be read: make room" in run.stderr
    assert b"Traceback" not in run.stderr
    assert read(log).driven().straight_m > 0.0


# --- by itself ---


def config_of(body):
    return next(recording(body, np.random.default_rng(1))).config


def walk_by_itself(config) -> list[tuple[float, float, float]]:
    """Return what a robot that calibrates itself is told (m/s, rad/s, s): its wheels follow within 0.1 s, and count."""
    plan, now, walk = SquareDrive(config), 0.0, [(0.0, 0.0, 1.0)]
    speeds, rolled, half = np.zeros(2), np.zeros(2), 0.5 * config.drive_train.axle_m
    while not plan.done:
        plan.on_counters(*rolled)
        assert plan.problem(now) == ""
        v, w = plan.motion(now)
        walk.append((v, w, 0.05))
        for _ in range(10):
            speeds = speeds + (np.array((v - w * half, v + w * half)) - speeds) * 0.05
            rolled = rolled + speeds * 0.005
        now += 0.05
    return [*walk, (0.0, 0.0, 1.0)]


@pytest.mark.drive
@pytest.mark.parametrize("off", [0.86, 1.15])
def test_a_robot_that_drives_by_itself_stays_in_its_square_and_tells_all_however_wrong_its_wheels_are(off):
    body = Body(left=off, right=off * 1.01, axle=2.0 - off, x=0.05, y=-0.03, yaw=0.1, latency=0.01, mirrored=False)
    walk = walk_by_itself(config_of(body))
    assert max(abs(v) for v, _, _ in walk) <= SPEED_M_S
    poses, _ = driven(body, np.random.default_rng(3), walk)
    assert np.abs(poses[:, :2]).max() + 0.17 < 0.6, "no part of it leaves the square"
    assert math.hypot(*poses[-1, :2]) < 0.1, "each movement is undone"
    found = calibrator_of(walk, body).solve().figures
    assert found["left"].value == pytest.approx(body.left, rel=0.006)
    assert found["right"].value == pytest.approx(body.right, rel=0.006)
    assert found["axle"].value == pytest.approx(0.235 * body.axle, rel=0.006)
    assert found["yaw"].value == pytest.approx(0.1, abs=math.radians(0.5))


def test_a_robot_without_free_and_seen_floor_around_it_does_not_drive_by_itself():
    body = Body(left=1.0, right=1.0, axle=1.0, x=0.0, y=0.0, yaw=0.0, latency=0.0, mirrored=False)
    view = RobotView()
    for entry in recording(body, np.random.default_rng(3), [(0.0, 0.0, 2.0)]):
        view.take(entry)
    points, plan = view.points(), SquareDrive(config_of(body))
    assert plan.unfit(points) == ""
    near = np.concatenate((points, [[0.0, -0.5]]))
    assert "something stands 0.50 m from it, 90 degrees to the right: 0.65 m must be free" in plan.unfit(near)
    begun = np.concatenate((points, [[0.0, -0.6]]))
    assert plan.unfit(begun) != ""
    assert plan.unfit(begun, -0.05) == "", "the wall that it came nearer to in a round"
    assert "in 18 of 36 directions only" in plan.unfit(points[points[:, 1] > 0.0])
    assert "in 0 of 36 directions only" in plan.unfit(points[:0])
    with pytest.raises(WrongUseError, match=r"too small .*: it needs --square 1.2 at least"):
        SquareDrive(config_of(body), 1.1)


def test_a_robot_that_drives_by_itself_stops_for_who_comes_near_for_slipping_and_for_standing_wheels():
    body = Body(left=1.0, right=1.0, axle=1.0, x=0.0, y=0.0, yaw=0.0, latency=0.0, mirrored=False)
    plan = SquareDrive(config_of(body))
    plan.on_counters(0.0, 0.0)
    walls = np.array([[2.0, y / 10.0] for y in range(-20, 20)])
    foot = np.array([[0.1, 0.4], [0.1, 0.41], [0.1, 0.42]])
    around = np.array([[2.0 * np.cos(a), 2.0 * np.sin(a)] for a in np.linspace(-3.1, 3.1, 90)])
    assert plan.disturbed(around) == ""
    assert plan.disturbed(np.concatenate((around, foot))) == "something has come near"
    assert "in 10 of 36 directions only" in plan.disturbed(walls), "a sheet over the lidar is no free floor"
    assert plan.motion(0.0) == (SPEED_M_S, 0.0)
    assert plan.problem(1.9) == ""
    assert plan.problem(2.1) == "its wheels have not turned for 2 s"
    plan.on_counters(0.6, 0.6)
    assert "it is 0.60 m from where it stood" in plan.problem(2.2)


def test_a_stop_while_a_robot_that_calibrates_itself_stands_between_two_rounds_ends_it(tmp_path, monkeypatch):
    """The next round took it over again: it drove on by itself, seconds after somebody had stopped it."""
    monkeypatch.setattr(by_itself, "_round", lambda _reach: [])
    body = Body(left=1.0, right=1.0, axle=1.0, x=0.0, y=0.0, yaw=0.0, latency=0.0, mirrored=False)
    entries = list(recording(body, np.random.default_rng(1), [(0.0, 0.0, 2.0)]))
    path, said, scan = tmp_path / "agent.sock", [], [e for e in entries if isinstance(e, ScanReceived)][-1]
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(str(path))
        listener.listen()

        def say(link, mode):
            state = {"mode": mode, "codes": [], "reasons": [f"it is in {mode}"]}
            link.sendall(local_link.encode(Published(channel="robot_state", ids={}, message=state)))

        def serve():
            link, _ = listener.accept()
            with link, suppress(ConnectionError):
                for entry in entries:
                    link.sendall(local_link.encode(entry))
                link.settimeout(0.1)
                while True:
                    link.sendall(local_link.encode(scan))
                    with suppress(TimeoutError):
                        if not (packet := link.recv(local_link.REQUEST_LIMIT)):
                            return
                        said.append(type(local_link.decode_request(packet)))
                        if said[-1] is not Steer:
                            link.sendall(local_link.encode(HandReply(accepted=True, reason="done")))
                            say(link, "TELEOP")
                            say(link, "INIT")

        server = threading.Thread(target=serve)
        server.start()
        with pytest.raises(FailedError, match="the robot has stopped: it is in INIT"):
            by_itself.drive(path, tmp_path / "drive.mcap", 1.2, None)
        server.join()
    assert said.count(TakeOver) == 1
