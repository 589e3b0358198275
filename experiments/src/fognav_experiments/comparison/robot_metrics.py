"""What a robot's own exporter tells of its processes during a drive: CPU by process and thread, and memory.

The agent of a real robot serves them for Prometheus, and says in its state where; a simulated robot's does so, too. So
both are measured by the same means, and nothing else has to run on the robot.
"""

from __future__ import annotations

import asyncio
import http.client
import math
from collections import defaultdict
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from prometheus_client.parser import text_string_to_metric_families

from fognav_experiments.comparison.drives import UsageSample

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

SAMPLE_S: Final = 2.0
"""Time between two samples, s of the system's clock."""
_POLL_S: Final = 0.1
_TIMEOUT_S: Final = 1.0
_MOST_BYTES: Final = 1 << 20
_CPU: Final = "fognav_thread_cpu_seconds"
_MEMORY: Final = "fognav_process_resident_bytes"


class MetricsError(Exception):
    """A robot's metrics can't be read; the message says why, and what to do."""


class Reading(NamedTuple):
    """What an exporter told: CPU seconds by process and thread since their start, and resident memory (MB)."""

    cpu_s: Mapping[str, Mapping[str, float]]
    memory_mb: Mapping[str, float]


def read(address: str) -> Reading:
    """Read the metrics at `host:port`; blocks for a second at most. Raises `MetricsError`."""
    if not address:
        raise MetricsError(
            "the robot names no address of its metrics: let its agent listen where this computer reaches it "
            "(FOGNAV_HTTP_HOST in robot.env)"
        )
    try:
        connection = http.client.HTTPConnection(address, timeout=_TIMEOUT_S)
        try:
            connection.request("GET", "/metrics")
            text = connection.getresponse().read(_MOST_BYTES).decode("utf-8", "replace")
        finally:
            connection.close()
        found = parse(text)
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise MetricsError(f"the robot's metrics at {address} can't be read ({error}): open that port to it") from error
    if not found.cpu_s:
        raise MetricsError(f"http://{address}/metrics tells nothing of a robot's processes: is its agent there?")
    return found


def parse(text: str) -> Reading:
    """Return what a page of metrics tells of a robot's processes; raises `ValueError` for what is no such page."""
    cpu: dict[str, dict[str, float]] = defaultdict(dict)
    memory: dict[str, float] = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            process = f"robot-{sample.labels.get('process', '')}"
            if family.name == _CPU and sample.name.endswith("_total"):
                cpu[process][sample.labels["thread"]] = sample.value
            elif family.name == _MEMORY:
                memory[process] = sample.value / 1e6
    return Reading(cpu, memory)


class RobotUsage:
    """What a robot's processes took during one drive, of readings at times (s) of the system's clock."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all readings: another drive begins."""
        self._begun = self._at = 0.0
        self._last: Reading | None = None
        self._used: dict[str, dict[str, float]] = {}
        self._peak: dict[str, float] = {}
        self._samples: list[UsageSample] = []

    def add(self, now: float, reading: Reading) -> None:
        """Count what was used since the last reading; the first one is the baseline."""
        if self._last is None:
            self._begun = now
        elif now > self._at:
            shares: dict[str, dict[str, float]] = {}
            for process, threads in reading.cpu_s.items():
                before, used = self._last.cpu_s.get(process, {}), self._used.setdefault(process, {})
                for thread, seconds in threads.items():
                    since = seconds - before.get(thread, 0.0)
                    since = seconds if since < 0.0 else since  # the process was started again
                    used[thread] = used.get(thread, 0.0) + since
                    shares.setdefault(process, {})[thread] = round(100.0 * since / (now - self._at), 2)
            at, memory = round(now - self._begun, 1), {name: round(mb, 1) for name, mb in reading.memory_mb.items()}
            self._samples.append(UsageSample(at=at, cpu_percent=shares, memory_mb=memory))
        for process, mb in reading.memory_mb.items():
            self._peak[process] = max(mb, self._peak.get(process, 0.0))
        self._at, self._last = now, reading

    def fields(self) -> dict[str, Any]:
        """Return what a record holds of it; nothing below two readings."""
        seconds = self._at - self._begun
        if seconds <= 0.0:
            return {}
        threads = {
            process: {thread: round(100.0 * used / seconds, 2) for thread, used in sorted(found.items())}
            for process, found in self._used.items()
        }
        return {
            "cpu_percent": {process: round(100.0 * sum(t.values()) / seconds, 2) for process, t in self._used.items()},
            "thread_percent": threads,
            "peak_mb": {process: round(mb, 1) for process, mb in self._peak.items()},
            "samples": self._samples,
        }


async def watch(
    usage: RobotUsage, address: Callable[[], str | None], now: Callable[[], float], tell: Callable[[str], None]
) -> None:
    """Read a robot's exporter every `SAMPLE_S` until it is cancelled.

    `address`: where it is now; None while there is nothing to measure. `tell` is called once with what is wrong if it
    can't be read; it is tried again all the same.
    """
    last, told = -math.inf, False
    while True:
        # The clock of a demonstration that starts again more slowly is another one.
        if abs(now() - last) >= SAMPLE_S and (asked := address()) is not None:
            last = now()
            try:
                reading = await asyncio.to_thread(read, asked)
            except MetricsError as error:
                if not told:
                    tell(f"CPU and memory of this drive are not measured: {error}")
                told = True
            else:
                usage.add(now(), reading)
        await asyncio.sleep(_POLL_S)
