"""The main function of a process: run until a signal, then end cleanly; and give back what only its start needed."""

from __future__ import annotations

import asyncio
import ctypes
import faulthandler
import gc
import os
import re
import secrets
import signal
import socket
import sys
import threading
from concurrent.futures import Future
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

from fog_runtime import logs, machine

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from fog_contracts.channels import Role

_DONTNEED: Final = 4
"""`MADV_DONTNEED` of madvise(2)."""
_MMAP_THRESHOLD: Final = -3
"""`M_MMAP_THRESHOLD` of mallopt(3)."""
_LARGE: Final = 1 << 20
_ARENA_MAX: Final = -8
"""`M_ARENA_MAX` of mallopt(3)."""
_HEAPS: Final = 1
_POLL_S: Final = 0.5
_LIBRARY: Final = re.compile(r"\.so(\.|$)")
_MAPPING: Final = re.compile(r"^([0-9a-f]+)-([0-9a-f]+) (\S+) \S+ \S+ \S+ *(.*)$")

_log = logs.get("process")


def process_id(service: Role) -> str:
    """Return an id for this run of this process that is never used again: service, host, process and a random number.

    A broker knows its clients by their ids, and disconnects one when another comes with the same.
    """
    host = re.sub(r"[^a-z0-9-]", "-", socket.gethostname().lower())[:40].strip("-") or "host"
    return f"{service}-{host}-{os.getpid()}-{secrets.token_hex(4)}"


def release_startup_memory() -> int:
    """Free what only the start needed; return the size (bytes) of the libraries' parts that are no longer in memory.

    The compiler (LLVM, some 65 MB of code and constants in memory) has loaded the kernels from their cache and is not
    used any more, nor is most of the other libraries. They are files': the system maps a page again when it is needed
    after all. Without /proc nothing is released. Large arrays are returned to the system as soon as they are freed,
    from now on; for the rest, new threads share one heap, since each one's own keeps what it once needed (27 MB in a
    planner with 50 robots).

    What is in use now, most of it modules, is passed over by the garbage collector from now on. Each full collection
    would stop all threads while it looks at it: for 90 ms, where numba is imported.
    """
    gc.collect()
    gc.freeze()
    maps = Path("/proc/self/smaps")
    if sys.platform != "linux" or not maps.exists():
        return 0
    libc = ctypes.CDLL(None, use_errno=True)
    if hasattr(libc, "malloc_trim"):
        # Without a fixed threshold, glibc keeps the memory of freed arrays for later ones, up to 32 MB each.
        libc.mallopt(_MMAP_THRESHOLD, _LARGE)
        libc.mallopt(_ARENA_MAX, _HEAPS)
        libc.malloc_trim(0)
    libc.madvise.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
    released = 0
    for begin, end in _unchanged_parts(maps.read_text("utf-8")):
        if libc.madvise(begin, end - begin, _DONTNEED) == 0:
            released += end - begin
    return released


async def release_when(ready: Callable[[], bool]) -> None:
    """Release what only the start needed once the process is ready: connecting and loading take more of it."""
    while not ready():  # noqa: ASYNC110  # readiness has conditions in many places
        await asyncio.sleep(_POLL_S)
    release_startup_memory()


def _unchanged_parts(smaps: str) -> list[tuple[int, int]]:
    """Return the address ranges of the libraries' code and constants of which no page was changed in memory."""
    found: list[tuple[int, int]] = []
    current: tuple[int, int] | None = None
    for line in smaps.splitlines():
        mapping = _MAPPING.match(line)
        if mapping is not None:
            begin, end, rights, name = mapping.groups()
            wanted = rights in ("r-xp", "r--p") and _LIBRARY.search(name) is not None
            current = (int(begin, 16), int(end, 16)) if wanted else None
        elif current is not None and line.startswith("Anonymous:") and line.split()[1] == "0":
            found.append(current)
    return found


class AgainError(Exception):
    """The process ends in order to be started again by what supervises it, with what it reads at its start only.

    Call `limit_the_end` before it is raised: as after a signal, an end that hangs is cut short.
    """


ENDING_S: Final = 9.0
"""How long an orderly end may take: less than container engines and service managers wait before they kill."""

T = TypeVar("T")


def limit_the_end() -> None:
    """Cut this process's end short if it is not over in `ENDING_S`: show where it hangs, and exit with status 1."""
    faulthandler.dump_traceback_later(ENDING_S, exit=True)


_loading: Final[set[threading.Thread]] = set()


async def load_aside(load: Callable[[], T]) -> T:
    """Return what `load` returns, on a thread of its own: meanwhile the loop goes on, and a signal ends the process.

    For what can't be interrupted and may take minutes, such as compiling kernels. A process that ends before does not
    wait for it: call it within `run`, and let `load` write nothing that must be whole.
    """
    result: Future[T] = Future()

    def work() -> None:
        if not result.set_running_or_notify_cancel():
            return  # cancelled before this thread's first line; the loop waits for its end
        gc.disable()  # to look at all modules again and again while more are loaded takes a fifteenth of the time
        try:
            result.set_result(load())
        except BaseException as error:  # noqa: BLE001  # raised to who awaits it
            result.set_exception(error)
        finally:
            gc.enable()

    thread = threading.Thread(target=work, name="loading", daemon=True)
    _loading.add(thread)
    thread.start()
    try:
        return await asyncio.wrap_future(result)
    finally:
        if result.done():
            thread.join()
            _loading.remove(thread)


async def _supervise(main: Callable[[], Awaitable[None]]) -> None:
    loop = asyncio.get_running_loop()
    task = asyncio.ensure_future(main())
    stopping = False

    def stop(number: int) -> None:
        nonlocal stopping
        if stopping and number == signal.SIGHUP:
            return  # a shell repeats the kernel's hang-up
        if stopping:
            _log.warning("forced_exit", signal=signal.Signals(number).name)
            os._exit(1)
        stopping = True
        _log.info("stopping", signal=signal.Signals(number).name)
        limit_the_end()
        task.cancel()

    numbers = tuple(machine.ending())
    for number in numbers:
        loop.add_signal_handler(number, stop, number)
    try:
        await task
    except asyncio.CancelledError:
        if not stopping:
            raise
    finally:
        for number in numbers:
            loop.remove_signal_handler(number)


def run(main: Callable[[], Awaitable[None]]) -> None:
    """Run `main` until it returns, or until a signal of `signals.ENDING` cancels it; all end the process with status 0.

    `AgainError` does so, too. Another exception from `main` is logged as one event, and the process exits with status
    1. A second signal ends the
    process at once, except a second hang-up. An end that takes longer than `ENDING_S` is cut short: the stacks of all
    threads are written to standard error, and the process exits with status 1.
    """
    try:
        asyncio.run(_supervise(main))
    except Exception as error:  # noqa: BLE001  # the last place that can log why the process ends
        causes = _leaves(error)
        if all(isinstance(cause, AgainError) for cause in causes):
            _log.info("starting_again", reason=str(causes[0]))
            _leave(0)
            return
        _log.error("crashed", error=error, reason="; ".join(f"{type(c).__name__}: {c}" for c in causes))
        _leave(1)
        raise SystemExit(1) from None
    _log.info("stopped")
    _leave(0)


def _leave(status: int) -> None:
    """End at once if something is still being loaded: the interpreter's own end would pull it from under the thread."""
    if _loading:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _leaves(error: BaseException) -> list[BaseException]:
    if isinstance(error, BaseExceptionGroup):
        return [leaf for inner in error.exceptions for leaf in _leaves(inner)]
    return [error]
