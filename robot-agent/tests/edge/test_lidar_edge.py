from __future__ import annotations

import asyncio
import time
from functools import partial

import numpy as np
import pytest
from guardian_rig import DEADLINE_S

from fog_runtime.clock import SystemClock
from fog_runtime.configuration.robot_file import default_robot
from fog_runtime.configuration.settings import SettingsError
from fognav_sim.pty_port import PtyPort
from robot_agent.agent.edges.lidar_edge import LidarEdge
from robot_agent.bases.roomba600.emulator import RoombaEmulator
from robot_agent.device_signature import LineCheck
from robot_agent.lidars.rplidar_a1 import protocol as rplidar
from robot_agent.lidars.rplidar_a1.driver import ANSWER_TIMEOUT_S, RESET_S, SAMPLES_TIMEOUT_S, STOP_S, RplidarA1Driver
from robot_agent.lidars.rplidar_a1.emulator import RplidarEmulator
from robot_agent.registry import make_base, signatures
from robot_agent.serial_port import Port, PortLost

STEP = 0.02


def wavy_room(angles, _at):
    return 2.0 + 0.5 * np.cos(3 * np.asarray(angles))


class Line:
    """A driver and an emulated lidar on one serial line, in emulated time."""

    def __init__(self):
        self.device = RplidarEmulator(wavy_room)
        self.driver = RplidarA1Driver()
        self.now = 50.0
        self.scans = []
        self.samples = []
        self.sent = b""
        self.cut = False
        self.write(self.driver.begin(self.now))

    def write(self, data):
        self.sent += data
        if data and not self.cut:
            self.device.receive(data, self.now)

    def run(self, seconds):
        for _ in range(round(seconds / STEP)):
            self.now += STEP
            data = self.device.outgoing(self.now)
            received = self.driver.receive(b"" if self.cut else data, self.now)
            self.scans += received.scans
            self.samples += [received.samples] if received.samples is not None else []
            self.write(received.data + self.driver.tick(self.now))


def test_driver_sends_stop_health_request_and_scan_request_then_scans_arrive():
    line = Line()
    line.run(2.0)
    assert line.sent == rplidar.stop() + rplidar.get_health() + rplidar.scan()
    assert 8 <= len(line.scans) <= 10
    assert np.nanmax(line.scans[0].ranges_m) == pytest.approx(2.5, abs=0.01)
    assert line.driver.problem == ""


def test_lidar_that_scans_already_is_stopped_first_and_its_old_nodes_are_discarded():
    line = Line()
    line.device.receive(rplidar.scan(), line.now)
    line.run(1.0)
    assert line.scans
    assert line.driver.incomplete == 0
    assert all(scan.started_at > 50.0 + STOP_S for scan in line.scans)


def test_samples_come_before_their_scan_is_whole_and_are_those_of_the_scans():
    line = Line()
    line.run(0.25)
    assert not line.scans
    assert line.samples
    line.run(1.75)
    # 2000 a second from the scan's begin on, within 40 ms of it, evenly in time.
    counts = [len(samples.ranges_m) for samples in line.samples]
    assert 3500 < sum(counts) < 3900
    assert max(counts) <= 41
    assert all(0.0 <= s.ended_at - s.started_at <= STEP for s in line.samples)
    angles = np.concatenate([samples.angles_rad for samples in line.samples])
    ranges = np.concatenate([samples.ranges_m for samples in line.samples])
    assert ranges == pytest.approx(wavy_room(angles, 0.0), abs=0.01)
    scan = line.scans[0]
    first = int(np.flatnonzero(np.isclose(angles, scan.angles_rad[0], atol=1e-6))[0])
    assert angles[first : first + len(scan.angles_rad)] == pytest.approx(scan.angles_rad, abs=1e-6)


def test_silence_restarts_the_scan():
    line = Line()
    line.run(1.0)
    line.device.stalled = True
    line.run(SAMPLES_TIMEOUT_S + 0.1)
    assert line.driver.problem.code == "no_samples"
    line.device.stalled = False
    before = len(line.scans)
    line.run(1.0)
    assert len(line.scans) > before
    assert line.driver.problem == ""


def test_lidar_that_does_not_answer_is_asked_repeatedly():
    line = Line()
    line.cut = True
    line.run(3 * (ANSWER_TIMEOUT_S + STOP_S) + 0.2)
    assert line.sent.count(rplidar.get_health()) >= 3
    assert line.driver.problem.code == "no_answer"
    line.cut = False
    line.run(3.0)
    assert line.scans


def test_lidar_in_error_is_reset_and_restarted():
    line = Line()
    line.device.health, line.device.error_code = 2, 7
    line.run(0.5)
    assert line.sent.endswith(rplidar.reset())
    assert line.driver.problem.code == "reports_error"
    assert "error 7" in line.driver.problem
    assert "supply or cable" in line.driver.problem
    line.device.health = 0
    line.run(RESET_S + 1.0)
    assert line.scans


@pytest.mark.parametrize("text", [b"", b"RP LIDAR System.\r\n" * 30, bytes(range(256)) * 4, rplidar.get_info() * 9])
def test_text_of_any_length_after_a_reset_is_skipped(text):
    line = Line()
    line.device.boot_text = text
    line.device.health = 2
    line.run(0.5)
    line.device.health = 0
    line.run(RESET_S + 1.5)
    assert line.scans
    assert line.driver.problem == ""


@pytest.mark.live
async def test_laser_and_motor_are_stopped_when_the_edge_ends(tmp_path, monkeypatch):
    lines = []  # of DTR, which a pty does not have
    monkeypatch.setattr(Port, "set_line", lambda _port, name, *, on: lines.append((name, on)))
    device, scans = RplidarEmulator(wavy_room), []
    with PtyPort(tmp_path / "lidar") as port:
        edge = LidarEdge(str(port.path), RplidarA1Driver(), SystemClock(), lambda *_: None)
        task = asyncio.create_task(edge.run())
        end = time.monotonic() + DEADLINE_S
        while not scans:
            assert time.monotonic() < end
            await asyncio.sleep(0.01)
            device.receive(port.read(), time.monotonic())
            port.write(device.outgoing(time.monotonic()))
            scans.extend(edge.poll(time.monotonic()))
        assert lines == [("dtr", False)]
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        assert port.read() == rplidar.stop()
    assert lines == [("dtr", False), ("dtr", True)]


@pytest.mark.live
async def test_simulated_speed_is_refused_on_a_real_port(tmp_path, monkeypatch):
    monkeypatch.setattr(Port, "device", "/dev/ttyUSB1")
    with PtyPort(tmp_path / "lidar") as port:
        edge = LidarEdge(str(port.path), RplidarA1Driver(), SystemClock(5.0), lambda *_: None)
        with pytest.raises(SettingsError, match="FOGNAV_SPEED is 5, but /dev/ttyUSB1 is no simulated device"):
            await edge.run()
        assert port.read() == b""


@pytest.mark.live
async def test_edge_waits_for_its_port_and_reopens_it(tmp_path):
    link = tmp_path / "lidar"
    scans = []
    edge = LidarEdge(str(link), RplidarA1Driver(), SystemClock(), lambda *_: None)
    task = asyncio.create_task(edge.run())

    async def until(condition, port=None, device=None):
        end = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < end
            await asyncio.sleep(0.01)
            scans.extend(edge.poll(time.monotonic()))
            if port is not None:
                device.receive(port.read(), time.monotonic())
                port.write(device.outgoing(time.monotonic()))

    try:
        await until(lambda: "lidar" in edge.problem and "No such file" in edge.problem)
        for _ in range(2):
            scans.clear()
            with PtyPort(link) as port:
                await until(lambda: len(scans) >= 2, port, RplidarEmulator(wavy_room))
                assert edge.problem == ""
            await until(lambda: edge.problem)
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


class Answering:
    """A base on the lidar's port, which answers as it would on its own."""

    def __init__(self):
        self.base = RoombaEmulator()
        self.received = b""

    def pump(self, port):
        data, now = port.read(), time.monotonic()
        self.received += data
        self.base.receive(data, now)
        self.base.tick(now, 0.01)
        port.write(self.base.outgoing(now))


@pytest.mark.live
@pytest.mark.parametrize("streams", [False, True])
async def test_lidar_commands_are_not_sent_to_a_base_on_the_lidars_port(tmp_path, streams):
    device = Answering()
    if streams:
        device.base.receive(make_base(default_robot()).wake(), time.monotonic())
    with PtyPort(tmp_path / "lidar") as port:
        check = partial(LineCheck, str(port.path), "rplidar-a1", signatures())
        edge = LidarEdge(str(port.path), RplidarA1Driver(), SystemClock(), lambda *_: None, check=check)
        task = asyncio.create_task(edge.run())
        try:
            end = time.monotonic() + DEADLINE_S
            while "a roomba600 speaks on this port, not a rplidar-a1" not in edge.problem:
                assert time.monotonic() < end
                await asyncio.sleep(0.005)
                device.pump(port)
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
    assert 0xA5 not in device.received
    assert device.received == (b"" if streams else bytes((128, 142, 35)))


@pytest.mark.live
@pytest.mark.parametrize("command", [b"", rplidar.scan()])
async def test_a_lidar_that_scans_or_is_silent_passes_the_check(tmp_path, command):
    device, scans = RplidarEmulator(wavy_room), []
    device.receive(command, time.monotonic())
    with PtyPort(tmp_path / "lidar") as port:
        check = partial(LineCheck, str(port.path), "rplidar-a1", signatures())
        edge = LidarEdge(
            str(port.path),
            RplidarA1Driver(),
            SystemClock(),
            lambda *_: None,
            check=check,
        )
        task = asyncio.create_task(edge.run())
        try:
            end = time.monotonic() + DEADLINE_S
            while not scans:
                assert time.monotonic() < end
                await asyncio.sleep(0.005)
                device.receive(port.read(), time.monotonic())
                port.write(device.outgoing(time.monotonic()))
                scans.extend(edge.poll(time.monotonic()))
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


class Motor:
    """A port that records what is done to it."""

    def __init__(self):
        self.done = []

    def set_line(self, name, *, on):
        self.done.append((name, on))

    def write(self, data):
        if data:
            self.done.append(data)

    def discard_input(self):
        self.done.append("discarded")

    def read_available(self):
        return b""


async def test_resting_lidar_is_stopped_with_its_motor_and_started_anew():
    edge = LidarEdge("/dev/none", RplidarA1Driver(), SystemClock(), lambda *_: None)
    port = Motor()
    edge._port, edge._lost = port, asyncio.get_running_loop().create_future()
    for now in (1.0, 1.05, 1.1):
        edge.poll(now, on=False)
    assert port.done == [rplidar.stop(), ("dtr", True)]
    port.done.clear()
    edge.poll(90.0, on=True)
    edge.poll(90.1 + STOP_S, on=True)
    assert port.done == [("dtr", False), "discarded", rplidar.stop(), rplidar.get_health()]


async def test_fetched_bytes_come_first_in_the_next_poll_and_a_port_lost_meanwhile_is_opened_again(monkeypatch):
    driver = RplidarA1Driver()
    edge = LidarEdge("/dev/none", driver, SystemClock(), lambda *_: None)
    port, received, arriving = Motor(), [], [b"a", b"b", b"c", b"d", b""]
    monkeypatch.setattr(port, "read_available", lambda: arriving.pop(0))
    receive = driver.receive
    monkeypatch.setattr(driver, "receive", lambda data, now: received.append((data, now)) or receive(b"", now))
    edge.fetch()
    edge._port, edge._lost = port, asyncio.get_running_loop().create_future()
    edge.fetch()
    edge.fetch()
    edge.poll(5.0)
    edge.poll(5.1)
    assert received == [(b"abc", 5.0), (b"d", 5.1)]
    edge.poll(5.2, on=False)
    edge.fetch()  # a resting lidar is not read

    def lose():
        raise PortLost("/dev/none", "unplugged")

    edge.poll(6.0)
    monkeypatch.setattr(port, "read_available", lose)
    edge.fetch()
    assert edge._port is None
    with pytest.raises(PortLost, match="unplugged"):
        edge._lost.result()
    assert edge.poll(6.1) == ()


@pytest.mark.live
async def test_a_port_named_by_its_number_ends_the_agent_with_the_remedy():
    edge = LidarEdge("/dev/ttyUSB7", RplidarA1Driver(), SystemClock(), lambda *_: None)
    with pytest.raises(SettingsError, match=r"lidar.port: /dev/ttyUSB7 .*/dev/serial/by-id"):
        await edge.run()
