"""The metrics of a robot, made when Prometheus asks: its three processes, its computer, and what the agent knows.

What Linux tells of a process and its computer is CPU time of each thread, memory, temperatures, throttling and Wi-Fi.
What does not exist is missing, and never 0: a base without a battery sensor, a computer without Wi-Fi, a pose that is
not known.
"""

from __future__ import annotations

import math
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.registry import Collector

from fog_contracts import channels as ch
from fog_contracts.messages import Power, RobotVitals

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from prometheus_client.core import Metric

    from fog_contracts.messages import RobotState
    from robot_agent.localization.pose import Uncertainty

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


def cpu_seconds(pid: int) -> float | None:
    """Return the CPU time (s) of all threads of a process since its start; None if it has ended.

    One system call, where `sample` reads three files for each thread. The clock's id is made of the process's: Linux,
    clock_getcpuclockid(3).
    """
    try:
        return time.clock_gettime(~pid << 3 | 2)
    except OSError:
        return None


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
VITALS_S: Final = ch.ROBOT_VITALS.period_s - 0.1
"""Period of vitals; a little less, since the seconds at which they are asked for are not quite even."""
_THROTTLED: Final = "sys/devices/platform/soc*/soc*:firmware/get_throttled"
"""Up to the Raspberry Pi 4 `soc`; `soc@107c000000` on a Raspberry Pi 5, where not every kernel has the file."""
_SUPPLY_MONITOR: Final = "rpi_volt"
"""The name of the kernel's monitor of a Raspberry Pi's supply (raspberrypi-hwmon): it tells of the last two seconds."""
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
    """Return, by cause, whether a Raspberry Pi is slowed down now; empty on other computers.

    Where the kernel does not pass on what the firmware reports, under-voltage alone is known.
    """
    for file in root.glob(_THROTTLED):
        if (bits := _number(_text(file), 16)) is not None:
            return {cause: bool(bits >> bit & 1) for bit, cause in enumerate(_CAUSES)}
    for monitor in (root / "sys/class/hwmon").glob("hwmon*"):
        if _text(monitor / "name") == _SUPPLY_MONITOR:
            alarm = _number(_text(monitor / "in0_lcrit_alarm"), 10)
            return {} if alarm is None else {_CAUSES[0]: bool(alarm)}
    return {}


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


class Observed(NamedTuple):
    """What the agent knew at its last report, once a second.

    map_age: s since the map was last confirmed (None: there is none). uncertainty: None while the pose is not known.
    corrupted: damaged frames by the port on which they came. incomplete scans and the rest are counters of their own.
    """

    state: RobotState
    map_age: float | None
    particles: int
    uncertainty: Uncertainty | None
    corrupted: Mapping[str, int]


class RobotCollector(Collector):
    """Collects on the thread that serves the metrics; the agent's loop only replaces `observed` and `pids`."""

    def __init__(self, root: Path = ROOT) -> None:
        """`root` is where the computer's /proc and /sys are."""
        self._root = root
        self.observed: Observed | None = None
        self.pids: Mapping[str, int] = {}
        """Process ids by name: those of the robot's processes that run."""
        self._used: dict[int, float] = {}
        self._sampled_at = -math.inf

    def vitals(self, now: float, stamp: float) -> RobotVitals | None:
        """Return what the processes took since the last time, when that is due; None at first.

        `now` is monotonic, in real seconds.
        """
        before, seconds = self._used, now - self._sampled_at
        if seconds < VITALS_S:
            return None
        used = {pid: taken for pid in self.pids.values() if (taken := cpu_seconds(pid)) is not None}
        self._used, self._sampled_at = used, now
        cpu = {
            name: round(100.0 * (used[pid] - before[pid]) / seconds, 2)
            for name, pid in self.pids.items()
            if pid in used and pid in before
        }
        levels = wifi_levels(self._root)
        return RobotVitals(cpu=cpu, wifi_dbm=max(levels.values(), default=None), stamp=stamp) if cpu else None

    def describe(self) -> Iterable[Metric]:
        """Describe nothing, so that registering collects nothing."""
        return ()

    def collect(self) -> Iterable[Metric]:
        """Return all metrics that have a value now."""
        families = [*self._processes(), *self._computer()]
        if (observed := self.observed) is not None:
            families += [*_agent(observed), *_power(observed.state)]
        return [family for family in families if family.samples]

    def _processes(self) -> list[Metric]:
        cpu = CounterMetricFamily(
            "fognav_thread_cpu_seconds_total", "CPU time of a process's threads", labels=["process", "thread"]
        )
        wakeups = CounterMetricFamily(
            "fognav_process_wakeups_total",
            "How often the threads of a process waited and were woken",
            labels=["process"],
        )
        memory = GaugeMetricFamily(
            "fognav_process_resident_bytes", "Memory that a process keeps resident", labels=["process"]
        )
        for process, pid in self.pids.items():
            threads = sample(pid, self._root / "proc").values()
            seconds: dict[str, float] = {}
            for thread in threads:
                seconds[thread.name] = seconds.get(thread.name, 0.0) + thread.cpu_s
            for name, used in seconds.items():
                cpu.add_metric([process, name], used)
            if threads:
                wakeups.add_metric([process], sum(thread.wakeups for thread in threads))
                memory.add_metric([process], 1e6 * memory_mb(pid, self._root / "proc"))
        return [cpu, wakeups, memory]

    def _computer(self) -> list[Metric]:
        root = self._root
        return [
            _by_label(
                "fognav_computer_celsius",
                "Temperature inside the robot's computer",
                "zone",
                temperatures(root),
            ),
            _by_label("fognav_computer_throttled", "1 while this slows the computer down", "cause", throttling(root)),
            _by_label("fognav_wifi_level_dbm", "Strength of the Wi-Fi signal", "interface", wifi_levels(root)),
        ]


def _agent(observed: Observed) -> list[Metric]:
    state, spread = observed.state, observed.uncertainty
    sigmas = {} if spread is None else {"along": spread.along, "across": spread.across}
    version = {"epoch": state.map_epoch, "seq": state.map_seq} if observed.map_age is not None else {}
    late = CounterMetricFamily(
        "fognav_late_stops_total", "Protective stops that a delay of the computer alone explains"
    )
    late.add_metric([], state.loop.late_stops)
    errors = CounterMetricFamily(
        "fognav_serial_errors_total", "Damaged frames that came on a serial port", labels=["port"]
    )
    for port, count in observed.corrupted.items():
        errors.add_metric([port], count)
    return [
        _by_label("fognav_robot_mode", "1 for the mode that the robot is in", "mode", {state.mode: 1}),
        _by_label(
            "fognav_robot_reason", "1 for each reason of the mode", "reason", dict.fromkeys(state.codes, 1)
        ),
        _by_label(
            "fognav_robot_base_fault",
            "1 for the fault that the guardian has latched", "fault", {state.base_fault: 1} if state.base_fault else {},
        ),
        _by_label("fognav_robot_map_version", "Version of the robot's map", "part", version),
        _single("fognav_robot_map_age_seconds", "Time since the robot's map was last confirmed", observed.map_age),
        _single("fognav_particles", "Particles of the localization", observed.particles or None),
        _by_label(
            "fognav_pose_sigma_meters",
            "Standard deviation of the position, in its least and its most certain direction", "direction", sigmas,
        ),
        _single(
            "fognav_pose_sigma_radians", "Standard deviation of the heading", None if spread is None else spread.heading
        ),
        late,
        errors,
    ]  # fmt: skip


def _power(state: RobotState) -> list[Metric]:
    power = state.power or Power()
    charging = {} if power.charging is None else {str(power.charging): 1}
    return [
        _single("fognav_battery_charge_ratio", "Charge of the robot's battery over its capacity", state.battery),
        _single("fognav_battery_volts", "Voltage of the robot's battery", power.voltage_v),
        _single(
            "fognav_battery_amperes",
            "Current into the robot's battery; negative while it discharges", power.current_a,
        ),
        _single("fognav_battery_celsius", "Temperature of the robot's battery", power.temperature_c),
        _by_label("fognav_battery_charging", "1 for what the charger does", "state", charging),
        _by_label(
            "fognav_proximity_strength", "Strength of a light sensor, 0 to 4095, 0 at the left", "sensor",
            {str(number): strength for number, strength in enumerate(state.proximity)},
        ),
    ]  # fmt: skip


def _single(name: str, text: str, value: float | None) -> Metric:
    family = GaugeMetricFamily(name, text)
    if value is not None:
        family.add_metric([], value)
    return family


def _by_label(name: str, text: str, label: str, values: Mapping[str, float]) -> Metric:
    family = GaugeMetricFamily(name, text, labels=[label])
    for key, value in values.items():
        family.add_metric([key], value)
    return family


def parent(pid: int, root: Path = ROOT) -> int | None:
    """Return the id of the process that started this one; None if it has ended."""
    try:
        # The name before it may contain anything, even brackets.
        return int((root / f"proc/{pid}/stat").read_text("utf-8", "replace").rpartition(")")[2].split()[1])
    except (OSError, IndexError, ValueError):
        return None
