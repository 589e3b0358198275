"""`fognav teleop` as an operator uses it: keys in a terminal, a game pad, and a page; the robot's processes are real.

The robot has no fog, no site and no map; the building is simulated.
"""

from __future__ import annotations

import fcntl
import json
import os
import pty
import re
import resource
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from contextlib import contextmanager, suppress
from functools import partial
from queue import SimpleQueue
from socket import SHUT_RDWR, create_connection, create_server
from threading import Thread
from typing import TYPE_CHECKING

import numpy as np
import pytest
from by_hand import ESTIG, Watcher, chromium, ended, robot_without_fog, wait_for
from playwright.sync_api import expect, sync_playwright
from scipy.ndimage import distance_transform_edt

from fog_contracts.costs import LETHAL
from fog_mapping.poses import place
from fog_runtime.configuration.maps import load_map
from fognav_experiments.lidar_logs.logs import read_robot_log
from robot_agent.local_client import LocalRobot

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.live, pytest.mark.timeout(120)]

SETTLED_S = 0.6
"""After this time a robot that has to stop within 0.3 s stands, on a busy machine too."""


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    with robot_without_fog(tmp_path_factory.mktemp("robot")) as socket, Watcher(socket) as watcher:
        yield socket, watcher


@pytest.fixture
def robot(shared):
    """The robot that these tests share, without a fault that one of them has left, as on a busy machine it may."""
    socket, watcher = shared
    if watcher.mode == "FAULT":
        with LocalRobot(socket) as local:
            wait_for(lambda: local.reset().accepted, "its fault is reset")
        wait_for(lambda: watcher.mode != "FAULT", "it has no fault")
    return shared


def start(*arguments: str, **streams) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-m", "fognav", "teleop", *arguments], start_new_session=True, **streams)


def test_a_held_key_drives_and_a_released_one_stops(robot):
    socket, watcher = robot
    terminal, theirs = pty.openpty()
    own_terminal = partial(fcntl.ioctl, 0, termios.TIOCSCTTY, 0)  # Ctrl-C reaches it
    process = start(
        "--socket", str(socket), stdin=theirs, stdout=theirs, stderr=theirs, preexec_fn=own_terminal
    )  # fmt: skip
    os.close(theirs)
    with ended(process):
        wait_for(lambda: watcher.mode == "TELEOP", "it has taken the robot over")
        before = watcher.wheels
        for _ in range(40):  # as a terminal repeats a key that is held
            os.write(terminal, b"j")
            time.sleep(0.033)
        turned = (watcher.wheels[0] - before[0], watcher.wheels[1] - before[1])
        assert turned[0] < -0.03, "to the left, the left wheel turns back"
        assert turned[1] > 0.03
        time.sleep(SETTLED_S)
        assert watcher.rolled(0.3) == pytest.approx((0.0, 0.0), abs=1e-3), "nobody holds a key"
        os.write(terminal, b"\x03")
        wait_for(lambda: watcher.mode == "INIT", "Ctrl-C hands the robot back")
        text = b""
        while select.select([terminal], [], [], 0.2)[0]:
            try:
                text += os.read(terminal, 4096)
            except OSError:
                break
        assert b"hold a key to drive" in text
        assert process.wait(5.0) == 0
    os.close(terminal)


def test_a_game_pad_drives_only_while_its_shoulder_button_is_held_and_stops_when_silent_or_unplugged(robot, tmp_path):
    socket, watcher = robot
    event = struct.Struct("<IhBB")  # time, value, kind (1: button, 2: axis, 128: as it is at the start), number
    device = tmp_path / "js0"
    os.mkfifo(device)
    keeper = os.open(device, os.O_RDWR)  # a pipe in the pad's place: this machine has none
    process = start("--socket", str(socket), "--gamepad", str(device), stderr=subprocess.PIPE)
    with ended(process):
        os.write(keeper, event.pack(0, 1, 1 | 128, 4) + event.pack(1, -32767, 2, 0))
        wait_for(lambda: watcher.mode == "TELEOP", "it has taken the robot over")
        assert watcher.rolled(0.5) == pytest.approx((0.0, 0.0), abs=1e-3), "the stick alone drives nothing"
        os.write(keeper, event.pack(2, 1, 1, 4))
        left, right = watcher.rolled(0.8)
        assert left < -0.015 < 0.015 < right
        time.sleep(0.4 + SETTLED_S)  # a wireless one out of range: nothing comes any more, and its file stays
        assert watcher.rolled(0.3) == pytest.approx((0.0, 0.0), abs=1e-3), "it has told nothing for a second"
        os.write(keeper, event.pack(3, -32000, 2, 0))
        assert watcher.rolled(0.5) == pytest.approx((0.0, 0.0), abs=1e-3), "the button is to be pressed again"
        os.write(keeper, event.pack(4, 1, 1, 4))
        assert watcher.rolled(0.8)[1] > 0.015
        writer = os.open(device, os.O_WRONLY)
        os.close(keeper)
        os.close(writer)  # unplugged
        wait_for(lambda: watcher.mode == "INIT", "the robot stands")
        assert b"the game pad is gone" in process.stderr.read()
        assert process.wait(5.0) == 1


def test_without_an_agent_the_command_names_socket_and_remedy(tmp_path):
    process = start("--socket", str(tmp_path / "agent.sock"), "--page", stderr=subprocess.PIPE)
    _, error = process.communicate(timeout=30.0)
    assert process.returncode == 1
    assert f"{tmp_path}/agent.sock: no robot's agent runs here".encode() in error


def test_a_recording_of_a_drive_by_hand_becomes_a_map_of_what_it_saw(robot, tmp_path):
    socket, _ = robot
    file = tmp_path / "drive.mcap"
    fognav = [sys.executable, "-m", "fognav", "map"]
    process = subprocess.Popen(
        [*fognav, "record", str(file), "--socket", str(socket), "--json"], stdout=subprocess.PIPE
    )
    with ended(process), LocalRobot(socket) as driver:
        wait_for(file.exists, "it records")
        wait_for(lambda: driver.take_over().accepted, "it may be driven")
        began_at = true_pose(socket.parent)
        until = time.monotonic() + 14.0
        while (left := until - time.monotonic()) > 0.0:
            driver.steer(*((0.15, 0.0) if left > 7.0 else (0.0, 0.5) if left > 3.0 else (0.15, 0.2)))
            time.sleep(0.05)
        driver.hand_back()
        process.send_signal(signal.SIGINT)
        told = json.loads(process.communicate(timeout=20.0)[0])
    assert told["scans"] > 50
    assert (told["missed"], told["gaps"]) == (0, 0)
    subprocess.run([*fognav, "from-log", str(file), "--out", str(tmp_path / "floor")], check=True, timeout=60.0)
    assert share_on_walls(tmp_path / "floor.yaml", began_at) > 0.95
    # What a loss of power leaves behind can be read up to its last whole chunk.
    cut = tmp_path / "cut.mcap"
    for share in (0.5, 0.77, 0.999):
        cut.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
        assert len(list(read_robot_log(cut))) > 0.8 * share * told["scans"] - 10


def test_a_full_disk_ends_a_recording_and_what_was_written_can_be_read(robot, tmp_path):
    socket, _ = robot
    file = tmp_path / "drive.mcap"
    limit = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (300_000, 300_000))
    process = subprocess.run(
        [sys.executable, "-m", "fognav", "map", "record", str(file), "--socket", str(socket), "--no-preview"],
        check=False, stderr=subprocess.PIPE, preexec_fn=limit, timeout=90.0,
    )  # fmt: skip
    assert process.returncode == 1
    assert b"File too large. What was recorded until now can be read: make room" in process.stderr
    assert len(list(read_robot_log(file))) > 10


def true_pose(folder: Path) -> tuple[float, float, float]:
    """Return where the robot is in its building (x, y in m, theta in rad)."""
    line = json.loads((folder / "truth.jsonl").read_bytes().splitlines()[-2])
    return line["x"], line["y"], line["theta"]


def share_on_walls(map_file: Path, start) -> float:
    """Return the share of a map's walls that lie within 0.1 m of one of estig; its origin is the robot's start."""
    made, real = load_map(map_file), load_map(ESTIG / "map.yaml")
    rows, columns = np.nonzero(made.cells == LETHAL)
    points = np.stack((columns, rows), axis=1) + 0.5
    points = points * made.geometry.resolution + (made.geometry.origin_x, made.geometry.origin_y)
    placed = place(np.array(start), points)
    walls = distance_transform_edt(real.cells != LETHAL) * real.geometry.resolution
    cells = np.floor((placed - (real.geometry.origin_x, real.geometry.origin_y)) / real.geometry.resolution).astype(int)
    return float((walls[cells[:, 1], cells[:, 0]] <= 0.1).mean())


@contextmanager
def served_page(socket: Path):
    """Serve the robot's page; yields a browser and the address that the command prints."""
    process = start("--socket", str(socket), "--page", stderr=subprocess.PIPE)
    with ended(process), sync_playwright() as playwright:
        address = re.search(rb"http://\S+", process.stderr.readline())[0].decode()
        yield chromium(playwright), address


def hold_left(page) -> None:
    """Hold the page's pad to the left."""
    box = page.locator("#pad").bounding_box()
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] - box["width"] / 2 + 4, middle[1])


HIDDEN = """() => {
  Object.defineProperty(document, "hidden", { value: true });
  document.dispatchEvent(new Event("visibilitychange"));
}"""
"""As a telephone's browser tells a page that is not shown; a browser without a screen shows all of its pages."""


def take_over(page) -> None:
    page.get_by_role("button", name="Drive by hand").click(timeout=20_000)
    expect(page.locator("#pad")).not_to_have_class("off", timeout=20_000)


@pytest.mark.browser
def test_the_page_shows_the_scan_drives_while_its_pad_is_held_and_stops_when_it_is_closed(robot):
    socket, watcher = robot
    with served_page(socket) as (browser, address):
        stranger = browser.new_page()
        stranger.goto(address.partition("?")[0])
        expect(stranger.locator("#reasons")).to_contain_text("open the address that the command printed")
        stranger.close()
        page = browser.new_page(viewport={"width": 390, "height": 844}, has_touch=True)
        problems = []
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.goto(address)
        expect(page.locator("#sensors")).to_contain_text(re.compile("[0-9]{3} returns"), timeout=20_000)
        take_over(page)
        hold_left(page)
        left, right = watcher.rolled(1.0)
        assert left < -0.02 < 0.02 < right, "held to the left it turns to the left"
        page.mouse.up()
        time.sleep(SETTLED_S)
        assert watcher.rolled(0.3) == pytest.approx((0.0, 0.0), abs=1e-3)
        if picture := os.environ.get("FOGNAV_PICTURE"):
            page.screenshot(path=picture)
        page.mouse.down()
        wait_for(lambda: watcher.rolled(0.3)[1] > 0.005, "it turns again")
        page.close()
        time.sleep(SETTLED_S)
        assert watcher.rolled(0.3) == pytest.approx((0.0, 0.0), abs=1e-3), "a closed page drives nothing"
        wait_for(lambda: watcher.mode == "INIT", "the robot waits to be enabled")
        assert problems == []


@pytest.mark.browser
def test_a_page_that_is_hidden_or_behind_another_drives_nothing(robot):
    socket, watcher = robot
    with served_page(socket) as (browser, address):
        context = browser.new_context()
        page, other = context.new_page(), context.new_page()
        page.goto(address)
        page.bring_to_front()
        devtools = context.new_cdp_session(page)
        devtools.send("Emulation.setFocusEmulationEnabled", {"enabled": False})  # each page believes to be in front
        take_over(page)
        hold_left(page)
        wait_for(lambda: watcher.rolled(0.3)[1] > 0.005, "it turns")
        other.bring_to_front()
        assert not page.evaluate("document.hasFocus()")
        time.sleep(SETTLED_S)
        assert watcher.rolled(0.3) == pytest.approx((0.0, 0.0), abs=1e-3), "nobody sees the page"
        page.bring_to_front()
        page.mouse.up()
        hold_left(page)
        wait_for(lambda: watcher.rolled(0.3)[1] > 0.005, "it turns again")
        page.evaluate(HIDDEN)
        time.sleep(SETTLED_S)
        assert watcher.rolled(0.3) == pytest.approx((0.0, 0.0), abs=1e-3), "nobody sees the page"
        wait_for(lambda: watcher.mode == "INIT", "the robot waits to be enabled")


@pytest.mark.browser
def test_a_key_drives_no_more_once_cmd_is_pressed_and_none_that_was_held_before_the_take_over(robot):
    socket, watcher = robot
    with served_page(socket) as (browser, address):
        page = browser.new_page()
        page.goto(address)
        expect(page.locator("#mode")).to_have_text("INIT", timeout=20_000)
        page.keyboard.down("a")
        take_over(page)
        assert watcher.rolled(0.5) == pytest.approx((0.0, 0.0), abs=1e-3), "it was held before"
        page.keyboard.up("a")
        page.keyboard.down("a")
        wait_for(lambda: watcher.rolled(0.3)[1] > 0.005, "it turns")
        page.keyboard.down("Meta")  # from now on macOS tells no release of the other key
        page.evaluate("window.dispatchEvent(new KeyboardEvent('keyup', { key: 'Meta', code: 'MetaLeft' }))")
        time.sleep(SETTLED_S)
        assert watcher.rolled(0.5) == pytest.approx((0.0, 0.0), abs=1e-3)


class SlowLink:
    """Relays TCP connections to a port of this computer; what the clients send arrives `delay` s later."""

    def __init__(self, port: int) -> None:
        self.delay = 0.0
        self._to = port
        self._listening = create_server(("127.0.0.1", 0))
        self.port = self._listening.getsockname()[1]
        Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            client = self._listening.accept()[0]
            server = create_connection(("127.0.0.1", self._to))
            waiting = SimpleQueue()
            for work in (
                partial(self._take, client, partial(self._wait, waiting), partial(waiting.put, (0.0, b""))),
                partial(self._take, server, client.sendall, partial(client.shutdown, SHUT_RDWR)),
                partial(self._deliver, waiting, server),
            ):
                Thread(target=work, daemon=True).start()

    def _wait(self, waiting, data: bytes) -> None:
        waiting.put((time.monotonic() + self.delay, data))

    @staticmethod
    def _take(end, then, at_the_end) -> None:
        with suppress(OSError):
            while data := end.recv(65536):
                then(data)
        with suppress(OSError):
            at_the_end()
        end.close()

    @staticmethod
    def _deliver(waiting, end) -> None:
        with suppress(OSError):
            while (item := waiting.get())[1]:
                time.sleep(max(0.0, item[0] - time.monotonic()))
                end.sendall(item[1])
            end.shutdown(SHUT_RDWR)


@pytest.mark.browser
def test_over_a_slow_link_the_page_drives_nothing(robot):
    socket, watcher = robot
    with served_page(socket) as (browser, address):
        port = int(re.search(r":(\d+)/", address)[1])
        link = SlowLink(port)
        page = browser.new_page()
        page.goto(address.replace(f":{port}/", f":{link.port}/"))
        take_over(page)
        hold_left(page)
        wait_for(lambda: watcher.rolled(0.3)[1] > 0.005, "it turns")
        link.delay = 1.0
        expect(page.locator("#reply")).to_contain_text("the link to the page is slow (1.")
        time.sleep(SETTLED_S)
        assert watcher.rolled(0.5) == pytest.approx((0.0, 0.0), abs=1e-3), "what is said now was meant a second ago"
        link.delay = 0.0
        wait_for(lambda: watcher.rolled(0.3)[1] > 0.005, "it turns again")
        page.mouse.up()


@pytest.mark.browser
def test_of_two_pages_one_drives_and_the_other_is_told_so_until_the_first_hands_back(robot):
    socket, watcher = robot
    with served_page(socket) as (browser, address):
        first, second = browser.new_page(), browser.new_page()
        for page in (first, second):
            page.goto(address)
        take_over(first)
        expect(second.locator("#mode")).to_have_text("TELEOP")
        second.get_by_role("button", name="Drive by hand").click()
        expect(second.locator("#reply")).to_contain_text("somebody else drives the robot by hand")
        expect(second.locator("#pad")).to_have_class("off")
        hold_left(second)
        assert watcher.rolled(0.5) == pytest.approx((0.0, 0.0), abs=1e-3), "the second drives nothing"
        hold_left(first)
        assert watcher.rolled(1.0)[1] > 0.02, "the first still drives"
        first.mouse.up()
        first.get_by_role("button", name="Hand back").click()
        expect(second.locator("#mode")).to_have_text("INIT")
        second.mouse.up()
        take_over(second)
        expect(first.locator("#pad")).to_have_class("off")
        hold_left(first)
        assert watcher.rolled(0.5) == pytest.approx((0.0, 0.0), abs=1e-3), "it was handed back"
        hold_left(second)
        assert watcher.rolled(1.0)[1] > 0.02
