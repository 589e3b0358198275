"""The signals that end a process in order, and those by which a terminal stops it. Imports nothing of Fognav.

A dropped SSH session sends SIGHUP, Ctrl and backslash SIGQUIT: by default both end a process on the spot, before it
has stopped what it drives.
"""

import signal
from collections.abc import Iterator
from typing import Final

ENDING: Final = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT)
"""Each of them asks for an orderly end."""
TERMINAL_STOPS: Final = (signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU)
"""By these a terminal stops a process (Ctrl-Z, and a background process that uses it); SIGSTOP can't be ignored."""


def ending() -> Iterator[signal.Signals]:
    """Yield the signals that shall end this process: not SIGHUP under `nohup`, which started it with that ignored."""
    for number in ENDING:
        if number is not signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            yield number


def ignore_terminal_stops() -> None:
    """Ignore the stop signals of terminals: a stopped process controls nothing. Children inherit it."""
    for number in TERMINAL_STOPS:
        signal.signal(number, signal.SIG_IGN)
