"""The lidar's scan, which begins while the rest of the agent is loaded."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
import time

import numpy as np
import pytest
from guardian_rig import DEADLINE_S
from little_world import KEY

from fog_runtime.clock import SystemClock
from fog_runtime.configuration.settings import SettingsError
from fog_runtime.credentials import CredentialsError
from fognav_sim.pty_port import PtyPort
from robot_agent import __main__ as program
from robot_agent.agent.edges.lidar_edge import LidarEdge
from robot_agent.bases.roomba600.emulator import RoombaEmulator
from robot_agent.lidars.rplidar_a1 import protocol as rplidar
from robot_agent.lidars.rplidar_a1.driver import RplidarA1Driver
from robot_agent.lidars.rplidar_a1.emulator import RplidarEmulator
from robot_agent.serial_port import Port

STARTED_WITHIN_S = 300.0
"""A busy machine needs a minute to load a lidar's driver with numba."""
LOADING_FOR_EVER = """
import importlib.machinery, runpy, sys, time
class Endless:
    def find_spec(self, name, path, target=None):
        if name == "robot_agent.agent.service":
            return importlib.machinery.ModuleSpec(name, self)
    def create_module(self, spec):
        return None
    def exec_module(self, module):
        time.sleep(1e6)  # as in a compiler, no code of Python runs on this thread meanwhile
sys.meta_path.insert(0, Endless())
runpy.run_module("robot_agent", run_name="__main__", alter_sys=True)
"""
"""It waits in the module's code: a finder would hold a lock that all imports need."""
pytestmark = pytest.mark.live


def room(angles, _at):
    return 2.0 + 0.5 * np.cos(3 * np.asarray(angles))


@pytest.fixture
def port(tmp_path):
    with PtyPort(tmp_path / "lidar") as opened:
        yield opened


@pytest.fixture
def motor(monkeypatch):
    """What was done to the DTR line, which a pty does not have."""
    lines = []
    monkeypatch.setattr(Port, "set_line", lambda _port, name, *, on: lines.append((name, on)))
    return lines


def environment(folder, port):
    key = folder / "operator.key"
    key.write_text(KEY.hex())
    (folder / "site.toml").write_text(
        'id = "lab"\n[[robots]]\nid = "r1"\nstart = { x = 1.0, y = 1.0, theta = 0.0 }\nradius = 0.17\n'
    )
    return {
        "FOGNAV_ROBOT": "r1",
        "FOGNAV_SITE_DIR": str(folder),
        "FOGNAV_DATA_DIR": str(folder),
        "FOGNAV_GUARDIAN_SOCKET": str(folder / "guardian"),
        "FOGNAV_OPERATOR_KEY_FILE": str(key),
        "FOGNAV_LIDAR_PORT": str(port.path),
    }


class Device:
    """A lidar, or another device, at the other end of a port; it notes what it receives."""

    def __init__(self, port, emulator=None):
        self.emulator = emulator or RplidarEmulator(room)
        self.received = b""
        self._port = port

    def step(self):
        data, now = self._port.read(), time.monotonic()
        self.received += data
        self.emulator.receive(data, now)
        if isinstance(self.emulator, RoombaEmulator):
            self.emulator.tick(now, 0.01)
        self._port.write(self.emulator.outgoing(now))

    async def until(self, condition, deadline_s=DEADLINE_S):
        end = time.monotonic() + deadline_s
        while not condition():
            assert time.monotonic() < end
            await asyncio.sleep(0.005)
            self.step()


async def test_edge_begins_the_scan_before_anybody_wants_it_and_passes_samples_on_from_then(port, motor):
    device, samples, scans = Device(port), [], []
    edge = LidarEdge(str(port.path), RplidarA1Driver(), SystemClock())
    task = asyncio.create_task(edge.run())
    began = time.monotonic()
    await device.until(lambda: device.emulator.scanning and time.monotonic() - began > 0.5)
    edge.on_samples = lambda newest, _now: samples.append(newest)
    await device.until(lambda: scans.extend(edge.poll(time.monotonic())) or scans)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    device.step()
    assert samples
    assert motor == [("dtr", False), ("dtr", True)]
    assert device.received == rplidar.stop() + rplidar.get_health() + rplidar.scan() + rplidar.stop()


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        (("FOGNAV_SITE_DIR", ""), "this robot's body, start and dock are not known"),
        (("FOGNAV_OPERATOR_KEY_FILE", "/nowhere/key"), "/nowhere/key"),
        (("FOGNAV_CREDENTIALS_FILE", "/nowhere/credentials"), "/nowhere/credentials"),
        (("FOGNAV_BASE", "hovercraft"), "hovercraft"),
        (("FOGNAV_BASE_OPTIONS", '{"axle": 0.2}'), "FOGNAV_BASE_OPTIONS.axle"),
        (("FOGNAV_FOOTPRINT", "[[0.2, 0.1], [0.2, -0.1], [-0.1, 0.0]]"), "FOGNAV_FOOTPRINT"),
        (("FOGNAV_LIDAR_OPTIONS", '{"range": 6.0}'), "FOGNAV_LIDAR_OPTIONS.range"),
    ],
)
async def test_wrong_setting_ends_the_start_before_the_motor_turns(tmp_path, port, motor, monkeypatch, setting, words):
    monkeypatch.setattr(program.logs, "configure", lambda *_: None)
    for name, text in (*environment(tmp_path, port).items(), setting):
        monkeypatch.setenv(name, text)
    with pytest.raises((SettingsError, CredentialsError), match=words):
        await program.main()
    assert motor == []
    assert port.read() == b""


@pytest.mark.timeout(STARTED_WITHIN_S + 2.0 * DEADLINE_S)
async def test_signal_ends_an_agent_that_is_still_being_loaded_and_its_lidars_scan(tmp_path, port):
    device, log = Device(port), tmp_path / "log"
    with log.open("wb") as stderr:
        agent = await asyncio.create_subprocess_exec(
            sys.executable, "-c", LOADING_FOR_EVER, env={**os.environ, **environment(tmp_path, port)}, stderr=stderr
        )
    try:
        await device.until(lambda: device.emulator.scanning, STARTED_WITHIN_S)
        agent.send_signal(signal.SIGTERM)
        await device.until(lambda: agent.returncode is not None)
    finally:
        if agent.returncode is None:
            agent.kill()
            await agent.wait()
    device.step()
    assert agent.returncode == 0
    assert not device.emulator.scanning
    events = [json.loads(line)["event"] for line in log.read_text().splitlines()]
    assert (events[0], set(events[1:-2]), events[-2:]) == (
        "settings_loaded", {"port_open", "base_lost"}, ["stopping", "stopped"],
    )  # fmt: skip
