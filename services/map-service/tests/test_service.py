"""The map-service's wiring: it serves every query that its core answers, once the map is complete."""

from __future__ import annotations

import asyncio
import threading
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import httpx
import numpy as np
from manual_clock import ManualClock
from prometheus_client import REGISTRY

from fog_contracts import channels as ch
from fog_contracts.grid import GridGeometry
from fog_contracts.handlers import Moment
from fog_contracts.messages import AreaDefinition, HazardArea, Message, ZoneSet
from fog_runtime.health import Health
from fog_runtime.http import Tokens
from map_service import api
from map_service.core import MapCore
from map_service.registry import make_layers
from map_service.service import Service

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pytest

    from fog_contracts.handlers import Ids, QueryHandler

ADDED = ch.Channel(
    "zones_again", "fog/{site}/zones-again", None, transport="zenoh", kind="query", encoding="msgpack",
    publishers=("map-service",), subscribers=("planner",), durability="volatile", reply=ZoneSet, reply_limit=1000,
)  # fmt: skip
"""A channel that the service doesn't know."""
AREAS = [AreaDefinition(id=name, polygon=[(0.5, 0.5), (1.5, 0.5), (1.5, 1.5)]) for name in ("a1", "a2")]


@dataclass
class Plan:
    geometry: GridGeometry
    cells: np.ndarray


class AnsweringCore(MapCore):
    """A core that answers one more query."""

    def query_handlers(self) -> Mapping[ch.Channel, QueryHandler]:
        return {**super().query_handlers(), ADDED: self._answer_again}

    def _answer_again(self, _ids: Ids, _request: None, _at: Moment) -> ZoneSet:
        return self.zone_set()


class Session:
    """Stands for both connections; queues what is served."""

    connected = True

    def __init__(self) -> None:
        self.served: asyncio.Queue[tuple[ch.Channel, Any, dict[str, str]]] = asyncio.Queue()

    def serve(self, channel: ch.Channel, handler: object, **ids: str) -> None:
        self.served.put_nowait((channel, handler, ids))

    def publish(self, channel: ch.Channel, message: Message, **ids: str) -> None: ...

    def on_connect(self, connected: object) -> None: ...


async def test_every_query_of_the_core_is_served_and_each_area_under_its_key() -> None:
    plan = Plan(GridGeometry(60, 60, 0.05, 0.0, 0.0), np.zeros((60, 60), dtype=np.uint8))
    core = AnsweringCore("test", plan, 1, layers=make_layers(plan), definitions=AREAS)
    core.load_zones([], Moment(0.0, 0.0))
    session = Session()
    edge = cast("Any", session)
    service = Service(core, cast("Any", None), edge, edge, ManualClock(1.0), Health())
    ticking = asyncio.create_task(service.tick_loop())
    async with asyncio.timeout(60):
        served = [await session.served.get() for _ in range(5)]
    ticking.cancel()
    await asyncio.gather(ticking, return_exceptions=True)
    assert session.served.empty()
    assert {(channel.name, *ids.values()) for channel, _, ids in served} == {
        ("map_snapshot",), ("zones",), ("zones_again",), ("hazard", "a1"), ("hazard", "a2"),
    }  # fmt: skip
    for channel, handler, ids in served:
        if channel is ch.HAZARD:
            reply = handler(ids, None)
            assert isinstance(reply, HazardArea)
            assert reply.hazard.area == ids["area"]


async def test_copy_is_not_ready_to_lead_before_its_map_is_complete() -> None:
    plan = Plan(GridGeometry(60, 60, 0.05, 0.0, 0.0), np.zeros((60, 60), dtype=np.uint8))
    core = MapCore("test", plan, 1, layers=make_layers(plan), definitions=AREAS, hazards_wait_s=3.0)
    edge = cast("Any", Session())
    service = Service(core, cast("Any", None), edge, edge, ManualClock(1.0), Health())
    core.load_zones([], Moment(0.0, 0.0))
    core.tick(Moment(1.0, 1.0))
    assert not await service.serves(), "the hazards are missing"
    core.tick(Moment(4.0, 4.0))
    assert await service.serves(), "nobody knows them, so they are unknown"


async def test_picture_is_refused_with_the_time_to_retry_while_pictures_of_four_versions_are_being_made(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plan = Plan(GridGeometry(60, 60, 0.05, 0.0, 0.0), np.zeros((60, 60), dtype=np.uint8))
    core = MapCore("test", plan, 1, layers=make_layers(plan), definitions=AREAS)
    edge = cast("Any", Session())
    service = Service(core, cast("Any", None), edge, edge, ManualClock(1.0), Health())
    free = threading.Event()

    def slowly(_cells: np.ndarray, _palette: bytes) -> bytes:
        free.wait(60.0)
        return b"picture"

    monkeypatch.setattr(api, "_png", slowly)
    site = cast("Any", SimpleNamespace(id="test", places={}))
    app = api.make_api(service, site, ManualClock(1.0), Health(), Tokens())
    try:
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://map") as client:
            waiting = []
            for number in range(1, 5):
                core.lead(number + 1)  # another version of the map
                waiting.append(asyncio.create_task(client.get("/api/v1/map.png")))
                async with asyncio.timeout(60):
                    while REGISTRY.get_sample_value("fognav_worker_queue", {"worker": "pictures"}) != number:  # noqa: ASYNC110  # on another thread
                        await asyncio.sleep(0)
            core.lead(9)
            refused = await client.get("/api/v1/map.png")
            assert (refused.status_code, refused.headers["content-type"]) == (503, "application/problem+json")
            assert float(refused.headers["retry-after"]) > 0
            assert "pictures" in refused.json()["detail"]
            free.set()
            assert {answer.status_code for answer in await asyncio.gather(*waiting)} == {200}
            assert (await client.get("/api/v1/map.png")).content == b"picture"
    finally:
        free.set()
