"""Whether lockstep tells the truth: the same drives by real processes, compared within stated tolerances. Pure.

Noise is drawn as often as a process measures, and real processes are scheduled by the machine: no two live drives are
equal to the millimetre. What must agree is what an experiment is about.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from fognav_experiments.comparison.document import Block, Heading, Paragraph, Table
from fognav_experiments.comparison.measured import KINDS, ROBOTS_PROCESSES
from fognav_experiments.statistics import estimate

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fognav_experiments.comparison.measured import Kind, MeasuredDrive
    from fognav_experiments.comparison.records import Record

DISTANCE_M: Final = 1.5
DISTANCE_SHARE: Final = 0.03
TIME_S: Final = 6.0
TIME_SHARE: Final = 0.05
PATHS: Final = 1
STOPPING_MODES: Final = frozenset({"PROTECTIVE_STOP", "FAULT", "EGRESS"})
"""Modes that a drive has not by chance: a robot slows down here and there, and holds for a moment at its goal."""

_BY: Final[dict[Kind, tuple[str, str]]] = {
    "live": ("real processes", "brokers, sockets, threads and serial lines"),
    "hardware": ("a real robot", "as the thesis's figures 6.11 and 6.12 compare simulation and reality"),
}
"""By whom drives of a kind were repeated, and what that means."""


class Compared(NamedTuple):
    """A drive by real processes, the same one in lockstep, and in what they differ beyond the tolerances."""

    live: MeasuredDrive
    lockstep: Record
    differences: list[str]


def compare_drives(live: MeasuredDrive, lockstep: Record) -> Compared:
    """Compare a drive by real processes with the same one in lockstep."""
    found = []
    if live.outcome != lockstep.outcome:
        found.append(f"outcome {live.outcome} ({live.reason}), in lockstep {lockstep.outcome}")
    if abs(live.distance_m - lockstep.distance_m) > max(DISTANCE_M, DISTANCE_SHARE * lockstep.distance_m):
        found.append(f"{live.distance_m:.1f} m, in lockstep {lockstep.distance_m:.1f} m")
    if live.time_s is not None and lockstep.time_s is not None:
        if abs(live.time_s - lockstep.time_s) > max(TIME_S, TIME_SHARE * lockstep.time_s):
            found.append(f"{live.time_s:.1f} s, in lockstep {lockstep.time_s:.1f} s")
    elif live.time_s is not lockstep.time_s:
        found.append("only one of them ended")
    if abs(live.paths - lockstep.paths) > PATHS:
        found.append(f"{live.paths} paths followed, in lockstep {lockstep.paths}")
    if live.route_areas != lockstep.route_areas:
        found.append(f"through {_listed(live.route_areas)}, in lockstep through {_listed(lockstep.route_areas)}")
    if (stopped := _stopping(live.modes)) != (expected := _stopping(lockstep.modes)):
        found.append(f"was in {_listed(sorted(stopped))}, in lockstep in {_listed(sorted(expected))}")
    return Compared(live, lockstep, found)


def compared(live: Sequence[MeasuredDrive], lockstep: Sequence[Record]) -> list[Compared]:
    """Compare all drives of which there is one in lockstep, those under a quota left out."""
    known = {record.name: record for record in lockstep}
    found = ((drive, known.get(drive.in_lockstep or "")) for drive in live)
    return [compare_drives(drive, record) for drive, record in found if record is not None]


def agreement(drives: Sequence[MeasuredDrive], lockstep: Sequence[Record], begun_with: str = "") -> list[Block]:
    """Return the comparison as parts of the report, each with its heading: one per kind of drives, none without any.

    `begun_with`: the commit of the records in lockstep that name none.
    """
    by_kind = ([drive for drive in drives if drive.kind == kind] for kind in KINDS)
    return [block for found in by_kind for block in _agreement(found, lockstep, begun_with)]


def _agreement(live: Sequence[MeasuredDrive], lockstep: Sequence[Record], begun_with: str) -> list[Block]:
    pairs = compared(live, lockstep)
    if not pairs:
        return []
    equal = [_same_commit(pair.live.commit, pair.lockstep.commit or begun_with) for pair in pairs]
    same = all(equal)
    rows = [
        [
            pair.live.name, pair.live.commit or "-", pair.lockstep.commit or begun_with or "-", f"{pair.live.load:.1f}",
            f"{pair.live.distance_m:.1f}", f"{pair.lockstep.distance_m:.1f}",
            _seconds(pair.live.time_s), _seconds(pair.lockstep.time_s), f"{pair.live.paths}", f"{pair.lockstep.paths}",
            "; ".join(pair.differences) or "yes",
        ]
        for pair in pairs
    ]  # fmt: skip
    agreed = sum(not pair.differences for pair in pairs)
    speeds = sorted({pair.live.speed for pair in pairs})
    subject = f"{len(pairs)} of the drives" if same else f"The routes and seeds of {len(pairs)} drives"
    version = "" if same else f" and {'in part ' if any(equal) else ''}another version of the program"
    by, how = _BY[pairs[0].live.kind]
    return [
        Heading(f"The same {'drives' if same else 'routes and seeds'} by {by}"),
        Paragraph(
            f"{subject} were repeated by {by}{version}: {how}, "
            f"at {', '.join(f'{speed:g}' for speed in speeds)} times real time. {agreed} of them agree with lockstep "
            f"in outcome, in distance within {DISTANCE_M} m or {100 * DISTANCE_SHARE:.0f} %, in time within "
            f"{TIME_S:.0f} s or {100 * TIME_SHARE:.0f} %, in the number of paths within {PATHS}, in the watched areas "
            f"that the robot crossed, and in whether it was in one of the modes {_listed(sorted(STOPPING_MODES))}."
        ),
        Table(
            [
                "drive", "commit, live", "commit, lockstep", "load, live", "live, m", "lockstep, m", "live, s",
                "lockstep, s", "paths, live", "paths, lockstep", "agrees",
            ],
            rows,
        ),
    ]  # fmt: skip


def resources(drives: Sequence[MeasuredDrive]) -> list[Block]:
    """Return what the robot's processes cost, by setup, quota, speed and commit; nothing if no drive measured it."""
    measured = [drive for drive in drives if drive.cpu_percent and drive.peak_mb]
    rows = []
    for setup, quota, speed, commit in sorted({_circumstances(drive) for drive in measured}, key=str):
        chosen = [drive for drive in measured if _circumstances(drive) == (setup, quota, speed, commit)]
        shares = [_mean([drive.cpu_percent.get(name, 0.0) for drive in chosen]) for name in ROBOTS_PROCESSES]
        peaks = [max(drive.peak_mb.get(name, 0.0) for drive in chosen) for name in ROBOTS_PROCESSES]
        times = [drive.time_s for drive in chosen if drive.time_s is not None]
        loads = [drive.load for drive in chosen]
        rows.append([
            setup, "none" if quota is None else f"{quota:g} of a core", f"{speed:g}", commit or "-",
            f"{min(loads):.0f} to {max(loads):.0f}", str(len(chosen)),
            *(f"{share:.2f}" for share in shares), f"{sum(shares):.2f}",
            *(f"{peak:.0f}" for peak in peaks), f"{sum(peaks):.0f}", _seconds(_mean(times) if times else None),
        ])  # fmt: skip
    if not rows:
        return []
    names = [name.removeprefix("robot-") for name in ROBOTS_PROCESSES]
    return [
        Paragraph(
            "What the robot's processes took, by the kernel's account: mean share of one core, per second of the "
            "system's clock, and the largest resident memory of any drive. A quota limits all of them together to a "
            "share of one core, as control groups enforce it."
        ),
        Table(
            [
                "setup", "quota", "speed", "commit", "load", "drives", *(f"{name}, %" for name in names), "robot, %",
                *(f"{name}, MB" for name in names), "robot, MB", "mean time, s",
            ],
            rows,
        ),
    ]  # fmt: skip


def of_processes(drives: Sequence[MeasuredDrive]) -> tuple[float, float] | None:
    """Return what the robot's processes took in `default` and in `fog`, % of a core; None unless both were measured.

    Of drives at the pace of real time and without a quota.
    """
    plain = [drive for drive in drives if drive.cpu_percent and drive.cpu_quota is None and drive.speed == 1.0]
    shares = {setup: [_of_robot(drive) for drive in plain if drive.setup == setup] for setup in ("default", "fog")}
    return (_mean(shares["default"]), _mean(shares["fog"])) if all(shares.values()) else None


def _of_robot(drive: MeasuredDrive) -> float:
    return sum(drive.cpu_percent.get(name, 0.0) for name in ROBOTS_PROCESSES)


def _circumstances(drive: MeasuredDrive) -> tuple[str, float | None, float, str]:
    """Return what a drive's cost depends on, its route apart."""
    return drive.setup, drive.cpu_quota, drive.speed, drive.commit


def _same_commit(one: str, other: str) -> bool:
    """Whether two revisions, shortened or not, are the same; one that is not known is no other's."""
    return bool(one and other) and (one.startswith(other) or other.startswith(one))


def _mean(values: Sequence[float]) -> float:
    return estimate(values).mean if values else 0.0


def _stopping(modes: dict[str, int]) -> frozenset[str]:
    return STOPPING_MODES & modes.keys()


def _seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) or "none"
