"""The page about the first node, run as it is written: the real aggregator, and a node of the firmware's code."""

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

import programs
import pytest

from fog_runtime.configuration.site import load_site
from fog_supervisor import net
from fog_supervisor.servers import start_mosquitto, start_redis, start_router

pytestmark = [
    pytest.mark.live,
    pytest.mark.timeout(600),
    pytest.mark.skipif(shutil.which("g++") is None, reason="the firmware's code needs a C++ compiler (g++)"),
]

ROOT = Path(__file__).parents[2]
WAIT_S = 120.0
"""For any wait, which ends with what it waits for: a busy machine may be ten times slower."""


def commands() -> list[str]:
    text = (ROOT / "docs" / "first-node.md").read_text("utf-8")
    return [line for block in re.findall(r"```sh\n(.*?)```", text, re.DOTALL) for line in block.splitlines()]


class Lab:
    """A fog node's broker, stores and aggregator, and a shell whose folders are those of the test."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.servers = [
            start_mosquitto(folder / "broker"),
            start_redis(folder / "redis"),
            start_router(folder / "zenoh"),
        ]
        broker, redis, router = self.servers
        self.port = net.free_port()
        runtime = folder / "runtime"
        runtime.mkdir(mode=0o700)
        self.environment = {
            **os.environ,
            "XDG_RUNTIME_DIR": str(runtime),
            "FOGNAV_AGGREGATOR_PORT": str(self.port),
            "FOGNAV_MAP_PORT": "1",
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
            "FOGNAV_HTTP_PORT": str(self.port),
        }
        self.aggregator: programs.Program | None = None
        self.node: subprocess.Popen[bytes] | None = None

    def start_aggregator(self) -> None:
        self.aggregator = programs.start("hazard_aggregator", self.services, self.folder / "aggregator.log")
        self.wait(lambda: "n8" in self.listed("nodes"), "the aggregator knows the node")

    def words(self, command: str) -> list[str]:
        """The command with the page's folders in the test's, run by this interpreter."""
        inside = {name: str(self.folder / name) for name in ("floor", "board", "coverage.png")}
        words = [inside.get(word, word) for word in shlex.split(command)]
        return [sys.executable, "-m", "fognav", *words[1:]] if words[0] == "./fognav" else words

    def run(self, command: str) -> str:
        # A site's id is not the aggregator's to tell, and the map-service does not run here.
        extra = ["--site-id", "estig"] if " watch " in command else []
        done = subprocess.run(
            [*self.words(command), *extra], cwd=ROOT, env=self.environment, capture_output=True, text=True,
            timeout=WAIT_S, check=False,
        )  # fmt: skip
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
        return done.stdout + done.stderr

    def simulate(self, command: str) -> None:
        self.end_node()
        with (self.folder / "node.log").open("wb") as log:
            self.node = subprocess.Popen(self.words(command), cwd=ROOT, env=self.environment, stdout=log, stderr=log)
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

    def end_node(self) -> None:
        if self.node is not None:
            self.node.send_signal(signal.SIGINT)
            assert self.node.wait(30) == 0, (self.folder / "node.log").read_text()
            self.node = None

    def stop(self) -> None:
        if self.node is not None:
            self.node.kill()
            self.node.wait()
        if self.aggregator is not None:
            self.aggregator.kill()
            self.aggregator.wait()
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
            if lab.aggregator is None:
                lab.start_aggregator()
            lab.simulate(command)
        else:
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
    lab.wait(lambda: re.search(r"^z4.*blocked", lab.run("./fognav area list"), re.MULTILINE), "the area is blocked")
    assert (lab.folder / "coverage.png").stat().st_size > 1000
    assert oct((lab.folder / "board" / "node.json").stat().st_mode)[-3:] == "600"
