"""A process on its machine: clock, suspension, signals, service manager, open files, real-time priority, locked memory.

Standard library only.
"""

import os
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final


class MachineClock:
    """The machine's clock, run `speed` times as fast; raises `ValueError` for a speed that is not positive."""

    def __init__(self, speed: float = 1.0) -> None:
        if not 0.0 < speed <= 100.0:
            raise ValueError(f"the clock's speed must lie in (0, 100], not {speed}")
        self._speed = speed

    @property
    def speed(self) -> float:
        """How many seconds of this clock pass in one real second."""
        return self._speed

    def now(self) -> float:
        """Monotonic seconds, by the hardware's own rate: what corrects the time of day does not slew them (ADR 17)."""
        return time.clock_gettime(time.CLOCK_MONOTONIC_RAW) * self._speed

    def stamp(self) -> float:
        """Seconds since the Unix epoch, times the speed."""
        return time.time() * self._speed

    def real(self, seconds: float) -> float:
        """Real seconds that `seconds` of this clock take."""
        return seconds / self._speed


_NOTICED_S: Final = 0.2
"""Shorter differences are the time between the readings of the two clocks."""


def _boot_time() -> float:
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class SuspensionMonitor:
    """Compares the two clocks (s) at each call."""

    def __init__(
        self, monotonic: Callable[[], float] = time.monotonic, boot_time: Callable[[], float] = _boot_time
    ) -> None:
        self._monotonic = monotonic
        self._boot_time = boot_time
        self._offset = boot_time() - monotonic()

    def suspended(self) -> float:
        """Return for how long (s) the computer was suspended since the last call; 0 if it was not."""
        offset = self._boot_time() - self._monotonic()
        # It only grows, and seems to shrink where this process was held up between the two readings.
        seconds, self._offset = offset - self._offset, max(offset, self._offset)
        return seconds if seconds >= _NOTICED_S else 0.0


# A dropped SSH session sends SIGHUP, Ctrl and backslash SIGQUIT: by default both end a process on the spot, before it
# has stopped what it drives.
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


SOCKET: Final = "NOTIFY_SOCKET"
ALIVE_S: Final = 0.5
"""Shortest time between two signs of life, however often they are given."""


class ServiceManager:
    """The service manager that started this process, if it listens."""

    def __init__(self, address: str | None = None) -> None:
        """Use the socket at `address`; by default the one that the environment names."""
        name = os.environ.get(SOCKET, "") if address is None else address
        # An abstract name is written with an at sign.
        self._address = f"\0{name[1:]}" if name.startswith("@") else name
        self._alive_at = -ALIVE_S

    def ready(self) -> None:
        """Tell that the service runs."""
        self._send("READY=1")

    def alive(self, status: str = "") -> None:
        """Tell that the service lives (`WatchdogSec`), and in one line how it does; call it as often as you like."""
        now = time.monotonic()
        if now - self._alive_at < ALIVE_S:
            return
        self._alive_at = now
        self._send(f"WATCHDOG=1\nSTATUS={' '.join(status.split())}")

    def _send(self, text: str) -> None:
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
                sender.settimeout(0)
                sender.sendto(text.encode(), self._address)
        except OSError:
            # A manager that is busy or gone must delay nothing: it judges this service by what it receives later.
            return


def raise_limit() -> None:
    """Allow as many as the system lets this process allow itself; each connection of a client takes one or more."""
    import resource  # noqa: PLC0415  # the guardian and the watchdog load this module, too, and never need it

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != hard:
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


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
    import ctypes  # noqa: PLC0415  # services load this module, too, and never need it

    if ctypes.CDLL(None, use_errno=True).mlockall(_CURRENT | _FUTURE | _ON_FAULT) == 0:
        return "locked"
    return f"not locked ({os.strerror(ctypes.get_errno())}): grant a memlock limit"
