"""What a demonstration asks of this machine: the usage of its processes, and whether the speed is sustained.

At a speed that the machine can't sustain, the processes miss their periods and limits although the system works
correctly; the demonstration then starts again more slowly. Speed 1 is never lowered. See
docs/adr/0008-what-excuses-a-demo.md.
"""

import contextlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import psutil

from fog_contracts.messages import RobotState, SimTruth
from fognav_sim.drive.drive import DriveOutcome


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


MAX_LATE_CHECKS: Final = 2
"""After this many consecutive checks with late processes the attempt is given up."""
MIN_SPEED_SHARE: Final = 0.93
"""Share of the requested speed that the simulator must sustain."""
MAX_LATE_CYCLES_PER_S: Final = 3.0
"""Late cycles per second of the agent's loops (25 are due) above which it can't keep up."""
SPEED_FACTOR: Final = 0.7


class TooFastError(Exception):
    """The machine can't sustain the requested speed; `sustained` is the speed of the simulator."""

    def __init__(self, sustained: float, reason: str) -> None:
        super().__init__(reason)
        self.sustained = sustained

    def lower(self, speed: float) -> float:
        """Return the speed to try next after `speed`."""
        return max(1.0, round(min(speed * SPEED_FACTOR, self.sustained), 1))


class SpeedWatch:
    """Monitors one attempt at a speed. `stops` are the stops of the drive without a cause in its scenario."""

    def __init__(self, speed: float) -> None:
        self._speed = speed
        self._late_checks = 0
        self._late_cycles = 0
        self._stops_seen = 0
        self._sustained: list[float] = []

    @property
    def sustained(self) -> float | None:
        """Mean of the simulator's speeds, None before the first check."""
        return round(sum(self._sustained) / len(self._sustained), 2) if self._sustained else None

    def check(
        self, elapsed_s: float, truth: SimTruth, state: RobotState, stops: Sequence[str], *, entered_blocked: bool
    ) -> None:
        """Check the time since the last check, `elapsed_s` (s of the clock).

        Raises `TooFastError` if the processes were late in several checks in a row, or late while the robot stopped;
        never if the robot has entered a blocked area.
        """
        self._sustained.append(truth.sustained_speed)
        new_late = max(0, state.loop.late - self._late_cycles)
        self._late_cycles = state.loop.late
        slow = truth.sustained_speed < MIN_SPEED_SHARE * self._speed
        late = new_late / elapsed_s > MAX_LATE_CYCLES_PER_S
        self._late_checks = self._late_checks + 1 if slow or late else 0
        new_stops, self._stops_seen = stops[self._stops_seen :], len(stops)
        stopped = bool(new_stops) and (slow or new_late > 0)
        if self._speed > 1.0 and not entered_blocked and (stopped or self._late_checks >= MAX_LATE_CHECKS):
            reason = (
                f"{truth.sustained_speed:.2f} sustained, {new_late} of the agent's cycles late in {elapsed_s:.0f} s"
            )
            raise TooFastError(truth.sustained_speed, "; ".join([reason, *(new_stops if stopped else [])]))

    def check_outcome(
        self,
        outcome: DriveOutcome,
        truth: SimTruth | None,
        stops: Sequence[str],
        *,
        entered_blocked: bool,
        hazard_placed: bool,
    ) -> None:
        """Raise `TooFastError` if the speed caused the outcome, not the robot.

        This holds for a drive that failed while processes were late, and for one that reached its goal but stopped
        without a cause in its scenario. Contact or a blocked area entered is never excused: what stops the robot must
        work at any speed. A stop alone excuses neither a drive that failed nor one without its hazard
        (`hazard_placed`).
        """
        if self._speed <= 1.0 or entered_blocked or outcome.kind == "contact":
            return
        sustained = truth.sustained_speed if truth is not None else 1.0
        if outcome.kind == "reached":
            if stops and hazard_placed:
                raise TooFastError(sustained, f"the robot reached its goal, but stopped before: {'; '.join(stops)}")
        elif self._late_checks:
            raise TooFastError(sustained, f"{outcome.kind}: {outcome.reason}")
