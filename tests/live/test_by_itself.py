"""`fognav calibrate --by-itself` in a corridor: the robot's processes are real, the building is simulated."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest
from by_hand import Watcher, ended, robot_without_fog, wait_for

from fognav_experiments.lidar_logs.logs import read_robot_log

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.live, pytest.mark.timeout(120)]

SETTLED_S = 0.6
"""After this time a robot that has to stop within 0.3 s stands, on a busy machine too."""


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    with robot_without_fog(tmp_path_factory.mktemp("robot")) as socket, Watcher(socket) as watcher:
        yield socket, watcher


def calibrates_itself(socket: Path, out: Path, *arguments: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "fognav", "calibrate", "--by-itself", "--socket", str(socket), "--out", str(out)]
    return subprocess.Popen([*command, *arguments], stderr=subprocess.PIPE, stdin=subprocess.DEVNULL)


@pytest.mark.parametrize("way", [signal.SIGINT, signal.SIGKILL])
def test_a_robot_that_calibrates_itself_stops_when_its_tool_is_ended(robot, tmp_path, way):
    socket, watcher = robot
    process = calibrates_itself(socket, tmp_path / "drive.mcap", "--yes")
    with ended(process):
        wait_for(lambda: watcher.mode == "TELEOP" and watcher.rolled(0.3)[0] > 0.01, "it drives by itself")
        process.send_signal(way)
        time.sleep(SETTLED_S)
        assert watcher.rolled(0.3) == pytest.approx((0.0, 0.0), abs=1e-3)
        wait_for(lambda: watcher.mode == "INIT", "the robot waits to be enabled")
        error = process.stderr.read()
    if way == signal.SIGINT:
        assert b"this can't be told yet: turn in place to the left" in error
        assert len(list(read_robot_log(tmp_path / "drive.mcap"))) > 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], b"nobody can be asked here whether the robot may drive by itself"),
        (["--yes", "--square", "4"], b"the robot does not drive by itself: something stands"),
    ],
)
def test_a_robot_does_not_calibrate_itself_unasked_or_without_free_floor(robot, tmp_path, arguments, words):
    socket, watcher = robot
    before = watcher.wheels
    process = calibrates_itself(socket, tmp_path / "drive.mcap", *arguments)
    with ended(process):
        assert words in process.communicate(timeout=60.0)[1]
        assert process.returncode != 0
    assert (watcher.wheels, watcher.mode) == (before, "INIT")
    assert not (tmp_path / "drive.mcap").exists(), "the next try may have its name"
