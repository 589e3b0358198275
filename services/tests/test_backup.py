"""A fog node is backed up while it runs, and comes back on an empty machine: zones, audit trail, secrets, site."""

import asyncio
import shutil
import time

import httpx
import pytest
from typer.testing import CliRunner

from fog_supervisor.servers import start_redis

pytest.importorskip("fognav")
from fognav.__main__ import app

pytestmark = pytest.mark.live
ZONE = {"kind": "BLOCKED", "shape": {"type": "circle", "centre": [2.0, 3.0], "radius": 0.2}, "reason": "wet"}


async def run(*arguments: str) -> str:
    done = await asyncio.to_thread(CliRunner().invoke, app, [str(argument) for argument in arguments])
    assert done.exit_code == 0, done.output
    return " ".join(done.output.split())


async def put(client: httpx.AsyncClient, url: str, token: dict[str, str], body: dict) -> httpx.Response:
    deadline = time.monotonic() + 60.0
    while (answer := await client.put(f"{url}/api/v1/zones/z1", json=body, headers=token)).status_code == 503:
        assert time.monotonic() < deadline, f"it has not led for a minute: {answer.text}"
    assert answer.status_code in (200, 201), answer.text
    return answer


async def test_fog_node_comes_back_on_an_empty_machine(fog, tokens, tmp_path, monkeypatch):
    monkeypatch.setenv("FOGNAV_CREDENTIALS_FILE", str(fog.credentials_file("administrator")))
    secrets = tmp_path / "secrets"
    secrets.mkdir()
    (secrets / "tokens.toml").write_bytes((fog.folder / "tokens.toml").read_bytes())
    fog.start("map_service")
    url = await fog.ready("map_service")
    file = tmp_path / "fog.tar.gz"
    async with httpx.AsyncClient(timeout=60) as client:
        await put(client, url, {**tokens["operator"], "If-None-Match": "*"}, ZONE)
        await put(client, url, tokens["operator"], {**ZONE, "reason": "still wet"})
        before = (await client.get(f"{url}/api/v1/zones")).json()["zones"]
        trail = (await client.get(f"{url}/api/v1/audit", headers=tokens["viewer"])).json()
        assert (before[0]["version"], len(trail)) == (2, 2)
        places = ["--site", fog.site, "--data", fog.folder / "data", "--secrets", secrets, "--redis", fog.redis.url]
        assert "backed up site test" in await run("backup", file, *places)
        metrics = (await client.get(f"{url}/metrics")).text
        assert float(metrics.partition("\nfognav_last_backup_seconds{")[2].split()[1]) > 1.7e9
        fog.kill("map_service")
        for folder in (fog.site, fog.folder / "data", secrets):
            shutil.rmtree(folder)
        with start_redis(tmp_path / "new-redis", security=fog.security.folder("redis")) as redis:
            assert "restored site test" in await run("restore", file, *places[:-1], redis.url)
            fog.start("map_service", FOGNAV_REDIS_URL=redis.url, FOGNAV_TOKENS_FILE=str(secrets / "tokens.toml"))
            url = await fog.ready("map_service")
            assert (await client.get(f"{url}/api/v1/zones")).json()["zones"] == before
            assert (await client.get(f"{url}/api/v1/audit", headers=tokens["viewer"])).json() == trail
            again = await put(client, url, tokens["operator"], {**ZONE, "reason": "dry soon"})
            assert again.json()["version"] == 3
            fog.kill("map_service")
