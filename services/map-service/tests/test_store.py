"""Zones in a real Redis: versions, repeated writes, kills."""

import asyncio
from pathlib import Path

import msgspec
import pytest
from redis.asyncio import Redis

from fog_contracts.messages import CircleShape, Zone
from fog_runtime.stores.redis_store import Audit
from fog_supervisor.servers import Server, start_redis
from map_service.store import Store

pytestmark = pytest.mark.live
AUDIT = Audit(1.0, "anna", "create")


@pytest.fixture
def redis(tmp_path: Path):
    with start_redis(tmp_path) as server:
        yield server


def zone(version: int = 1, radius: float = 0.5) -> Zone:
    return Zone(id="z1", kind="BLOCKED", shape=CircleShape(centre=(1.0, 1.0), radius=radius), version=version)


async def test_version_is_written_once_and_a_stale_one_is_refused(redis: Server):
    async with Store(redis.url, "test") as store:
        assert await store.create(zone(), AUDIT) == ("ok", zone())
        assert (await store.create(zone(radius=0.7), AUDIT))[0] == "exists"
        assert await store.replace(zone(2, 0.7), expected=1, audit=AUDIT) == "ok"
        assert await store.replace(zone(2, 0.9), expected=1, audit=AUDIT) == "stale"
        assert await store.zones() == ([zone(2, 0.7)], {})
        assert await store.delete(zone(1), AUDIT) == "stale"
        assert await store.delete(zone(2), AUDIT) == "ok"
        assert await store.zones() == ([], {})


async def test_zone_that_is_created_again_has_a_version_that_no_zone_had_before(redis: Server):
    async with Store(redis.url, "test") as store, Store(redis.url, "test") as other:
        assert await other.zones() == ([], {})
        await store.create(zone(), AUDIT)
        for version in range(2, 4):
            await store.replace(zone(version), expected=version - 1, audit=AUDIT)
        assert await store.delete(zone(3), AUDIT) == "ok"
        # Another process, which did not see the deletion.
        assert await other.create(zone(), AUDIT) == ("ok", zone(4))
        assert await store.delete(zone(4), AUDIT) == "ok"
    async with Store(redis.url, "test") as restarted:
        assert await restarted.zones() == ([], {})
        assert await restarted.create(zone(), AUDIT) == ("ok", zone(5))


async def test_repeated_write_leaves_one_audit_entry(redis: Server):
    async with Store(redis.url, "test") as store, Redis.from_url(redis.url) as raw:
        for _ in range(2):
            assert await store.create(zone(), AUDIT) == ("ok", zone())
        assert await raw.xlen("fog:test:audit:zone") == 1
        for _ in range(2):
            assert await store.delete(zone(), AUDIT) == "ok"
        entries = await raw.xrange("fog:test:audit:zone")
        assert {fields[b"who"] for _, fields in entries} == {b"anna"}


async def test_acknowledged_zones_survive_kills_of_redis(redis: Server):
    async with Store(redis.url, "test", timeout_s=5.0) as store:
        await store.create(zone(), AUDIT)
        for version in range(2, 7):
            assert await store.replace(zone(version), expected=version - 1, audit=AUDIT) == "ok"
            await asyncio.to_thread(redis.kill)
            await asyncio.to_thread(redis.start)
            assert await store.zones() == ([zone(version)], {})


@pytest.mark.parametrize("record", [b'{"id": "z2"}', b"nonsense", b"[7]"])
async def test_unreadable_zone_is_left_out_by_name_and_can_be_deleted(redis: Server, record: bytes):
    async with Store(redis.url, "test") as store, Redis.from_url(redis.url) as raw:
        await store.create(zone(), AUDIT)
        await raw.hset("fog:test:zones", "z2", record)
        zones, unreadable = await store.zones()
        assert (zones, list(unreadable)) == ([zone()], ["z2"])
        await store.delete_unusable("z2", AUDIT)
        assert await store.zones() == ([zone()], {})
        (entry, _) = (await store.audit()).entries
        assert (entry.id, msgspec.json.decode(entry.after)) == ("z2", None)
        msgspec.json.decode(entry.before)
