"""A drive by real processes, on a simulated robot (live) or on a real one (hardware): its record. Pure."""

from __future__ import annotations

from typing import Final, Literal

import msgspec

from fog_contracts.messages import ProfileName  # read at run time, when a file is decoded

Kind = Literal["live", "hardware"]
KINDS: Final[tuple[Kind, ...]] = ("live", "hardware")
ROBOTS_PROCESSES: Final = ("robot-agent", "robot-guardian", "robot-watchdog")
"""The processes that run on the robot."""


class MeasuredDrive(msgspec.Struct, frozen=True, kw_only=True):
    """One drive; lengths in m, times in s of the system's clock, which runs `speed` times as fast as real time.

    Distance and areas are those of the simulator's ground truth, with a real robot those of its own poses.
    `cpu_percent`: mean share (%) of one core that each process took, per second of the system's clock. `peak_mb`: its
    largest resident memory (MB), sampled once a second. `cpu_quota`: share of one core that the robot's processes had
    together; None without a limit. `asked_speed`: that of the command, from which `speed` differs where the machine
    could not sustain it. `restarts`: processes that died. `load`: the machine's load average at the end.
    """

    kind: Kind
    setup: ProfileName
    run: int
    route: str
    seed: int
    area: str
    moment: str
    trigger_m: float
    outcome: str
    reason: str
    success: bool
    distance_m: float
    time_s: float | None
    plans: int
    paths: int
    modes: dict[str, int]
    stops: list[str]
    route_areas: list[str]
    min_clearance_m: float | None = None
    cpu_percent: dict[str, float] = {}
    peak_mb: dict[str, float] = {}
    cpu_quota: float | None = None
    speed: float = 1.0
    asked_speed: float = 1.0
    restarts: int = 0
    load: float = 0.0
    version: str = ""
    commit: str = ""

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


def drive_name(run: int, route: str, setup: str, cpu_quota: float | None = None, speed: float = 1.0) -> str:
    """Return the name of a drive's record; without a quota and in real time the same as that in lockstep."""
    quota = "" if cpu_quota is None else f"-quota{cpu_quota:g}"
    return f"{run:04}-{route}-{setup}{quota}" + ("" if speed == 1.0 else f"-speed{speed:g}")
