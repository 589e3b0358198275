"""The lidar's scan that begins while the agent is being loaded, and who goes on with it."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
import time
from functools import partial

import numpy as np
import pytest
from guardian_rig import DEADLINE_S
from little_world import KEY

from fog_runtime.clock import SystemClock
from fog_runtime.configuration import parts
from fog_runtime.configuration.robot_file import default_robot
from fog_runtime.configuration.settings import SettingsError
from fog_runtime.credentials import CredentialsError
from fognav_sim.pty_port import PtyPort
from robot_agent import __main__ as program
from robot_agent.agent.edges.lidar_edge import LidarEdge, LidarStart
from robot_agent.bases.roomba600.emulator import RoombaEmulator
from robot_agent.device_signature import LISTEN_S, LineCheck, SerialSettings
from robot_agent.lidars.rplidar_a1 import protocol as rplidar
from robot_agent.lidars.rplidar_a1.driver import RplidarA1Driver
from robot_agent.lidars.rplidar_a1.emulator import RplidarEmulator
from robot_agent.registry import LIDARS, make_base, make_lidar, signatures
from robot_agent.serial_port import Port, PortLost

SERIAL = signatures()["rplidar-a1"].serial
QUESTIONS = bytes((128, 142, 35))
"""For a Roomba that might be on a silent line."""
STARTED_WITHIN_S = 300.0
"""A busy machine needs a minute to load a lidar's driver with numba."""
LOADING_FOR_EVER = """
import importlib.machinery, runpy, sys, time
class Endless:
    def find_spec(self, name, path, target=None):
        if name == "robot_agent.agent.process":
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


def start_on(port, clock=None):
    check = partial(LineCheck, str(port.path), "rplidar-a1", signatures())
    return LidarStart(str(port.path), SERIAL, check, clock or SystemClock())


class Seen(RplidarA1Driver):
    """A driver that notes the whole scans that it has returned."""

    def __init__(self):
        super().__init__()
        self.scans = 0

    def receive(self, data, now):
        events = super().receive(data, now)
        self.scans += len(events.scans)
        return events


async def test_edge_goes_on_with_the_scan_that_was_begun_for_it(port, motor):
    device, driver, scans = Device(port), Seen(), []
    clock = SystemClock(0.25)  # so that on a busy machine nothing is asked again
    with start_on(port, clock) as start:
        start.begin(driver)
        await device.until(lambda: driver.scans)
        edge = LidarEdge(str(port.path), driver, clock, lambda *_: None, start=start)
        task = asyncio.create_task(edge.run())
        await device.until(lambda: scans.extend(edge.poll(time.monotonic())) or scans)
        assert motor == [("dtr", False)]
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
    device.step()
    assert motor == [("dtr", False), ("dtr", True)]
    assert device.received == QUESTIONS + rplidar.stop() + rplidar.get_health() + rplidar.scan() + rplidar.stop()


async def test_nothing_is_sent_before_the_line_was_listened_to(port):
    device, began = Device(port), time.monotonic()
    with start_on(port) as start:
        start.begin(RplidarA1Driver())
        await device.until(lambda: device.received)
    assert time.monotonic() - began >= LISTEN_S


async def test_driver_that_wants_other_serial_settings_than_its_signature_says_is_left_to_the_edge(port, motor):
    class Slow(RplidarA1Driver):
        serial = SerialSettings(baud=9600)

    device = Device(port)
    with start_on(port) as start:
        start.begin(Slow())
        assert await asyncio.to_thread(start.take) is None
    device.step()
    assert rplidar.scan() not in device.received


async def test_commands_are_sent_only_when_the_driver_is_loaded(port):
    device = Device(port)
    with start_on(port) as start:
        await device.until(lambda: device.received == QUESTIONS)
        start.begin(RplidarA1Driver())
        await device.until(lambda: device.received.startswith(QUESTIONS + rplidar.stop()))


async def test_scan_that_nobody_takes_over_ends_with_its_motor(port, motor):
    device, driver = Device(port), Seen()
    with start_on(port) as start:
        start.begin(driver)
        await device.until(lambda: driver.scans)
    assert port.read() == rplidar.stop()
    assert motor == [("dtr", False), ("dtr", True)]
    with pytest.raises(PortLost, match="Bad file descriptor"):
        start.take().read_available()


async def test_motor_stands_still_until_the_driver_is_loaded(port, motor):
    device = Device(port)
    with start_on(port):
        await device.until(lambda: device.received == QUESTIONS)
    assert motor == []
    assert port.read() == b""


@pytest.mark.parametrize("streams", [False, True])
async def test_another_device_gets_no_command_and_the_edge_says_what_it_is(port, streams):
    device = Device(port, RoombaEmulator())
    if streams:
        device.emulator.receive(make_base(default_robot()).wake(), time.monotonic())
    check, driver = partial(LineCheck, str(port.path), "rplidar-a1", signatures()), RplidarA1Driver()
    clock = SystemClock(0.25)  # so that a busy machine does not delay the answer for too long
    with start_on(port, clock) as start:
        start.begin(driver)
        edge = LidarEdge(str(port.path), driver, clock, lambda *_: None, check=check, start=start)
        task = asyncio.create_task(edge.run())
        await device.until(lambda: "a roomba600 speaks on this port, not a rplidar-a1" in edge.problem)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
    assert 0xA5 not in device.received


async def test_edge_opens_a_port_that_was_missing_at_the_start(tmp_path):
    link, driver, scans = tmp_path / "lidar", RplidarA1Driver(), []
    start = LidarStart(str(link), SERIAL, partial(LineCheck, str(link), "rplidar-a1", signatures()), SystemClock())
    with start:
        start.begin(driver)
        assert await asyncio.to_thread(start.take) is None
        edge = LidarEdge(str(link), driver, SystemClock(), lambda *_: None, start=start)
        task = asyncio.create_task(edge.run())
        with PtyPort(link) as port:
            await Device(port).until(lambda: scans.extend(edge.poll(time.monotonic())) or scans)
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


@pytest.mark.parametrize("name", parts.names(LIDARS))
def test_serial_settings_that_are_known_before_a_driver_is_loaded_are_the_drivers_own(name):
    serial = signatures()[name].serial
    assert serial is None or serial == make_lidar(default_robot(lidar=name)).serial
    assert serial is None or isinstance(serial, SerialSettings)


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
    assert port.read() in (b"", QUESTIONS)  # all that is written to a line that is listened to


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
    assert events == ["settings_loaded", "stopping", "stopped"]
