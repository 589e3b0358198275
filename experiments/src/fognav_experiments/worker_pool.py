"""Worker processes that drive beside each other: they yield to other work, and end with who started them."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor
from multiprocessing.connection import wait
from typing import Final

_NICENESS: Final = 5


def open_pool(jobs: int) -> ProcessPoolExecutor:
    """Return a pool of this many fresh processes, which leave Ctrl-C to this one and end even when it is killed."""
    return ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"), initializer=_begin)


def _begin() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(_NICENESS)
    threading.Thread(target=_end_with_parent, name="parent's end", daemon=True).start()


def _end_with_parent() -> None:
    """Workers share the queue of their drives, so that a worker of a killed parent would wait for the next for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None, "only a worker has this thread"
    wait([parent.sentinel])
    os._exit(1)
