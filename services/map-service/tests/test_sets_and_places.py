"""Sets of zones that are switched together, changes of single fields, and places, over REST and the real servers."""

from __future__ import annotations

import asyncio
import json
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import httpx
import pytest

from fog_contracts import channels as ch
from fog_contracts.costs import LETHAL
from fog_contracts.messages import MapDelta, MapSnapshot, PlaceSet
from fog_contracts.replica import Applied, Replica

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping

pytestmark = pytest.mark.live
PLACES = """
[places.door]
x = 1.0
y = 1.0
theta = 0.0
label = "the door"

[places.window]
x = 2.0
y = 1.0
"""


class Follower:
    """Follows the map as a robot does, and hears of places as the planner does."""

    def __init__(self, zenoh) -> None:
        self.replica = Replica()
        self.versions: set[int] = set()
        self.places: list[Mapping[str, object]] = []
        zenoh.subscribe(ch.MAP_DELTA, MapDelta, self._on_delta)
        zenoh.subscribe(ch.PLACES, PlaceSet, lambda _, heard: self.places.append(heard.places))

    def _on_delta(self, _, delta: MapDelta) -> None:
        if isinstance(self.replica.apply(delta), Applied):
            self.versions.add(delta.seq)

    def cost(self, x: float, y: float) -> int:
        column, row = self.replica.geometry.cell(x, y)
        return int(self.replica.cost[row, column])


@asynccontextmanager
async def running(fog) -> AsyncIterator[tuple[httpx.AsyncClient, Follower]]:
    """Start the map-service on the site with its places; yield its client, and one who follows the map."""
    (fog.site / "site.toml").write_text((fog.site / "site.toml").read_text() + PLACES)
    fog.start("map_service")
    url = await fog.ready("map_service")
    async with httpx.AsyncClient(base_url=url, timeout=60) as client, fog.edges() as (_, zenoh, _):
        follower = Follower(zenoh)
        async with asyncio.timeout(60):
            while (snapshot := await zenoh.query(ch.MAP_SNAPSHOT, None, MapSnapshot, 1.0)) is None:
                pass
        follower.replica.load(snapshot)
        yield client, follower


def circle(x: float, sets: list[str]) -> dict[str, object]:
    return {"kind": "BLOCKED", "shape": {"type": "circle", "centre": [x, 3.0], "radius": 0.3}, "sets": sets}


async def test_switched_set_ends_its_zones_in_one_version_of_the_map_and_stays_off_after_a_kill(fog, until, tokens):
    async with running(fog) as (client, follower):
        operator = tokens["operator"]
        unknown = await client.put(
            "/api/v1/zones/east", json=circle(6.0, ["night"]), headers={**operator, "If-None-Match": "*"}
        )
        assert (unknown.status_code, unknown.json()["errors"][0]["field"]) == (422, "body.sets.0")
        made = await client.put("/api/v1/zone-sets/night", json={"name": "at night"}, headers=operator)
        assert (made.status_code, made.headers["etag"], made.json()["on"]) == (201, '"1"', True)
        for name, x in (("east", 6.0), ("west", 1.5)):
            answer = await client.put(
                f"/api/v1/zones/{name}", json=circle(x, ["night"]), headers={**operator, "If-None-Match": "*"}
            )
            assert answer.status_code == 201, answer.text
        await until(lambda: follower.cost(6.0, 3.0) == follower.cost(1.5, 3.0) == LETHAL, "both")
        follower.versions.clear()
        off = await client.put(
            "/api/v1/zone-sets/night", json={"enabled": False}, headers={**operator, "If-Match": '"1"'}
        )
        assert (off.status_code, off.json()["on"], off.json()["zones"]) == (200, False, ["east", "west"])
        await until(lambda: follower.cost(6.0, 3.0) == 0, "off", lambda: fog.log("map_service"))
        assert follower.cost(1.5, 3.0) == 0
        assert len(follower.versions) == 1
        assert (await client.get("/api/v1/zones")).json()["active"] == []
        used = await client.delete("/api/v1/zone-sets/night", headers=operator)
        assert (used.status_code, used.json()["type"]) == (409, "urn:fognav:zone_set_used")
        fog.kill("map_service")
        fog.start("map_service")
        async with httpx.AsyncClient(base_url=await fog.ready("map_service"), timeout=60) as again:
            assert (await again.get("/api/v1/zones")).json()["active"] == []
            assert (await again.get("/api/v1/zone-sets/night")).json()["version"] == 2
            trail = (await again.get("/api/v1/audit", params={"kind": "set"}, headers=tokens["viewer"])).json()
            assert [(each["who"], each["action"]) for each in trail] == [("anna", "replace"), ("anna", "create")]
            undo = {"entry": trail[0]["entry"]}
            assert (await again.post("/api/v1/zone-sets/night/undo", json=undo, headers=operator)).status_code == 200
            assert (await again.get("/api/v1/zones")).json()["active"] == ["east", "west"]
            again_off = await again.post(
                "/api/v1/zone-sets/night/undo", json={"entry": trail[1]["entry"]}, headers=operator
            )
            assert again_off.status_code == 409, "somebody has changed it since"


async def test_patch_changes_the_fields_that_it_names_and_the_time_of_the_zone_goes_on(fog, tokens):
    async with running(fog) as (client, _):
        operator = tokens["operator"]
        body = {**circle(6.0, []), "ttl_s": 600.0, "reason": "wet"}
        await client.put("/api/v1/zones/wet", json=body, headers={**operator, "If-None-Match": "*"})
        patch = {"reason": None, "shape": {"radius": 0.5}}
        merge = {**operator, "Content-Type": "application/merge-patch+json", "If-Match": '"1"', "Idempotency-Key": "k1"}
        for _ in range(2):
            answer = await client.request("PATCH", "/api/v1/zones/wet", content=json.dumps(patch), headers=merge)
            assert (answer.status_code, answer.headers["etag"]) == (200, '"2"'), answer.text
        zone = answer.json()
        assert (zone["shape"]["radius"], zone["shape"]["centre"], zone["reason"]) == (0.5, [6.0, 3.0], "")
        assert 0.0 < zone["ttl_s"] < 600.0
        stale = await client.patch("/api/v1/zones/wet", json={"reason": "x"}, headers={**operator, "If-Match": '"1"'})
        assert stale.status_code == 412
        until_moment = await client.patch("/api/v1/zones/wet", json={"expires_at": 4e9}, headers=operator)
        assert (until_moment.json()["ttl_s"], until_moment.json()["expires_at"]) == (None, 4e9)
        for wrong, field in (({"kind": None}, "body"), ({"kind": "CLOSED"}, "body.kind"), ({"id": "dry"}, "body.id")):
            refused = await client.patch("/api/v1/zones/wet", json=wrong, headers=operator)
            assert (refused.status_code, refused.json()["errors"][0]["field"]) == (422, field)
        assert (await client.patch("/api/v1/zones/none", json={}, headers=operator)).status_code == 404


async def test_places_are_those_of_the_site_as_operators_have_changed_them(fog, until, tokens):
    async with running(fog) as (client, follower):
        operator, path = tokens["operator"], "/api/v1/places"
        await until(lambda: follower.places and set(follower.places[-1]) == {"door", "window"}, "those of the site")
        assert (await client.get(f"{path}/door")).headers["etag"] == '"0"'
        moved = await client.patch(f"{path}/door", json={"x": 3.0}, headers={**operator, "If-Match": '"0"'})
        assert (moved.status_code, moved.json()["label"], moved.json()["version"]) == (200, "the door", 1)
        assert (
            await client.patch(f"{path}/door", json={"x": 4.0}, headers={**operator, "If-Match": '"0"'})
        ).status_code == 412
        for wrong in ({"x": 0.0, "y": 0.0}, {"x": 90.0, "y": 1.0}):
            refused = await client.put(f"{path}/shelf", json=wrong, headers=operator)
            assert (refused.status_code, refused.json()["errors"][0]["field"]) == (422, "body.x")
        await client.put("/api/v1/zones/wet", json=circle(6.0, []), headers={**operator, "If-None-Match": "*"})
        body = {"x": 6.0, "y": 3.0, "public": True}
        added = await client.put(f"{path}/shelf", json=body, headers={**operator, "If-None-Match": "*"})
        assert (added.status_code, len(added.json()["warnings"])) == (201, 1)
        assert "zone wet" in added.json()["warnings"][0]
        assert (
            await client.put(f"{path}/shelf", json=body, headers={**operator, "If-None-Match": "*"})
        ).status_code == 412
        assert (await client.delete(f"{path}/window", headers=operator)).status_code == 204
        await until(lambda: set(follower.places[-1]) == {"door", "shelf"}, "all changes")
        assert (follower.places[-1]["door"].x, follower.places[-1]["shelf"].public) == (3.0, True)
        fog.kill("map_service")
        fog.start("map_service")
        async with httpx.AsyncClient(base_url=await fog.ready("map_service"), timeout=60) as again:
            assert set((await again.get(path)).json()) == {"door", "shelf"}
            assert (await again.delete(f"{path}/shelf", headers=operator)).status_code == 204
            back = await again.put(
                f"{path}/window", json={"x": 2.0, "y": 2.0}, headers={**operator, "If-None-Match": "*"}
            )
            assert (back.status_code, back.json()["version"]) == (201, 2)
            trail = (await again.get("/api/v1/audit", params={"kind": "place"}, headers=tokens["viewer"])).json()
            assert [f"{each['action']} {each['id']}" for each in trail] == [
                "create window", "delete shelf", "delete window", "create shelf", "replace door",
            ]  # fmt: skip
            for entry in (trail[0], trail[1], trail[4]):
                undo = {"entry": entry["entry"]}
                answer = await again.post(f"{path}/{entry['id']}/undo", json=undo, headers=operator)
                assert answer.status_code == 200, answer.text
            found = (await again.get(path)).json()
            assert set(found) == {"door", "shelf"}, "the window is removed again"
            assert (found["door"]["x"], found["door"]["version"]) == (1.0, 0), "as in site.toml"
