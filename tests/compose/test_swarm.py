"""A floor with two copies of each service on three engines that are killed and cut off: `fognav stack`.

The engines are in network namespaces of this machine, so all clocks are the same. Figures are printed (`-s`), with the
machine's load; those in docs/benchmarks.md are from here.
"""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import threading
import time
from contextlib import ExitStack, contextmanager
from datetime import datetime
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import httpx
import pytest
import yaml  # type: ignore[import-untyped]  # PyYAML ships no types
from compose_project import BUILD_S, ROOT, Project, skip_reason, third_party
from swarm_engines import Engine, Swarm, missing, wait
from swarm_warnings import Place, Warnings

from fog_contracts.channels import MAP_HEARTBEAT
from fog_contracts.messages import MapHeartbeat
from fog_runtime.clock import SystemClock
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fognav.hosting.swarm_stacks import write_stacks

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
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
WRITERS: Final = 4
PATIENCE_S: Final = 3.0
"""For how long a writer waits for its answer."""
BEFORE_S: Final = 15.0
CUT_OFF_S: Final = 60.0
LEADING: Final = ("hazard-aggregator", "map-service", "planner")
"""Those of which one copy leads."""


class Term(NamedTuple):
    """When which copy of a service began to lead (s since the epoch), and with which epoch."""

    since: float
    service: str
    epoch: int
    holder: str


def write_stack(out: Path, engines: Sequence[Engine]) -> dict[str, Any]:
    """Write the stack of a floor on these engines, with the images that they have; return the whole one."""
    site = shutil.copytree(ROOT / "sites" / "estig", out / "site")
    text = (site / "site.toml").read_text("utf-8")
    (site / "site.toml").write_text(text.replace('id = "estig"', f'id = "{SITE}"', 1), "utf-8")
    write_stacks([(site, [engine.address for engine in engines])], ROOT, out / "stacks", OURS)
    stack: dict[str, Any] = {}
    for part in (f"{SITE}.1", f"{SITE}.2", f"{SITE}.3", SITE):
        file = out / "stacks" / f"{part}.yml"
        stack = yaml.safe_load(file.read_text("utf-8"))
        stack["services"].pop("grafana", None)  # it has no stand-in, and nothing here needs it
        for service in stack["services"].values():
            if not service["image"].startswith(OURS):
                service["image"] = third_party(service["image"])
        for kind in ("secrets", "configs"):
            used = {each["source"] for service in stack["services"].values() for each in service[kind]}
            stack[kind] = {name: each for name, each in stack[kind].items() if name in used}
        file.write_text(yaml.safe_dump(stack, sort_keys=False), "utf-8")
    return stack


class Floor:
    """The floor's stack on the engines."""

    def __init__(self, folder: Path, swarm: Swarm) -> None:
        """Write its stack; `load` and `deploy` start it."""
        self.engines = swarm.engines
        self._swarm = swarm
        self._folder = folder
        self._stack = write_stack(folder, swarm.engines)
        locks = folder / "stacks" / SITE / "locks"
        token = (locks / "admin.token").read_text("ascii").strip()
        large = [engine.address for engine in swarm.engines[:2]]
        self.place = Place(folder / "site", locks / "credentials", token, large, large)
        self.token = {"Authorization": f"Bearer {token}"}
        self.robot = self.place.of("r1")
        self._tls = self.robot.tls_context()

    def on(self, engine: Engine) -> set[str]:
        """Return the services that belong on an engine."""
        label = f"node.labels.fognav.machine == {self.engines.index(engine) + 1}"
        services = self._stack["services"].items()
        return {name for name, each in services if label in each["deploy"]["placement"]["constraints"]}

    def load(self) -> None:
        """Give each engine its images."""
        for engine in self.engines:
            engine.load(sorted({self._stack["services"][name]["image"] for name in self.on(engine)}))

    def label(self) -> None:
        """Say which engine is which machine of the floor."""
        self._swarm.label({"fognav.floor": SITE, "fognav.machine": str(number)} for number in (1, 2, 3))

    def deploy(self, part: str = SITE) -> None:
        """Deploy it, or what it has on one machine, and wait until all that it has runs and is healthy."""
        file = str(self._folder / "stacks" / f"{part}.yml")
        self.engines[0].docker("stack", "deploy", "--resolve-image", "never", "-c", file, SITE)
        self.wait_ready()

    def upgrade(self) -> None:
        """Deploy it anew, one machine after the other, as if each of its services had changed."""
        for machine in (3, 2, 1):
            file = self._folder / "stacks" / f"{SITE}.{machine}.yml"
            stack = yaml.safe_load(file.read_text("utf-8"))
            for service in stack["services"].values():
                service["labels"] = {"changed": f"{time.time()}"}
            file.write_text(yaml.safe_dump(stack, sort_keys=False), "utf-8")
            engine = self.engines[machine - 1]
            before = {each["Id"] for each in engine.containers().values()}
            self.deploy(f"{SITE}.{machine}")
            replaced = partial(self.replaced, engine, before)
            wait(replaced, READY_S, f"{engine.name} runs what it had before")
            self.wait_ready()

    @staticmethod
    def replaced(engine: Engine, before: set[str]) -> bool:
        """Whether an engine runs none of these containers."""
        return not before & {each["Id"] for each in engine.containers().values()}

    def unready(self) -> dict[str, set[str]]:
        """Return what does not run, or is not healthy, by its engine's name."""
        found = {}
        for engine in self.engines:
            healthy = {
                name for name, each in engine.containers().items() if each["State"]["Health"]["Status"] == "healthy"
            }
            if lacking := self.on(engine) - healthy:
                found[engine.name] = lacking
        if unsettled := self._swarm.unsettled():  # what a machine that was away still runs is to be replaced
            found["swarm"] = unsettled
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
            base_url=f"https://{engine.address}", verify=self._tls, headers=self.token, timeout=PATIENCE_S,
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

    def primary(self) -> Engine | None:
        """Return the engine of Redis's primary, if it is a large one: Redis writes its role into its file."""
        for number, engine in enumerate(self.engines[:2]):
            redis = engine.containers()[f"redis-{number + 1}" if number else "redis"]["Id"]
            if "\nreplicaof " not in engine.docker("exec", redis, "cat", "/data/redis.conf"):
                return engine
        return None

    def terms(self) -> list[Term]:
        """Return who has led so far."""
        found = []
        for number, engine in enumerate(self.engines[:2]):
            for service in LEADING:
                name = f"{SITE}_{service}-{number + 1}" if number else f"{SITE}_{service}"
                for line in engine.logs(f"com.docker.swarm.service.name={name}").splitlines():
                    if '"event": "leading"' in line:
                        said = json.loads(line[line.index("{") :])
                        since = datetime.fromisoformat(said["ts"]).timestamp()
                        found.append(Term(since, service, said["epoch"], said["holder"]))
        return sorted(found)


class Witness:
    """Writers of zones, each through a gateway, and a robot's ear: what they notice of a fault.

    Each writer changes a zone of its own, whose version rises by one with each change that is stored. So one that was
    acknowledged and lost leaves a version that is acknowledged twice, or none.
    """

    def __init__(self, floor: Floor, through: Sequence[Engine]) -> None:
        """`through` are the engines whose gateways are used; one that is shut is not among them."""
        self._floor = floor
        self._through = through
        self._stopped = threading.Event()
        self._acknowledged: list[float] = []
        self._refused: dict[str, int] = {}
        self._lost = 0
        self._heard: list[float] = []
        self._epoch = 0
        self._outdated = 0

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Write and listen while entered."""
        threads = [threading.Thread(target=self._write, args=(number,)) for number in range(WRITERS)]
        threads.append(threading.Thread(target=lambda: asyncio.run(self._listen())))
        for thread in threads:
            thread.start()
        try:
            wait(lambda: len(self._acknowledged) > WRITERS and self._heard, 60.0, "nothing is written, or heard")
            yield
        finally:
            self._stopped.set()
            for thread in threads:
                thread.join()

    def _write(self, number: int) -> None:
        zone, version = "", 0
        with self._floor.client(self._through[number % len(self._through)]) as client:
            while not self._stopped.is_set() or (zone and not self._removed(client, zone)):
                body = {**ZONE, "reason": f"{time.time()}"}
                try:
                    if zone:
                        answer = client.patch(f"/api/v1/zones/{zone}", json={"reason": body["reason"]})
                    else:
                        answer = client.post("/api/v1/zones", json=body)
                except httpx.HTTPError as error:
                    why = type(error).__name__
                else:
                    why = f"{answer.status_code} {answer.json().get('title', '')}"
                    if answer.status_code < 300:
                        zone, before, version = answer.json()["id"], version, answer.json()["version"]
                        self._lost += version <= before
                        self._acknowledged.append(time.time())
                        continue
                    self._lost += answer.status_code == 404
                self._refused[why] = self._refused.get(why, 0) + 1
                time.sleep(0.05)

    def _removed(self, client: httpx.Client, zone: str) -> bool:
        try:
            return client.delete(f"/api/v1/zones/{zone}").status_code in (204, 404)
        except httpx.HTTPError:
            return False

    async def _listen(self) -> None:
        routers = [f"tls/{engine.address}:7447" for engine in self._floor.engines[:2]]
        async with ZenohEdge.open(
            connect=routers, clock=SystemClock(), role="robot-agent", id="r1", site=SITE, credentials=self._floor.robot
        ) as edge:
            edge.subscribe(MAP_HEARTBEAT, MapHeartbeat, lambda _ids, heartbeat: self._hear(heartbeat))
            while not self._stopped.is_set():  # noqa: ASYNC110  # a thread's
                await asyncio.sleep(0.1)

    def _hear(self, heartbeat: MapHeartbeat) -> None:
        if heartbeat.epoch < self._epoch:
            self._outdated += 1  # a robot refuses it
        else:
            self._epoch = heartbeat.epoch
            self._heard.append(time.time())

    def judge(self, since: float, led: set[str], **what: object) -> None:
        """Report what came of a fault that began then, to who led these services; require no loss and one leader."""
        terms = self._floor.terms()
        took = {name: min((term.since - since for term in terms if term.service == name and term.since > since),
                          default=None) for name in led}  # fmt: skip
        holders: dict[tuple[str, int], set[str]] = {}
        for term in terms:
            holders.setdefault((term.service, term.epoch), set()).add(term.holder)
        no_map_s = _longest(self._heard, since)
        twice = {epoch: names for epoch, names in holders.items() if len(names) > 1}
        figures = {
            **what, "acknowledged": len(self._acknowledged), "lost": self._lost, "refused": self._refused,
            "leads_after_s": took, "no_write_s": _longest(self._acknowledged, since),
            "no_map_s": no_map_s, "outdated": self._outdated,
            "load": os.getloadavg(),
        }  # fmt: skip
        print(json.dumps(figures), flush=True)  # noqa: T201  # shown by `-s`
        assert self._lost == 0
        assert twice == {}
        assert no_map_s < CUT_OFF_S, "the robot has no map until all is well again"


def _longest(times: Sequence[float], since: float) -> float:
    """Return the longest time (s) between two of them, of those that end after a time."""
    return max((b - a for a, b in pairwise(times) if b >= since), default=float("inf"))


@pytest.fixture(scope="module")
def floor(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Floor]:
    project = Project(tmp_path_factory.mktemp("images"))
    project("build", "zenoh", *LEADING, "console-service", timeout_s=BUILD_S)
    with Swarm(tmp_path_factory.mktemp("swarm")) as swarm:
        floor = Floor(tmp_path_factory.mktemp("floor"), swarm)
        floor.load()
        floor.label()
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


def victim(floor: Floor) -> tuple[Engine, Engine, set[str], bool]:
    """Return the large machine with Redis's primary, else that which leads the map, the other one, and what it leads.

    Also whether it has the primary.
    """
    floor.wait_ready()
    primary = floor.primary()
    leads = {each: floor.leading(each) for each in floor.engines[:2]}
    first, second = sorted(leads, key=lambda each: (each is not primary, LEADING[1] not in leads[each]))
    return first, second, leads[first], first is primary


def endure(
    floor: Floor, what: str, act: Callable[[Engine], object], heal: Callable[[Engine], object], lasts_s: float
) -> Engine:
    """Do something to a machine that leads, while the other one is written to; return it when all is well again."""
    first, second, led, primary = victim(floor)
    witness, warnings = Witness(floor, [second]), Warnings(floor.place._replace(gateways=[second.address]))
    with ExitStack() as healing, warnings.coming(), witness.watching():
        healing.callback(heal, first)
        time.sleep(BEFORE_S)
        since = warnings.with_next()
        act(first)
        time.sleep(lasts_s)
    floor.wait_ready()
    witness.judge(since, led, what=what, primary=primary, echo_to_path=warnings.figures(since))
    return first


def test_machine_that_dies_loses_no_acknowledged_write(floor: Floor) -> None:
    endure(floor, "killed", Engine.kill, Engine.start, 30.0)


def test_machine_that_is_cut_off_acknowledges_nothing_and_lives_on(floor: Floor) -> None:
    answers: list[str] = []
    running: dict[str, Any] = {}

    def cut(engine: Engine) -> None:
        engine.cut_off()
        begun = time.monotonic()
        running.update(engine.containers())
        while time.monotonic() - begun < CUT_OFF_S:
            answers.append(write_inside(floor, engine))
        own = {name: each["Id"] for name, each in engine.containers().items()}
        assert own == {name: each["Id"] for name, each in running.items()}, "its engine has ended some"
        engine.reconnect()

    engine = endure(floor, "cut off", cut, Engine.reconnect, 15.0)
    replaced = partial(floor.replaced, engine, {each["Id"] for each in running.values()})
    wait(replaced, READY_S, "Swarm starts all of a machine anew that was away")
    assert not [each for each in answers if each.startswith("2")], "only one machine has it"


def write_inside(floor: Floor, engine: Engine) -> str:
    """Write on a machine, by its own gateway; return the answer's status."""
    headers = [f"Authorization: {floor.token['Authorization']}", "Content-Type: application/json"]
    options = [word for header in headers for word in ("-H", header)]
    url = f"https://{engine.address}/api/v1/zones"
    return engine.inside(
        "sh", "-c", 'curl "$@" || true', "-", "-sk", "-m", "5", "-o", "/dev/null", "-w", "%{http_code}",
        *options, "-d", json.dumps(ZONE), url,
    )  # fmt: skip


def test_machine_that_is_drained_hands_over_and_takes_part_again(floor: Floor) -> None:
    def available(engine: Engine, how: str) -> None:
        node = engine.docker("info", "--format", "{{.Swarm.NodeID}}").strip()
        floor.engines[2].docker("node", "update", "--availability", how, node)

    def drain(engine: Engine) -> None:
        available(engine, "drain")
        wait(lambda: not engine.containers(), READY_S, f"{engine.name} still runs something")

    endure(floor, "drained", drain, lambda engine: available(engine, "active"), 5.0)


def test_upgrade_of_one_machine_after_the_other_keeps_a_leader(floor: Floor) -> None:
    first, second, led, primary = victim(floor)
    witness, warnings = Witness(floor, [first, second]), Warnings(floor.place)
    with warnings.coming(), witness.watching():
        since = warnings.with_next()
        floor.upgrade()
    witness.judge(since, led, what="upgraded", primary=primary, echo_to_path=warnings.figures(since))
