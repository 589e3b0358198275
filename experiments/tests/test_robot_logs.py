"""Maps of logs that Fognav's own robots wrote: of a drive through a building, without knowing its map."""

from __future__ import annotations

import json
import math
import re
import socket
import threading
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from small_floors import OFFICE, log_of_drive

from fog_contracts.costs import LETHAL
from fog_contracts.messages import Pose, RobotGoal
from fog_kernels.distance import squared_distance_capped
from fog_mapping.poses import between, compose, place
from fog_runtime.configuration.site import load_site
from fog_runtime.record import Recorder
from fognav.output import WrongUseError
from fognav.robot_page.recording import Recording
from fognav_experiments.bench.calibration import Body, recording
from fognav_experiments.lidar_logs.logs import read_log
from fognav_experiments.lidar_logs.mapping import map_log
from fognav_experiments.lockstep import LockstepDrive
from fognav_sim.sensors import Noise
from robot_agent.agent import local_link
from robot_agent.agent.recording.input_log import TOPIC_OF_ENTRY, LoggedAgent
from robot_agent.agent.recording.input_writer import InputWriter

ESTIG = Path(__file__).parents[2] / "sites" / "estig"


@pytest.fixture(scope="module")
def logged(tmp_path_factory):
    """The log of a robot that visits places of the thesis's floor, and its first true pose."""
    file, site = tmp_path_factory.mktemp("log") / "agent.mcap", load_site(ESTIG)
    start = site.site.robots[0].start
    assert start is not None
    with InputWriter(file, queue_limit=10**6) as writer:
        goals = [Pose(x=each.x, y=each.y, theta=0.0) for each in list(site.site.places.values())[:2]] + [start]
        run = LockstepDrive(
            site, start, RobotGoal(goal_id="g0", pose=goals[0]), 1, Noise(), watched=False, hazard=None, bus=None,
            make_agent=partial(LoggedAgent, write=writer.write),
        )  # fmt: skip
        assert run.warm_up() is None
        run.start()
        for number, pose in enumerate(goals):
            run.system.fog.planner.set_goal(run.robot.id, RobotGoal(goal_id=f"g{number}", pose=pose), any_heading=True)
            until = run.now + 300.0
            while run.now < until and np.hypot(run.world.pose[0] - pose.x, run.world.pose[1] - pose.y) > 0.3:
                run.step()
    return file, np.array((start.x, start.y, start.theta)), site.map


@pytest.mark.drive
def test_walls_of_the_map_stand_where_those_of_the_building_stand(logged):
    file, start, building = logged
    made = map_log(read_log(file).scans, "matched", [], 0.05, 12.0)
    walls = made.map.geometry.centres(np.argwhere(made.map.cells == LETHAL)[:, ::-1].astype(np.int64))
    walls = place(compose(start, between(made.poses[0], np.zeros(3))), walls) - start[:2]
    solid = (building.cells == LETHAL).astype(np.uint8)
    away = np.sqrt(squared_distance_capped(solid, 40)) * building.geometry.resolution
    # The map lies as the first scan does, by some thousandths of a radian turned.
    off = min(
        (building.geometry.sample(away, place(np.array((*start[:2], turn)), walls), 2.0)
         for turn in np.linspace(-0.01, 0.01, 41)),
        key=np.mean,
    )  # fmt: skip
    assert len(walls) > 5000
    assert (off <= 0.05).mean() > 0.9
    assert (off <= 0.1).mean() > 0.97  # 97.7 % of the way that it took when this was written


def test_recording_that_is_no_log_of_an_agent_is_refused(tmp_path):
    (tmp_path / "other.mcap").write_bytes(b"nothing")
    with pytest.raises(WrongUseError, match=r"not an MCAP file.*Name the file that `fognav map record` wrote"):
        read_log(tmp_path / "other.mcap")


STANDS, ALONG = (0.0, 0.0, 4.0), (0.12, 0.0, 20.0)


def entries_of_a_drive(*silences):
    """The entries of a robot that stands for 4 s, and drives straight on, without those of some times (s)."""
    body = Body(left=1.0, right=1.0, axle=1.0, x=0.0, y=0.0, yaw=0.0, latency=0.0, mirrored=False)
    for entry in recording(body, np.random.default_rng(4), [STANDS, ALONG]):
        if not any(begin < getattr(entry, "now", 0.0) < end for begin, end in silences):
            yield entry


def log_of(file, *silences):
    with Recorder(file) as recorder:
        for number, entry in enumerate(entries_of_a_drive(*silences)):
            recorder.write_entry(TOPIC_OF_ENTRY[type(entry)], entry, number)
    return read_log(file)


@pytest.mark.parametrize("silence", [2.0, 14.0], ids=["known by its counters", "too long for its counters"])
def test_a_pause_in_a_log_during_which_the_robot_drove_is_told_by_its_time(tmp_path, silence):
    log = log_of(tmp_path / "drive.mcap", (8.0, 8.0 + silence))
    assert log.stamps_mended == 0
    made = map_log(log.scans, "matched", [], 0.05, 12.0)
    ((begin, end),) = made.figures()["breaks"]
    first = 0.5  # a first scan began at 0.3 s
    assert begin == pytest.approx(8.0 - first, abs=1.8), "of a scan that the map uses"
    assert end == pytest.approx(8.0 + silence - first, abs=0.4)
    (told,) = [line for line in made.lines() if "the wheels were not heard" in line]
    assert f"from {begin:.1f} s to {end:.1f} s" in told


def test_a_pause_in_a_log_during_which_the_robot_stood_or_that_is_short_is_no_break(tmp_path):
    scans = log_of(tmp_path / "drive.mcap", (1.0, 3.5), (8.0, 8.6)).scans
    assert {scan.stretch for scan in scans} == {0}
    assert max(np.diff([scan.stamp for scan in scans])) > 2.4


def test_a_recording_tells_of_a_break_while_it_is_made(tmp_path):
    path, told = tmp_path / "agent.sock", threading.Event()
    made = Recording(tmp_path / "drive.mcap", preview=False)

    def listen_to_advice():
        if "the wheels were not heard for 14 s" in made.advice:
            told.set()

    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(str(path))
        listener.listen()

        def serve():
            link, _ = listener.accept()
            with link, suppress(ConnectionError):  # the recorder leaves once it has told
                for entry in entries_of_a_drive((8.0, 22.0)):
                    link.sendall(local_link.encode(entry))
                told.wait(20.0)

        server = threading.Thread(target=serve)
        server.start()
        made.run(path, listen_to_advice, lambda: told.is_set() or not server.is_alive())
        server.join()
    assert told.is_set()
    assert made.breaks == 1


# --- logs of others, in which something is wrong ---


def turned(scan):
    return {**scan, "ranges": scan["ranges"][20:] + scan["ranges"][:20]}


def leaping(scan):
    x, y, theta = scan["odom"]
    return scan if scan["t"] < 4.0 else {**scan, "odom": [3.0 - y, x + 40.0, theta + math.pi / 2]}


def scaled(key, scale):
    return lambda scan: {**scan, key: [value and value * scale for value in scan[key]]}


def spoilt(tmp_path, spoil) -> Path:
    """Return a log of a drive along a corridor, each scan of which is spoilt."""
    first, *lines = log_of_drive(OFFICE, [(2.0, 2.0), (13.0, 2.0)], 3)
    (tmp_path / "log.jsonl").write_text("\n".join([first, *(json.dumps(spoil(json.loads(one))) for one in lines)]))
    return tmp_path / "log.jsonl"


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda scan: scan, ""),
        (turned, r"looks (29|30|31) degrees \(counter-clockwise\) away from where the log says"),
        (lambda scan: {**scan, "odom": [1.2 * scan["odom"][0], *scan["odom"][1:]]}, r"tells 1.2\d m where the scans"),
        (lambda scan: {**scan, "ranges": [2.0 + 0.01 * (n % 7) for n in range(240)]}, "this map is wrong"),
    ],
    ids=["right", "lidar turned", "odometry too long", "lidar that shows the same all the time"],
)
def test_what_contradicts_the_odometry_is_told(tmp_path, spoil, told):
    made = map_log(read_log(spoilt(tmp_path, spoil)).scans, "matched", [], 0.05, 12.0)
    said = [line for line in made.lines() if re.search("away from where|calibrate|is wrong", line)]
    assert [bool(re.search(told, line)) for line in said] == ([True] if told else [])


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (scaled("ranges", 1000.0), "none of 45 scans shows enough between 0.1 m and 12 m: are its ranges in metres?"),
        (scaled("odom", 1000.0), "the odometry goes faster than 5 m/s again and again, as by"),
    ],
)
def test_millimetres_in_place_of_metres_are_refused(tmp_path, spoil, told):
    with pytest.raises(WrongUseError, match=told):
        map_log(read_log(spoilt(tmp_path, spoil)).scans, "matched", [], 0.05, 12.0)


def test_odometry_that_leaps_goes_on_where_it_was_after_a_break(tmp_path):
    whole, leapt = (read_log(spoilt(tmp_path, spoil)).scans for spoil in (lambda scan: scan, leaping))
    at = next(number for number, scan in enumerate(leapt) if scan.stretch)
    assert {scan.stretch for scan in leapt[at:]} == {1}
    assert leapt[at].odom == pytest.approx(leapt[at - 1].odom)
    for one, other in zip(whole[at:], leapt[at:], strict=True):
        assert one.odom.relative_to(whole[at].odom) == pytest.approx(other.odom.relative_to(leapt[at].odom), abs=1e-9)
