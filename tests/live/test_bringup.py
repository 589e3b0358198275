"""`fognav robot bringup` as a person uses it beside a new robot: its processes are real, its body is simulated."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
import tomllib
from contextlib import contextmanager

import pytest
from by_hand import SETTINGS, Watcher, chromium, ended, robot_without_fog, wait_for
from playwright.sync_api import expect, sync_playwright

pytestmark = [pytest.mark.live, pytest.mark.timeout(150)]

POST = (2.0, 2.2)
"""Where the turned lidar sees a post of its robot, rad in the robot's frame."""
TURNED = f"yaw_rad = {math.pi / 2}\nmirrored = true\nmasks = [[{POST[0]}, {POST[1]}]]\n"


def environment(socket) -> dict[str, str]:
    wires = socket.parent / "sim"
    return {**os.environ, "FOGNAV_BASE_PORT": str(wires / "base"), "FOGNAV_LIDAR_PORT": str(wires / "lidar")}


def bringup(socket, *arguments: str) -> tuple[int, dict[str, dict]]:
    """Return the exit code and the findings by name."""
    command = [sys.executable, "-m", "fognav", "robot", "bringup", "--json", "--socket", str(socket), *arguments]
    done = subprocess.run(command, capture_output=True, check=False, timeout=60.0, env=environment(socket))
    told = json.loads(done.stdout)
    assert told["ok"] is (done.returncode == 0), done.stderr
    return done.returncode, {finding["name"]: finding for finding in told["findings"]}


def test_a_good_robot_is_judged_and_what_nobody_tried_is_not_called_good(tmp_path):
    with robot_without_fog(tmp_path) as socket, Watcher(socket):
        code, found = bringup(socket, "--robot-file", str(tmp_path / "robot.toml"))
    assert {name: f["text"] for name, f in found.items() if f["state"] == "bad"} == {}
    assert code == 0
    good = {"settings", "agent", "versions", "base_port", "lidar_port", "lidar", "lidar_rate", "base", "battery"}
    assert {name for name in good if found[name]["state"] != "ok"} == set()
    untried = {"bumper_left", "bumper_right", "cliff", "wheel_drop", "encoders", "voltage", "own_returns"}
    assert {found[name]["state"] for name in untried} == {"unknown"}
    assert all(found[name]["remedy"] for name in ("bumper_left", "encoders", "voltage"))


def test_an_unplugged_lidar_is_named_with_its_remedy(tmp_path):
    with robot_without_fog(tmp_path, FOGNAV_LIDAR_PORT=str(tmp_path / "nowhere")) as socket:
        wait_for(lambda: bringup(socket, "--seconds", "1")[1]["base"]["state"] == "ok", "the base speaks")
        code, found = bringup(socket)
    assert code == 1
    assert found["lidar"]["state"] == "bad"
    assert f"{tmp_path}/nowhere" in found["lidar"]["text"]
    assert "plugs" in found["lidar"]["remedy"]
    assert found["lidar_rate"]["state"] == found["lidar_returns"]["state"] == "unknown"


def test_without_an_agent_the_computer_is_judged_all_the_same(tmp_path):
    code, found = bringup(tmp_path / "agent.sock")
    assert code == 1
    assert "no robot's agent runs here: start it" in found["agent"]["text"]
    assert found["memory"]["state"] == "ok"


@contextmanager
def opened(folder, socket):
    """Serve the page and open it; yields it and what went wrong in it."""
    command = [sys.executable, "-m", "fognav", "robot", "bringup", "--page", "--socket", str(socket)]
    process = subprocess.Popen(
        [*command, "--robot-file", str(folder / "robot.toml")], stderr=subprocess.PIPE, start_new_session=True,
        env=environment(socket),
    )  # fmt: skip
    with ended(process), sync_playwright() as playwright:
        address = re.search(rb"http://\S+", process.stderr.readline())[0].decode()
        page = chromium(playwright).new_page(viewport={"width": 1500, "height": 950})
        problems = []
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.goto(address)
        yield page
        if picture := os.environ.get("FOGNAV_PICTURE"):
            page.screenshot(path=picture)
        assert problems == []


@pytest.mark.browser
def test_a_lidar_that_is_mounted_turned_and_mirrored_is_set_by_looking_and_its_robots_post_is_masked(tmp_path):
    truth = SETTINGS.replace("[body]", f"{TURNED}[body]")
    with robot_without_fog(tmp_path, truth) as socket, Watcher(socket) as watcher, opened(tmp_path, socket) as page:
        expect(page.locator("[data-name=lidar_rate]")).to_have_class("ok", timeout=30_000)
        expect(page.locator("[data-name=own_returns]")).to_have_class("warn", timeout=20_000)
        page.get_by_label("Mirrored").check()
        drag_a_quarter_turn(page)
        expect(page.get_by_label("Yaw in degrees")).to_have_value("90")
        page.locator("#proposed").get_by_role("button", name="Mask it").click()
        page.get_by_role("button", name="Drag a mask").click()
        drag_a_quarter_turn(page)
        expect(page.locator("#masks")).to_contain_text("0° to 90°")
        page.locator("#masks li", has_text="0° to 90°").get_by_role("button", name="Remove").click()
        page.get_by_role("button", name="Write robot.toml").click()
        expect(page.locator("#reply")).to_contain_text("wrote lidar.yaw_rad, lidar.mirrored, lidar.masks")
        expect(page.locator("[data-name=settings]")).to_contain_text("the agent runs with another mounting")
        assert watcher.rolled(0.3) == pytest.approx((0.0, 0.0), abs=1e-3), "a page that only looks moves nothing"
        assert watcher.mode == "INIT"
        page.keyboard.down("w")
        assert watcher.rolled(0.5) == pytest.approx((0.0, 0.0), abs=1e-3), "it was not taken over"
        page.keyboard.up("w")
        page.get_by_role("button", name="Drive by hand").click()
        expect(page.locator("#mode")).to_have_text("TELEOP", timeout=20_000)
        assert watcher.rolled(0.5) == pytest.approx((0.0, 0.0), abs=1e-3), "no key is held"
        page.keyboard.down("a")
        wait_for(lambda: watcher.rolled(0.2)[1] > 0.005, "a held key turns the wheels")
        page.keyboard.up("a")
        expect(page.locator("[data-name=voltage]")).to_contain_text("while it drives")
    text = (tmp_path / "robot.toml").read_text("utf-8")
    lidar = tomllib.loads(text)["lidar"]
    assert lidar["yaw_rad"] == pytest.approx(math.pi / 2, abs=0.01)
    assert lidar["mirrored"] is True
    assert text.count("by looking: fognav robot bringup), before: ") == 3
    ((begin, end),) = lidar["masks"]
    assert POST[0] - 0.1 < begin <= POST[0] < POST[1] <= end < POST[1] + 0.1


def drag_a_quarter_turn(page) -> None:
    """Drag round the robot, from ahead to the left."""
    box = page.locator("#scan").bounding_box()
    middle, far = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2), 200
    page.mouse.move(middle[0], middle[1] - far)
    page.mouse.down()
    page.mouse.move(middle[0] - far / math.sqrt(2), middle[1] - far / math.sqrt(2))
    page.mouse.move(middle[0] - far, middle[1])
    page.mouse.up()
