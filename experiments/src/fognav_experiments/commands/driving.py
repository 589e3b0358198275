"""What the commands of experiments share: what must be ready, the machine, and each drive as it comes."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, TypeVar

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from fognav import checkout, kernels, system
from fognav.output import console, print_line

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from fognav_experiments.comparison.drives import MeasuredDrive
    from fognav_experiments.comparison.people import PeopleDrive
    from fognav_experiments.comparison.records import DriveFiles, Record
    from fognav_experiments.comparison.sensitivity import SweptDrive

    D = TypeVar("D", Record, MeasuredDrive, SweptDrive, PeopleDrive)


def prepare() -> None:
    """Make nodes' code and kernels ready."""
    system.prepare_node_code(print_line)
    kernels.warm_cache(print_line)


def measured_on() -> dict[str, object]:
    """Return what drives are measured on and with."""
    from fognav_experiments import machine  # noqa: PLC0415  # keeps the other commands fast

    return {"commit": checkout.revision(), **machine.describe()}


def show(names: Sequence[str], files: DriveFiles[D], records: Iterator[D]) -> int:
    """Show each record as it comes; return how many of those asked for, new and old, failed."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TimeRemainingColumn(), console=console, disable=not console.is_terminal) as progress:
        known = sum(files.has(name) for name in names)
        task = progress.add_task("drives", total=len(names), completed=known)
        begun = time.monotonic()
        for done, record in enumerate(records, known + 1):
            progress.advance(task)
            time_s = "" if record.time_s is None else f"{record.time_s:6.1f} s"
            print_line(
                f"{record.name:20} {record.outcome:8} {record.distance_m:6.1f} m {time_s:8}  {record.area:6}"
                f"{done} of {len(names)}{_left(len(names) - done, (time.monotonic() - begun) / (done - known))}"
            )
    return count_failed(names, files)


def _left(drives: int, each_s: float) -> str:
    """Return in words how long so many drives will take; logs have no progress bar."""
    minutes = math.ceil(drives * each_s / 60.0)
    if not drives:
        return ""
    return f", {minutes // 60} h {minutes % 60} min left" if minutes >= 60 else f", {minutes} min left"


def count_failed(names: Sequence[str], files: DriveFiles[D]) -> int:
    """Name the drives without a record; return how many of those asked for did not succeed."""
    from fognav_experiments.comparison.drives import ATTEMPT  # noqa: PLC0415  # keeps the other commands fast

    succeeded = {record.name.partition(ATTEMPT)[0] for record in files.read() if record.success}
    if missing := [name for name in names if not files.has(name)]:
        print_line(f"no record of {', '.join(missing)}: repeat the command to drive them")
    return sum(name not in succeeded for name in names)
