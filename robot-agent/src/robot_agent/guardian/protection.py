"""Keeps the machine from delaying a process that stops wheels: its memory is never swapped out or dropped."""

from __future__ import annotations

import ctypes
import os
from typing import Final

_CURRENT: Final = 1
_FUTURE: Final = 2
_ON_FAULT: Final = 4
"""MCL_CURRENT, MCL_FUTURE and MCL_ONFAULT of mlockall(2)."""


def lock_memory() -> str:
    """Lock every page that is or will be in memory, and return the result as text; pages never touched cost nothing."""
    if ctypes.CDLL(None, use_errno=True).mlockall(_CURRENT | _FUTURE | _ON_FAULT) == 0:
        return "locked"
    return f"not locked ({os.strerror(ctypes.get_errno())}): grant a memlock limit"
