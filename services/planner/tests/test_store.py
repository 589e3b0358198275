"""Missions in a real Redis: repeated requests, deletions of older missions, a loss."""

from pathlib import Path
from unittest.mock import Mock

import pytest
from redis.asyncio import Redis

from fog_contracts.messages import Pose, RobotGoal
from fog_runtime.clock import SystemClock
from fog_runtime.health import Health
from fog_runtime.leadership import LeaseStore
from fog_runtime.lease import Request
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import Attempt, Audit, IdempotencyError, RecoveryError
from fog_supervisor.servers import Server, start_redis
from planner.store import MissionPersistence, Store, StoredGoal

pytestmark = pytest.mark.live
AUDIT = Audit(1.0, "anna", "goal")


@pytest.fixture
def redis(tmp_path: Path):
    with start_redis(tmp_path) as server:
        yield server


def goal(name: str) -> StoredGoal:
    return StoredGoal(goal=RobotGoal(goal_id=name, pose=Pose(x=1.0, y=2.0, theta=0.0)))


async def test_repeated_request_finds_its_mission_also_after_a_newer_one(redis: Server):
    attempt = Attempt.of("anna", "k1", "PUT /goal", {"place": "a"})
    async with Store(redis.url, "test") as store:
        assert await store.earlier_result(attempt) is None
        assert await store.put("r1", goal("first"), AUDIT._replace(attempt=attempt)) == "ok"
        assert await store.put("r1", goal("other"), AUDIT._replace(attempt=attempt)) == "exists"
        assert await store.put("r1", goal("newer"), AUDIT) == "ok"
        assert await store.earlier_result(attempt) == goal("first")
        with pytest.raises(IdempotencyError):
            await store.earlier_result(Attempt.of("anna", "k1", "PUT /goal", {"place": "b"}))
        assert await store.earlier_result(Attempt.of("bert", "k1", "PUT /goal", {"place": "a"})) is None
        await store.delete("r1", "first", AUDIT)
        assert await store.goals() == {"r1": goal("newer")}


async def test_restore_replaces_what_redis_has_and_later_writes_are_accepted(redis: Server, tmp_path: Path):
    async with (
        Store(redis.url, "test", data_dir=tmp_path) as store,
        Redis.from_url(redis.url) as raw,
    ):
        await store.put("r1", goal("first"), AUDIT)
        with pytest.raises(RecoveryError):
            await store.require_loss()
        await raw.flushall()
        await raw.hset("fog:test:goals", "r9", b"{}")
        async with Store(redis.url, "test", data_dir=tmp_path) as restarted:
            for attempt in (
                restarted.goals(),
                restarted.put("r1", goal("x"), AUDIT),
                store.put("r1", goal("x"), AUDIT),
            ):
                with pytest.raises(StoreError, match="Redis "):
                    await attempt
        await store.require_loss()
        await store.restore({"r1": goal("first")}, Audit(2.0, "ada", "restore"))
        assert await store.goals() == {"r1": goal("first")}
        assert await store.put("r1", goal("second"), AUDIT) == "ok"
        assert [entry.action for entry in (await store.audit()).entries] == ["goal", "restore"]


async def test_mission_that_was_stored_although_its_request_failed_can_be_cancelled(redis: Server):
    async with (
        Store(redis.url, "test", service="planner") as store,
        LeaseStore(redis.url, "test", "planner") as leases,
    ):
        granted = await leases.acquire("p1", Request(epoch=0, floor=0, confirmed=False, sent_at=0.0))
        assert granted is not None
        persistence = MissionPersistence(Mock(), store, SystemClock(), Health(), lambda _change: None)
        with pytest.raises(StoreError, match="not loaded yet"):
            await persistence.cancel("r1", "anna")
        await persistence.lead(granted.epoch, confirmed=True)
        assert not await persistence.cancel("r1", "anna")
        await store.put("r1", goal("unacknowledged"), AUDIT)
        persistence._reload = True  # as after any write that failed
        assert await persistence.cancel("r1", "anna")
        assert await store.goals() == {}
