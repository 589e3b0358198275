"""Prometheus metrics that all processes share; CPU and memory come from prometheus-client's process collector."""

from collections.abc import Collection
from typing import Final

from prometheus_client import (
    CONTENT_TYPE_LATEST,
    REGISTRY,
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    Info,
    generate_latest,
)

from fog_contracts.messages import Trace
from fog_contracts.stages import SPANS, durations_s
from fog_runtime.version import VERSION

STAGE_SECONDS: Final = Histogram(
    "fognav_stage_seconds",
    "Duration of one stage of a hazard's way, from the first disagreeing reading to the wheels",
    ["stage"],
    buckets=(0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0),
)
TRACE_SKEW: Final = Counter(
    "fognav_trace_skew_total",
    "Stages whose end is stamped before their beginning: clocks of two hosts differ",
    ["stage"],
)
REFUSED: Final = Counter("fognav_refused_messages_total", "Messages that broke their channel's contract", ["channel"])
RECEIVED: Final = Counter("fognav_received_messages_total", "Messages taken from a channel", ["channel"])
PUBLISHED: Final = Counter("fognav_published_messages_total", "Messages given to a channel", ["channel"])
DROPPED: Final = Counter(
    "fognav_dropped_messages_total", "Messages that could not be sent because the connection was down", ["channel"]
)
HANDLER_ERRORS: Final = Counter(
    "fognav_handler_errors_total", "Messages whose handler raised an exception: a bug in this process", ["channel"]
)
BUILD: Final = Info("fognav_build", "Which code runs: its version")
BUILD.info({"version": VERSION})
CONNECTED: Final = Gauge("fognav_connected", "Whether the connection is up (1) or down (0)", ["transport"])
CONNECTS: Final = Counter("fognav_connections_total", "Connections made, the first one included", ["transport"])


def observe_trace(trace: Trace, stages: Collection[str] = tuple(SPANS)) -> None:
    """Take a trace's finished `stages` into the histogram; stages with a stamp missing are left out.

    Each process observes the stages that it completes, so that none counts twice.
    """
    for stage, seconds in durations_s(trace, {stage: SPANS[stage] for stage in stages}).items():
        if seconds < 0.0:
            TRACE_SKEW.labels(stage).inc()
        else:
            STAGE_SECONDS.labels(stage).observe(seconds)


def exposition(registry: CollectorRegistry = REGISTRY) -> tuple[bytes, str]:
    """Return the metrics in Prometheus's text format, and their content type."""
    return generate_latest(registry), CONTENT_TYPE_LATEST
