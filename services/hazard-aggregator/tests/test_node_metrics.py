"""What Prometheus is told of each node: unknown, silent, flapping; nothing of a node that is gone."""

import pytest
from prometheus_client import REGISTRY

from hazard_aggregator.areas.node_report import NodeReport
from hazard_aggregator.node_metrics import NodeMetrics


def report(node, state="clear", age=0.1, *, flapping=False) -> NodeReport:
    return NodeReport(node, "hall", state, "", online=True, age=age, received=9, ignored=0, flapping=flapping)


def metric(name: str, node: str) -> float | None:
    return REGISTRY.get_sample_value(f"fognav_node_{name}", {"area": "hall", "node": node})


@pytest.fixture
def metrics():
    shown = NodeMetrics()
    yield shown
    shown.show(())


def test_node_is_unknown_silent_or_flapping(metrics):
    metrics.show([report("n1"), report("n2", "unknown", 40.0), report("n3", "unknown", flapping=True)])
    found = [[metric(name, node) for name in ("unknown", "silence_seconds", "flapping")] for node in ("n1", "n2", "n3")]
    assert found == [[0, 0.1, 0], [1, 40.0, 0], [1, 0.1, 1]]


def test_node_without_a_reading_has_no_silence(metrics):
    metrics.show([report("n1", "unknown", None)])
    assert (metric("unknown", "n1"), metric("silence_seconds", "n1")) == (1, None)
    metrics.show(())
    assert metric("unknown", "n1") is None


def test_node_without_a_reading_since_its_definition_changed_has_no_silence_any_more(metrics):
    metrics.show([report("n1", age=0.1), report("n2", age=0.2)])
    for _ in range(2):
        metrics.show([report("n1", "unknown", None), report("n2", age=0.3)])
        assert [metric("silence_seconds", node) for node in ("n1", "n2")] == [None, 0.3]
        assert metric("unknown", "n1") == 1
    metrics.show([report("n1", age=0.4)])
    assert metric("silence_seconds", "n1") == 0.4


def test_metrics_of_a_node_that_is_gone_are_removed(metrics):
    metrics.show([report("n1"), report("n2")])
    metrics.show([report("n2")])
    assert [metric(name, "n1") for name in ("unknown", "silence_seconds", "flapping")] == [None, None, None]
    assert metric("unknown", "n2") == 0
