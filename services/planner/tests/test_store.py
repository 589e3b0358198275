"""Missions in a real Redis: repeated requests, deletions of older missions, a loss."""

import random
from pathlib import Path
from unittest.mock import Mock

import pytest
from manual_clock import ManualClock
from redis.asyncio import Redis

from fog_contracts import channels as ch
from fog_contracts.handlers import Moment
from fog_contracts.messages import AreaHazard, AreaState, HazardArea, OutOfService, Pose, RobotGoal
from fog_runtime.clock import SystemClock
from fog_runtime.health import Health
from fog_runtime.lease import Request
from fog_runtime.lease_store import LeaseStore
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import Attempt, Audit, IdempotencyError, RecoveryError
from fog_supervisor.servers import Server, start_redis
from planner.core import PlannerCore
from planner.stops import Order
from planner.store import OutOfServiceError, Store, StoredGoal
from planner.tours.persistence import MissionPersistence
from planner.waits.persistence import LearnedPersistence

pytestmark = pytest.mark.live
AUDIT = Audit(1.0, "anna", "goal")


@pytest.fixture
def redis(tmp_path: Path):
    with start_redis(tmp_path) as server:
        yield server


def goal(name: str) -> StoredGoal:
    return StoredGoal(goal=RobotGoal(goal_id=name, pose=Pose(x=1.0, y=2.0, theta=0.0)))


def missions_of(core: PlannerCore, store: Store, change_core=lambda change: change()) -> MissionPersistence:
    return MissionPersistence(core, store, SystemClock(), Health(), change_core, lambda _robot: None)


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
        await store.restore({"r1": goal("first")}, {}, {}, {}, Audit(2.0, "ada", "restore"))
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
        persistence = missions_of(Mock(), store, lambda _change: None)
        with pytest.raises(StoreError, match="not loaded yet"):
            await persistence.cancel("r1", "anna")
        await persistence.lead(granted.epoch, confirmed=True)
        assert not await persistence.cancel("r1", "anna")
        await store.put("r1", goal("unacknowledged"), AUDIT)
        persistence._reload = True  # as after any write that failed
        assert await persistence.cancel("r1", "anna")
        assert await store.goals() == {}


async def test_no_goal_is_accepted_or_begun_while_a_robot_is_out_of_service_whatever_is_ordered_or_restarted(
    redis: Server,
):
    rng, order = random.Random(7), Order("r1", Pose(x=1.0, y=2.0, theta=0.0), "anna")
    async with (
        Store(redis.url, "test", service="planner") as store,
        LeaseStore(redis.url, "test", "planner") as leases,
    ):
        granted = await leases.acquire("p1", Request(epoch=0, floor=0, confirmed=False, sent_at=0.0))
        assert granted is not None

        async def start() -> tuple[PlannerCore, MissionPersistence]:
            core = PlannerCore()
            persistence = missions_of(core, store)
            await persistence.lead(granted.epoch, confirmed=True)
            return core, persistence

        core, missions = await start()
        out = False
        for number in range(60):
            match rng.choice(("goal", "goal", "out", "in", "restart", "cancel")):
                case "goal" if out:
                    with pytest.raises(OutOfServiceError, match="worn wheel"):
                        await missions.send(order)
                case "goal":
                    await missions.send(order)
                case "out":
                    record = OutOfService(id=f"{number}", reason="worn wheel", by="anna", since=1.0)
                    out = await missions.take_out("r1", record, "anna")
                case "in":
                    assert await missions.put_back("r1", "anna") == out
                    out = False
                case "restart":
                    core, missions = await start()
                case "cancel":
                    await missions.cancel("r1", "anna")
            assert (missions.out_of_service("r1") is not None) == out
            assert (core.missions.of("r1").out_of_service is not None) == out
            if out:
                assert core.missions.goal("r1") is None
                assert (missions.goals, await store.goals()) == ({}, {})


async def test_refused_undo_of_a_robots_service_ends_no_mission(redis: Server):
    async with Store(redis.url, "test") as store:
        missions = missions_of(PlannerCore(), store)
        await missions.lead(-1, confirmed=True)
        given = await missions.send(Order("r1", Pose(x=1.0, y=2.0, theta=0.0), "anna"))
        before = OutOfService(id="1", reason="worn wheel", by="anna", since=1.0)
        assert not await missions.take_out("r1", before, "anna", expected="2", action="undo")
        assert (missions.goals, await store.goals()) == ({"r1": given}, {"r1": given})
        assert missions.out_of_service("r1") is None


async def test_goal_of_a_robot_whose_record_of_service_cannot_be_read_is_refused(redis: Server):
    async with Store(redis.url, "test") as store, Redis.from_url(redis.url) as raw:
        await store.put("r1", goal("first"), AUDIT)
        await raw.hset("fog:test:out_of_service", "r1", b"{half")
        core = PlannerCore()
        missions = missions_of(core, store)
        await missions.lead(-1, confirmed=True)
        assert core.missions.goal("r1") is None
        assert missions.out_of_service("r1") is not None


async def test_planner_that_starts_in_the_middle_of_a_block_goes_on_with_its_age_and_with_what_was_learned(
    redis: Server,
):
    async with Store(redis.url, "test") as store:
        clock, first, second = ManualClock(100.0), PlannerCore(), PlannerCore()

        async def lead(core: PlannerCore) -> LearnedPersistence:
            durations = LearnedPersistence(core.waits.blocks, core.paces, store, clock, lambda change: change())
            await durations.load()
            return durations

        def tell(core: PlannerCore, state: AreaState, seq: int, since: float) -> None:
            hazard = AreaHazard(
                area="a", state=state, severity=0, penalty=254 if state == "blocked" else 0, since=since, seq=seq,
                epoch=1, cause="",
            )  # fmt: skip
            area = HazardArea(hazard=hazard, polygon=[(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)])
            core.handlers()[ch.HAZARD]({"area": "a"}, area, Moment(clock.now(), clock.now() + 1e9))

        durations = await lead(first)
        for seq in range(1, 12, 2):
            tell(first, "blocked", seq, clock.now() + 1e9)
            clock.advance(4.0)
            tell(first, "clear", seq + 1, clock.now() + 1e9)
        tell(first, "blocked", 20, began := clock.now() + 1e9)
        clock.advance(30.0)
        await durations.save()
        clock.advance(5.0)  # the planner dies
        await lead(second)
        tell(second, "blocked", 20, began)
        assert second.waits.blocks.age("a", clock.now()) == pytest.approx(35.0, abs=0.01)
        assert second.waits.blocks.survival("a", 35.0, began, learned=True) is not None
        (record,) = second.waits.blocks.to_store(clock.now()).values()
        assert sum(ended for spans in record.hours.values() for _, ended, _ in spans) == 6
        assert sum(spent for spans in record.hours.values() for *_, spent in spans) == pytest.approx(6 * 4.0 + 35.0)
