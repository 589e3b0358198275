"""Keeps the machine from delaying a process that moves or stops wheels: real-time priority, and locked memory."""

from __future__ import annotations

import ctypes
import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable

_CURRENT: Final = 1
_FUTURE: Final = 2
_ON_FAULT: Final = 4
"""MCL_CURRENT, MCL_FUTURE and MCL_ONFAULT of mlockall(2)."""


def run_in_real_time(priority: int) -> str:
    """Give all threads of this process a real-time priority (0: none), and return the result as text.

    So programs of normal priority delay it by nothing but their last time slice. Later threads and children inherit it.
    All threads, because one of normal priority that waits for the processor may hold the interpreter's lock.

    Where the system refuses (a container whose engine gives it no real-time share), they get a larger share of the
    processor than other programs instead: the niceness `-priority`, which is better than nothing and no guarantee.
    """
    if priority <= 0:
        return "not requested"
    try:
        _for_all_threads(lambda thread: os.sched_setscheduler(thread, os.SCHED_RR, os.sched_param(priority)))
    except OSError:
        return _run_favoured(priority)
    return f"SCHED_RR {priority}"


def _run_favoured(priority: int) -> str:
    remedy = "grant CAP_SYS_NICE or an rtprio limit"
    try:
        _for_all_threads(lambda thread: os.setpriority(os.PRIO_PROCESS, thread, -priority))
    except OSError:
        return f"refused: {remedy}"
    return f"niceness {-priority}, as SCHED_RR was refused: {remedy}"


def _for_all_threads(change: Callable[[int], object]) -> None:
    for thread in Path("/proc/self/task").iterdir():
        with suppress(ProcessLookupError):  # it has just ended
            change(int(thread.name))


def lock_memory() -> str:
    """Lock every page that is or will be in memory, and return the result as text; pages never touched cost nothing."""
    if ctypes.CDLL(None, use_errno=True).mlockall(_CURRENT | _FUTURE | _ON_FAULT) == 0:
        return "locked"
    return f"not locked ({os.strerror(ctypes.get_errno())}): grant a memlock limit"
