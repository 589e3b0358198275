"""Changes of areas and overrides while what is stored differs from what this process knows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import httpx
import numpy as np
import pytest
from manual_clock import ManualClock
from msgspec import structs

from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.handlers import Moment
from fog_contracts.messages import AreaDefinition
from fog_runtime.health import Health
from fog_runtime.http import Tokens, token_hash
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import Attempt, Audit
from fog_runtime.token_file import TokenEntry
from fog_supervisor.servers import start_redis
from hazard_aggregator import area_size
from hazard_aggregator.api import make_api
from hazard_aggregator.areas import AreaOverride
from hazard_aggregator.core import Aggregator
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.registry import find_rule
from hazard_aggregator.service import Service
from hazard_aggregator.store import Store
from hazard_aggregator.writers import ConflictError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable
    from pathlib import Path

    from fog_runtime.stores.redis_store import Outcome

pytestmark = pytest.mark.live
HALL = AreaDefinition(id="hall", polygon=[(0, 0), (1, 0), (1, 1)])
ATTEMPT = Attempt.of("ann", "k1", "PUT /api/v1/areas/hall", None)
AUDIT = Audit(at=1.0, who="ben", action="put")


class Connection:
    """Stands for both connections; nobody listens."""

    def publish(self, *_: object, **_ids: str) -> None: ...

    publish_nowait = publish

    async def listen_to_foreign(self, *_: object) -> None: ...


class HangingStore(Store):
    """A store whose Redis hangs during the first write, and carries it out only just before the second one."""

    late: list[tuple[Any, ...]]

    async def _swap(self, *arguments: Any, **options: Any) -> Outcome:
        if not hasattr(self, "late"):
            self.late = [arguments]
            raise StoreError("Redis does not answer within 1 s")
        while self.late:
            await super()._swap(*self.late.pop())
        return await super()._swap(*arguments, **options)


def override(reason: str, version: int) -> AreaOverride:
    return AreaOverride(
        area="hall", state="blocked", author="ben", reason=reason, ttl_s=600.0, set_at=1.0, boot="", deadline=601.0,
        version=version,
    )  # fmt: skip


async def running(
    store: Store,
    clock: ManualClock | None = None,
    areas: Iterable[AreaDefinition] = (HALL,),
    *,
    confirmed: bool = False,
) -> Service:
    core = Aggregator(AreaFusion(areas, [], 1, registry=find_rule), complete=False)
    core.tick(Moment(0.9, 0.9))
    edge = cast("Any", Connection())
    service = Service(core, store, edge, edge, clock or ManualClock(1.0), Health(), boot="this-boot")
    await service.lead(5, confirmed=confirmed)
    # Redis granted no epoch here: the store takes the writer for no copy of a service.
    store.epoch = -1
    return service


@pytest.fixture
async def redis_url(tmp_path: Path) -> AsyncIterator[str]:
    with start_redis(tmp_path) as redis:
        yield redis.url


async def test_unconditional_override_replaces_a_stored_one_that_this_process_does_not_know(redis_url: str):
    async with Store(redis_url, "test", timeout_s=5.0) as store, Store(redis_url, "test", timeout_s=5.0) as other:
        service = await running(store)
        assert (await other.put_override(override("wet floor", 0), AUDIT))[0] == "ok"
        done = await service.overrides.put("hall", "blocked", "cables", 60.0, "ann")
        assert (done.reason, done.version) == ("cables", 2)
        assert service.core.overrides.get("hall") == done
        assert (await store.overrides())[0] == [done]


async def test_conditional_override_of_another_version_than_the_stored_one_is_a_conflict(redis_url: str):
    async with Store(redis_url, "test", timeout_s=5.0) as store, Store(redis_url, "test", timeout_s=5.0) as other:
        service = await running(store)
        first = await service.overrides.put("hall", "blocked", "cables", 60.0, "ann")
        assert (await other.put_override(first, AUDIT))[0] == "ok"
        with pytest.raises(ConflictError):
            await service.overrides.put("hall", "blocked", "paint", 60.0, "ann", expected=first.version)
        known = service.core.overrides.get("hall")
        assert known is not None
        assert known.version == first.version + 1, "the stored one is in force now"


async def test_override_that_a_hanging_redis_stored_late_answers_its_repeated_request(redis_url: str):
    async with HangingStore(redis_url, "test", timeout_s=5.0) as store:
        clock = ManualClock(1.0)
        service = await running(store, clock)
        with pytest.raises(StoreError):
            await service.overrides.put("hall", "blocked", "wet floor", 60.0, "ann", attempt=ATTEMPT)
        clock.advance(2.0)
        done = await service.overrides.put("hall", "blocked", "wet floor", 60.0, "ann", attempt=ATTEMPT)
        assert (done.reason, done.version) == ("wet floor", 1)
        assert service.core.overrides.get("hall") == done
        assert (await store.overrides())[0] == [done]


async def test_unconditional_area_replaces_a_stored_one_that_this_process_does_not_know(redis_url: str):
    async with Store(redis_url, "test", timeout_s=5.0) as store, Store(redis_url, "test", timeout_s=5.0) as other:
        service = await running(store)
        stored = AreaDefinition(id="hall", polygon=HALL.polygon, label="by ben", version=1)
        assert await other.put_area(stored, expected=0, audit=AUDIT) == "ok"
        done = await service.areas.put_area(HALL, "ann")
        assert (done.label, done.version) == ("", 2)
        assert (service.core.definitions(), await store.areas()) == ([done], ([done], {}))


async def test_area_beyond_the_most_is_refused_until_one_is_removed_while_others_can_be_changed(
    redis_url: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(area_size, "AREAS_MAX", 3)
    areas = [structs.replace(HALL, id=f"a{number}") for number in range(2)]
    tokens = Tokens([TokenEntry(name="ann", role="operator", sha256=token_hash("secret"))])
    async with Store(redis_url, "test", timeout_s=5.0) as store:
        service = await running(store, areas=areas)
        static = StaticMap(GridGeometry(100, 100, 0.05, 0.0, 0.0), np.zeros((100, 100), np.uint8))
        app = make_api(service, static, ManualClock(1.0), Health(), tokens)
        async with httpx.AsyncClient(
            transport=httpx.ASGITransport(app), base_url="http://fog", headers={"Authorization": "Bearer secret"}
        ) as client:

            async def put(area: str, **fields: object) -> httpx.Response:
                return await client.put(f"/api/v1/areas/{area}", json={"polygon": HALL.polygon, **fields})

            assert (await put("last")).status_code == 201
            refused = await put("extra")
            assert refused.status_code == 422
            (error,) = refused.json()["errors"]
            assert error["field"] == "path"
            assert "the site has 3 areas, and 3 is the limit" in error["problem"]
            assert "remove one first" in error["problem"]
            assert [(await put(area, label="new")).status_code for area in ("a0", "last")] == [200, 200]
            assert (await put("a0", removed=True)).status_code == 200
            assert (await put("extra")).status_code == 201
            assert (await put("a0")).status_code == 422, "it was removed, and would be one too many again"
        assert len((await store.areas())[0]) == 3
