"""The simulator as a process: its devices, nodes on a real broker, ground truth and commands over a real router."""

import asyncio
import contextlib
import json
import os
import signal
import time
import urllib.request
from pathlib import Path

import numpy as np
import programs
import pytest
from secured_servers import SecuredSite

from fog_contracts import channels as ch
from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.messages import CommandReply, NodeReading, Pose, SimCommand, SimObstacle, SimTruth
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.maps import save_map
from fog_runtime.security.site_security import CREDENTIALS
from fog_runtime.transports.mqtt_edge import MqttEdge
from fog_runtime.transports.zenoh_edge import ZenohEdge

pytestmark = pytest.mark.live

SITE = """
id = "lab"
[[areas]]
id = "z1"
polygon = [[3.0, 0.2], [5.0, 0.2], [5.0, 2.8], [3.0, 2.8]]
[[nodes]]
id = "n1"
area = "z1"
x = 4.0
y = 0.25
theta = 1.5707963
sonars = [{ angle = -0.1, range_limit = 2.2 }, { angle = 0.1, range_limit = 2.2 }]
[[nodes]]
id = "n2"
area = "z1"
x = 4.0
y = 2.75
theta = -1.5707963
sonars = [{ angle = -0.1, range_limit = 2.2 }, { angle = 0.1, range_limit = 2.2 }]
[[robots]]
id = "r1"
start = { x = 1.0, y = 1.5, theta = 0.0 }
radius = 0.17
"""
BOX = SimObstacle(id="box", polygon=[(3.5, 1.0), (4.5, 1.0), (4.5, 1.4), (3.5, 1.4)], height=1.0)


async def until(condition, description, seconds=45.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, description
        await asyncio.sleep(0.02)


class Rig:
    """The simulator's environment, and what it has published."""

    def __init__(self, folder, mqtt_url, zenoh, site):
        self.folder, self.mqtt_url, self.zenoh, self.site = folder, mqtt_url, zenoh, site
        self.run, self.truth_log, self.port_file = folder / "run", folder / "truth.jsonl", folder / "port"
        self.readings, self.availability, self.truths = [], [], []
        self.edge = None

    def start(self, speed):
        values = {
            "SITE_DIR": self.folder / "site",
            "DATA_DIR": self.folder,
            "RUN_DIR": self.run,
            "TRUTH_LOG": self.truth_log,
            "PORT_FILE": self.port_file,
            "MQTT_URL": self.mqtt_url,
            "ZENOH_CONNECT": self.zenoh,
            "SPEED": speed,
            "NODE_CREDENTIALS_DIR": self.site.security.directory / CREDENTIALS,
        }
        environment = os.environ | self.site.environment("sim") | {f"FOGNAV_{key}": str(v) for key, v in values.items()}
        return programs.start("fognav_sim", environment, self.folder / "sim.log")

    async def send_command(self, **command):
        return await self.edge.query(ch.SIM_COMMAND, SimCommand(**command), CommandReply, 5.0, robot="r1")

    def log(self):
        return [json.loads(line) for line in self.truth_log.read_bytes().splitlines()]


def write_site(folder):
    folder.mkdir()
    (folder / "site.toml").write_text(SITE, "utf-8")
    geometry = GridGeometry(160, 60, 0.05, 0.0, 0.0)
    cells = np.zeros(geometry.shape, np.uint8)
    cells[:4], cells[-4:], cells[:, :4], cells[:, -4:] = 254, 254, 254, 254
    save_map(folder / "map", StaticMap(geometry, cells))


@contextlib.asynccontextmanager
async def simulator(folder: Path, speed=1):
    write_site(folder / "site")
    site = SecuredSite(folder, "lab", robots=["r1"], nodes=["n1"])
    with site.mosquitto() as broker, site.router() as router:
        rig = Rig(folder, broker.url, router.url, site)
        clock = SystemClock()
        console = site.credentials("console")
        mqtt = MqttEdge(broker.url, "test", clock, site="lab", credentials=console)
        mqtt.on(ch.NODE_READING, lambda _, reading: rig.readings.append(reading), NodeReading)
        mqtt.on(ch.NODE_AVAILABILITY, lambda _, text: rig.availability.append(text))
        listening = asyncio.create_task(mqtt.run())
        opened = ZenohEdge.open(
            connect=[router.url], clock=clock, role="console", id="t", site="lab", credentials=console
        )
        async with opened as rig.edge:
            rig.edge.subscribe(ch.SIM_TRUTH, SimTruth, lambda _, truth: rig.truths.append(truth), robot="r1")
            await mqtt.wait_connected()
            process = rig.start(speed)
            try:
                await until(lambda: rig.truths and rig.readings, "the simulator came up")
                yield rig, process
            finally:
                process.kill()
                process.wait()
                listening.cancel()
                await asyncio.gather(listening, return_exceptions=True)


async def test_drive_commands_move_the_robot_and_the_ground_truth_shows_it(tmp_path):
    async with simulator(tmp_path) as (rig, process):
        port = rig.port_file.read_text("utf-8").split()[0]
        answer = await asyncio.to_thread(urllib.request.urlopen, f"http://127.0.0.1:{port}/readyz")
        assert json.loads(answer.read())["ready"]
        base = os.open(rig.run / "base", os.O_RDWR | os.O_NOCTTY)
        try:
            os.write(base, bytes([128, 131, 145, 0, 200, 0, 200, 148, 2, 43, 44]))
            await until(lambda: rig.truths[-1].distance > 0.3, "the robot drove")
            assert rig.truths[-1].left == pytest.approx(0.2)
            assert os.read(base, 4096)[:2] == b"\x13\x06"
            os.write(base, bytes([145, 0, 0, 0, 0]))
            await until(lambda: rig.truths[-1].left == 0.0, "the robot stopped")
        finally:
            os.close(base)
        assert rig.truths[-1].sustained_speed == pytest.approx(1.0, abs=0.2)
        process.send_signal(signal.SIGTERM)
        assert await asyncio.to_thread(process.wait) == 0
        assert not (rig.run / "base").exists()
    log = rig.log()
    assert any(line["left"] == 0.2 for line in log)
    assert log[-1]["x"] == pytest.approx(rig.truths[-1].x, abs=1e-6)
    assert {"t_mono", "x", "y", "theta", "left", "right", "contacts", "clearance"} <= set(log[-1])
    # At least 50 lines a second.
    assert len(log) / (log[-1]["now"] - log[0]["now"]) > 50.0


@pytest.mark.smoke
async def test_placed_obstacle_shows_in_the_readings_and_in_the_ground_truth(tmp_path):
    async with simulator(tmp_path, speed=4) as (rig, _):
        await until(lambda: rig.readings[-1].state == "clear", "the floor is clear")
        assert (await rig.send_command(place=[BOX])).accepted
        await until(lambda: rig.readings[-1].state == "blocked", "the node sees the box")
        await until(lambda: [o.id for o in rig.truths[-1].obstacles] == ["box"], "the ground truth lists it")
        trap = SimObstacle(id="trap", polygon=[(0.9, 1.4), (1.1, 1.4), (1.1, 1.6)], height=1.0)
        reply = await rig.send_command(place=[trap])
        assert not reply.accepted
        assert "would stand on robot r1" in reply.reason
        assert (await rig.send_command(remove=["box"], kidnap=Pose(x=6.0, y=1.0, theta=1.0))).accepted
        await until(lambda: rig.readings[-1].state == "clear", "the box is gone")
        await until(lambda: abs(rig.truths[-1].x - 6.0) < 0.01, "the robot was moved")
        reply = await rig.send_command(remove=["nothing"])
        assert not reply.accepted


async def test_node_whose_board_alone_has_its_password_is_left_to_that(tmp_path):
    async with simulator(tmp_path) as (rig, _):
        assert '"event": "nodes_left_to_their_boards", "nodes": ["n2"]' in (rig.folder / "sim.log").read_text("utf-8")


async def test_silenced_node_publishes_nothing_and_a_killed_one_leaves_its_last_will(tmp_path):
    async with simulator(tmp_path) as (rig, process):
        assert rig.availability == ["online"]
        assert (await rig.send_command(nodes_silent=["n1"])).accepted
        count = len(rig.readings)
        truths = len(rig.truths)
        await until(lambda: len(rig.truths) > truths + 10, "a second passed")
        assert len(rig.readings) <= count + 1
        assert (await rig.send_command(nodes_silent=[])).accepted
        await until(lambda: len(rig.readings) > count + 5, "the node publishes again")
        process.kill()
        await until(lambda: rig.availability[-1] == "offline", "the last will")
