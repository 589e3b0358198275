"""A drive by real processes, on a simulated robot (live) or on a real one (hardware): its record. Pure."""

from __future__ import annotations

from typing import Final, Literal

import msgspec

from fognav_experiments.comparison.driven import ComparedDrive, drive_name

Kind = Literal["live", "hardware"]
KINDS: Final[tuple[Kind, ...]] = ("live", "hardware")
ROBOTS_PROCESSES: Final = ("robot-agent", "robot-guardian", "robot-watchdog")
"""The processes that run on the robot."""


class MeasuredDrive(ComparedDrive, frozen=True, kw_only=True):
    """One drive by real processes, whose clock runs `speed` times as fast as real time.

    Distance and areas are those of the simulator's ground truth, with a real robot those of its own poses.
    `cpu_percent`: mean share (%) of one core that each process took, per second of the system's clock. `peak_mb`: its
    largest resident memory (MB), sampled once a second. `cpu_quota`: share of one core that the robot's processes had
    together; None without a limit. `asked_speed`: that of the command, from which `speed` differs where the machine
    could not sustain it. `restarts`: processes that died. `barrier_at_m`: distance (m) driven when a person said that
    the barrier stands.
    """

    kind: Kind
    plans: int
    cpu_percent: dict[str, float] = msgspec.field(default_factory=dict)
    peak_mb: dict[str, float] = msgspec.field(default_factory=dict)
    cpu_quota: float | None = None
    speed: float = 1.0
    asked_speed: float = 1.0
    restarts: int = 0
    barrier_at_m: float | None = None

    @property
    def name(self) -> str:
        """Name of the record's file, without suffix."""
        return drive_name(self.run, self.route, self.setup, self.cpu_quota, self.asked_speed)

    @property
    def in_lockstep(self) -> str | None:
        """Name of the drive in lockstep that it repeats; None under a quota, which lockstep does not have."""
        return drive_name(self.run, self.route, self.setup) if self.cpu_quota is None else None

    def robots_peak_mb(self) -> float | None:
        """Return the sum (MB) of the largest memories of the robot's processes; None if they were not measured."""
        return sum(self.peak_mb.get(name, 0.0) for name in ROBOTS_PROCESSES) if self.peak_mb else None
