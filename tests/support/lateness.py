"""How late a busy machine made processes: the time for which they were ready to run, and had no core.

A test whose subject is a limit of real processes adds this to the limit. So a busy machine does not fail it, while an
idle one, where nothing waits, measures as exactly as before.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable


class Lateness:
    """How long the processes that `pids` returns, and their threads, have waited for a core since this was made.

    It is the sum of all threads, and no chain of them can be later. A message passes through threads of zenoh, the loop
    and threads that compute, in several processes. Each may have waited for the one before it, so that the longest wait
    of one thread would be too little. Waits at the same time count twice: on a busy machine a limit is longer than it
    need be, and only on an idle one as exact as it is written. Without the kernel's statistics it is 0.

    What a virtual machine's host took from its cores (proc_stat(5), "steal") counts too: the kernel of the machine
    believes that its threads ran meanwhile.
    """

    def __init__(self, pids: Callable[[], Iterable[int]]) -> None:
        self._pids = pids
        self._before = self._waited()
        self._stolen_before = _stolen()

    def seconds(self) -> float:
        """Return the time (s) until now; what has ended meanwhile does not count."""
        waited = sum(max(0.0, waited - self._before.get(thread, 0.0)) for thread, waited in self._waited().items())
        return waited + _stolen() - self._stolen_before

    def _waited(self) -> dict[Path, float]:
        found: dict[Path, float] = {}
        for pid in self._pids():
            for thread in _threads(pid):
                # The second figure of sched(5)'s statistics: ns on a run queue. The thread may just have ended.
                with contextlib.suppress(OSError, IndexError):
                    found[thread] = int((thread / "schedstat").read_text("ascii").split()[1]) / 1e9
        return found


def _stolen() -> float:
    """Return how long (s, all cores) the host has let this machine wait."""
    return int(Path("/proc/stat").read_text("ascii").split("\n", 1)[0].split()[8]) / os.sysconf("SC_CLK_TCK")


def _threads(pid: int) -> list[Path]:
    """Return the folders of a process's threads: none of a process that has just ended."""
    try:
        return list(Path(f"/proc/{pid}/task").iterdir())
    except (FileNotFoundError, ProcessLookupError):
        return []
