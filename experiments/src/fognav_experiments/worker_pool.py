"""Worker processes that drive beside each other: they yield to other work, and end with who started them."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.connection import wait
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator
    from multiprocessing.connection import Connection

_NICENESS: Final = 5


@contextmanager
def open_pool(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """Give a pool of this many fresh processes, which leave Ctrl-C to this one.

    They end even when this one is killed, and in the middle of their drives when the block is left by an exception:
    who interrupts it doesn't wait for drives that nobody records.
    """
    interrupted, interrupt = multiprocessing.Pipe(duplex=False)
    context = multiprocessing.get_context("spawn")
    with interrupted, interrupt, ProcessPoolExecutor(jobs, context, _begin, (interrupted,)) as pool:
        try:
            yield pool
        except BaseException:
            interrupt.close()
            raise


def _begin(interrupted: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(_NICENESS)
    threading.Thread(target=_end_when_alone, args=(interrupted,), name="parent's end", daemon=True).start()


def _end_when_alone(interrupted: Connection) -> None:
    """Workers share the queue of their drives, so that a worker of a killed parent would wait for the next for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None, "only a worker has this thread"
    wait([parent.sentinel, interrupted])
    os._exit(1)
