"""What Linux tells of a process and its computer: CPU time of each thread, memory, temperatures, throttling, Wi-Fi.

Every function on the computer returns only what this computer has: a missing sensor is no value, and never 0.
"""

from __future__ import annotations

import threading
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

    Samples = Mapping[int, "ThreadSample"]

PROC = Path("/proc")


class ThreadSample(NamedTuple):
    """What one thread has used since its start."""

    name: str
    cpu_s: float
    wakeups: int
    """How often it waited and was woken: voluntary context switches."""


@dataclass(frozen=True)
class ProcessUsage:
    """What a process used in a period; percents are of one core."""

    cpu_percent: float
    wakeups_per_s: float
    threads: dict[str, float]
    """CPU percent by the name of the thread; threads of one name are summed up."""


def sample(pid: int, proc: Path = PROC) -> dict[int, ThreadSample]:
    """Return a sample of each thread of a process, by thread id; none if it has ended.

    The scheduler's own nanoseconds (`schedstat`), because the usual ticks of 10 ms hide threads that cost less.
    """
    samples = {}
    for folder in (proc / str(pid) / "task").glob("*"):
        try:
            name = (folder / "comm").read_text("utf-8", "replace").strip()
            nanoseconds = int((folder / "schedstat").read_text("ascii").split()[0])
            switches = _status_field(folder / "status", "voluntary_ctxt_switches")
        except (FileNotFoundError, ProcessLookupError):
            continue  # the thread has just ended
        samples[int(folder.name)] = ThreadSample(name, nanoseconds / 1e9, switches)
    return samples


def name_thread(name: str, proc: Path = PROC) -> None:
    """Give the calling thread a name of at most 15 characters in the system's list, where it is `python` otherwise.

    Does nothing where /proc can't be written, which only leaves the thread without its name.
    """
    with suppress(OSError):
        (proc / "self" / "task" / str(threading.get_native_id()) / "comm").write_text(name, "ascii")


def usage(before: Samples, after: Samples, seconds: float) -> ProcessUsage:
    """Return the usage between two samples that lie `seconds` apart; threads that ended in between are left out."""
    cpu: dict[str, float] = {}
    wakeups = 0
    for thread, last in after.items():
        first = before.get(thread, ThreadSample(last.name, 0.0, 0))
        cpu[last.name] = cpu.get(last.name, 0.0) + last.cpu_s - first.cpu_s
        wakeups += last.wakeups - first.wakeups
    return ProcessUsage(
        cpu_percent=100.0 * sum(cpu.values()) / seconds,
        wakeups_per_s=wakeups / seconds,
        threads={name: 100.0 * used / seconds for name, used in sorted(cpu.items(), key=lambda item: -item[1])},
    )


def memory_mb(pid: int, proc: Path = PROC) -> float:
    """Return the resident memory (MB) of a process; 0 if it has ended."""
    try:
        return _status_field(proc / str(pid) / "status", "VmRSS") * 1024 / 1e6
    except (FileNotFoundError, ProcessLookupError):
        return 0.0


def _status_field(file: Path, name: str) -> int:
    for line in file.read_text("utf-8", "replace").splitlines():
        key, _, value = line.partition(":")
        if key == name:
            return int(value.split()[0])
    return 0


ROOT: Final = Path("/")
_THROTTLED: Final = "sys/devices/platform/soc/soc:firmware/get_throttled"
_CAUSES: Final = ("under_voltage", "frequency_capped", "throttled", "soft_temperature_limit")
"""Bits 0 to 3 of what the Raspberry Pi's firmware reports: what holds now. Source: its documentation of vcgencmd."""
_LEVEL_COLUMN: Final = 3


def temperatures(root: Path = ROOT) -> dict[str, float]:
    """Return the temperature (degrees Celsius) of each thermal zone, by its type."""
    found = {}
    for zone in sorted((root / "sys/class/thermal").glob("thermal_zone*")):
        kind, value = _text(zone / "type"), _number(_text(zone / "temp"), 10)
        if kind and value is not None:
            found[kind] = value / 1000.0
    return found


def throttling(root: Path = ROOT) -> dict[str, bool]:
    """Return, by cause, whether a Raspberry Pi is slowed down now; empty on other computers."""
    bits = _number(_text(root / _THROTTLED), 16)
    return {} if bits is None else {cause: bool(bits >> bit & 1) for bit, cause in enumerate(_CAUSES)}


def wifi_levels(root: Path = ROOT) -> dict[str, float]:
    """Return the signal level (dBm) of each wireless interface that is connected."""
    found = {}
    for line in _text(root / "proc/net/wireless").splitlines():
        name, colon, rest = line.partition(":")
        columns = rest.split()
        if colon and len(columns) > _LEVEL_COLUMN - 1:
            level = columns[_LEVEL_COLUMN - 1].rstrip(".")
            if level.lstrip("-").isdigit():
                found[name.strip()] = float(level)
    return found


def _text(file: Path) -> str:
    try:
        return file.read_text("utf-8", "replace").strip()
    except OSError:
        return ""


def _number(text: str, base: int) -> int | None:
    try:
        return int(text, base)
    except ValueError:
        return None
