"""Areas and nodes over REST, with a running aggregator."""

import asyncio
import json

import httpx
import msgspec
import pytest

from fog_contracts.messages import AREAS_MAX, AreaDefinition

pytestmark = pytest.mark.live
POLYGON = [[1.0, 1.0], [2.0, 1.0], [2.0, 2.0], [1.0, 2.0]]


@pytest.fixture
async def client(fog):
    fog.start("hazard_aggregator")
    async with httpx.AsyncClient(base_url=await fog.ready("hazard_aggregator"), timeout=60) as client:
        yield client


async def test_areas_are_changed_by_version_and_survive_a_kill(fog, client, tokens):
    (area,) = (await client.get("/api/v1/areas")).json()
    assert (area["definition"]["id"], area["hazard"]["state"], area["withheld"]) == ("hall", "unknown", False)
    body = {"polygon": POLYGON, "nodes": ["n1"], "debounce": {"to_blocked": 3}}
    assert (await client.put("/api/v1/areas/hall", json=body)).status_code == 401
    put = await client.put("/api/v1/areas/hall", json=body, headers={**tokens["operator"], "If-Match": '"0"'})
    assert (put.status_code, put.headers["etag"]) == (200, '"1"'), put.text
    stale = await client.put("/api/v1/areas/hall", json=body, headers={**tokens["operator"], "If-Match": '"0"'})
    assert stale.status_code == 412
    fog.kill("hazard_aggregator")
    fog.start("hazard_aggregator")
    async with httpx.AsyncClient(base_url=await fog.ready("hazard_aggregator"), timeout=60) as again:
        kept = (await again.get("/api/v1/areas/hall")).json()["definition"]
    assert (kept["polygon"], kept["debounce"]["to_blocked"], kept["version"]) == (POLYGON, 3, 1)


async def test_history_continues_over_a_kill(fog, client, tokens):
    override = {"state": "blocked", "reason": "wet floor", "ttl_s": 600}
    put = await client.put("/api/v1/areas/hall/override", json=override, headers=tokens["operator"])
    assert put.status_code == 201, put.text

    async def blocked(client: httpx.AsyncClient) -> dict:
        answer = await client.get("/api/v1/areas/hall/history?limit=1")
        async with asyncio.timeout(60):
            while [view["period"]["state"] for view in answer.json()] != ["blocked"]:
                await asyncio.sleep(0.05)
                answer = await client.get("/api/v1/areas/hall/history?limit=1")
        return answer.json()[0]

    before = await blocked(client)
    older = await client.get("/api/v1/areas/hall/history")
    assert [view["period"]["state"] for view in older.json()] == ["blocked", "unknown"]
    fog.kill("hazard_aggregator")
    fog.start("hazard_aggregator")
    async with httpx.AsyncClient(base_url=await fog.ready("hazard_aggregator"), timeout=60) as again:
        after = await blocked(again)
        assert (await again.get("/api/v1/areas/nowhere/history")).status_code == 404
        assert (await again.get("/api/v1/areas/hall/history?cursor=x")).status_code == 422
    assert (after["period"], after["ended"]) == (before["period"], None)
    assert after["lasted_s"] > before["lasted_s"]


async def test_version_stored_by_another_writer_is_loaded_after_the_conflict(fog, client, tokens):
    other = AreaDefinition(id="hall", polygon=[(1.0, 1.0), (2.0, 1.0), (2.0, 2.0)], label="elsewhere", version=5)
    async with fog.raw_redis() as raw:
        await raw.hset("fog:test:areas", "hall", msgspec.json.encode(other))
    body = {"polygon": POLYGON, "nodes": ["n1"]}
    refused = await client.put("/api/v1/areas/hall", json=body, headers={**tokens["operator"], "If-Match": '"0"'})
    assert refused.status_code == 412
    async with asyncio.timeout(60):
        for _ in iter(int, 1):
            if (await client.get("/api/v1/areas/hall")).json()["definition"]["label"] == "elsewhere":
                break
            await asyncio.sleep(0.05)
    again = await client.put("/api/v1/areas/hall", json=body, headers={**tokens["operator"], "If-Match": '"5"'})
    assert (again.status_code, again.headers["etag"]) == (200, '"6"')


async def test_invalid_areas_are_refused_naming_the_field_and_a_dead_store_is_reported(fog, client, tokens):
    for body, field in (
        ({"polygon": [[1, 1], [2, 2], [2, 1], [1, 2]]}, "body.polygon"),
        ({"polygon": [[1, 1], [90, 1], [2, 2]]}, "body.polygon.1"),
        ({"polygon": POLYGON, "nodes": ["n9"]}, "body.nodes.0"),
        ({"polygon": POLYGON, "unknown": {"penalty": 255}}, "body.unknown.penalty"),
        ({"polygon": POLYGON, "debounce": {"rule": "majority"}}, "body.debounce.rule"),
        ({"polygon": POLYGON, "debounce": {"to_clear": 0}}, "body.debounce.to_clear"),
        ({"nodes": ["n1"]}, "body.polygon"),
        ({"polygon": POLYGON, "nodes": ["n1"], "cone_of": "n1"}, "body.cone_of"),
        ({"cone_of": "n9"}, "body.cone_of"),
        ({"cone_of": "n1"}, "body.cone_of"),
    ):
        answer = await client.put("/api/v1/areas/hall", json=body, headers=tokens["operator"])
        assert answer.status_code == 422
        assert answer.json()["errors"][0]["field"] == field
    assert (await client.get("/api/v1/areas/gate")).status_code == 404
    fog.redis.kill()
    answer = await client.put("/api/v1/areas/hall", json={"polygon": POLYGON}, headers=tokens["operator"])
    assert answer.status_code == 503
    assert (await client.get("/api/v1/areas/hall")).json()["definition"]["version"] == 0


async def test_area_that_is_the_cone_of_a_node_follows_it_and_is_unusable_without_it(fog, client, tokens):
    body = {"nodes": ["n1"], "cone_of": "n1"}
    drawn = (await client.get("/api/v1/areas/hall")).json()["seen_share"]
    put = await client.put("/api/v1/areas/hall", json=body, headers=tokens["operator"])
    assert put.status_code == 200, put.text
    assert drawn < 0.6
    assert (await client.get("/api/v1/areas/hall")).json()["seen_share"] > 0.95
    lowest = min(y for _, y in put.json()["polygon"])
    assert lowest == pytest.approx(3.0, abs=0.02), "n1 looks down from 4.5 m, 1.5 m far"
    text = (fog.site / "site.toml").read_text()

    async def after_restart(text: str) -> tuple[dict, dict]:
        fog.kill("hazard_aggregator")
        (fog.site / "site.toml").write_text(text)
        fog.start("hazard_aggregator")
        async with httpx.AsyncClient(base_url=await fog.ready("hazard_aggregator"), timeout=60) as again:
            area = (await again.get("/api/v1/areas/hall")).json()
            return area["definition"], (await again.get("/readyz")).json()["parts"].get("areas", {})

    moved, _ = await after_restart(text.replace("y = 4.5", "y = 5.0"))
    assert min(y for _, y in moved["polygon"]) == pytest.approx(3.5, abs=0.02)
    assert (moved["cone_of"], moved["version"]) == ("n1", 1)
    async with fog.raw_redis() as raw, asyncio.timeout(60):
        while json.loads(await raw.hget("fog:test:areas", "hall"))["polygon"] != moved["polygon"]:  # noqa: ASYNC110  # another process changes it
            await asyncio.sleep(0.05)
    left, readiness = await after_restart(text.replace('id = "n1"', 'id = "n2"'))
    assert (left["nodes"], left["polygon"]) == ([], moved["polygon"]), "it stays where its node was last"
    assert "the site has no node n1: name one of the area's nodes" in readiness["detail"]


async def test_more_areas_of_site_and_store_than_a_heartbeat_lists_are_told_until_some_are_removed(fog, client, tokens):
    put = await client.put("/api/v1/areas/stored", json={"polygon": POLYGON}, headers=tokens["operator"])
    assert put.status_code == 201, put.text
    fog.kill("hazard_aggregator")
    more = "".join(f'\n[[areas]]\nid = "more-{number}"\npolygon = {POLYGON}\n' for number in range(AREAS_MAX - 1))
    with (fog.site / "site.toml").open("a") as site:
        site.write(more)
    fog.start("hazard_aggregator")
    url = await fog.url("hazard_aggregator")
    async with httpx.AsyncClient(base_url=url, timeout=60) as again, asyncio.timeout(60):

        async def told() -> str:
            return str((await again.get("/readyz")).json()["parts"].get("area_count", {}).get("detail"))

        while f"have {AREAS_MAX + 1} areas together, and {AREAS_MAX} is the limit" not in await told():  # noqa: ASYNC110  # another process tells it
            await asyncio.sleep(0.05)
        assert (await again.get("/readyz")).status_code == 503
        removed = {"polygon": POLYGON, "removed": True}
        headers = {**tokens["operator"], "If-Match": "*"}
        answer = await again.put("/api/v1/areas/stored", json=removed, headers=headers)
        while answer.status_code == 503:
            await asyncio.sleep(0.05)  # the lease of the one that was killed has not ended yet
            answer = await again.put("/api/v1/areas/stored", json=removed, headers=headers)
        assert answer.status_code == 200, answer.text
        while (await again.get("/readyz")).json()["parts"]["area_count"]["detail"]:  # noqa: ASYNC110  # as above
            await asyncio.sleep(0.05)


async def test_nodes_report_their_health(client):
    (node,) = (await client.get("/api/v1/nodes")).json()
    assert (node["id"], node["area"], node["state"], node["age_s"]) == ("n1", "hall", "unknown", None)
    assert node["code"] == "not_heard"
    described = (await client.get("/openapi.json")).json()
    assert {"/api/v1/areas", "/api/v1/areas/{area_id}", "/api/v1/nodes"} <= set(described["paths"])


async def test_repeated_put_returns_the_first_result_and_emptied_redis_is_restored_from_memory(fog, client, tokens):
    body = {"polygon": POLYGON, "nodes": ["n1"]}
    headers = {**tokens["operator"], "Idempotency-Key": "k1"}
    answers = [await client.put("/api/v1/areas/hall", json=body, headers=headers) for _ in range(2)]
    assert [(answer.status_code, answer.headers["etag"]) for answer in answers] == 2 * [(200, '"1"')]
    other = await client.put("/api/v1/areas/hall", json={"polygon": POLYGON}, headers=headers)
    assert (other.status_code, other.json()["errors"][0]["field"]) == (422, "header.Idempotency-Key")
    new = {**tokens["operator"], "If-None-Match": "*"}
    refused = await client.put("/api/v1/areas/hall", json=body, headers=new)
    assert (refused.status_code, refused.json()["type"]) == (412, "urn:fognav:area_changed")
    assert (await client.put("/api/v1/areas/gate", json=body, headers=new)).status_code == 201
    async with fog.raw_redis() as raw:
        await raw.flushall()
        refused = await client.put("/api/v1/areas/hall", json=body, headers=tokens["operator"])
        assert (refused.status_code, refused.json()["type"]) == (503, "urn:fognav:store_away")
        recovery = {"json": {"action": "restore"}, "headers": tokens["admin"]}
        assert (await client.post("/api/v1/store/recovery", **recovery)).status_code == 204
        assert set(await raw.hkeys("fog:test:areas")) == {b"hall", b"gate"}
        assert set(await raw.hkeys("fog:test:hazards")) == {b"hall", b"gate"}
    await fog.ready("hazard_aggregator")
    # The lease was lost with the rest, and changes are refused until it is held again.
    for _ in range(60):
        put = await client.put("/api/v1/areas/hall", json=body, headers=tokens["operator"])
        if put.status_code != 503:
            break
        await asyncio.sleep(float(put.headers["retry-after"]))
    assert (put.status_code, put.headers["etag"]) == (200, '"2"')


async def test_change_of_an_area_before_the_stored_areas_are_loaded_is_refused_without_a_conflict(fog, client, tokens):
    body = {"polygon": POLYGON, "nodes": ["n1"]}
    put = await client.put("/api/v1/areas/hall", json=body, headers=tokens["operator"])
    fog.redis.kill()
    fog.kill("hazard_aggregator")
    fog.start("hazard_aggregator")
    async with httpx.AsyncClient(base_url=await fog.url("hazard_aggregator"), timeout=60) as restarted:
        headers = {**tokens["operator"], "If-Match": put.headers["etag"]}
        # At first it waits for a leader that might be alive, then it leads without the stored areas.
        detail = ""
        while "not loaded yet" not in detail:
            refused = await restarted.put("/api/v1/areas/hall", json=body, headers=headers)
            assert refused.status_code == 503
            detail = refused.json()["detail"]
        fog.redis.start()
        await fog.ready("hazard_aggregator")
        assert (await restarted.put("/api/v1/areas/hall", json=body, headers=headers)).headers["etag"] == '"2"'


async def test_override_counts_at_once_survives_a_kill_and_ends_with_an_entry_in_the_audit_trail(fog, client, tokens):
    path = "/api/v1/areas/hall/override"
    body = {"state": "blocked", "reason": "wet floor", "ttl_s": 3600}
    assert (await client.put(path, json=body)).status_code == 401
    put = await client.put(path, json=body, headers={**tokens["operator"], "Idempotency-Key": "k1"})
    assert (put.status_code, put.headers["etag"], put.json()["author"]) == (201, '"1"', "anna"), put.text
    again = await client.put(path, json=body, headers={**tokens["operator"], "Idempotency-Key": "k1"})
    assert again.headers["etag"] == '"1"', "the same attempt"
    fog.kill("hazard_aggregator")
    fog.start("hazard_aggregator")
    async with httpx.AsyncClient(base_url=await fog.ready("hazard_aggregator"), timeout=60) as restarted:
        area = (await restarted.get("/api/v1/areas/hall")).json()
        assert (area["hazard"]["state"], area["hazard"]["override"]["author"]) == ("blocked", "anna")
        assert 3600 - 180 < area["override"]["rest_s"] < 3600

        async def put_under_lease(changed: dict[str, object], **headers: str) -> httpx.Response:
            """Put as soon as the lease of the one that was killed has ended."""
            while True:
                answer = await restarted.put(path, json={**body, **changed}, headers={**tokens["operator"], **headers})
                if answer.status_code != 503:
                    return answer

        assert (await put_under_lease({}, **{"If-Match": '"7"'})).status_code == 412
        short = await put_under_lease({"ttl_s": 0.2})
        assert short.headers["etag"] == '"2"'
        async with asyncio.timeout(60), fog.raw_redis() as raw:
            while await raw.hlen("fog:test:overrides"):  # noqa: ASYNC110  # another process deletes it
                await asyncio.sleep(0.05)
            entries = [entry for _, entry in await raw.xrange("fog:test:audit:override")]
        assert [(entry[b"who"], entry[b"action"], entry[b"id"]) for entry in entries] == [
            (b"anna", b"override", b"hall"),
            (b"anna", b"override", b"hall"),
            (b"hazard-aggregator", b"end", b"hall"),
        ]
        before, after = (json.loads(entries[1][name]) for name in (b"before", b"after"))
        assert (before["ttl_s"], after["ttl_s"]) == (3600, 0.2)
        area = (await restarted.get("/api/v1/areas/hall")).json()
        assert (area["override"], area["hazard"]["override"]) == (None, None)
        assert (await restarted.delete(path, headers=tokens["operator"])).status_code == 404


async def test_only_an_admin_declares_an_area_clear_and_for_a_quarter_of_an_hour_at_most(client, tokens):
    path = "/api/v1/areas/hall/override"
    body = {"state": "clear", "reason": "I stand here", "ttl_s": 900}
    refused = await client.put(path, json=body, headers=tokens["operator"])
    assert (refused.status_code, refused.json()["type"]) == (403, "urn:fognav:clear_needs_admin")
    long = await client.put(path, json={**body, "ttl_s": 901}, headers=tokens["admin"])
    assert (long.status_code, long.json()["errors"][0]["field"]) == (422, "body.ttl_s")
    unreasoned = await client.put(path, json={**body, "reason": ""}, headers=tokens["admin"])
    assert unreasoned.status_code == 422
    assert (await client.put(path.replace("hall", "nix"), json=body, headers=tokens["admin"])).status_code == 404
    missing = await client.get(path)
    assert (missing.status_code, missing.json()["type"]) == (404, "urn:fognav:no_override")
    assert (await client.put(path, json=body, headers=tokens["admin"])).status_code == 201
    read = await client.get(path)
    assert (read.json()["author"], read.headers["etag"]) == ("ada", '"1"')
    assert (await client.put(path, json=body, headers=tokens["admin"])).status_code == 200
    stale = await client.delete(path, headers={**tokens["operator"], "If-Match": '"1"'})
    assert (stale.status_code, stale.json()["type"]) == (412, "urn:fognav:area_changed")
    assert (await client.delete(path, headers={**tokens["operator"], "If-Match": '"2"'})).status_code == 204
    assert (await client.delete(path, headers={**tokens["operator"], "If-Match": '"2"'})).status_code == 404
    assert (await client.get("/api/v1/areas/hall")).json()["override"] is None
