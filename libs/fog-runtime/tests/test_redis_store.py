"""The store base against a real Redis: compare-and-swap, epochs, unreadable records, audit entries."""

import asyncio
import math
from pathlib import Path

import pytest
from redis.asyncio import Redis

from fog_contracts.messages import Message
from fog_runtime.lease import Request
from fog_runtime.lease_store import LeaseStore
from fog_runtime.stores.redis_connection import StoreError, StoreRefusedError
from fog_runtime.stores.redis_store import ANY, MEMORY, Audit, RedisStore, Table
from fog_supervisor.servers import Server, start_redis

pytestmark = pytest.mark.live
ABSENT = "0"
AUDIT = Audit(1.5, "anna", "put")
THINGS = Table("things", "zone")
JOBS = Table("jobs", "mission", version="job.id")


class Thing(Message, frozen=True, kw_only=True):
    label: str
    version: int = 1


class Job(Message, frozen=True, kw_only=True):
    job: dict[str, str]


@pytest.fixture
def redis(tmp_path: Path):
    with start_redis(tmp_path) as server:
        yield server


async def test_one_of_eight_concurrent_writers_that_expect_the_same_version_succeeds(redis: Server):
    async with RedisStore(redis.url, "test") as store:
        for expected in (ABSENT, "1"):
            version = int(expected) + 1
            things = [Thing(label=f"by {number}", version=version) for number in range(8)]
            outcomes = await asyncio.gather(*(store._swap(THINGS, "a", thing, expected, AUDIT) for thing in things))
            refusal = "exists" if expected == ABSENT else "stale"
            assert sorted(outcomes) == sorted(["ok"] + 7 * [refusal])
            assert await store._readable_records("things", Thing) == {"a": things[outcomes.index("ok")]}
        assert len((await store.audit()).entries) == 2


async def test_deletion_needs_the_stored_version_and_a_repeated_one_is_missing(redis: Server):
    async with RedisStore(redis.url, "test") as store:
        assert await store._swap(THINGS, "a", Thing(label="x"), "7", AUDIT) == "missing"
        assert await store._swap(THINGS, "a", Thing(label="x"), ABSENT, AUDIT) == "ok"
        assert await store._swap(THINGS, "a", None, "7", AUDIT) == "stale"
        assert await store._swap(THINGS, "a", None, "1", AUDIT) == "ok"
        assert await store._swap(THINGS, "a", None, "1", AUDIT) == "missing"
        assert await store._swap(THINGS, "a", None, ANY, AUDIT) == "missing"


async def test_nested_version_is_checked_and_any_version_can_be_overwritten(redis: Server):
    async with RedisStore(redis.url, "test") as store:
        for name in ("first", "second"):
            assert await store._swap(JOBS, "r1", Job(job={"id": name}), ANY, AUDIT) == "ok"
        assert await store._swap(JOBS, "r1", None, "first", AUDIT) == "stale"
        assert await store._swap(JOBS, "r1", None, "second", AUDIT) == "ok"


async def test_audit_entries_have_author_action_before_and_after_newest_first(redis: Server):
    async with RedisStore(redis.url, "test") as store:
        site = Thing(label="from the site", version=0)
        await store._swap(THINGS, "a", Thing(label="x"), ABSENT, AUDIT, before=site)
        await store._swap(THINGS, "a", Thing(label="x"), ABSENT, AUDIT)  # a repeated attempt, after a lost reply
        await store._swap(THINGS, "a", Thing(label="y", version=2), "1", AUDIT)
        entries = (await store.audit()).entries
        assert [(e.at, e.who, e.action, e.kind, e.id) for e in entries] == 2 * [(1.5, "anna", "put", "zone", "a")]
        assert [(bytes(e.before), bytes(e.after)) for e in entries] == [
            (b'{"label":"x","version":1}', b'{"label":"y","version":2}'),
            (b'{"label":"from the site","version":0}', b'{"label":"x","version":1}'),
        ]


async def test_unreadable_record_is_left_out(redis: Server):
    async with RedisStore(redis.url, "test") as store, Redis.from_url(redis.url) as raw:
        await store._write_records("things", {"a": Thing(label="x")})
        await raw.hset("fog:test:things", "b", b"nonsense")
        assert await store._readable_records("things", Thing) == {"a": Thing(label="x")}


async def test_memory_of_redis_is_told(redis: Server):
    MEMORY.set(math.nan)
    async with RedisStore(redis.url, "test") as store:
        await store.check()
        assert 1e5 < MEMORY._value.get() < 1e9


async def test_dead_redis_is_named_in_the_error(redis: Server):
    async with RedisStore(redis.url, "test") as store:
        assert await store.durability_warning() == ""
        await asyncio.to_thread(redis.kill)
        for attempt in (store.check(), store._swap(THINGS, "a", None, ANY, AUDIT)):
            with pytest.raises(StoreError, match="Redis: "):
                await attempt


async def test_writer_whose_epoch_is_not_the_granted_one_is_refused(redis: Server):
    async with (
        RedisStore(redis.url, "test", service="map") as old,
        RedisStore(redis.url, "test", service="map") as new,
        LeaseStore(redis.url, "test", "map") as leases,
    ):
        request = Request(epoch=0, floor=0, confirmed=False, sent_at=0.0)
        granted = await leases.acquire("a", request)
        assert granted is not None
        old.epoch = granted.epoch
        assert await old._swap(THINGS, "a", Thing(label="x"), ABSENT, AUDIT) == "ok"
        await old._write_records("things", {"b": Thing(label="y")})
        await leases.release("a")
        taken = await leases.acquire("b", request)
        assert taken is not None
        new.epoch = taken.epoch
        assert await new._swap(THINGS, "c", Thing(label="z"), ABSENT, AUDIT) == "ok"
        before = await new._readable_records("things", Thing)
        for late in (old.epoch, taken.epoch + 1):
            old.epoch = late
            for attempt in (
                old._swap(THINGS, "a", Thing(label="late", version=2), "1", AUDIT),
                old._swap(THINGS, "a", None, ANY, AUDIT),
                old._write_records("things", {"b": Thing(label="late")}),
            ):
                with pytest.raises(StoreRefusedError, match="not that of the map"):
                    await attempt
        assert await new._readable_records("things", Thing) == before


async def test_entry_of_the_audit_trail_is_there_once_however_often_it_is_tried_and_a_fenced_one_is_the_leaders(redis):
    other = AUDIT._replace(at=2.5)
    async with RedisStore(redis.url, "test", service="map") as leader, RedisStore(redis.url, "test") as standby:
        standby.epoch = 0
        for audit in (AUDIT, other, AUDIT, other):
            await leader._record("alert", "a", b"{}", audit, fenced=True)
        with pytest.raises(StoreRefusedError, match="stands by"):
            await standby._record("alert", "b", b"{}", AUDIT, fenced=True)
        await standby._record("stop", "r1", b"{}", AUDIT)
        entries = (await leader.audit()).entries
    assert [(entry.kind, entry.at, entry.id) for entry in entries] == [
        ("stop", 1.5, "r1"), ("alert", 2.5, "a"), ("alert", 1.5, "a"),
    ]  # fmt: skip


async def test_standby_that_never_led_may_read_and_not_write(redis: Server):
    async with RedisStore(redis.url, "test", service="map") as leader, RedisStore(redis.url, "test") as standby:
        assert await leader._swap(THINGS, "a", Thing(label="x"), ABSENT, AUDIT) == "ok"
        standby.epoch = 0
        for attempt in (
            standby._swap(THINGS, "b", Thing(label="y"), ABSENT, AUDIT),
            standby._write_records("things", {"a": Thing(label="y")}),
        ):
            with pytest.raises(StoreRefusedError, match="stands by"):
                await attempt
        assert await standby._readable_records("things", Thing) == {"a": Thing(label="x")}


async def test_redis_without_durable_writes_is_reported(redis: Server):
    async with RedisStore(redis.url, "test") as store, Redis.from_url(redis.url) as raw:
        await raw.config_set("appendfsync", "everysec")
        assert "appendfsync always" in await store.durability_warning()
        await raw.config_set("appendfsync", "always")
        await raw.config_set("maxmemory-policy", "allkeys-lru")
        assert "noeviction" in await store.durability_warning()


async def test_copies_follow_what_is_decided_about_a_loss_at_one_of_them_and_about_no_later_loss(redis, tmp_path):
    async def went_back(copy: RedisStore, writes: int) -> bool:
        await leader._redis.write(("HSET", leader._key("writes"), "things", writes))
        return (await copy.status({})).lost

    folders = [tmp_path / name for name in ("here", "there")]
    async with (
        RedisStore(redis.url, "test", service="map", data_dir=folders[0]) as leader,
        RedisStore(redis.url, "test", service="map", data_dir=folders[1]) as copy,
        RedisStore(redis.url, "test", service="planner", data_dir=folders[1]) as other,
    ):
        for each in (leader, copy, other):
            await each.check()
        await leader._redis.write(("FLUSHALL",))
        assert [(await each.status({})).lost for each in (leader, copy, other)] == 3 * [True]
        await leader.accept_loss(AUDIT)
        await leader._swap(THINGS, "a", Thing(label="after the loss"), ABSENT, AUDIT)
        assert await copy._readable_records("things", Thing) == {"a": Thing(label="after the loss")}
        assert (await other.status({})).lost, "another service's records are another decision"
        async with RedisStore(redis.url, "test", service="map", data_dir=folders[1]) as again:
            assert not (await again.status({})).lost, "nor after its next start"

        await copy._swap(THINGS, "b", Thing(label="x"), ABSENT, AUDIT)
        await leader._swap(THINGS, "c", Thing(label="x"), ABSENT, AUDIT)
        assert await went_back(leader, 1)
        assert (await copy.status({})).lost, "the decision of before was about another generation"
        await leader.accept_loss(AUDIT)
        assert not (await copy.status({})).lost

        for name in "defg":
            await copy._swap(THINGS, name, Thing(label="x"), ABSENT, AUDIT)
        assert await went_back(copy, 1), "nobody has decided about those"
