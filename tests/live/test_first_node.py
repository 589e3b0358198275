"""The page about the first node, run as written: real aggregator and map-service, a node of the firmware's code."""

import io
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import programs
import pytest
from PIL import Image

from fog_contracts.costs import LETHAL
from fog_runtime.configuration.site import load_site
from fog_runtime.security.site_security import SiteSecurity
from fog_supervisor import child, net
from fog_supervisor.servers import start_mosquitto, start_redis, start_router

pytestmark = [
    pytest.mark.live,
    pytest.mark.timeout(900),
    pytest.mark.skipif(shutil.which("g++") is None, reason="the firmware's code needs a C++ compiler (g++)"),
]

ROOT = Path(__file__).parents[2]
WAIT_S = 120.0
"""For any wait, which ends with what it waits for: a busy machine may be ten times slower."""
COMMAND_S = 600.0
"""For a command: some load every member and count the floor's cells."""


def commands() -> list[str]:
    text = (ROOT / "docs" / "first-node.md").read_text("utf-8")
    return [line for block in re.findall(r"```sh\n(.*?)```", text, re.DOTALL) for line in block.splitlines()]


class Lab:
    """A fog node's broker, stores, aggregator and map-service, and a shell whose folders are those of the test."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.servers = [
            start_mosquitto(folder / "broker"),
            start_redis(folder / "redis"),
            start_router(folder / "zenoh"),
        ]
        broker, redis, router = self.servers
        # A board gets its password from credentials; the broker of this test lets in everybody.
        self.security = folder / "locks"
        SiteSecurity(self.security, "estig").make(["fog.example"])
        self.port, self.map_port = net.free_port(), net.free_port()
        runtime = folder / "runtime"
        runtime.mkdir(mode=0o700)
        self.environment = {
            **os.environ,
            "XDG_RUNTIME_DIR": str(runtime),
            "FOGNAV_AGGREGATOR_PORT": str(self.port),
            "FOGNAV_MAP_PORT": str(self.map_port),
            "FOGNAV_PLANNER_PORT": "1",
            "FOGNAV_MQTT_PORT": str(broker.port),
            "FOGNAV_FOG": "fog-node",
        }
        self.services = {
            **self.environment,
            "FOGNAV_SITE_DIR": str(folder / "floor"),
            "FOGNAV_DATA_DIR": str(folder / "data"),
            "FOGNAV_MQTT_URL": broker.url,
            "FOGNAV_REDIS_URL": redis.url,
            "FOGNAV_ZENOH_CONNECT": router.endpoint,
        }
        self.programs: list[programs.Program] = []
        self.node: subprocess.Popen[bytes] | None = None

    def start_services(self) -> None:
        for module, port in (("hazard_aggregator", self.port), ("map_service", self.map_port)):
            settings = {**self.services, "FOGNAV_HTTP_PORT": str(port)}
            self.programs.append(programs.start(module, settings, self.folder / f"{module}.log"))
        self.wait(lambda: "n8" in self.listed("nodes"), "the aggregator knows the node")
        self.wait(lambda: self.hazard("z4") is not None, "the map knows the area")

    def hazard(self, area: str) -> dict[str, Any] | None:
        """What the map-service says of an area; None while it is starting."""
        try:
            body = net.request("GET", self.map_port, "/api/v1/hazards").body
        except ConnectionRefusedError:
            return None
        return next((view for view in body if view["hazard"]["area"] == area), None) if isinstance(body, list) else None

    def words(self, command: str) -> list[str]:
        """The command with the page's folders in the test's."""
        inside = {name: str(self.folder / name) for name in ("floor", "board", "coverage.png")}
        inside["~/.local/share/fognav/locks"] = str(self.security)
        return [inside.get(word, word) for word in shlex.split(command)]

    def run(self, command: str) -> str:
        program, *arguments = self.words(command)
        if program != "./fognav":
            subprocess.run([program, *arguments], cwd=ROOT, check=True)
            return ""
        done = programs.run(arguments, self.environment, ROOT, COMMAND_S)
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
        return done.stdout + done.stderr

    def simulate(self, command: str) -> None:
        self.end_node()
        with (self.folder / "node.log").open("wb") as log:
            self.node = subprocess.Popen(
                child.command(sys.executable, "-m", "fognav", *self.words(command)[1:]), cwd=ROOT,
                env=self.environment, stdout=log, stderr=log,
            )  # fmt: skip
        self.wait(lambda: self.listed("nodes")["n8"]["age_s"] is not None, "the node is heard")

    def listed(self, what: str) -> dict[str, Any]:
        """What the aggregator lists, by id; a command would start an interpreter for each look."""
        try:
            body = net.request("GET", self.port, f"/api/v1/{what}").body
        except ConnectionRefusedError:
            return {}  # it is starting
        return {view["id"]: view for view in body} if isinstance(body, list) else {}

    def wait(self, condition, what: str) -> None:
        deadline = time.monotonic() + WAIT_S
        while not condition():
            assert self.node is None or self.node.poll() is None, (self.folder / "node.log").read_text()
            assert time.monotonic() < deadline, what
            time.sleep(0.05)

    def cost_at(self, x: float, y: float) -> int:
        """The cost of a place (m) in the picture of the map that everybody can look at."""
        geometry = load_site(self.folder / "floor").map.geometry
        url = f"http://127.0.0.1:{self.map_port}/api/v1/costmap.png"
        with urlopen(url, timeout=WAIT_S) as answer, Image.open(io.BytesIO(answer.read())) as picture:
            column, row = geometry.cell(x, y)
            return int(np.asarray(picture)[geometry.height - 1 - row, column])

    def end_node(self) -> None:
        if self.node is not None:
            self.node.send_signal(signal.SIGINT)
            assert self.node.wait(60) == 0, (self.folder / "node.log").read_text()
            self.node = None

    def stop(self) -> None:
        if self.node is not None:
            self.node.kill()
            self.node.wait()
        for program in self.programs:
            program.kill()
            program.wait()
        for server in self.servers:
            server.stop()


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    made = Lab(tmp_path)
    try:
        yield made
    finally:
        made.stop()


def test_page_leads_from_a_site_to_a_hazard(lab: Lab) -> None:
    printed: dict[str, str] = {}
    for command in commands():
        if " node sim " in command:
            if not lab.programs:
                lab.start_services()
            lab.simulate(command)
        else:
            if command == "./fognav area list":
                # The page's reader looks again until it has come; the map has it soon after the aggregator.
                lab.wait(lambda: (found := lab.hazard("z4")) and found["hazard"]["state"] == "blocked", "z4 is blocked")
            printed[command] = lab.run(command)
            if " node add " in command:
                limits = [sonar.range_limit for sonar in load_site(lab.folder / "floor").site.nodes[-1].sonars]
            if " watch n8 --count 5" in command:
                assert "clear" in printed[command]
            if " calibrate " in command:
                node = next(node for node in load_site(lab.folder / "floor").site.nodes if node.id == "n8")
                assert all(2.1 < sonar.range_limit < 2.5 for sonar in node.sonars)
                assert [sonar.range_limit for sonar in node.sonars] != limits
    watched = printed["./fognav node watch n8 --count 12"]
    assert watched.splitlines()[-1].split()[1] == "blocked"
    assert re.search(r"^z4.*blocked", printed["./fognav area list"], re.MULTILINE)
    told = next(line for line in printed["./fognav map hazards"].splitlines() if line.startswith("z4: "))
    assert re.fullmatch(
        r"z4: blocked, impassable \(node n8: sonar [01]: something at [01]\.\d+ m, nearer than 2\.\d+ m\)", told
    )
    assert lab.cost_at(33.2, 39.4) == LETHAL
    assert (lab.folder / "coverage.png").stat().st_size > 1000
    assert oct((lab.folder / "board" / "node.json").stat().st_mode)[-3:] == "600"
    assert "BEGIN CERTIFICATE" in (lab.folder / "board" / "ca.pem").read_text()
