"""Publishes what the core returns, logs each new hazard once, and keeps the metrics of hazards."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING, Final, get_args

from prometheus_client import Gauge

from fog_contracts import channels as ch
from fog_contracts.messages import AreaHazard, AreaState
from fog_runtime import logs, metrics
from hazard_aggregator.areas.area_discovery import discovery_publication

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.handlers import Publication
    from fog_runtime.transports.edges import Edges
    from hazard_aggregator.core import Aggregator
    from hazard_aggregator.history_keeper import HistoryKeeper

AREA_STATES: Final[tuple[str, ...]] = get_args(AreaState)

HAZARDS = Gauge("fognav_hazards", "Whether an area is announced in this state (1) or not (0)", ["area", "state"])
WITHHELD = Gauge("fognav_hazards_withheld", "Areas whose relief is withheld until it is stored")
UNSTORED = Gauge("fognav_hazards_unstored", "Areas whose newest hazard is not stored yet")

_log = logs.get("aggregator")


class Publisher:
    """The way of the core's publications to the edges; `write_pending` is set while hazards must be stored.

    Home Assistant is told of the areas of this `site`; without its id, of none.
    """

    def __init__(self, core: Aggregator, edges: Edges, history: HistoryKeeper, site: str) -> None:
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
