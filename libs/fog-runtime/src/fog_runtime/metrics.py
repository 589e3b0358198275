"""Prometheus metrics common to all processes; CPU and memory come from prometheus-client's process collector."""

import math
import shutil
from collections.abc import Collection
from pathlib import Path
from typing import Final, Literal

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
from fog_runtime.version import REVISION, VERSION

STAGE_SECONDS: Final = Histogram(
    "fognav_stage_seconds",
    "Duration of a stage between a hazard's first reading and the first wheel command",
    ["stage"],
    buckets=(0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0),
)
TRACE_SKEW: Final = Counter(
    "fognav_trace_skew_total",
    "Stages that end before they begin by their stamps, because the clocks of two hosts differ",
    ["stage"],
)
REFUSED: Final = Counter(
    "fognav_refused_messages_total", "Messages refused because they violate their channel's contract", ["channel"]
)
UNPUBLISHABLE: Final = Counter(
    "fognav_unpublishable_messages_total",
    "Messages not published because they violate their channel's contract: too large, mostly",
    ["channel"],
)
RECEIVED: Final = Counter("fognav_received_messages_total", "Messages received and decoded", ["channel"])
PUBLISHED: Final = Counter("fognav_published_messages_total", "Messages published", ["channel"])
BYTES: Final = Counter(
    "fognav_bytes_total",
    "Bytes of zenoh messages, requests and replies, without keys and headers; direction: sent, received",
    ["channel", "direction"],
)
DROPPED: Final = Counter(
    "fognav_dropped_messages_total",
    "Messages dropped without a connection, because a queue was full, or because zenoh failed to send them",
    ["channel"],
)
ANSWERED: Final = Counter("fognav_answered_queries_total", "Queries answered with a reply", ["channel"])
REPLY_SECONDS: Final = Histogram(
    "fognav_reply_encoding_seconds",
    "Time to make a long reply (a snapshot of the map), away from the event loop; once per version, shared by all",
    ["channel"],
    buckets=(0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0),
)
HANDLER_ERRORS: Final = Counter(
    "fognav_handler_errors_total", "Messages whose handler raised an exception, which is a bug", ["channel"]
)
BUILD: Final = Info("fognav_build", "Which code runs: its version, and its revision if that is known")
BUILD.info({"version": VERSION, "revision": REVISION})
CONDITION: Final = Gauge(
    "fognav_condition", "Whether a condition of readiness is met (1) or not (0), as /readyz describes it", ["condition"]
)
DISK_FREE: Final = Gauge("fognav_disk_free_bytes", "Free space of the disk that holds this folder", ["folder"])
DISK_SIZE: Final = Gauge("fognav_disk_size_bytes", "Size of the disk that holds this folder", ["folder"])
LAST_BACKUP: Final = Gauge(
    "fognav_last_backup_seconds", "When this folder's last backup was made (s since the epoch); 0: never", ["folder"]
)
CONNECTED: Final = Gauge("fognav_connected", "Whether the connection is up (1) or down (0)", ["transport"])
CONNECTIONS: Final = Counter("fognav_connections_total", "Connections established", ["transport"])


def count_bytes(channel: str, direction: Literal["sent", "received"], size: int) -> None:
    """Count the bytes of a payload."""
    BYTES.labels(channel, direction).inc(size)


class Traffic:
    """The messages and bytes of one channel in one direction, counted by one call: `labels` costs as much as `inc`."""

    def __init__(self, channel: str, direction: Literal["sent", "received"]) -> None:
        """Export both counters of the channel from now on."""
        self._bytes = BYTES.labels(channel, direction)
        self._messages = (PUBLISHED if direction == "sent" else RECEIVED).labels(channel)

    def count(self, size: int) -> None:
        """Count a message of `size` bytes that was sent."""
        self._messages.inc()
        self._bytes.inc(size)

    def count_size(self, size: int) -> None:
        """Count the bytes of a message that came, whatever it turns out to be."""
        self._bytes.inc(size)

    def count_message(self) -> None:
        """Count a message that came, once it was decoded."""
        self._messages.inc()


def watch_disk(folder: Path) -> None:
    """Export size and free space of the disk that holds the folder, as they are when Prometheus asks."""
    DISK_FREE.labels(str(folder)).set_function(lambda: _disk(folder)[1])
    DISK_SIZE.labels(str(folder)).set_function(lambda: _disk(folder)[0])


def watch_backup(stamp: Path) -> None:
    """Export when the last backup of the stamp's folder was made, which is when this file was written.

    A label keeps processes that watch none from exporting "never": without one, the metric would begin with its import.
    """
    LAST_BACKUP.labels(str(stamp.parent)).set_function(lambda: stamp.stat().st_mtime if stamp.exists() else 0.0)


def _disk(folder: Path) -> tuple[float, float]:
    """Return size and free space (bytes); not-a-number, which no rule takes for a value, while it can't be asked."""
    try:
        usage = shutil.disk_usage(folder)
    except OSError:
        return math.nan, math.nan
    return float(usage.total), float(usage.free)


def expect_stages(stages: Collection[str]) -> None:
    """Export the stages that a process completes from its start on: a rate needs a value before the first event."""
    for stage in stages:
        STAGE_SECONDS.labels(stage)
        TRACE_SKEW.labels(stage)


def expect_messages(channel: str) -> None:
    """Export from now on, for a channel with a handler, what `increase` must see grow from 0: errors and refusals."""
    HANDLER_ERRORS.labels(channel)
    REFUSED.labels(channel)


def observe_trace(trace: Trace, stages: Collection[str] = tuple(SPANS)) -> None:
    """Add the durations of a trace's `stages` to the histogram, without those that lack a stamp.

    Each process observes the stages that it completes, so that each is counted once.
    """
    for stage, seconds in durations_s(trace, {stage: SPANS[stage] for stage in stages}).items():
        if seconds < 0.0:
            TRACE_SKEW.labels(stage).inc()
        else:
            STAGE_SECONDS.labels(stage).observe(seconds)


def exposition(registry: CollectorRegistry = REGISTRY) -> tuple[bytes, str]:
    """Return the metrics in Prometheus's text format, and their content type."""
    return generate_latest(registry), CONTENT_TYPE_LATEST
