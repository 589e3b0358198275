"""A Redis that refuses writes or hangs, under aggregator, map-service and planner: said, refused, nothing half done."""

import asyncio
import contextlib
import os
import signal
from collections.abc import Callable
from dataclasses import dataclass

import httpx
import pytest

pytestmark = pytest.mark.live

ROBOT_AND_AREA = """
[[robots]]
id = "r1"
start = { x = 1.0, y = 1.0, theta = 0.0 }
radius = 0.17

[[areas]]
id = "gate"
polygon = [[0.2, 4.5], [0.6, 4.5], [0.6, 4.9]]
"""
CIRCLE = {"type": "circle", "centre": [6.0, 3.0], "radius": 0.5}
WRITES = {
    "map_service": {
        "/api/v1/zones/wet": ({"kind": "BLOCKED", "shape": CIRCLE, "reason": "wet"}, "reason"),
    },
    "hazard_aggregator": {
        "/api/v1/areas/hall": (
            {"label": "hall", "polygon": [[3.0, 2.0], [4.0, 2.0], [4.0, 4.0], [3.0, 4.0]], "nodes": ["n1"]}, "label",
        ),
        "/api/v1/areas/gate/override": ({"state": "blocked", "reason": "wet", "ttl_s": 3600.0}, "reason"),
    },
    "planner": {"/api/v1/robots/r1/goal": ({"pose": {"x": 6.0, "y": 4.0, "theta": 0.0}}, "")},
}  # fmt: skip
"""What each service stores: by path, the body, and the field of it that a second version changes."""
AUDITED = ("zone", "area", "override", "mission")


@dataclass
class Operator:
    """Writes to all three services, and compares Redis before and after."""

    client: httpx.AsyncClient
    urls: dict[str, str]
    headers: dict[str, str]

    async def write(self, service: str, path: str, version: int) -> httpx.Response:
        """Put a version of it; the first creates it."""
        body, field = WRITES[service][path]
        body = {**body, field: f"version {version}"} if field else {"pose": {"x": 6.0, "y": 4.0 - 0.2 * version}}
        condition = {}
        if service == "map_service":
            condition = {"If-Match": "*"} if version else {"If-None-Match": "*"}
        elif path.endswith("hall"):
            condition = {"If-Match": "*"}
        headers = {**self.headers, "Idempotency-Key": f"{version}{path}".replace("/", "-"), **condition}
        return await self.client.put(f"{self.urls[service]}{path}", json=body, headers=headers)

    async def write_all(self, version: int) -> dict[str, httpx.Response]:
        return {path: await self.write(service, path, version) for service, paths in WRITES.items() for path in paths}

    async def detail(self, url: str) -> str:
        """Return what a service says of its store."""
        return (await self.client.get(f"{url}/readyz")).json()["parts"]["store"]["detail"]

    async def wait_for(self, stored: Callable[[str], bool]) -> None:
        """Wait until every service says something of its store on /readyz that is as expected."""
        for url in self.urls.values():
            async with asyncio.timeout(60):
                while not stored(await self.detail(url)):  # noqa: ASYNC110  # another process changes it
                    await asyncio.sleep(0.05)


@pytest.fixture
async def operator(fog, tokens):
    with (fog.site / "site.toml").open("a") as site:
        site.write(ROBOT_AND_AREA)
    for module in WRITES:
        fog.start(module)
    urls = {module: await fog.ready(module) for module in WRITES}
    async with httpx.AsyncClient(timeout=60.0) as client:
        made = Operator(client, urls, tokens["operator"])
        for answer in (await made.write_all(0)).values():
            assert answer.status_code in (200, 201), answer.text
        yield made


BY_THE_SERVICES = (
    "lease", "epoch", "floor", "ready", "hazards", "history", "override_rests", "alerts", "alert", "writes",
)  # fmt: skip
"""Words in keys of what the services write by themselves, at their own times, whatever an operator does: leases, what
has become of an area, its alerts, the time that is left of an override, and how much was written of each."""


async def records(raw) -> dict[bytes, bytes]:
    """Return all that is stored for operators."""
    keys = [key for key in await raw.keys("*") if not set(key.decode().split(":")) & set(BY_THE_SERVICES)]
    assert keys
    return {key: await raw.dump(key) for key in sorted(keys)}


@contextlib.asynccontextmanager
async def read_only(_fog, raw):
    await raw.replicaof("127.0.0.1", 1)
    yield "Redis is a read-only replica"
    await raw.replicaof("NO", "ONE")


@contextlib.asynccontextmanager
async def full(_fog, raw):
    await raw.config_set("maxmemory", 1)
    yield "Redis is full"
    await raw.config_set("maxmemory", 0)


@contextlib.asynccontextmanager
async def hung(fog, _raw):
    os.kill(fog.redis.pid, signal.SIGSTOP)
    try:
        yield "Redis does not answer within 1 s"
    finally:
        os.kill(fog.redis.pid, signal.SIGCONT)


async def entries(raw) -> dict[str, int]:
    """Return how many entries each kind of the audit trail has."""
    return {kind: await raw.xlen(f"fog:test:audit:{kind}") for kind in AUDITED}


def lasting(answers: dict[str, httpx.Response]) -> list[dict]:
    """Return the contents of answers without the time that is left of an override."""
    return [{name: value for name, value in answer.json().items() if name != "rest_s"} for answer in answers.values()]


async def test_redis_that_takes_no_writes_is_named_and_changes_nothing_and_each_write_succeeds_later(fog, operator):
    async with fog.raw_redis() as raw:
        for version, fault in enumerate((read_only, full, hung), start=1):
            before, audited = await records(raw), await entries(raw)
            async with fault(fog, raw) as text:
                refused = await operator.write_all(version)
                await operator.wait_for(lambda detail, text=text: text in detail)
            certain = fault is not hung
            for path, answer in refused.items():
                assert answer.status_code == 503, (path, answer.text)
                detail = answer.json()["detail"]
                assert text in detail, (path, detail)
                assert detail.startswith("nothing was changed: ") == certain, (path, detail)
                assert ("may or may not be stored" in detail) != certain, (path, detail)
            await operator.wait_for(lambda detail: not detail)
            assert not certain or await records(raw) == before
            repeated = await operator.write_all(version)
            for path, answer in repeated.items():
                assert answer.status_code in (200, 201), (path, answer.text)
            assert lasting(await operator.write_all(version)) == lasting(repeated)
            assert await entries(raw) == {kind: count + 1 for kind, count in audited.items()}, "each once"
