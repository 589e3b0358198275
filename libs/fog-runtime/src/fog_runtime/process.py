"""The main function of a process: run until a signal, then end cleanly."""

import asyncio
import faulthandler
import os
import signal
import sys
import threading
from collections.abc import Awaitable, Callable
from concurrent.futures import Future
from typing import Final, TypeVar

from fog_runtime import logs
from fog_runtime.machine import signals

ENDING_S: Final = 9.0
"""How long an orderly end may take: less than container engines and service managers wait before they kill."""

_log = logs.get("process")

T = TypeVar("T")

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
        try:
            result.set_result(load())
        except BaseException as error:  # noqa: BLE001  # raised to who awaits it
            result.set_exception(error)

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
        faulthandler.dump_traceback_later(ENDING_S, exit=True)
        task.cancel()

    numbers = tuple(signals.ending())
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

    An exception from `main` is logged as one event, and the process exits with status 1. A second signal ends the
    process at once, except a second hang-up. An end that takes longer than `ENDING_S` is cut short: the stacks of all
    threads are written to standard error, and the process exits with status 1.
    """
    try:
        asyncio.run(_supervise(main))
    except Exception as error:  # noqa: BLE001  # the last place that can log why the process ends
        causes = _leaves(error)
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
