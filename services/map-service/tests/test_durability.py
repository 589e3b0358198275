"""What operators can rely on when they repeat requests, and when Redis loses records or refuses writes."""

import asyncio
import json
import os
import signal

import httpx
import pytest

from fog_runtime.stores.records import ZONE_TIMES

pytestmark = pytest.mark.live
CIRCLE = {"kind": "BLOCKED", "shape": {"type": "circle", "centre": [6.0, 3.0], "radius": 0.5}, "reason": "wet floor"}
RECOVERY = "/api/v1/store/recovery"


@pytest.fixture
async def client(fog):
    fog.start("map_service")
    async with httpx.AsyncClient(base_url=await fog.ready("map_service"), timeout=60) as client:
        yield client


@pytest.fixture
async def raw(fog):
    async with fog.raw_redis() as raw:
        yield raw


async def ids(client) -> list[str]:
    return [zone["id"] for zone in (await client.get("/api/v1/zones")).json()["zones"]]


async def unready(client, text: str) -> None:
    """Wait until /readyz says this of the store."""
    async with asyncio.timeout(60):
        while text not in (report := (await client.get("/readyz")).json())["parts"]["store"]["detail"]:  # noqa: ASYNC110  # another process changes it
            await asyncio.sleep(0.05)
    assert not report["ready"]


async def post_until_it_leads(client, body, headers) -> httpx.Response:
    """Post a zone; a process that was just started stands by until its predecessor's lease ends."""
    async with asyncio.timeout(60):
        while (answer := await client.post("/api/v1/zones", json=body, headers=headers)).status_code == 503:  # noqa: ASYNC110  # another process
            await asyncio.sleep(0.05)
    return answer


async def test_repeated_request_returns_the_first_zone_also_after_a_restart(fog, client, raw, tokens):
    headers = {**tokens["operator"], "Idempotency-Key": "a1"}
    first = await client.post("/api/v1/zones", json=CIRCLE, headers=headers)
    again = await client.post("/api/v1/zones", json=CIRCLE, headers=headers)
    assert (first.status_code, again.status_code) == (201, 201)
    assert (again.json(), again.headers["etag"]) == (first.json(), first.headers["etag"])
    other = await client.post("/api/v1/zones", json={**CIRCLE, "reason": "x"}, headers=headers)
    assert (other.status_code, other.json()["errors"][0]["field"]) == (422, "header.Idempotency-Key")
    invalid = await client.post("/api/v1/zones", json=CIRCLE, headers={**headers, "Idempotency-Key": "x" * 129})
    assert invalid.status_code == 422
    fog.kill("map_service")
    fog.start("map_service")
    async with httpx.AsyncClient(base_url=await fog.ready("map_service"), timeout=60) as restarted:
        again = await post_until_it_leads(restarted, CIRCLE, headers)
        assert again.json() == first.json()
        assert await ids(restarted) == [first.json()["id"]]
    (key,) = await raw.keys("fog:test:idempotency:*")
    assert 86_000 < await raw.ttl(key) <= 86_400


async def test_write_whose_reply_was_lost_is_found_by_its_key_and_stays_one_zone(fog, client, tokens):
    headers = {**tokens["operator"], "Idempotency-Key": "lost-reply"}
    os.kill(fog.redis.pid, signal.SIGSTOP)
    try:
        refused = await client.post("/api/v1/zones", json=CIRCLE, headers=headers)
    finally:
        os.kill(fog.redis.pid, signal.SIGCONT)
    assert refused.status_code == 503
    assert refused.json()["type"] == "urn:fognav:store_uncertain"
    assert "does not answer within 1 s" in refused.json()["detail"]
    await fog.ready("map_service")
    again = await client.post("/api/v1/zones", json=CIRCLE, headers=headers)
    assert again.status_code == 201
    assert await ids(client) == [again.json()["id"]]


async def test_put_with_if_none_match_creates_a_zone_once(client, tokens):
    headers = {**tokens["operator"], "If-None-Match": "*"}
    answers = [await client.put("/api/v1/zones/wet", json=CIRCLE, headers=headers) for _ in range(2)]
    assert [answer.status_code for answer in answers] == [201, 412]
    assert answers[0].headers["etag"] == '"1"'
    for path, header, field in (
        ("wet", '"1"', "header.If-None-Match"),
        ("No%20id", "*", "path"),
    ):
        refused = await client.put(f"/api/v1/zones/{path}", json=CIRCLE, headers={**headers, "If-None-Match": header})
        assert (refused.status_code, refused.json()["errors"][0]["field"]) == (422, field)


async def test_repeated_put_returns_the_first_result_though_its_condition_is_false_now(client, tokens):
    operator = tokens["operator"]
    await client.post("/api/v1/zones", json={**CIRCLE, "id": "wet"}, headers=operator)
    headers = {**operator, "If-Match": '"1"', "Idempotency-Key": "p1"}
    answers = [await client.put("/api/v1/zones/wet", json=CIRCLE, headers=headers) for _ in range(2)]
    assert [(answer.status_code, answer.headers["etag"]) for answer in answers] == 2 * [(200, '"2"')]
    headers = {**operator, "If-None-Match": "*", "Idempotency-Key": "p2"}
    answers = [await client.put("/api/v1/zones/dry", json=CIRCLE, headers=headers) for _ in range(2)]
    assert [answer.status_code for answer in answers] == [201, 201]


async def test_emptied_redis_is_noticed_and_the_zones_are_restored_from_memory(fog, client, raw, tokens):
    await client.post("/api/v1/zones", json={**CIRCLE, "id": "wet", "ttl_s": 900.0}, headers=tokens["operator"])
    refused = await client.post(RECOVERY, json={"action": "restore"}, headers=tokens["admin"])
    assert refused.status_code == 409, "nothing was lost"
    await raw.flushall()
    await unready(client, "Redis was emptied")
    assert "fognav_store_lost 1.0" in (await client.get("/metrics")).text
    assert await ids(client) == ["wet"], "the map keeps its zones"
    for method, path in (("POST", "/api/v1/zones"), ("PUT", "/api/v1/zones/wet"), ("DELETE", "/api/v1/zones/wet")):
        refused = await client.request(method, path, json=CIRCLE, headers=tokens["operator"])
        assert refused.status_code == 503
        assert refused.json()["type"] == "urn:fognav:store_away"
        assert RECOVERY in refused.json()["detail"]
    records = [key for key in await raw.keys("*") if not key.endswith((b":lease", b":epoch"))]
    assert records == [], "nothing was written into the emptied store"
    assert (await client.post(RECOVERY, json={"action": "restore"}, headers=tokens["operator"])).status_code == 403
    assert (await client.post(RECOVERY, json={"action": "restore"}, headers=tokens["admin"])).status_code == 204
    (times,) = await raw.hvals(f"fog:test:{ZONE_TIMES}")
    assert b'"wet"' in times, "a restart now does not let it last longer"
    await fog.ready("map_service")
    assert (
        await client.post("/api/v1/zones", json={**CIRCLE, "id": "dry"}, headers=tokens["operator"])
    ).status_code == 201
    fog.kill("map_service")
    fog.start("map_service")
    async with httpx.AsyncClient(base_url=await fog.ready("map_service"), timeout=60) as restarted:
        assert await ids(restarted) == ["dry", "wet"]
        (entry,) = (await restarted.get("/api/v1/audit", params={"kind": "store"}, headers=tokens["admin"])).json()
    assert (entry["who"], entry["action"], entry["id"]) == ("ada", "restore", "map-service")


async def test_start_on_an_emptied_redis_serves_no_map_until_an_administrator_accepts(fog, client, raw, tokens):
    await client.post("/api/v1/zones", json={**CIRCLE, "id": "wet"}, headers=tokens["operator"])
    fog.kill("map_service")
    await raw.flushall()
    fog.start("map_service")
    async with httpx.AsyncClient(base_url=await fog.url("map_service"), timeout=60) as restarted:
        await unready(restarted, "Redis was emptied")
        assert (await restarted.get("/api/v1/zones")).status_code == 503
        nothing = await restarted.post(RECOVERY, json={"action": "restore"}, headers=tokens["admin"])
        assert (nothing.status_code, "restore a backup" in nothing.json()["detail"]) == (409, True)
        assert (await restarted.post(RECOVERY, json={"action": "accept"}, headers=tokens["admin"])).status_code == 204
        await fog.ready("map_service")
        assert await ids(restarted) == []


async def test_older_state_of_redis_is_noticed(fog, client, raw, tokens):
    await client.post("/api/v1/zones", json={**CIRCLE, "id": "wet"}, headers=tokens["operator"])
    backup = {key: await raw.dump(key) for key in await raw.keys("*")}
    await client.post("/api/v1/zones", json={**CIRCLE, "id": "dry"}, headers=tokens["operator"])
    async with raw.pipeline() as pipeline:
        pipeline.flushall()
        for key, value in backup.items():
            pipeline.restore(key, 0, value)
        await pipeline.execute()
    await unready(client, "Redis went back to an older state: it has 1 of 2 writes of zones")
    assert await ids(client) == ["dry", "wet"]
    assert (await client.post(RECOVERY, json={"action": "accept"}, headers=tokens["admin"])).status_code == 204
    assert await ids(client) == ["wet"]


async def test_replica_full_and_hung_redis_refuse_each_write_and_half_do_none(fog, client, raw, tokens):
    await client.post("/api/v1/zones", json={**CIRCLE, "id": "wet"}, headers=tokens["operator"])

    async def refused(text: str) -> None:
        before = {key: await raw.dump(key) for key in await raw.keys("*")}
        for method, path in (("POST", "/api/v1/zones"), ("PUT", "/api/v1/zones/wet")):
            answer = await client.request(method, path, json={**CIRCLE, "reason": "no"}, headers=tokens["operator"])
            assert answer.status_code == 503
            assert answer.json()["detail"].startswith(f"nothing was changed: {text}"), answer.text
        await unready(client, text)
        assert {key: await raw.dump(key) for key in await raw.keys("*")} == before

    await raw.replicaof("127.0.0.1", 1)
    await refused("Redis is a read-only replica")
    await raw.replicaof("NO", "ONE")
    await fog.ready("map_service")
    await raw.config_set("maxmemory", 1)
    await refused("Redis is full")
    assert (await client.delete("/api/v1/zones/wet", headers=tokens["operator"])).status_code == 204, "makes room"
    await raw.config_set("maxmemory", 0)
    await fog.ready("map_service")
    await raw.config_set("min-replicas-to-write", 1)
    await client.post("/api/v1/zones", json={**CIRCLE, "id": "wet"}, headers=tokens["operator"])
    await unready(client, "Redis has too few replicas")
    await raw.config_set("min-replicas-to-write", 0)
    await fog.ready("map_service")
    assert await ids(client) == []


async def test_audit_is_paged_over_all_kinds_and_no_kind_pushes_out_another(client, raw, tokens):
    created = [{**CIRCLE, "id": f"z{number}"} for number in range(5)]
    for zone in created:
        assert (await client.post("/api/v1/zones", json=zone, headers=tokens["operator"])).status_code == 201
    fields = {"at": "1", "who": "r1", "action": "reached", "id": "r1", "before": "{}", "after": ""}
    async with raw.pipeline() as pipeline:
        for _ in range(20):
            pipeline.xadd("fog:test:audit:mission", fields, maxlen=10, approximate=False)
        await pipeline.execute()
    seen, path = [], "/api/v1/audit?limit=4"
    while path:
        page = await client.get(path, headers=tokens["viewer"])
        entries = page.json()
        assert 1 <= len(entries) <= 4
        seen += [(entry["kind"], entry["id"]) for entry in entries]
        path = page.links["next"]["url"] if "next" in page.links else ""
    assert seen == 10 * [("mission", "r1")] + [("zone", zone["id"]) for zone in reversed(created)]
    for limit, count in ((10**20, 15), (1000, 15), (-(10**20), 1)):
        entries = (await client.get(f"/api/v1/audit?limit={limit}", headers=tokens["viewer"])).json()
        assert len(entries) == count
    for query in ("cursor=yesterday", "cursor=1-1.token", "kind=token"):
        assert (await client.get(f"/api/v1/audit?{query}", headers=tokens["viewer"])).status_code == 422


async def test_start_with_a_zone_list_too_large_for_robots_says_so_and_goes_on(fog, raw, tokens):
    square = {"type": "rectangle", "corner": [6.0, 3.0], "opposite": [6.2, 3.2]}
    zone = {"kind": "BLOCKED", "shape": square, "reason": "\N{GRINNING FACE}" * 500, "version": 1}
    stored = {f"z{number}": json.dumps({**zone, "id": f"z{number}"}) for number in range(2050)}
    await raw.hset("fog:test:zones", mapping=stored)
    fog.start("map_service")
    async with httpx.AsyncClient(base_url=await fog.ready("map_service"), timeout=60) as client:
        report = (await client.get("/readyz")).json()
        assert "too large for robots" in report["parts"]["zones"]["detail"]
        assert 'fognav_unpublishable_messages_total{channel="zones"}' in (await client.get("/metrics")).text
        refused = await client.post("/api/v1/zones", json=CIRCLE, headers=tokens["operator"])
        assert (refused.status_code, refused.json()["errors"][0]["field"]) == (422, "body.shape")
        assert "delete zones" in refused.json()["detail"]
        assert (await client.delete("/api/v1/zones/z0", headers=tokens["operator"])).status_code == 204
        shorter = await client.put(
            "/api/v1/zones/z1", json={"kind": "BLOCKED", "shape": square}, headers=tokens["operator"]
        )
        assert shorter.status_code == 200
        assert len(await ids(client)) == 2049
