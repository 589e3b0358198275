"""Publishes what the core returns, logs each new hazard once, keeps their history and metrics, and tells who leads."""

from __future__ import annotations

import asyncio
from collections import deque
from contextlib import suppress
from typing import TYPE_CHECKING, Final, get_args

from prometheus_client import Gauge

from fog_contracts import channels as ch
from fog_contracts.handlers import Publication
from fog_contracts.messages import AreaHazard, AreaState
from fog_runtime import logs, metrics
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.transports.mqtt_edge import Will
from hazard_aggregator.history import period_of
from hazard_aggregator.publications import discovery_publication

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.handlers import Ids, Moment
    from fog_runtime.transports.edges import Edges
    from fog_runtime.transports.mqtt_edge import MqttEdge
    from hazard_aggregator.core import Aggregator
    from hazard_aggregator.history import HistoryPage
    from hazard_aggregator.store import Store

LAST_WILL: Final = Will(ch.AGGREGATOR_AVAILABILITY, ch.OFFLINE)

_history_log = logs.get("history")


class Availability:
    """The presence of the one that leads: `offline` comes from a copy that stood by, or from the leader before, too."""

    def __init__(self, edges: Edges, leading: asyncio.Event) -> None:
        self._edges = edges
        self._leading = leading

    def subscribe(self, mqtt: MqttEdge) -> None:
        """Register what keeps the presence true; call before the connection runs."""
        mqtt.on(ch.AGGREGATOR_AVAILABILITY, self._on_availability)
        mqtt.on_connect(self._on_connect)

    def announce(self) -> None:
        """Publish that an aggregator leads, if this one does."""
        if self._leading.is_set():
            self._edges.publish(Publication(ch.AGGREGATOR_AVAILABILITY, ch.ONLINE))

    async def _on_connect(self) -> None:
        self.announce()

    def _on_availability(self, _ids: Ids, text: str) -> None:
        if text == ch.OFFLINE:
            self.announce()


_QUEUE: Final = 10_000
"""Hazards that wait while Redis is away; beyond them the oldest are missing in the history."""
_PERIOD_S: Final = 0.5
_FORGET_S: Final = 86_400.0


class HistoryPersistence:
    """The queue of published hazards that begin periods; Redis refuses those that it has already."""

    def __init__(self, core: Aggregator, store: Store, leading: asyncio.Event) -> None:
        self._core = core
        self._store = store
        self._leading = leading
        self._queue: deque[tuple[AreaHazard, Moment | None]] = deque(maxlen=_QUEUE)
        self._newest: dict[str, tuple[int, int]] = {}
        self._forget_at = 0.0

    def add(self, hazard: AreaHazard, at: Moment) -> None:
        """Queue a hazard that is published at this moment, unless it was queued before.

        The first of an epoch begins its period when its state began: the earlier run may have been killed before it
        wrote that.
        """
        epoch, seq = self._newest.get(hazard.area, (0, 0))
        if (epoch, seq) != (hazard.epoch, hazard.seq):
            self._newest[hazard.area] = (hazard.epoch, hazard.seq)
            self._queue.append((hazard, at if epoch == hazard.epoch else None))

    async def page(self, area: str, cursor: str | None, limit: int, at: Moment) -> HistoryPage:
        """Return a page of an area's history at this moment; raises `CursorError` and `StoreError`."""
        return await self._store.history(area, cursor=cursor, limit=limit, at=at)

    async def forget_removed(self, at: Moment) -> None:
        """Forget, once a day, what became of areas that have been gone for 90 days; raises `StoreError`."""
        if at.now < self._forget_at:
            return
        await self._store.forget_histories(self._core.definitions(), at.stamp)
        self._forget_at = at.now + _FORGET_S

    async def run(self) -> None:
        """Write what is queued, while this process leads."""
        while True:
            await asyncio.sleep(_PERIOD_S)
            await self._leading.wait()
            try:
                await self.write()
            except StoreError as error:
                # It stays queued; the store's own loop reports the state of Redis in the process's health.
                _history_log.debug("history_waits", reason=str(error), queued=len(self._queue))

    async def write(self) -> None:
        """Write all that is queued; raises `StoreError`, and keeps what is not written.

        What was decided under an earlier epoch, while another copy led, is that copy's to write.
        """
        while self._queue:
            hazard, at = self._queue[0]
            if hazard.epoch == self._core.epoch:
                await self._store.begin_period(hazard, period_of(hazard, at))
            if self._queue and self._queue[0][0] is hazard:
                self._queue.popleft()


AREA_STATES: Final[tuple[str, ...]] = get_args(AreaState)

HAZARDS = Gauge("fognav_hazards", "Whether an area is announced in this state (1) or not (0)", ["area", "state"])
WITHHELD = Gauge("fognav_hazards_withheld", "Areas whose relief is withheld until it is stored")
UNSTORED = Gauge("fognav_hazards_unstored", "Areas whose newest hazard is not stored yet")

_log = logs.get("aggregator")


class Publisher:
    """The way of the core's publications to the edges; `write_pending` is set while hazards must be stored.

    Home Assistant is told of the areas of this `site`; without its id, of none.
    """

    def __init__(self, core: Aggregator, edges: Edges, history: HistoryPersistence, site: str) -> None:
        metrics.expect_stages(["debounce"])
        self._site = site
        self.write_pending = asyncio.Event()
        self._core = core
        self._edges = edges
        self._history = history
        self._logged: dict[str, int] = {}  # the seq of each area's last hazard in the log

    def announce(self, publications: Sequence[Publication]) -> None:
        """Publish decisions of the core, and log each new one once, however often it is published again."""
        for publication in publications:
            hazard = publication.message
            if isinstance(hazard, AreaHazard) and self._logged.get(hazard.area) != hazard.seq:
                self._logged[hazard.area] = hazard.seq
                if hazard.trace is not None:
                    metrics.observe_trace(hazard.trace, ["debounce"])
                _log.info(
                    "hazard_announced", area=hazard.area, state=hazard.state, penalty=hazard.penalty, cause=hazard.cause
                )
        self.publish(publications)

    def publish(self, publications: Sequence[Publication]) -> None:
        """Publish without a line in the log."""
        for publication in publications:
            _count(publication)
            self._edges.publish(publication)
            if publication.channel is ch.AREA_DEFINITION and self._site:
                self._edges.publish(discovery_publication(self._site, publication))
            if isinstance(hazard := publication.message, AreaHazard):
                self._history.add(hazard, self._edges.now())
        WITHHELD.set(len(self._core.withheld()))
        UNSTORED.set(len(self._core.to_store()))
        if self._core.to_store():
            self.write_pending.set()

    async def republish_all(self) -> None:
        """Publish everything again, for a broker that has (re)connected."""
        self.publish(self._core.republish_all())


def _count(publication: Publication) -> None:
    """Set the gauges of the area that a publication is about; remove them for a deleted area."""
    if isinstance(hazard := publication.message, AreaHazard):
        for state in AREA_STATES:
            HAZARDS.labels(hazard.area, state).set(hazard.state == state)
    elif publication.message is None and publication.channel is ch.AREA_HAZARD:
        for state in AREA_STATES:
            with suppress(KeyError):  # an area that another aggregator had published
                HAZARDS.remove(publication.ids["area"], state)
