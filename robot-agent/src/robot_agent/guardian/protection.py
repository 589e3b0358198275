"""Keeps the machine from delaying a process that moves or stops wheels: real-time priority, and locked memory."""

from __future__ import annotations

import ctypes
import os
from contextlib import suppress
from pathlib import Path
from typing import Final

_CURRENT: Final = 1
_FUTURE: Final = 2
_ON_FAULT: Final = 4
"""MCL_CURRENT, MCL_FUTURE and MCL_ONFAULT of mlockall(2)."""


def run_in_real_time(priority: int) -> str:
    """Give all threads of this process a real-time priority (0: none), and return the result as text.

    So programs of normal priority delay it by nothing but their last time slice. Later threads and children inherit it.
    All threads, because one of normal priority that waits for the processor may hold the interpreter's lock.
    """
    if priority <= 0:
        return "not requested"
    try:
        for thread in Path("/proc/self/task").iterdir():
            with suppress(ProcessLookupError):  # it has just ended
                os.sched_setscheduler(int(thread.name), os.SCHED_RR, os.sched_param(priority))
    except OSError:
        return "refused: grant CAP_SYS_NICE or an rtprio limit"
    return f"SCHED_RR {priority}"


def lock_memory() -> str:
    """Lock every page that is or will be in memory, and return the result as text; pages never touched cost nothing."""
    if ctypes.CDLL(None, use_errno=True).mlockall(_CURRENT | _FUTURE | _ON_FAULT) == 0:
        return "locked"
    return f"not locked ({os.strerror(ctypes.get_errno())}): grant a memlock limit"
