"""What an aggregator publishes when it begins to lead, and when Redis confirms that it does."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, cast

import pytest
from manual_clock import ManualClock

from fog_contracts import channels as ch
from fog_contracts.handlers import Moment
from fog_contracts.messages import AreaDefinition, AreaHazard
from fog_runtime.health import Health
from fog_runtime.stores.redis_store import Audit
from fog_supervisor.servers import start_redis
from hazard_aggregator.areas import AreaOverride
from hazard_aggregator.core import Aggregator
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.registry import find_rule
from hazard_aggregator.service import Service
from hazard_aggregator.store import Store

if TYPE_CHECKING:
    from pathlib import Path

    from fog_contracts.channels import Channel

pytestmark = pytest.mark.live
AREAS = [AreaDefinition(id=name, polygon=[(0, 0), (1, 0), (1, 1)]) for name in ("hall", "gate")]
BOOT = "this-boot"


class Connection:
    """Stands for both connections; keeps the hazards that are published."""

    def __init__(self) -> None:
        self.hazards: dict[str, AreaHazard] = {}

    def publish(self, channel: Channel, message: object, **_ids: str) -> None:
        if channel is ch.AREA_HAZARD:
            assert isinstance(message, AreaHazard)
            self.hazards[message.area] = message

    publish_nowait = publish

    async def listen_to_foreign(self, *_: object) -> None: ...


async def test_stored_blockages_are_published_when_redis_confirms_a_provisional_epoch_under_its_number(tmp_path: Path):
    stored = AreaHazard(area="gate", state="blocked", severity=3, penalty=254, since=0, seq=7, epoch=1, cause="")
    override = AreaOverride(
        area="hall", state="blocked", author="ann", reason="wet floor", ttl_s=600.0, set_at=1.0, boot=BOOT,
        deadline=1e9, version=0,
    )  # fmt: skip
    connection = Connection()
    edge = cast("Any", connection)
    core = Aggregator(AreaFusion(AREAS, [], 1, registry=find_rule), complete=False)
    core.tick(Moment(0.9, 0.9))
    with start_redis(tmp_path) as redis:
        async with Store(redis.url, "test", timeout_s=5.0) as store:
            await store.save_hazards([stored])
            assert (await store.put_override(override, Audit(at=1.0, who="ann", action="put")))[0] == "ok"
            await asyncio.to_thread(redis.kill)
            service = Service(core, store, edge, edge, ManualClock(1.0), Health(), boot=BOOT)
            await service.lead(5, confirmed=False)
            assert {area: hazard.penalty for area, hazard in connection.hazards.items()} == {"hall": 200, "gate": 200}
            await asyncio.to_thread(redis.start)
            await service.lead(5, confirmed=True)
    hall, gate = connection.hazards["hall"], connection.hazards["gate"]
    assert (hall.state, hall.penalty, hall.epoch) == ("blocked", 254, 5)
    assert (gate.state, gate.penalty, gate.epoch) == ("unknown", 254, 5), "it was blocked, and no node says otherwise"
