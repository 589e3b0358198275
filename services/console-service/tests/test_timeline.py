"""The timeline and the recording of the running console-service, with a real Redis and those who write to it."""

import asyncio
import time
from functools import partial

import httpx
import pytest

pytestmark = pytest.mark.live
ZONE = {"kind": "BLOCKED", "shape": {"type": "circle", "centre": [2.0, 3.0], "radius": 0.5}, "reason": "wet"}


async def poll(request, accepted):
    """Repeat a request until its reply is accepted, and return that reply."""
    async with asyncio.timeout(60):
        while True:
            reply = await request()
            if accepted(reply):
                return reply
            await asyncio.sleep(0.1)


async def json_of(client: httpx.AsyncClient, path: str, headers: dict[str, str]):
    answer = await client.get(path, headers=headers)
    assert answer.status_code == 200, answer.text
    return answer.json()


async def test_timeline_has_changes_and_hazards_in_the_order_of_their_times_page_by_page(all_services, tokens):
    url = await all_services.ready("hazard_aggregator")
    all_services.start("console_service", FOGNAV_AGGREGATOR_URL=url)
    viewer, operator = tokens["viewer"], tokens["operator"]
    async with (
        httpx.AsyncClient(base_url=url) as areas,
        httpx.AsyncClient(base_url=await all_services.ready("map_service")) as zones,
        httpx.AsyncClient(base_url=await all_services.ready("console_service")) as console,
    ):
        begun = time.time()
        for number in range(3):
            assert (await zones.post("/api/v1/zones", json={**ZONE, "id": f"w{number}"}, headers=operator)).is_success
            override = {"state": "blocked", "reason": f"for test {number}", "ttl_s": 60.0}
            assert (await areas.put("/api/v1/areas/hall/override", json=override, headers=operator)).is_success
            assert (await areas.delete("/api/v1/areas/hall/override", headers=operator)).is_success

        async def read(**query: object) -> list[dict[str, object]]:
            found, address = [], str(httpx.URL("/api/v1/timeline", params={"from": begun - 1, **query}))
            while address:
                answer = await console.get(address, headers=viewer)
                assert answer.status_code == 200, answer.text
                found += answer.json()
                address = answer.links.get("next", {}).get("url", "")
            return found

        # Histories are written soon after the changes, and areas are fetched soon after the start.
        await poll(lambda: read(kind="hazard"), lambda found: [each["action"] for each in found].count("blocked") == 3)
        whole = await read()
        assert [each["at"] for each in whole] == sorted((each["at"] for each in whole), reverse=True)
        assert {each["kind"] for each in whole} == {"zone", "override", "hazard"}
        assert whole == await read(limit=2)
        only = await read(kind=["zone"], limit=1)
        assert [each["id"] for each in only] == ["w2", "w1", "w0"]
        assert {each["who"] for each in only} == {"anna"}
        assert only[0]["after"]["reason"] == "wet"
        assert all(each["entry"] for each in only), "by which it can be undone"
        assert await read(**{"from": begun - 120, "to": begun - 60}) == [], "nothing had begun"
        for query in ({"kind": "nonsense"}, {"cursor": "nonsense"}):
            refused = await console.get("/api/v1/timeline", params=query, headers=viewer)
            assert refused.status_code == 422, refused.text
        assert (await console.get("/api/v1/timeline")).status_code == 401

        span = await poll(partial(json_of, console, "/api/v1/recording", viewer), lambda span: span["end"] is not None)
        assert span["frames"] == []
        everything = partial(json_of, console, "/api/v1/recording?from=0", viewer)
        names = {"map", "costmap", "area", "zone"}
        await poll(everything, lambda shown: names <= {e["event"] for f in shown["frames"] for e in f["events"]})
        assert (await console.get("/api/v1/recording")).status_code == 401
