"""A limit of the CPU time of some processes, by Linux's control groups (version 2, or 1 where that is mounted)."""

from __future__ import annotations

import os
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from fognav.output import WrongUseError

if TYPE_CHECKING:
    from collections.abc import Iterator

CGROUPS = Path("/sys/fs/cgroup")
PERIOD_US = 10_000
"""A group that has used up its share stands still until the next period: with Linux's usual 100 ms a fifth of a core
would be a fast core that stops for 80 ms, and not the slow one that is meant."""


class CpuQuota:
    """A control group with a share of one core; processes that are added, and their children, share it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def add(self, pid: int) -> None:
        """Put a process into the group; its later children are in it from their start."""
        # A process that has just ended needs no limit.
        with suppress(ProcessLookupError):
            (self._folder / "cgroup.procs").write_text(str(pid), "ascii")


@contextmanager
def cpu_quota(share: float, root: Path = CGROUPS) -> Iterator[CpuQuota]:
    """Make a group that may use `share` of one core, 0.2 for a fifth, and remove it at the end.

    All processes in it must have ended by then. Raises `WrongUseError` where this user may make no group.
    """
    quota_us = round(share * PERIOD_US)
    unified = (root / "cgroup.controllers").exists()
    folder = (root if unified else root / "cpu") / f"fognav-bench-{os.getpid()}"
    try:
        if unified:
            (root / "cgroup.subtree_control").write_text("+cpu", "ascii")
        folder.mkdir()
        if unified:
            (folder / "cpu.max").write_text(f"{quota_us} {PERIOD_US}", "ascii")
        else:
            (folder / "cpu.cfs_period_us").write_text(str(PERIOD_US), "ascii")
            (folder / "cpu.cfs_quota_us").write_text(str(quota_us), "ascii")
    except OSError as error:
        with suppress(OSError):
            folder.rmdir()
        raise WrongUseError(
            f"--cpu-quota: {folder} can't be used ({error.strerror}). Run this as root on a system with control "
            "groups, or leave the option out: nothing else limits a process without stopping it"
        ) from error
    try:
        yield CpuQuota(folder)
    finally:
        folder.rmdir()
