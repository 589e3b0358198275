"""Changes of zones that meet others, or a Redis that carries out a write after its reply was given up."""

from __future__ import annotations

import asyncio
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest
from manual_clock import ManualClock
from msgspec import structs

from fog_contracts.grid import GridGeometry
from fog_contracts.messages import CircleShape, Message, Zone
from fog_runtime.concurrency import BusyError
from fog_runtime.health import Health
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import Attempt, Audit
from fog_supervisor.servers import start_redis
from map_service.core import MapCore
from map_service.record_writer import ConflictError
from map_service.registry import make_layers
from map_service.service import Service
from map_service.store import Store
from map_service.zone_writer import KEPT_S, MAX_PREPARING

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from fog_contracts import channels as ch
    from fog_runtime.stores.redis_store import Outcome

pytestmark = pytest.mark.live
ATTEMPT = Attempt.of("ann", "k1", "POST /api/v1/zones", None)


@dataclass
class Plan:
    geometry: GridGeometry
    cells: np.ndarray


class Connection:
    """Stands for both connections; nobody listens."""

    connected = True

    def publish(self, channel: ch.Channel, message: Message, **ids: str) -> None: ...


class HangingStore(Store):
    """A store whose Redis hangs during a write while `hangs`, and carries it out only just before the next one."""

    hangs = False
    late: tuple[Any, ...] | None = None

    async def _swap(self, *arguments: Any, **options: Any) -> Outcome:
        if self.hangs:
            self.hangs, self.late = False, arguments
            raise StoreError("Redis does not answer within 1 s")
        late, self.late = self.late, None
        if late is not None:
            await super()._swap(*late)
        return await super()._swap(*arguments, **options)


def zone(name: str, reason: str = "") -> Zone:
    return Zone(id=name, kind="BLOCKED", shape=CircleShape(centre=(1.0, 1.0), radius=0.5), reason=reason)


@pytest.fixture
async def store(tmp_path: Path) -> AsyncIterator[HangingStore]:
    with start_redis(tmp_path) as redis:
        async with HangingStore(redis.url, "test", timeout_s=5.0) as store:
            yield store


async def running(store: Store) -> Service:
    plan = Plan(GridGeometry(60, 60, 0.05, 0.0, 0.0), np.zeros((60, 60), dtype=np.uint8))
    core = MapCore("test", plan, 1, layers=make_layers(plan), definitions=[])
    edge = cast("Any", Connection())
    service = Service(core, store, edge, edge, ManualClock(1.0), Health())
    await service.zones.load()
    return service


async def test_unconditional_changes_of_a_zone_at_the_same_time_follow_one_another(store: HangingStore) -> None:
    service = await running(store)
    await service.zones.create(zone("z1"), "ann")
    stored = await asyncio.gather(*(service.zones.replace(zone("z1", f"{n}"), None, "ann") for n in range(8)))
    assert sorted(each.version for each in stored) == list(range(2, 10))
    with pytest.raises(ConflictError):
        await service.zones.replace(zone("z1"), 8, "ann")
    await service.zones.delete("z1", None, "ann")
    assert (await store.zones())[0] == [] == service.core.zones.zones()


async def test_zone_that_a_hanging_redis_stored_late_answers_its_repeated_request(store: HangingStore) -> None:
    service = await running(store)
    store.hangs = True
    with pytest.raises(StoreError):
        await service.zones.create(zone("z1"), "ann", ATTEMPT)
    # The id of a zone that names none is drawn for each request.
    created = await service.zones.create(zone("z2"), "ann", ATTEMPT)
    assert (created.id, created.version) == ("z1", 1)
    store.hangs = True
    attempt = Attempt.of("ann", "k2", "PUT /api/v1/zones/z1", None)
    with pytest.raises(StoreError):
        await service.zones.replace(zone("z1", "first"), 1, "ann", attempt)
    replaced = await service.zones.replace(zone("z1", "second"), 1, "ann", attempt)
    assert (replaced.reason, replaced.version) == ("first", 2)
    assert (await store.zones())[0] == [replaced] == service.core.zones.zones()


async def test_zones_are_loaded_however_many_requests_wait_for_theirs_to_be_validated(store: HangingStore) -> None:
    service, free = await running(store), threading.Event()
    await store.create(zone("z1"), Audit(1.0, "ann", "create"))  # by another process
    waiting = [asyncio.create_task(service.zones._worker.run(free.wait, 60.0)) for _ in range(MAX_PREPARING)]
    await asyncio.sleep(0)  # they begin
    try:
        with pytest.raises(BusyError):
            await service.zones.prepare(zone("z2"))
        await service.zones.load()
        assert service.core.zones.ids() == ["z1"]
    finally:
        free.set()
        await asyncio.gather(*waiting)


async def test_zone_that_ended_an_hour_ago_is_deleted_and_stays_in_the_audit_trail(store: HangingStore) -> None:
    service = await running(store)
    service._leading = True  # there is no lease in this Redis, whose epoch it would ask for
    clock = cast("ManualClock", service._clock)
    await service.zones.create(structs.replace(zone("short"), ttl_s=10.0), "ann")
    await service.zones.create(zone("lasting"), "ann")
    loops = [asyncio.create_task(service.store_loop()), asyncio.create_task(service.publisher.commit_loop())]
    try:
        for step, left in ((11.0, ["lasting", "short"]), (KEPT_S - 5.0, ["lasting", "short"]), (10.0, ["lasting"])):
            clock.advance(step)
            service.core.tick(service._now())
            for _ in range(600):
                if service.core.zones.ids() == left[::-1]:
                    break
                await asyncio.sleep(0.1)
            assert sorted(service.core.zones.ids()) == left
    finally:
        for loop in loops:
            loop.cancel()
        await asyncio.gather(*loops, return_exceptions=True)
    assert [each.id for each in (await store.zones())[0]] == ["lasting"]
    trail = (await service.audit(["zone"], None, 10)).entries
    assert [(entry.id, entry.action, entry.who) for entry in trail] == [
        ("short", "delete", "map-service"), ("lasting", "create", "ann"), ("short", "create", "ann"),
    ]  # fmt: skip
