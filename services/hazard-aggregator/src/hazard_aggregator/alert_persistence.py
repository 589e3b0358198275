"""Keeps the alerts: evaluates them once a second, publishes them, and stores them with their history.

The metrics of nodes follow the same reports.
"""

from __future__ import annotations

import asyncio
from collections import deque
from contextlib import suppress
from typing import TYPE_CHECKING, Final, get_args

from prometheus_client import Gauge

from fog_contracts import channels as ch
from fog_contracts.handlers import Publication
from fog_contracts.messages import AlertKind
from fog_runtime import logs
from fog_runtime.clock import ticker
from fog_runtime.stores.redis_connection import StoreError, StoreRefusedError
from hazard_aggregator.alerts import AlertEvent, Alerts

if TYPE_CHECKING:
    from collections.abc import Iterable

    from fog_contracts.messages import Alert
    from fog_runtime.clock import Clock
    from fog_runtime.transports.edges import Edges
    from hazard_aggregator.alerts import NodeReport
    from hazard_aggregator.core import Aggregator
    from hazard_aggregator.store import Store

_LABELS: Final = ["area", "node"]
UNKNOWN = Gauge("fognav_node_unknown", "1 while nothing is known from a node or source", _LABELS)
SILENCE = Gauge("fognav_node_silence_seconds", "Time since the last reading of a node or source", _LABELS)
FLAPPING = Gauge("fognav_node_flapping", "1 while a node or source changes too often to be believed", _LABELS)

_log = logs.get("alerts")


class NodeMetrics:
    """The metrics of the nodes and sources that an aggregator knows; only those that are gone are removed."""

    def __init__(self) -> None:
        self._shown: set[tuple[str, str]] = set()

    def show(self, reports: Iterable[NodeReport]) -> None:
        """Set the metrics to these reports; a node without a reading has no silence."""
        gone, self._shown = self._shown, set()
        for report in reports:
            labels = (report.area, report.id)
            self._shown.add(labels)
            UNKNOWN.labels(*labels).set(report.state == "unknown")
            FLAPPING.labels(*labels).set(report.flapping)
            if report.age is not None:
                SILENCE.labels(*labels).set(report.age)
            else:
                _remove_silence(labels)  # of the readings before its definition changed
        for labels in gone - self._shown:
            UNKNOWN.remove(*labels)
            FLAPPING.remove(*labels)
            _remove_silence(labels)


def _remove_silence(labels: tuple[str, str]) -> None:
    with suppress(KeyError):  # without a reading it had none
        SILENCE.remove(*labels)


_PERIOD_S: Final = 1.0
_QUEUE: Final = 10_000
"""Events that wait while Redis is away; beyond them the oldest are missing in the history."""

ALERTS = Gauge("fognav_alerts", "Alerts of areas and nodes that an operator has acknowledged, or not", ["kind", "seen"])


class AlertPersistence:
    """The alerts of the aggregator that leads; one that stands by has none."""

    def __init__(self, core: Aggregator, store: Store, edges: Edges, clock: Clock, leading: asyncio.Event) -> None:
        self._core = core
        self._clock = clock
        self._store = store
        self._edges = edges
        self._leading = leading
        self._alerts = Alerts()
        self._nodes = NodeMetrics()
        self._events: deque[AlertEvent] = deque(maxlen=_QUEUE)
        self._storing = asyncio.Lock()
        self._saved = True
        self._recoveries = 0
        self._loaded = False
        self._epoch = -1

    def active(self) -> list[Alert]:
        """Return the active alerts, oldest first."""
        return self._alerts.active()

    async def run(self) -> None:
        """Evaluate, publish and store alerts, while this process leads."""
        async for _ in ticker(self._clock, _PERIOD_S):
            if self._leading.is_set():
                await self._load()
                self._evaluate()
                await self._write()
            else:
                self._forget()

    async def publish(self) -> None:
        """Publish the alerts; call it after every connection too, since the broker may have lost them."""
        if self._leading.is_set():
            self._epoch = self._core.epoch
            self._edges.publish(Publication(ch.AGGREGATOR_ALERTS, self._alerts.message(self._epoch)))

    async def acknowledge(self, name: str, who: str) -> Alert:
        """Store durably that an operator has seen an alert, then publish it; raises `AlertError` and `StoreError`.

        What could not be stored is not in force: the operator repeats it.
        """
        if not self._loaded:
            raise StoreRefusedError("the stored alerts are not loaded yet: /readyz says why")
        await self._store_events()  # first that it was raised
        async with self._storing:
            event = self._alerts.acknowledgement(name, who, self._edges.now().stamp)
            await self._store.record_alert(event)
            others = [alert for alert in self._alerts.active() if alert.id != name]
            await self._store.save_alerts([*others, event.alert])
            self._alerts.accept(event.alert)
        self._edges.publish(Publication(ch.AGGREGATOR_ALERTS, self._alerts.message(self._core.epoch)))
        self._count()
        return event.alert

    def _forget(self) -> None:
        """Stand by: the leader's alerts are its own."""
        self._alerts, self._loaded, self._epoch = Alerts(), False, -1
        self._events.clear()
        ALERTS.clear()
        self._nodes.show(())

    async def _load(self) -> None:
        if self._loaded:
            return
        try:
            self._alerts.restore(await self._store.alerts())
        except StoreError as error:
            # The store's own loop reports the state of Redis in the process's health.
            _log.debug("alerts_not_loaded", reason=str(error))
        else:
            self._loaded = True

    def _evaluate(self) -> None:
        at, before = self._edges.now(), self._alerts.active()
        reports = self._core.node_reports(at.now)
        self._nodes.show(reports)
        events = self._alerts.update(self._core.definitions(), self._core.announced(), reports, at)
        for event in events:
            alert = event.alert
            _log.info(f"alert_{event.action}", alert=alert.id, code=alert.code, reason=alert.reason)
        self._events += events
        if self._alerts.active() != before or self._epoch != self._core.epoch:
            self._epoch = self._core.epoch
            self._edges.publish(Publication(ch.AGGREGATOR_ALERTS, self._alerts.message(self._epoch)))
        self._count()

    def _count(self) -> None:
        active = self._alerts.active()
        for kind in get_args(AlertKind):
            for seen in (True, False):
                count = sum(alert.kind == kind and (alert.acknowledged_by is not None) == seen for alert in active)
                ALERTS.labels(kind, str(seen).lower()).set(count)

    async def _write(self) -> None:
        try:
            await self._store_events()
        except StoreError as error:
            _log.debug("alerts_wait", reason=str(error), queued=len(self._events))

    async def _store_events(self) -> None:
        """Store the history and then the active alerts: killed in between, an alert is in the history twice."""
        async with self._storing:
            if not self._loaded:
                return
            while self._events:
                self._saved, event = False, self._events[0]
                await self._store.record_alert(event)
                if self._events and self._events[0] is event:
                    self._events.popleft()
            recoveries = self._store.recoveries
            if not self._saved or recoveries != self._recoveries:
                await self._store.save_alerts(self._alerts.active())
                self._saved, self._recoveries = True, recoveries
