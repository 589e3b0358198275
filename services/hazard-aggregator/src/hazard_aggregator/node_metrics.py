"""Metrics of each node and source: whether anything is known from it, since when it is silent, whether it flaps."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Final

from prometheus_client import Gauge

if TYPE_CHECKING:
    from collections.abc import Iterable

    from hazard_aggregator.areas.node_report import NodeReport

_LABELS: Final = ["area", "node"]
UNKNOWN = Gauge("fognav_node_unknown", "1 while nothing is known from a node or source", _LABELS)
SILENCE = Gauge("fognav_node_silence_seconds", "Time since the last reading of a node or source", _LABELS)
FLAPPING = Gauge("fognav_node_flapping", "1 while a node or source changes too often to be believed", _LABELS)


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
