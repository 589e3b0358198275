"""A real Prometheus, configured as on a fog node, beside the running system: each panel and each rule has its data."""

from __future__ import annotations

import asyncio
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import pytest_asyncio
import yaml
from driver import LiveSystem

from fog_contracts.messages import SimCommand, SimObstacle
from fog_supervisor import child, net
from fognav.programs import AGENT, MAP_SERVICE, SERVICES

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

ROOT = Path(__file__).parents[2]
DEPLOYED = ROOT / "deploy"
GOAL = (58.0, 28.4)
BARRIER = SimObstacle(id="barrier", polygon=[(39.6, 26.9), (40.4, 26.9), (40.4, 29.8), (39.6, 29.8)], height=1.0)
"""Across the middle corridor, in the beam of the node of area z1."""

pytestmark = [
    pytest.mark.live,
    pytest.mark.asyncio(loop_scope="module"),
    pytest.mark.timeout(240),
    pytest.mark.skipif(shutil.which("prometheus") is None, reason="prometheus is not installed"),
]


def consoles() -> list[str]:
    """Return the options by which the fog node's Prometheus finds its pages, with the folder of this checkout."""
    compose = yaml.safe_load((ROOT / "docker-compose.yml").read_text("utf-8"))["services"]["prometheus"]
    assert "./deploy/prometheus:/etc/prometheus:ro" in compose["volumes"]
    given = [option for option in compose["command"] if option.startswith(("--web.console", "--web.external-url"))]
    given += [option for option in compose["command"] if option.startswith("--web.route-prefix")]
    return [option.replace("/etc/prometheus", str(DEPLOYED / "prometheus")) for option in given]


class Prometheus:
    """A Prometheus on a loopback port that scrapes a running system with the deployed configuration."""

    def __init__(self, folder: Path, system: LiveSystem) -> None:
        self.port = net.free_port()
        ports = {name: system.stack.port(name) for name in SERVICES}
        config = yaml.safe_load((DEPLOYED / "prometheus" / "prometheus.yml").read_text("utf-8"))
        config["global"] |= {"scrape_interval": "1s", "evaluation_interval": "1s"}
        self.robots = folder / "robots"  # prometheus.yml names it relative to itself
        self.robots.mkdir()
        config["rule_files"] = [str(DEPLOYED / "prometheus" / "rules" / "*.yml")]
        fog, bridge, robots = config["scrape_configs"]
        config["scrape_configs"].remove(bridge)  # the system has none
        # One machine instead of one host name per service.
        assert [target.split(":")[0] for target in fog["static_configs"][0]["targets"]] == list(SERVICES)
        del fog["relabel_configs"]
        fog["static_configs"] = [
            {"targets": [f"127.0.0.1:{port}"], "labels": {"process": name}} for name, port in ports.items()
        ]
        (discovery,) = robots["http_sd_configs"]
        discovery["url"] = discovery["url"].replace("map-service:8000", f"127.0.0.1:{ports[MAP_SERVICE]}")
        discovery["refresh_interval"] = "1s"
        file = folder / "prometheus.yml"
        file.write_text(yaml.safe_dump(config))
        self.log = folder / "prometheus.log"
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                child.command(
                    "prometheus", f"--config.file={file}", f"--storage.tsdb.path={folder / 'data'}",
                    f"--web.listen-address=127.0.0.1:{self.port}", *consoles(),
                ), stdout=log, stderr=log,
            )  # fmt: skip

    def wait_ready(self) -> None:
        deadline = time.monotonic() + 60.0
        while True:
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{self.port}/-/ready", timeout=5.0):
                    return
            except urllib.error.HTTPError as error:
                error.close()
            except urllib.error.URLError:
                assert self.process.poll() is None, self.log.read_text()
            assert time.monotonic() < deadline, self.log.read_text()
            time.sleep(0.05)

    def close(self) -> None:
        self.process.terminate()
        self.process.wait(30)

    def ask(self, path: str, **parameters: str) -> Any:
        """GET from its API; raises `urllib.error.URLError` while it starts, AssertionError for a wrong query."""
        url = f"http://127.0.0.1:{self.port}/api/v1/{path}?{urllib.parse.urlencode(parameters)}"
        try:
            with urllib.request.urlopen(url, timeout=5.0) as answer:
                return json.load(answer)["data"]
        except urllib.error.HTTPError as error:
            with error:
                raise AssertionError(f"{parameters}: {error.read().decode()}") from error

    def series(self, expression: str) -> list[Any]:
        return list(self.ask("query", query=expression)["result"])


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def system(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[LiveSystem]:
    async with LiveSystem(tmp_path_factory.mktemp("live")) as running:
        yield running


@pytest.fixture(scope="module")
def prometheus(tmp_path_factory: pytest.TempPathFactory, system: LiveSystem) -> Iterator[Prometheus]:
    running = Prometheus(tmp_path_factory.mktemp("prometheus"), system)
    try:
        running.wait_ready()
        yield running
    finally:
        running.close()


def panels() -> list[tuple[str, str, str]]:
    """Return the page, the panel and the query of each panel that must have data."""
    spec = importlib.util.spec_from_file_location("panels", DEPLOYED / "grafana" / "panels.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return [
        (page.title, panel.title, query)
        for page in module.DASHBOARDS
        for _, row in page.rows
        for panel in row
        for query, _ in panel.queries
        if not panel.needs or panel.title.startswith("Stages")
    ]


def as_grafana_asks(query: str) -> str:
    """Fill in what Grafana does with all robots chosen."""
    (chosen,) = json.loads((DEPLOYED / "grafana" / "dashboards" / "fognav-robots.json").read_text("utf-8"))[
        "templating"
    ]["list"]
    return query.replace("$__rate_interval", "15s").replace("$robot", chosen["allValue"])


async def test_every_panel_has_data_and_every_rule_works_while_a_robot_drives_and_a_hazard_appears(
    system: LiveSystem, prometheus: Prometheus
) -> None:
    deadline = time.monotonic() + 60.0
    while not await asyncio.to_thread(prometheus.series, 'fognav_plans_total{reason="goal"} == 0'):
        assert time.monotonic() < deadline, "the planner was not asked before the first plan"
        await asyncio.sleep(0.2)
    await system.drive_to(*GOAL)
    await system.simulate(SimCommand(place=[BARRIER]))
    await system.until(lambda: system.hazard("z1") == "blocked", 20, "the barrier is seen")
    missing = [(page, panel, as_grafana_asks(query)) for page, panel, query in panels()]
    assert len(missing) > 30
    deadline = time.monotonic() + 90.0
    while missing:
        assert time.monotonic() < deadline, f"no data: {missing}"
        missing = [entry for entry in missing if not await asyncio.to_thread(prometheus.series, entry[2])]
        await asyncio.sleep(0.5)
    # The first plan counts as well: a counter that appeared with its first event would show no rise.
    (plans,) = prometheus.series('increase(fognav_plans_total{reason="goal"}[2m])')
    assert float(plans["value"][1]) > 0.5
    for page, panel, query in panels():
        if page == "Robots":
            if "baseline:" in query:  # of recorded drives
                continue
            found = [series["metric"] for series in prometheus.series(as_grafana_asks(query))]
            assert {labels.get("robot") for labels in found} == {"r1"}, f"{panel} shows what is no robot: {found}"
    groups = prometheus.ask("rules")["groups"]
    rules = [rule for group in groups for rule in group["rules"]]
    assert len(rules) > 25
    assert [(rule["name"], rule["lastError"]) for rule in rules if rule["health"] == "err"] == []
    targets = prometheus.ask("targets")["activeTargets"]
    assert sorted(target["labels"].get("robot", target["labels"].get("process")) for target in targets) == sorted(
        [*SERVICES, "r1"]
    )
    (robot,) = [target for target in targets if target["labels"]["job"] == "robots"]
    assert robot["scrapeUrl"] == f"http://127.0.0.1:{system.stack.port(AGENT)}/metrics"
    firing = {
        alert["labels"]["alertname"] for alert in prometheus.ask("alerts")["alerts"] if alert["state"] == "firing"
    }
    assert firing & {"ServiceDown", "NotOneLeader", "BrokerDown", "StoreDown", "StoreLost", "StoreNotDurable"} == set()


async def test_prometheus_itself_shows_the_cpu_of_each_robot(system: LiveSystem, prometheus: Prometheus) -> None:
    """Above all what the robot's processes take, beside recorded drives; without Grafana, and without any script."""
    await wait_for_robots(prometheus, ["r1"])
    await system.drive_to(*GOAL)  # who stands decides nothing

    def page() -> str:
        with urllib.request.urlopen(f"http://127.0.0.1:{prometheus.port}/consoles/robots.html", timeout=30.0) as answer:
            return str(answer.read().decode("utf-8"))

    deadline = time.monotonic() + 60.0
    while "agent / decide" not in (shown := await asyncio.to_thread(page)):  # a rate needs a while
        assert time.monotonic() < deadline, shown
        await asyncio.sleep(0.5)
    await asyncio.to_thread(look_at, prometheus)
    headings = re.findall(r"<h[12][^>]*>(.*?)</h[12]>", shown)
    assert headings == ["CPU of the robots", "Robot r1", "The fog node"]
    assert "/prometheus/graph?" in shown, "behind the gateway its links must have its path"
    rows = re.findall(r'<th scope="row">(.*?)</th><td>([0-9.]+) %</td>', shown)
    names = [name for name, _ in rows]
    assert names[:2] == ["now", "mean of 10 minutes"]
    assert {name.split(" (")[0] for name in names if name.startswith("recorded")} == {
        "recorded default", "recorded full", "recorded fog"
    }  # fmt: skip
    assert {"agent", "guardian", "watchdog", "agent / decide", *SERVICES} <= set(names)
    (known,) = prometheus.series("100 * avg_over_time(robot:cpu:rate1m[10m])")
    assert float(dict(reversed(rows))["mean of 10 minutes"]) == pytest.approx(float(known["value"][1]), rel=0.5)


def look_at(prometheus: Prometheus) -> None:
    """Let a browser draw the page into the file that FOGNAV_CONSOLE_PICTURE names, for people; by default no file."""
    if (file := os.environ.get("FOGNAV_CONSOLE_PICTURE")) is None:
        return
    address = f"http://127.0.0.1:{prometheus.port}/consoles/robots.html"
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--window-size=1100,1500", f"--screenshot={file}"]
    subprocess.run(["chromium", *options, address], check=True, capture_output=True, timeout=120)


def drawn(prometheus: Prometheus, folder: Path) -> set[str]:
    """Return the pages of which the command has drawn a picture."""
    command = [sys.executable, str(DEPLOYED / "grafana" / "draw_panels.py"), "--out", str(folder), "--minutes", "1"]
    address = f"http://127.0.0.1:{prometheus.port}"
    done = subprocess.run([*command, "--prometheus", address], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return {file.stem for file in folder.glob("*.png")}


async def test_pictures_of_all_pages_are_drawn_from_the_panels_own_queries(
    tmp_path: Path, prometheus: Prometheus
) -> None:
    pages = {file.stem for file in (DEPLOYED / "grafana" / "dashboards").glob("*.json")}
    assert await asyncio.to_thread(drawn, prometheus, tmp_path) == pages


async def wait_for_robots(prometheus: Prometheus, expected: list[str]) -> None:
    def robots() -> list[str]:
        found = prometheus.ask("targets")["activeTargets"]
        return sorted(target["labels"]["robot"] for target in found if target["labels"]["job"] == "robots")

    deadline = time.monotonic() + 60.0
    while await asyncio.to_thread(robots) != expected:
        assert time.monotonic() < deadline, f"robots are not {expected}"
        await asyncio.sleep(0.2)


async def test_robot_is_a_target_while_a_file_lists_it(system: LiveSystem, prometheus: Prometheus) -> None:
    file = prometheus.robots / "workshop.json"
    target = {"targets": [f"127.0.0.1:{system.stack.port(AGENT)}"], "labels": {"robot": "r9"}}
    file.write_text(json.dumps([target]))
    await wait_for_robots(prometheus, ["r1", "r9"])
    file.write_text("[]")
    await wait_for_robots(prometheus, ["r1"])


async def test_robot_that_is_gone_is_no_target_any_more(system: LiveSystem, prometheus: Prometheus) -> None:
    await wait_for_robots(prometheus, ["r1"])
    await system.stop_operator()
    await system.stack.supervisor.stop(AGENT)
    await wait_for_robots(prometheus, [])
