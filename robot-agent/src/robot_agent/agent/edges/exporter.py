"""The metrics of a robot, made when Prometheus asks: its three processes, its computer, and what the agent knows.

What does not exist is missing: a base without a battery sensor, a computer without Wi-Fi, a pose that is not known.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.registry import Collector

from fog_contracts.messages import Power
from fog_runtime import usage

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from prometheus_client.core import Metric

    from fog_contracts.messages import RobotState
    from robot_agent.localization.pose import Uncertainty


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

    def __init__(self, root: Path = usage.ROOT) -> None:
        """`root` is where the computer's /proc and /sys are."""
        self._root = root
        self.observed: Observed | None = None
        self.pids: Mapping[str, int] = {}
        """Process ids by name: those of the robot's processes that run."""

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
            threads = usage.sample(pid, self._root / "proc").values()
            seconds: dict[str, float] = {}
            for thread in threads:
                seconds[thread.name] = seconds.get(thread.name, 0.0) + thread.cpu_s
            for name, used in seconds.items():
                cpu.add_metric([process, name], used)
            if threads:
                wakeups.add_metric([process], sum(thread.wakeups for thread in threads))
                memory.add_metric([process], 1e6 * usage.memory_mb(pid, self._root / "proc"))
        return [cpu, wakeups, memory]

    def _computer(self) -> list[Metric]:
        root = self._root
        return [
            _by_label(
                "fognav_computer_celsius",
                "Temperature inside the robot's computer",
                "zone",
                usage.temperatures(root),
            ),
            _by_label(
                "fognav_computer_throttled", "1 while this slows the computer down", "cause", usage.throttling(root)
            ),
            _by_label("fognav_wifi_level_dbm", "Strength of the Wi-Fi signal", "interface", usage.wifi_levels(root)),
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


def parent(pid: int, root: Path = usage.ROOT) -> int | None:
    """Return the id of the process that started this one; None if it has ended."""
    try:
        # The name before it may contain anything, even brackets.
        return int((root / f"proc/{pid}/stat").read_text("utf-8", "replace").rpartition(")")[2].split()[1])
    except (OSError, IndexError, ValueError):
        return None
