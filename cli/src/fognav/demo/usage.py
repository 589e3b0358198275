"""CPU and memory usage of each process over a period."""

import contextlib
import time
from collections.abc import Mapping
from dataclasses import dataclass

import psutil


@dataclass
class _ProcessUsage:
    pid: int
    process: psutil.Process
    cpu_s: float
    """CPU seconds up to the last sample, summed over all processes that had this name."""
    last_cpu_s: float
    rss_mb: float = 0.0
    recent_percent: float = 0.0


def _cpu_seconds(process: psutil.Process) -> float:
    times = process.cpu_times()
    return times.user + times.system


class Usage:
    """Samples processes by name; a restarted process keeps its name."""

    def __init__(self) -> None:
        self._used: dict[str, _ProcessUsage] = {}
        self._started_at: float | None = None
        self._sampled = 0.0

    def sample(self, pids: Mapping[str, int]) -> None:
        """Sample all processes; the first sample of a name is its baseline."""
        now = time.monotonic()
        elapsed = now - self._sampled
        for name, pid in pids.items():
            # A process may end between its listing and the sample.
            with contextlib.suppress(psutil.NoSuchProcess, psutil.AccessDenied):
                self._sample_one(name, pid, elapsed)
        self._started_at = now if self._started_at is None else self._started_at
        self._sampled = now

    def _sample_one(self, name: str, pid: int, elapsed: float) -> None:
        used = self._used.get(name)
        if used is None or used.pid != pid:
            process = psutil.Process(pid)
            seconds = _cpu_seconds(process)
            counted = used.cpu_s if used is not None else 0.0
            used = self._used[name] = _ProcessUsage(pid, process, counted, seconds, used.rss_mb if used else 0.0)
        else:
            seconds = _cpu_seconds(used.process)
            used.cpu_s += seconds - used.last_cpu_s
            used.recent_percent = 100.0 * (seconds - used.last_cpu_s) / elapsed if elapsed > 0 else 0.0
            used.last_cpu_s = seconds
        used.rss_mb = max(used.rss_mb, used.process.memory_info().rss / 1e6)

    def restart(self) -> None:
        """Clear all samples: a new period begins."""
        self._used.clear()
        self._started_at = None

    def recent(self) -> dict[str, tuple[float, float]]:
        """Percent of one core since the previous sample, and peak resident memory (MB), by name."""
        return {name: (used.recent_percent, used.rss_mb) for name, used in self._used.items()}

    def report(self) -> dict[str, dict[str, float]]:
        """Mean percent of one core over the whole period, and peak resident memory (MB), by name."""
        elapsed = self._sampled - (self._started_at or 0.0)
        return {
            name: {
                "cpu_percent": round(100.0 * used.cpu_s / elapsed, 2) if elapsed > 0 else 0.0,
                "rss_mb": round(used.rss_mb, 1),
            }
            for name, used in self._used.items()
        }


def children(pid: int) -> list[int]:
    """Process ids of the children of a process; none if it has ended."""
    try:
        return [child.pid for child in psutil.Process(pid).children()]
    except psutil.NoSuchProcess:
        return []
