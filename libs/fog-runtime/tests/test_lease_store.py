"""The lease in a real Redis: the same decisions as the model of the state machine's tests, and one holder of many."""

import asyncio
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from lease_model import LeaseModel

from fog_runtime import lease_store
from fog_runtime.lease import (
    ATTEMPT_S,
    HANDED_KNOWN_S,
    HANDED_PAUSE_S,
    LEASE_S,
    READY_SAID_S,
    Granted,
    Held,
    LeftToOther,
    Request,
)
from fog_runtime.lease_store import LeaseStore
from fog_supervisor.servers import Server, start_redis

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def redis(tmp_path_factory: pytest.TempPathFactory):
    with start_redis(tmp_path_factory.mktemp("redis")) as server:
        yield server


SLOWER = 500.0


@pytest.fixture(autouse=True)
def no_haste(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let nothing end while a test runs, however slowly: what has to end, the test ends itself (`expire`)."""
    for name, seconds in (("ATTEMPT_S", ATTEMPT_S), ("LEASE_S", LEASE_S), ("READY_SAID_S", READY_SAID_S)):
        monkeypatch.setattr(lease_store, name, SLOWER * seconds)


async def expire(store: LeaseStore, key: str, after_s: float) -> None:
    """Let a key end now that would have ended after some time (s)."""
    (left_ms,) = await store._redis.write(("PTTL", key))
    assert 0 < left_ms <= 1000 * after_s
    await store._redis.write(("DEL", key))


NEW = Request(epoch=0, floor=0, confirmed=False, sent_at=0.0)
STEPS = st.lists(
    st.tuples(
        st.sampled_from(["a", "b", "expire", "unready", "forget", "pause"]),
        st.integers(0, 6),
        st.integers(0, 8),
        st.booleans(),
        st.booleans(),
        st.booleans(),
        st.booleans(),
    ),
    max_size=12,
)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(steps=STEPS)
def test_redis_decides_as_the_model_does(redis: Server, steps, monkeypatch):
    monkeypatch.setattr("fog_runtime.lease_store._now_ms", lambda: 3)
    asyncio.run(compare(redis, steps))


async def compare(redis: Server, steps) -> None:
    expected = LeaseModel()
    async with LeaseStore(redis.url, "test", "planner") as store:
        await store._redis.write(("FLUSHALL",))
        for who, epoch, floor, confirmed, ready, cut_off, late in steps:
            if who == "expire":
                await store._redis.write(("DEL", "fog:test:planner:lease"))
                expected.lease = None
            elif who == "unready":
                await store._redis.write(("DEL", "fog:test:planner:ready"))
                expected.ready = None
            elif who == "pause":
                await store._redis.write(("DEL", "fog:test:planner:handed"))
                expected.handed.clear()
            elif who == "forget":
                await store._redis.write(("FLUSHALL",))
                expected = LeaseModel()
            else:
                held = expected.lease[0] if expected.lease is not None and late else 0
                request = Request(epoch, floor, confirmed, 0.0, ready=ready, cut_off=cut_off, late=held)
                reply, wanted = await store.acquire(who, request), expected.acquire(who, request, 0.0, clock=3)
                assert type(reply) is type(wanted)
                assert reply is not None
                if isinstance(reply, LeftToOther):
                    assert reply == wanted
                    continue
                assert reply.epoch == wanted.epoch
                assert getattr(reply, "taken", None) == getattr(wanted, "taken", None)
                if isinstance(reply, Held):
                    assert reply.holder == wanted.holder
                    assert 0.0 < reply.remaining_s <= SLOWER * LEASE_S
        stored = await store._redis.read("GET", "fog:test:planner:epoch")
        assert int(stored or 0) == expected.stored


async def test_one_of_many_is_granted_the_lease_and_its_epoch_outlives_it(redis: Server):
    async with LeaseStore(redis.url, "many", "map-service") as store:
        replies = await asyncio.gather(*(store.acquire(f"p{n}", NEW) for n in range(8)))
        granted = [reply for reply in replies if isinstance(reply, Granted)]
        assert len(granted) == 1
        assert {reply.epoch for reply in replies} == {granted[0].epoch}
        await expire(store, "fog:many:map-service:lease", SLOWER * LEASE_S)
        later = await store.acquire("late", NEW)
        assert isinstance(later, Granted)
        assert later.epoch > granted[0].epoch


async def test_leader_learns_at_its_renewal_of_a_higher_epoch_that_somebody_else_knows(redis: Server):
    async with LeaseStore(redis.url, "higher", "planner") as store:
        leader = await store.acquire("a", NEW)
        assert isinstance(leader, Granted)
        # The provisional epoch of a process that Redis did not answer, and that receivers have heard.
        higher = leader.epoch + 1000
        assert isinstance(await store.acquire("b", Request(epoch=0, floor=higher, confirmed=False, sent_at=0.0)), Held)
        renewed = await store.acquire("a", Request(leader.epoch, leader.epoch - 1, confirmed=True, sent_at=0.0))
        assert isinstance(renewed, Granted)
        assert renewed.epoch > higher


async def test_lease_of_a_leader_that_is_cut_off_goes_to_a_copy_that_says_it_is_ready_and_for_a_moment_only(
    redis: Server,
):
    async with LeaseStore(redis.url, "ready", "planner") as store:
        first = await store.acquire("a", NEW)
        assert isinstance(first, Granted)
        lost = Request(first.epoch, 0, confirmed=True, sent_at=0.0, ready=False, cut_off=True)
        unready = Request(0, 0, confirmed=False, sent_at=0.0, ready=False, cut_off=False)
        assert isinstance(await store.acquire("b", unready), Held)
        assert await store.acquire("a", lost) == first, "nobody else is ready"
        assert isinstance(await store.acquire("b", NEW), Held)
        left = LeftToOther("b")
        assert await store.acquire("a", lost) == left
        assert await store.acquire("a", lost) == left, "it does not come between"
        taken = await store.acquire("b", NEW)
        assert isinstance(taken, Granted)
        assert taken.epoch > first.epoch
        assert isinstance(await store.acquire("a", NEW), Held)
        await expire(store, "fog:ready:planner:ready", SLOWER * READY_SAID_S)
        assert await store.acquire("b", replace(lost, epoch=taken.epoch)) == taken


async def test_lease_of_a_late_leader_is_taken_by_who_is_ready_and_the_next_one_not_before_the_pause_has_passed(
    redis: Server,
):
    async with LeaseStore(redis.url, "late", "planner") as store:
        taken = await store.acquire("a", NEW)
        assert isinstance(taken, Granted)
        assert isinstance(await store.acquire("b", replace(NEW, late=taken.epoch - 1)), Held), "an earlier one was late"
        assert isinstance(await store.acquire("b", replace(NEW, late=taken.epoch, ready=False)), Held)
        holder, other = "a", "b"
        for handed in range(3):
            claim = replace(NEW, late=taken.epoch)
            if handed:
                assert isinstance(await store.acquire(other, claim), Held), "too soon"
                pause_ms = round(1000 * HANDED_PAUSE_S * 2 ** (handed - 1))
                known_ms = round(1000 * HANDED_KNOWN_S)
                await store._redis.write(("PEXPIRE", "fog:late:planner:handed", known_ms - pause_ms + 5000))
                assert isinstance(await store.acquire(other, claim), Held), "5 s too soon"
                await store._redis.write(("PEXPIRE", "fog:late:planner:handed", known_ms - pause_ms))
            before, taken = taken, await store.acquire(other, claim)
            assert isinstance(taken, Granted)
            assert taken.taken
            assert taken.epoch > before.epoch
            renewal = Request(before.epoch, 0, confirmed=True, sent_at=0.0)
            assert isinstance(await store.acquire(holder, renewal), Held), "it hears who leads now"
            holder, other = other, holder


async def test_released_lease_is_free_at_once_and_nobody_releases_that_of_another(redis: Server):
    async with LeaseStore(redis.url, "released", "planner") as store:
        await store.acquire("a", NEW)
        await store.release("b")
        assert isinstance(await store.acquire("b", NEW), Held)
        await store.release("a")
        assert isinstance(await store.acquire("b", NEW), Granted)


async def test_redis_that_hangs_or_is_away_gives_no_reply_in_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with start_redis(tmp_path) as server:
        async with LeaseStore(server.url, "away", "planner") as store:
            assert await store.acquire("a", NEW) is not None
            await store._redis.write(("CLIENT", "PAUSE", 600_000))
            monkeypatch.setattr(lease_store, "ATTEMPT_S", ATTEMPT_S)
            began = asyncio.get_running_loop().time()
            assert await store.acquire("a", NEW) is None
            assert asyncio.get_running_loop().time() - began >= ATTEMPT_S * 0.9
            server.kill()
            assert await store.acquire("a", NEW) is None
            await store.release("a")
