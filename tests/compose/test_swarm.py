"""A floor with two copies of each service on three engines, which are in network namespaces: `fognav stack`."""

from __future__ import annotations

import shutil
import time
from typing import TYPE_CHECKING, Any, Final

import httpx
import pytest
import yaml  # type: ignore[import-untyped]  # PyYAML ships no types
from compose_project import BUILD_S, ROOT, Project, skip_reason, third_party
from swarm_engines import Engine, Swarm, missing

from fog_runtime.credentials import Credentials
from fognav.hosting.swarm_stacks import write_stacks

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

SKIP_REASON: Final = skip_reason() or missing()
pytestmark = [
    pytest.mark.compose,
    pytest.mark.long,
    pytest.mark.timeout(2 * BUILD_S + 3600),
    pytest.mark.skipif(SKIP_REASON is not None, reason=SKIP_REASON or ""),
]
SITE: Final = "ground"
OURS: Final = "fognav-compose-test/"
ZONE: Final = {"kind": "BLOCKED", "shape": {"type": "circle", "centre": [9.0, 42.6], "radius": 0.5}, "reason": "new"}
READY_S: Final = 1200.0
"""Kernels are compiled on both machines at first."""
LEADING: Final = ("hazard-aggregator", "map-service", "planner")
"""Those of which one copy leads."""


def stack_of(out: Path, engines: Sequence[Engine]) -> dict[str, Any]:
    """Write the stack of a floor on these engines, with the images that they have; return it."""
    site = shutil.copytree(ROOT / "sites" / "estig", out / "site")
    text = (site / "site.toml").read_text("utf-8")
    (site / "site.toml").write_text(text.replace('id = "estig"', f'id = "{SITE}"', 1), "utf-8")
    write_stacks([(site, [engine.address for engine in engines])], ROOT, out / "stacks", OURS)
    file = out / "stacks" / f"{SITE}.yml"
    stack = yaml.safe_load(file.read_text("utf-8"))
    del stack["services"]["grafana"]  # it has no stand-in, and nothing here needs it
    for service in stack["services"].values():
        if not service["image"].startswith(OURS):
            service["image"] = third_party(service["image"])
    for kind in ("secrets", "configs"):
        used = {each["source"] for service in stack["services"].values() for each in service[kind]}
        stack[kind] = {name: each for name, each in stack[kind].items() if name in used}
    file.write_text(yaml.safe_dump(stack, sort_keys=False), "utf-8")
    return dict(stack)


class Floor:
    """The floor's stack on the engines."""

    def __init__(self, folder: Path, swarm: Swarm) -> None:
        """Write its stack; `load` and `deploy` start it."""
        self.engines = swarm.engines
        self._swarm = swarm
        self._folder = folder
        self._stack = stack_of(folder, swarm.engines)
        locks = folder / "stacks" / SITE / "locks"
        self.token = {"Authorization": f"Bearer {(locks / 'admin.token').read_text('ascii').strip()}"}
        self._tls = Credentials.read(locks / "credentials" / "console.toml").tls_context()

    def on(self, engine: Engine) -> set[str]:
        """Return the services that belong on an engine."""
        label = f"node.labels.fognav.machine == {self.engines.index(engine) + 1}"
        services = self._stack["services"].items()
        return {name for name, each in services if label in each["deploy"]["placement"]["constraints"]}

    def load(self) -> None:
        """Give each engine its images."""
        for engine in self.engines:
            engine.load(sorted({self._stack["services"][name]["image"] for name in self.on(engine)}))

    def deploy(self) -> None:
        """Deploy it, and wait until all that it has runs and is healthy."""
        self._swarm.label({"fognav.floor": SITE, "fognav.machine": str(number)} for number in (1, 2, 3))
        command = [
            "stack",
            "deploy",
            "--resolve-image",
            "never",
            "-c",
            str(self._folder / "stacks" / f"{SITE}.yml"),
            SITE,
        ]
        self.engines[0].docker(*command)
        self.wait_ready()

    def unready(self) -> dict[str, set[str]]:
        """Return what does not run, or is not healthy, by its engine's name."""
        found = {}
        for engine in self.engines:
            healthy = {
                name for name, each in engine.containers().items() if each["State"]["Health"]["Status"] == "healthy"
            }
            if lacking := self.on(engine) - healthy:
                found[engine.name] = lacking
        return found

    def wait_ready(self) -> None:
        """Wait until all services run and are healthy."""
        end = time.monotonic() + READY_S
        while unready := self.unready():
            assert time.monotonic() < end, f"not ready: {unready}"
            time.sleep(2.0)

    def client(self, engine: Engine) -> httpx.Client:
        """Return a client of an engine's gateway."""
        return httpx.Client(
            base_url=f"https://{engine.address}", verify=self._tls, headers=self.token, timeout=10.0,
            trust_env=False,
        )  # fmt: skip

    def leading(self, engine: Engine) -> set[str]:
        """Return the services whose copy on an engine leads."""
        found = set()
        for name, container in engine.containers().items():
            if (service := name.removesuffix("-2")) in LEADING:
                code = (
                    "import urllib.request as r\n"
                    "try: print(r.urlopen('http://127.0.0.1:8000/leads', timeout=5).status)\n"
                    "except OSError as e: print(e)"
                )
                if engine.docker("exec", container["Id"], "python", "-c", code).strip() == "200":
                    found.add(service)
        return found


@pytest.fixture(scope="module")
def floor(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Floor]:
    project = Project(tmp_path_factory.mktemp("images"))
    project("build", "zenoh", *LEADING, "console-service", timeout_s=BUILD_S)
    with Swarm(tmp_path_factory.mktemp("swarm")) as swarm:
        floor = Floor(tmp_path_factory.mktemp("floor"), swarm)
        floor.load()
        floor.deploy()
        yield floor


def test_one_copy_of_each_service_leads_and_either_gateway_finds_it(floor: Floor) -> None:
    first, second, _ = floor.engines
    assert {
        service: (service in floor.leading(first)) != (service in floor.leading(second)) for service in LEADING
    } == dict.fromkeys(LEADING, True)
    for engine in (first, second):
        with floor.client(engine) as client:
            assert client.get("/").status_code == 200
            made = client.post("/api/v1/zones", json=ZONE)
            assert made.status_code == 201, made.text
            assert client.delete(f"/api/v1/zones/{made.json()['id']}").status_code == 204
            assert client.get("/api/v1/robots").status_code == 200
            assert client.get("/api/v1/areas").status_code == 200
