"""Another map over REST: looked at, put into force, and back, by the running map-service that is started again."""

from __future__ import annotations

import asyncio
import base64
import io
import zlib
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np
import pytest
from PIL import Image

from fog_runtime.configuration.uploaded_maps import MapInForce, UploadedMaps
from fog_runtime.stores.redis_connection import StoreError
from fog_supervisor.servers import start_redis
from map_service.record_writer import RecordWriter
from map_service.site_map import MAP_ID, MapFile, StoredMap
from map_service.store import SITE_MAPS, Store

if TYPE_CHECKING:
    from collections.abc import Mapping

pytestmark = pytest.mark.live
PREVIEW = "/api/v1/map/preview"
YAML = "image: x.pgm\nresolution: 0.05\norigin: [0.0, 0.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
PLACES = """
[places.door]
x = 1.0
y = 1.0

[places.window]
x = 2.0
y = 1.0

[[robots]]
id = "r1"
start = { x = 1.0, y = 1.5, theta = 0.0 }
radius = 0.17
"""
ZONE = {"kind": "BLOCKED", "shape": {"type": "circle", "centre": [6.0, 3.0], "radius": 0.2}}


def pixels(*walls: tuple[float, float, float, float]) -> np.ndarray:
    """The site's room of 8 m x 6 m, and walls: left, bottom, right, top."""
    cells = np.full((120, 160), 254, np.uint8)
    cells[[0, -1], :] = 0
    cells[:, [0, -1]] = 0
    for left, bottom, right, top in walls:
        cells[round(bottom * 20) : round(top * 20), round(left * 20) : round(right * 20)] = 0
    return cells[::-1]


def upload(cells: np.ndarray, yaml: str = YAML, kind: str = "PPM") -> dict[str, Any]:
    data = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(cells)).save(data, kind)
    return {"upload": {"yaml": yaml, "image": base64.b64encode(data.getvalue()).decode()}}


def raw(image: bytes, yaml: str = YAML) -> dict[str, Any]:
    return {"upload": {"yaml": yaml, "image": base64.b64encode(image).decode()}}


def png_header(width: int, height: int) -> bytes:
    """A PNG that says to be of this size and has all its pixels in some bytes, as a bomb has."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")

    header = width.to_bytes(4, "big") + height.to_bytes(4, "big") + b"\x08\x00\x00\x00\x00"
    parts = [chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(bytes(10_000))), chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


async def start(fog) -> httpx.AsyncClient:
    fog.start("map_service")
    return httpx.AsyncClient(base_url=await fog.ready("map_service"), timeout=60)


async def ends(fog, until) -> None:
    """Wait until the service has ended by itself, in order."""
    process = fog.processes["map_service"]
    await until(lambda: process.poll() is not None, "the service ends", lambda: fog.log("map_service"))
    assert process.poll() == 0, fog.log("map_service")
    assert "starting_again" in fog.log("map_service")
    del fog.processes["map_service"]


async def look(client: httpx.AsyncClient, body: Mapping[str, Any], admin: Mapping[str, str]) -> dict[str, Any]:
    answer = await client.post(PREVIEW, json=body, headers=admin)
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


@pytest.fixture
def site(fog):
    (fog.site / "site.toml").write_text((fog.site / "site.toml").read_text() + PLACES)
    return fog


async def test_what_would_lie_in_a_wall_is_named_and_the_accepted_map_is_in_force_with_a_new_epoch_and_back(
    site, until, tokens
):
    admin = tokens["admin"]
    async with await start(site) as client:
        await client.put("/api/v1/zones/wet", json=ZONE, headers={**tokens["operator"], "If-None-Match": "*"})
        put = {"x": 7.0, "y": 5.0}
        assert (await client.put("/api/v1/places/sofa", json=put, headers=tokens["operator"])).status_code == 201
        bad = await look(client, upload(pixels((0.9, 0.9, 1.1, 1.1))), admin)
        assert [(one["kind"], one["id"], one["code"], one["refused"]) for one in bad["findings"]] == [
            ("place", "door", "in_wall", True)
        ]
        refused = await client.put("/api/v1/map", json={"preview": bad["id"], "accept": True}, headers=admin)
        assert (refused.status_code, refused.json()["type"]) == (422, "urn:fognav:map_does_not_fit")
        assert "place door at (1.00, 1.00) lies in a wall" in refused.json()["detail"]

        walls = pixels((5.5, 2.5, 6.5, 3.5), (6.9, 4.9, 7.1, 5.1))
        seen = await look(client, upload(walls, kind="PNG"), admin)
        assert {(one["kind"], one["id"]) for one in seen["findings"]} == {("zone", "wet"), ("moved-place", "sofa")}
        assert (seen["accepted"], seen["refused"], seen["area"]["floor_to_wall_m2"]) == (False, False, 1.04)
        assert seen["agreement"] > 0.9
        picture = await client.get(f"/api/v1/map/previews/{seen['id']}.png", headers=admin)
        with Image.open(io.BytesIO(picture.content)) as shown:
            assert shown.convert("RGB").getpixel((120, 120 - 60)) == (200, 30, 40)
        change = {"preview": seen["id"]}
        assert (await client.put("/api/v1/map", json=change, headers=admin)).status_code == 422
        epoch = (await client.get("/api/v1/map")).json()["epoch"]
        done = await client.put("/api/v1/map", json={**change, "accept": True}, headers=admin)
        assert (done.status_code, done.json()["version"], done.headers["etag"]) == (200, 1, '"1"')
    await ends(site, until)
    async with await start(site) as client:
        assert (await client.get("/api/v1/map")).json()["epoch"] > epoch
        plan = await client.get("/api/v1/map.png")
        with Image.open(io.BytesIO(plan.content)) as shown:
            assert shown.convert("RGB").getpixel((120, 120 - 60)) == (0, 0, 0)
        (entry,) = (await client.get("/api/v1/audit", params={"kind": "map"}, headers=admin)).json()
        assert (entry["who"], entry["action"], entry["after"]["name"]) == ("ada", "replace", done.json()["name"])
        state = (await client.get("/api/v1/map/state", headers=tokens["viewer"])).json()
        assert state == {"name": done.json()["name"], "version": 1, "back": True}
        back = await look(client, {"back": True}, admin)
        assert (back["name"], back["accepted"], back["area"]["wall_to_floor_m2"]) == (None, True, 1.04)
        undo = await client.post("/api/v1/map/undo", json={"entry": entry["entry"]}, headers=admin)
        assert (undo.status_code, undo.json()["value"]) == (200, None), undo.text
    await ends(site, until)
    async with await start(site) as client:
        plan = await client.get("/api/v1/map.png")
        with Image.open(io.BytesIO(plan.content)) as shown:
            assert shown.convert("RGB").getpixel((120, 120 - 60)) == (255, 255, 255)
        state = (await client.get("/api/v1/map/state", headers=admin)).json()
        assert state == {"name": None, "version": 0, "back": False}


async def test_only_an_administrator_changes_the_map_and_nobody_applies_what_he_did_not_see(site, until, tokens):
    admin = tokens["admin"]
    body = upload(pixels((5.5, 2.5, 6.5, 3.5)))
    async with await start(site) as client:
        for role, status in ((None, 401), ("viewer", 403), ("operator", 403)):
            headers = {} if role is None else tokens[role]
            for method, path, sent in (
                ("POST", PREVIEW, body),
                ("PUT", "/api/v1/map", {"preview": "site-0-0123456789ab"}),
                ("POST", "/api/v1/map/undo", {"entry": "1-1.map"}),
            ):
                answer = await client.request(method, path, json=sent, headers=headers)
                assert answer.status_code == status, (role, path, answer.text)
        seen, other = await look(client, body, admin), await look(client, upload(pixels((5.5, 1.5, 6.5, 2.0))), admin)
        new = {**tokens["operator"], "If-None-Match": "*"}
        assert (await client.put("/api/v1/zones/wet", json=ZONE, headers=new)).status_code == 201
        stale = await client.put("/api/v1/map", json={"preview": seen["id"], "accept": True}, headers=admin)
        assert (stale.status_code, stale.json()["type"]) == (412, "urn:fognav:map_not_seen")
        assert "zone wet" in stale.json()["detail"]
        seen = await look(client, body, admin)
        changes = [{"preview": one["id"], "accept": True} for one in (seen, other)]
        answers = await asyncio.gather(*(client.put("/api/v1/map", json=one, headers=admin) for one in changes))
        assert sorted(answer.status_code for answer in answers) == [200, 412], [each.text for each in answers]
    await ends(site, until)
    async with await start(site) as client:
        unknown = await client.put("/api/v1/map", json={"preview": f"{'a' * 16}-1-{'b' * 12}"}, headers=admin)
        assert (unknown.status_code, unknown.json()["type"]) == (404, "urn:fognav:no_map_preview")
        # Whoever lets site.toml name another map later means that one.
        (site.site / "map.pgm").write_bytes(base64.b64decode(upload(pixels((7.0, 1.0, 7.5, 1.5)))["upload"]["image"]))
    site.kill("map_service")
    async with await start(site) as client:
        plan = await client.get("/api/v1/map.png")
        with Image.open(io.BytesIO(plan.content)) as shown:
            assert shown.convert("RGB").getpixel((145, 120 - 25)) == (0, 0, 0)
        assert "uploaded_map_superseded" in site.log("map_service")


async def test_each_bad_upload_is_refused_with_the_field_and_what_to_do(site, tokens):
    room = pixels()
    other = np.full((120, 160), 0, np.uint8)
    other[10:110:2, 10:150] = 254
    own = YAML + "fognav:\n  image_size: [100, 90]\n"
    cases = [
        (raw(base64.b64decode(upload(room)["upload"]["image"])[:5000]), "image", "can't be decoded"),
        (raw(b"GIF89a" + bytes(50)), "image", "no PGM or PNG: save it as one"),
        (raw(png_header(20_000, 20_000)), "image", "more than 16000000 pixels"),
        (raw(png_header(4_000, 4_000)), "image", "can't be decoded"),
        (upload(room, own), "image", "160 x 120 pixels, and the YAML file is of one of [100, 90]"),
        (upload(room, YAML.replace("[0.0, 0.0, 0.0]", "[.nan, 0.0, 0.0]")), "yaml", "is not [x, y, yaw]"),
        (upload(room, YAML.replace("[0.0, 0.0, 0.0]", "[1.0e+300, 0.0, 0.0]")), "yaml", "impossible"),
        (upload(room, YAML.replace("0.05", "-0.05")), "yaml", "resolution: -0.05 is not a number"),
        (upload(room, YAML + "mode: painted\n"), "yaml", "mode: 'painted' is unknown"),
        (upload(room, YAML.replace("0.65", "0.1")), "yaml", "free_thresh"),
        (raw(png_header(9_000, 9_000)), "image", "9000 x 9000 pixels, more than 16000000"),
        (upload(room, "a: &a [1, 2]\nb: *a\n"), "yaml", "aliases"),
        (upload(room, "resolution: [\n"), "yaml", "not valid YAML"),
        (upload(np.full((120, 160), 205, np.uint8)), "yaml", "no cell of the map is free"),
    ]
    async with await start(site) as client:
        for body, field, says in cases:
            answer = await client.post(PREVIEW, json=body, headers=tokens["admin"])
            assert answer.status_code == 422, answer.text
            told = answer.json()
            assert told["type"] == "urn:fognav:map_invalid", told
            assert (told["errors"][0]["field"], says in told["detail"]) == (f"body.upload.{field}", True), told
        floor = await look(client, upload(other), tokens["admin"])
        assert (floor["accepted"], floor["agreement"] < 0.5) == (False, True)
        too_large = await client.post(PREVIEW, content=b'{"upload": "' + b"a" * 9_000_000, headers=tokens["admin"])
        assert (too_large.status_code, too_large.json()["type"]) == (413, "urn:fognav:body_too_large")
        strangers = await client.post(PREVIEW, content=b'{"upload": "' + b"a" * 2_000_000)
        assert strangers.status_code == 413
        assert (await client.get("/readyz")).status_code == 200


def test_map_that_another_machine_has_is_in_force_once_it_was_copied_here_and_no_empty_store_changes_that(tmp_path):
    maps = UploadedMaps(tmp_path)
    record = StoredMap(id=MAP_ID, name="a" * 16, over="b" * 16)
    file = MapFile(maps)
    file.use({MAP_ID: record})
    file.write(0.0)
    assert maps.in_force() is None
    assert record.name is not None
    maps.file(record.name).write_bytes(b"a map")
    file.write(0.5)
    expected = MapInForce(name=record.name, over=record.over)
    assert maps.in_force() == expected
    MapFile(maps).write(1.0)
    assert maps.in_force() == expected


async def test_map_of_which_the_store_knows_nothing_gives_way_to_that_of_the_site_once_the_store_was_read(tmp_path):
    maps = UploadedMaps(tmp_path / "maps")
    maps.put(MapInForce(name="a" * 16, over="b" * 16))
    file = MapFile(maps)
    with start_redis(tmp_path / "redis") as redis:
        async with Store(redis.url, "test") as store:
            # Nothing is written, so it needs none of what writers share.
            writer = RecordWriter(SITE_MAPS, StoredMap, store, None, file.use)  # type: ignore[arg-type]  # see above
            redis.kill()
            with pytest.raises(StoreError):
                await writer.load()
            file.write(0.0)
            assert maps.in_force() is not None
            redis.start()
            await writer.load()
    file.write(1.0)
    assert maps.in_force() is None
