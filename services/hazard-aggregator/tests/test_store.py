"""The aggregator's records in a real Redis."""

import asyncio
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest
from redis.asyncio import Redis

from fog_contracts.handlers import Moment
from fog_contracts.messages import AreaDefinition, AreaHazard
from fog_runtime.health import Health
from fog_runtime.stores.records import CursorError
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import Audit
from fog_supervisor.servers import Server, start_redis
from hazard_aggregator.areas import Members
from hazard_aggregator.history import Period, period_of
from hazard_aggregator.publisher import HistoryPersistence
from hazard_aggregator.records import UnusableAreas
from hazard_aggregator.registry import find_rule
from hazard_aggregator.store import Store

pytestmark = pytest.mark.live
AUDIT = Audit(at=1.0, who="anna", action="put")


@pytest.fixture
def redis(tmp_path: Path):
    with start_redis(tmp_path) as server:
        yield server


def hazard(seq: int) -> AreaHazard:
    return AreaHazard(area="hall", state="blocked", severity=3, penalty=254, since=0, seq=seq, epoch=1, cause="")


async def test_stored_hazards_and_areas_survive_kills_of_redis(redis: Server):
    area = AreaDefinition(id="hall", polygon=[(0, 0), (1, 0), (1, 1)], version=4)
    async with Store(redis.url, "test", timeout_s=5.0) as store:
        first = await store.load()
        assert (first.definitions, first.hazards) == ([], [])
        assert await store.put_area(area, expected=0, audit=AUDIT) == "ok"
        for seq in range(1, 6):
            await store.save_hazards([hazard(seq)])
            await asyncio.to_thread(redis.kill)
            await asyncio.to_thread(redis.start)
            assert (await store.load()).hazards == [hazard(seq)]
        again = await store.load()
        assert again.definitions == [area]
        assert await store.durability_warning() == ""
        await asyncio.to_thread(redis.kill)
        with pytest.raises(StoreError):
            await store.save_hazards([hazard(9)])


def at(stamp: float, uptime: float | None = None, clock: int = 1) -> Moment:
    """Return a moment by the time of day, and by the clock that nobody sets."""
    return Moment(stamp if uptime is None else uptime, stamp, clock=clock)


@pytest.mark.parametrize("step", [-3600.0, 3600.0])
async def test_steps_of_the_clock_change_no_duration_in_an_areas_history(redis: Server, step: float):
    blocked, clear = hazard(1), msgspec.structs.replace(hazard(2), state="clear", penalty=0)
    last = hazard(3)
    async with Store(redis.url, f"steps{int(step) % 7}", timeout_s=5.0) as store:
        await store.begin_period(blocked, period_of(blocked, at(9000.0, 100.0)))
        await store.begin_period(clear, period_of(clear, at(9030.0 + step, 130.0)))
        after_a_boot = at(9070.0 + step, 5.0, clock=2)
        await store.begin_period(last, period_of(last, after_a_boot))
        page = await store.history("hall", cursor=None, limit=9, at=at(9080.0, 15.0, clock=2))
        views = [(view.period.began, view.ended, view.lasted_s) for view in page.periods]
        assert views == [
            (9070.0 + step, None, 10.0), (9030.0 + step, 9070.0 + step, 40.0), (9000.0, 9030.0, 30.0),
        ]  # fmt: skip
        assert set(Period.__struct_fields__) == set(msgspec.to_builtins(page.periods[0].period))


async def test_period_whose_state_began_in_an_earlier_run_is_counted_by_the_time_of_day(redis: Server):
    old = hazard(1)
    async with Store(redis.url, "earlier", timeout_s=5.0) as store:
        await store.begin_period(old, period_of(old, None))
        page = await store.history("hall", cursor=None, limit=1, at=at(old.since + 25.0, 7.0))
        assert [view.lasted_s for view in page.periods] == [25.0]


async def test_period_of_an_area_is_written_once_continues_over_restarts_and_is_forgotten_after_90_days(redis: Server):
    day = 86_400.0
    blocked, clear = hazard(1), msgspec.structs.replace(hazard(2), state="clear", penalty=0)
    again = msgspec.structs.replace(blocked, epoch=2)
    relief, last = msgspec.structs.replace(clear, epoch=2), msgspec.structs.replace(blocked, epoch=2, seq=3)
    written = [(blocked, 0.0), (clear, 10.0), (blocked, 10.0), (clear, 11.0), (again, 20.0)]
    async with Store(redis.url, "test", timeout_s=5.0) as store:
        for announced, stamp in written:
            await store.begin_period(announced, period_of(announced, at(stamp)))
    async with Store(redis.url, "test", timeout_s=5.0) as store:
        restarted = msgspec.structs.replace(again, epoch=3)
        await store.begin_period(restarted, period_of(restarted, at(50.0)))
        first = await store.history("hall", cursor=None, limit=2, at=at(60.0))
        rest = await store.history("hall", cursor=first.next, limit=2, at=at(60.0))
        assert [(v.period.state, v.period.began, v.ended, v.lasted_s) for v in [*first.periods, *rest.periods]] == [
            ("blocked", 20.0, None, 40.0), ("clear", 10.0, 20.0, 10.0), ("blocked", 0.0, 10.0, 10.0),
        ]  # fmt: skip
        assert rest.next is None
        for announced, stamp in ((relief, 80 * day), (last, 100 * day)):
            later = msgspec.structs.replace(announced, epoch=4)
            await store.begin_period(later, period_of(later, at(stamp)))
        kept = await store.history("hall", cursor=None, limit=9, at=at(101 * day))
        assert [v.period.began for v in kept.periods] == [100 * day, 80 * day, 20.0], "the third ended 20 days ago"
        gone = await store.history("hall", cursor=first.next, limit=9, at=at(101 * day))
        assert gone.periods == []
        for seq in range(4, 20):
            announced = msgspec.structs.replace(blocked if seq % 2 == 0 else clear, epoch=4, seq=seq)
            await store.begin_period(announced, period_of(announced, at(101 * day)))
        ahead = msgspec.structs.replace(blocked, epoch=5, penalty=7)
        await store.begin_period(ahead, period_of(ahead, at(20_000 * day)))
        after = await store.history("hall", cursor=None, limit=50, at=at(102 * day))
        assert len(after.periods) >= 15, "a clock that is years ahead after a boot cost the whole history"
        with pytest.raises(CursorError):
            await store.history("hall", cursor="1", limit=9, at=at(0.0))


async def test_history_of_an_area_that_is_no_more_is_forgotten_once_it_is_90_days_old(redis: Server):
    day = 86_400.0
    gone, back = (AreaDefinition(id=name, polygon=[(0, 0), (1, 0), (1, 1)], removed=True) for name in ("hall", "new"))
    here = msgspec.structs.replace(gone, id="here", removed=False)
    core = SimpleNamespace(definitions=lambda: [gone, back, here])
    async with Store(redis.url, "test", timeout_s=5.0) as store, Redis.from_url(redis.url) as raw:
        for area, stamp in (("hall", 0.0), ("new", 5 * day), ("here", 0.0), ("left", 0.0)):
            of_area = msgspec.structs.replace(hazard(1), area=area)
            await store.save_hazards([of_area])  # of the one that left site.toml, nothing else is left
            await store.begin_period(of_area, period_of(of_area, at(stamp)))
        history = HistoryPersistence(core, store, asyncio.Event())  # type: ignore[arg-type]  # all that it needs of a core
        for stamp, left in ((89 * day, [b"hall", b"here", b"left", b"new"]), (91 * day, [b"here", b"new"])):
            await history.forget_removed(at(stamp))
            assert sorted(key.rpartition(b":")[2] for key in await raw.keys("fog:test:history:*")) == left


def test_stored_area_with_an_unknown_rule_stays_on_the_map_unwatched_and_is_named(caplog):
    polygon = [(0, 0), (1, 0), (1, 1)]
    areas = [
        AreaDefinition(id="hall", polygon=polygon, nodes=["n1"], debounce={"rule": "of-a-removed-package"}, version=3),
        AreaDefinition(id="foyer", polygon=polygon, debounce={"to_blocked": 3}),
        AreaDefinition(id="gone", polygon=polygon, debounce={"rule": "of-a-removed-package"}, removed=True),
    ]
    health = Health()
    unusable = UnusableAreas(Members({}, find_rule, "consecutive").checked, health)
    usable = unusable.made_usable(areas, {})
    assert usable == [AreaDefinition(id="hall", polygon=polygon, version=3), *areas[1:]]
    (record,) = [record for record in caplog.records if record.message == "stored_area_unusable"]
    assert record.levelname == "ERROR"
    assert "hall (area hall: debounce" in health.report()["parts"]["areas"]["detail"]
    assert unusable.made_usable(areas[1:], {}) == areas[1:]
    assert health.report()["parts"]["areas"] == {"ok": True, "detail": ""}


def test_area_that_this_version_cannot_use_is_restored_as_it_was_stored_until_it_is_put_again():
    polygon = [(0, 0), (1, 0), (1, 1)]
    debounce = {"rule": "of-a-removed-package"}
    stored = AreaDefinition(id="hall", polygon=polygon, nodes=["n1"], cone_of="n1", debounce=debounce, version=3)
    unusable = UnusableAreas(Members({}, find_rule, "consecutive").checked, Health())
    (usable,) = unusable.made_usable([stored], {})
    assert usable.nodes == []
    assert unusable.as_stored(usable) == stored
    again = AreaDefinition(id="hall", polygon=polygon, version=4)
    assert unusable.as_stored(again) == again


async def test_area_whose_record_can_be_read_in_part_only_keeps_its_place(redis: Server):
    polygon = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)]
    record = {"id": "hall", "polygon": polygon, "nodes": "of another version", "version": 4}
    async with Store(redis.url, "test") as store, Redis.from_url(redis.url) as raw:
        await raw.hset("fog:test:areas", "hall", msgspec.json.encode(record))
        await raw.hset("fog:test:areas", "gate", b"nonsense")
        areas, unreadable = await store.areas()
    assert areas == [AreaDefinition(id="hall", polygon=polygon, version=4)]
    assert set(unreadable) == {"hall", "gate"}
