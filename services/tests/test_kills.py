"""Nothing acknowledged is lost when servers and services are killed at random moments under load, alone and in pairs.

`FOGNAV_KILLS=200` kills each of them 200 times alone and 200 times in pairs; without it each is killed once, and one
pair. `FOGNAV_SEED` gives another sequence of moments.
"""

import asyncio
import itertools
import os
import random
import sys
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import httpx
import pytest

from fog_contracts import channels as ch
from fog_contracts.messages import AreaHazard, NodeReading
from fog_runtime.clock import SystemClock
from fog_runtime.transports.mqtt_edge import MqttEdge

pytestmark = pytest.mark.live
KILLS = int(os.environ.get("FOGNAV_KILLS", "1"))
SEED = int(os.environ.get("FOGNAV_SEED", "1"))
SERVICES = ("map_service", "hazard_aggregator", "planner")
SERVERS = ("redis", "mosquitto")
TARGETS = (*SERVERS, *SERVICES)
ROBOT = """
[[robots]]
id = "r1"
start = { x = 1.0, y = 1.0, theta = 0.0 }
radius = 0.17
"""
AREA_WITHOUT_NODES = """
[[areas]]
id = "gate"
polygon = [[0.2, 4.5], [0.6, 4.5], [0.6, 4.9]]
"""
PROGRESS_S = 60.0
CLEAR_S = 1.5 + 0.5
"""How long the map may call an area clear that was blocked meanwhile, while it has lost the broker, and a busy tick."""


def sequence(chance: random.Random) -> list[tuple[str, ...]]:
    """Return what is killed at once, in random order: everything alone, and everything in as many pairs."""
    alone = [(target,) for target in TARGETS for _ in range(KILLS)]
    shuffled = list(itertools.combinations(TARGETS, 2))
    chance.shuffle(shuffled)
    pairs = list(itertools.islice(itertools.cycle(shuffled), KILLS * len(TARGETS) // 2 if KILLS > 1 else 1))
    kills = alone + pairs
    chance.shuffle(kills)
    return kills


@dataclass
class Operators:
    """Change zones, areas, overrides and a robot's mission as fast as they are acknowledged, and remember what was.

    Each change has an idempotency key and is repeated until it is acknowledged: what must be stored is known exactly.
    """

    fog: Any
    headers: dict[str, str]
    chance: random.Random
    client: httpx.AsyncClient
    zones: dict[str, tuple[str, str]] = field(default_factory=dict)
    area: tuple[str, str] = ("", '"0"')
    override: tuple[str, str] | None = None
    """Reason and state of the override of an area without nodes."""
    goal: str | None = None
    acknowledged: Counter[str] = field(default_factory=Counter)
    repeated: int = 0
    keys: Any = field(default_factory=lambda: itertools.count(1))
    turn: dict[str, asyncio.Lock] = field(default_factory=lambda: {kind: asyncio.Lock() for kind in SERVICES})

    async def request(self, service: str, method: str, path: str, **options: Any) -> httpx.Response:
        """Repeat a request until it is answered by anything but "try again"."""
        port_file = self.fog.folder / f"{service}.port"
        while True:
            try:
                url = f"http://127.0.0.1:{port_file.read_text().strip()}{path}"
                answer = await self.client.request(method, url, **options)
            except (OSError, httpx.TransportError, httpx.InvalidURL):
                pass
            else:
                if answer.status_code != 503:
                    return answer
            self.repeated += 1
            await asyncio.sleep(0.05)

    async def change(self, service: str, method: str, path: str, body: Any = None, **headers: str) -> httpx.Response:
        key = {"Idempotency-Key": f"k{next(self.keys)}"} if method != "DELETE" else {}
        answer = await self.request(service, method, path, json=body, headers={**self.headers, **key, **headers})
        # A deletion that is repeated after a lost answer finds nothing.
        assert answer.status_code in ((204, 404) if method == "DELETE" else (200, 201)), (method, path, answer.text)
        self.acknowledged[service] += 1
        return answer

    async def change_zones(self) -> None:
        for number in itertools.count():
            reason = f"change {number}"
            circle = {"type": "circle", "centre": [self.chance.uniform(1.5, 2.5), 3.0], "radius": 0.2}
            body = {"kind": "BLOCKED", "shape": circle, "reason": reason}
            async with self.turn["map_service"]:
                name = self.chance.choice(list(self.zones)) if self.zones else ""
                if len(self.zones) < 4 or (self.chance.random() < 0.3 and len(self.zones) < 12):
                    answer = await self.change("map_service", "POST", "/api/v1/zones", body)
                    self.zones[answer.json()["id"]] = reason, answer.headers["etag"]
                elif self.chance.random() < 0.5:
                    etag = self.zones[name][1]
                    answer = await self.change(
                        "map_service", "PUT", f"/api/v1/zones/{name}", body, **{"If-Match": etag}
                    )
                    self.zones[name] = reason, answer.headers["etag"]
                else:
                    await self.change("map_service", "DELETE", f"/api/v1/zones/{name}")
                    del self.zones[name]
            await asyncio.sleep(0.01)

    async def change_area(self) -> None:
        polygon = [[3.0, 2.0], [4.0, 2.0], [4.0, 4.0], [3.0, 4.0]]
        for number in itertools.count():
            body = {"label": f"label {number}", "polygon": polygon, "nodes": ["n1"], "number": 7}
            async with self.turn["hazard_aggregator"]:
                headers = {"If-Match": self.area[1]}
                answer = await self.change("hazard_aggregator", "PUT", "/api/v1/areas/hall", body, **headers)
                self.area = body["label"], answer.headers["etag"]
            await asyncio.sleep(0.05)

    async def change_override(self) -> None:
        path = "/api/v1/areas/gate/override"
        for number in itertools.count():
            async with self.turn["hazard_aggregator"]:
                if self.override is not None and self.chance.random() < 0.4:
                    answer = await self.change("hazard_aggregator", "DELETE", path)
                    self.override = None
                else:
                    body = {"state": "blocked", "reason": f"override {number}", "ttl_s": 86_400.0}
                    answer = await self.change("hazard_aggregator", "PUT", path, body)
                    self.override = body["reason"], answer.json()["state"]
            await asyncio.sleep(0.05)

    async def change_goal(self) -> None:
        path = "/api/v1/robots/r1/goal"
        while True:
            async with self.turn["planner"]:
                if self.goal is not None and self.chance.random() < 0.2:
                    await self.change("planner", "DELETE", path)
                    self.goal = None
                else:
                    pose = {"x": self.chance.uniform(5.0, 7.0), "y": self.chance.uniform(1.0, 5.0)}
                    answer = await self.change("planner", "PUT", path, {"pose": pose})
                    self.goal = answer.json()["goal_id"]
            await asyncio.sleep(0.02)

    async def verify(self) -> None:
        """Compare what the services have with what they acknowledged; nothing changes meanwhile."""
        async with self.turn["map_service"], self.turn["hazard_aggregator"], self.turn["planner"]:
            listed = (await self.request("map_service", "GET", "/api/v1/zones")).json()["zones"]
            assert {z["id"]: (z["reason"], f'"{z["version"]}"') for z in listed} == self.zones
            area = await self.request("hazard_aggregator", "GET", "/api/v1/areas/hall")
            if self.area[0]:
                assert (area.json()["definition"]["label"], area.headers["etag"]) == self.area
            gate = (await self.request("hazard_aggregator", "GET", "/api/v1/areas/gate")).json()
            found = gate["override"]
            assert (None if found is None else (found["reason"], found["state"])) == self.override
            assert self.override is None or gate["hazard"]["state"] == "blocked"
            goal = await self.request("planner", "GET", "/api/v1/robots/r1/goal", headers=self.headers)
            assert (goal.json()["goal_id"] if goal.status_code == 200 else None) == self.goal

    async def verify_audit(self) -> None:
        """Check that each acknowledged change has exactly one entry in the audit trail."""
        kinds = {"map_service": ["zone"], "hazard_aggregator": ["area", "override"], "planner": ["mission"]}
        async with self.turn["map_service"], self.turn["hazard_aggregator"], self.turn["planner"]:
            async with self.fog.raw_redis() as raw:
                entries = {
                    service: sum([await raw.xlen(f"fog:test:audit:{kind}") for kind in found])
                    for service, found in kinds.items()
                }
            assert entries == self.acknowledged


@dataclass
class Node:
    """A sensor node whose area is blocked and cleared in turn; knows when nobody may call the area clear."""

    fog: Any
    chance: random.Random
    latest: AreaHazard | None = None
    blocked: bool = False
    """Whether the area's blockage was confirmed, and no reading showed a clear area since."""
    blocked_at: float = 0.0
    late: Any = None
    """How late a busy machine has made the processes since then."""
    confirmed: int = 0
    losses: list[str] = field(default_factory=list)
    seq: Any = field(default_factory=itertools.count)

    def __post_init__(self) -> None:
        self.mqtt = MqttEdge(
            self.fog.mosquitto.url, "kill-test", SystemClock(), site="test", credentials=self.fog.test_credentials
        )
        self.mqtt.on(ch.AREA_HAZARD, self._on_hazard, AreaHazard)

    def _on_hazard(self, ids: Mapping[str, str], hazard: AreaHazard) -> None:
        if ids["area"] != "hall":  # the other area is the operators'
            return
        # A restarted broker may have an older message; receivers ignore it by epoch and seq.
        if self.latest is not None and (hazard.epoch, hazard.seq) <= (self.latest.epoch, self.latest.seq):
            return
        self.latest = hazard
        if self.blocked and hazard.state == "clear":
            self.losses.append(f"the area became clear: {hazard}")

    async def _measure(self, state: str) -> None:
        # By it the aggregator tells fresh readings from a burst of delayed ones.
        uptime_ms = int(asyncio.get_running_loop().time() * 1000) % 2**32
        distance = {"blocked": 0.8, "clear": 3.0}[state]
        reading = NodeReading(
            seq=next(self.seq),
            boot=1,
            uptime_ms=uptime_ms,
            range_m=[distance, distance],
            status=["ok", "ok"],
            state=state,
        )
        await self.mqtt.publish(ch.NODE_READING, reading, node="n1")
        await asyncio.sleep(0.05)

    async def run(self) -> None:
        while True:
            self.blocked = False
            while self.latest is None or self.latest.state != "clear":
                await self._measure("clear")
            while self.latest.state != "blocked":
                await self._measure("blocked")
            self.blocked, self.blocked_at, self.late = True, asyncio.get_running_loop().time(), self.fog.lateness()
            self.confirmed += 1
            measuring = self.chance.random() < 0.5
            until = asyncio.get_running_loop().time() + self.chance.uniform(0.5, 4.0)
            while asyncio.get_running_loop().time() < until:
                # A silent node must not clear its area either.
                await (self._measure("blocked") if measuring else asyncio.sleep(0.05))

    async def verify(self, operators: Operators) -> None:
        """Check that neither the aggregator's messages nor, for longer than it may, the map called the area clear."""
        while True:
            asked_at, before = asyncio.get_running_loop().time(), (self.blocked, self.confirmed)
            areas = (await operators.request("map_service", "GET", "/api/v1/hazards")).json()
            states = {area["hazard"]["area"]: area["hazard"]["state"] for area in areas}
            if not self.blocked or before != (True, self.confirmed) or states.get("hall") != "clear":
                break
            assert asked_at <= self.blocked_at + CLEAR_S + self.late.seconds(), areas
            await asyncio.sleep(0.05)
        assert self.losses == []


async def kill_and_restart(fog: Any, targets: tuple[str, ...], chance: random.Random) -> None:
    """Kill all targets at once, and start them again in random order."""
    for target in targets:
        if target in SERVERS:
            getattr(fog, target).kill()
        else:
            fog.kill(target)
    for target in chance.sample(targets, len(targets)):
        await asyncio.sleep(chance.uniform(0.0, 0.5))
        if target in SERVERS:
            await asyncio.to_thread(getattr(fog, target).start)
        else:
            fog.start(target)


@pytest.mark.timeout(180 + 150 * KILLS)
async def test_nothing_acknowledged_is_lost_in_kills_under_load(fog, tokens):
    chance = random.Random(SEED)
    kills = sequence(chance)
    with (fog.site / "site.toml").open("a") as site:
        site.write(ROBOT + AREA_WITHOUT_NODES)
    for service in SERVICES:
        fog.start(service)
    async with httpx.AsyncClient(timeout=5.0) as client, asyncio.TaskGroup() as tasks:
        operators = Operators(fog, tokens["operator"], random.Random(SEED), client)
        node = Node(fog, random.Random(SEED))
        changes = (operators.change_zones, operators.change_area, operators.change_override, operators.change_goal)
        work = (node.mqtt.run(), node.run(), *(change() for change in changes))
        running = [tasks.create_task(each) for each in work]

        async def progress(changes: int) -> None:
            """Wait until every service acknowledged this many more changes."""
            goal = {service: operators.acknowledged[service] + changes for service in SERVICES}
            async with asyncio.timeout(PROGRESS_S):
                # Several tasks count: an event for each would say no more than a look every 20 ms.
                while any(operators.acknowledged[service] < goal[service] for service in SERVICES):  # noqa: ASYNC110  # see above
                    await asyncio.sleep(0.02)

        await progress(5)
        for targets in kills:
            await asyncio.sleep(chance.uniform(0.0, 0.5))
            await kill_and_restart(fog, targets, chance)
            await progress(2)
            await operators.verify()
            await node.verify(operators)
        await operators.verify_audit()
        async with asyncio.timeout(PROGRESS_S):
            while not node.confirmed:  # noqa: ASYNC110  # as above
                await asyncio.sleep(0.02)
        for task in running:
            task.cancel()
    sys.stdout.write(
        f"{Counter(target for targets in kills for target in targets)} in {len(kills)} moments:"
        f" {dict(operators.acknowledged)} changes acknowledged, {node.confirmed} hazards confirmed,"
        f" {operators.repeated} requests repeated, 0 lost\n"
    )
