"""The operator's commands after a loss: a real Redis is emptied under three running services."""

import asyncio
import re

import httpx
import pytest
from typer.testing import CliRunner

pytest.importorskip("fognav")
from fognav.__main__ import app

pytestmark = pytest.mark.live
SERVICES = {"hazard_aggregator": "AGGREGATOR", "map_service": "MAP", "planner": "PLANNER"}
ZONE = {"kind": "BLOCKED", "shape": {"type": "circle", "centre": [2.0, 3.0], "radius": 0.2}, "reason": "wet"}


async def run(*arguments: str, code: int) -> str:
    done = await asyncio.to_thread(CliRunner().invoke, app, ["store", *arguments])
    assert done.exit_code == code, done.output
    return " ".join(done.output.split())


async def test_lost_records_are_shown_and_restored_or_given_up_by_command(fog, tokens, monkeypatch):
    with (fog.site / "site.toml").open("a") as site:
        site.write('[[robots]]\nid = "r1"\nstart = { x = 1.0, y = 1.0, theta = 0.0 }\nradius = 0.17\n')
    urls = {}
    for module, name in SERVICES.items():
        fog.start(module)
        urls[module] = await fog.ready(module)
        monkeypatch.setenv(f"FOGNAV_{name}_PORT", urls[module].rpartition(":")[2])
    monkeypatch.setenv("FOGNAV_FOG", "127.0.0.1")
    monkeypatch.setenv("FOGNAV_TOKEN", "admin-token")
    async with httpx.AsyncClient(timeout=60) as client, fog.raw_redis() as raw:
        override = {"state": "blocked", "reason": "wet", "ttl_s": 3600}
        for url, body in (
            (f"{urls['map_service']}/api/v1/zones/z1", ZONE),
            (f"{urls['hazard_aggregator']}/api/v1/areas/hall/override", override),
        ):
            headers = {**tokens["operator"], **({"If-None-Match": "*"} if body is ZONE else {})}
            while (put := await client.put(url, json=body, headers=headers)).status_code == 503:
                pass  # it does not lead yet
            assert put.status_code in (200, 201), put.text
        assert "map-service: complete: 1 zones" in await run("status", code=0)
        assert "there is nothing to recover" in await run("accept", "--yes", code=1)

        await raw.flushall()
        shown = await run("status", code=1)
        assert "map-service: LOST: Redis was emptied" in shown
        assert re.search("In Redis: 0 zones, [^;]*; in memory: 1 zones, 0 zone sets", shown)
        assert "nothing was changed" in await run("restore", code=2)
        assert await raw.exists("fog:test:zones") == 0
        monkeypatch.setenv("FOGNAV_TOKEN", "operator-token")
        assert "needs the role admin" in await run("restore", "--yes", code=1)
        monkeypatch.setenv("FOGNAV_TOKEN", "admin-token")
        restored = await run("restore", "--yes", code=0)
        assert all(f"{name}: restored" in restored for name in ("hazard-aggregator", "map-service", "planner"))
        assert [await raw.hkeys(f"fog:test:{table}") for table in ("zones", "overrides")] == [[b"z1"], [b"hall"]]
        entries = [entry for _, entry in await raw.xrange("fog:test:audit:store")]
        assert {(e[b"who"], e[b"action"]) for e in entries} == {(b"ada", b"restore")}
        assert "1 overrides" in await run("status", code=0)

        await raw.flushall()
        fog.kill("map_service")
        fog.start("map_service")
        monkeypatch.setenv("FOGNAV_MAP_PORT", (await fog.url("map_service")).rpartition(":")[2])
        async with asyncio.timeout(60):
            while "started after the loss" not in await run("status", code=1):
                pass
        assert "has no zones: restore a backup of Redis, or accept" in await run(
            "restore", "--service", "map-service", "--yes", code=1
        )
        assert "map-service: accepted" in await run("accept", "--service", "map-service", "--yes", code=0)
        assert (await client.get(f"{await fog.ready('map_service')}/api/v1/zones")).json()["zones"] == []
