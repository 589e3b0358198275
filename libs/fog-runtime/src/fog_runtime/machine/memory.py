"""Gives memory back that a process needed only while it started, and lets the garbage collector pass over the rest."""

from __future__ import annotations

import asyncio
import ctypes
import gc
import re
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

_DONTNEED: Final = 4
"""`MADV_DONTNEED` of madvise(2)."""
_MMAP_THRESHOLD: Final = -3
"""`M_MMAP_THRESHOLD` of mallopt(3)."""
_LARGE: Final = 1 << 20
_POLL_S: Final = 0.5
_LIBRARY: Final = re.compile(r"\.so(\.|$)")
_MAPPING: Final = re.compile(r"^([0-9a-f]+)-([0-9a-f]+) (\S+) \S+ \S+ \S+ *(.*)$")


@contextmanager
def loading(made_garbage: Callable[[], bool]) -> Iterator[None]:
    """Load modules without collecting garbage: to look at all of them again and again takes a tenth of the time.

    What was made meanwhile is passed over by the collector from then on, as by `release_startup_memory`. Where
    `made_garbage` says at the end that there is some worth it, it is collected before.
    """
    gc.disable()
    try:
        yield
        if made_garbage():
            gc.collect()
    finally:
        gc.freeze()
        gc.enable()


def release_startup_memory() -> int:
    """Free what only the start needed; return the size (bytes) of the libraries' parts that are no longer in memory.

    The compiler (LLVM, some 65 MB of code and constants in memory) has loaded the kernels from their cache and is not
    used any more, nor is most of the other libraries. They are files': the system maps a page again when it is needed
    after all. Without /proc nothing is released. Large arrays are returned to the system as soon as they are freed,
    from now on.

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
