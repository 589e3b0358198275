"""Memory that only the start needed is given back, the rest is passed over by collections, and the process works on."""

from __future__ import annotations

import asyncio
import gc
import subprocess
import sys
import weakref
from functools import cache

import pytest

from fog_runtime import process


class Cycle:
    """Garbage that only a collection frees."""

    itself: Cycle


CODE = """
import gc
import numpy as np
from numba import njit
from fog_kernels.components import Components
from fog_runtime.process import release_startup_memory

Components(np.zeros((50, 50), np.uint8))
print(release_startup_memory())
compiler = held = 0
with open("/proc/self/smaps") as maps:
    for line in maps:
        if "-" in line.split()[0]:
            compiler = "libllvmlite" in line and " r" in line and " rw" not in line
        elif compiler and line.startswith("Rss:"):
            held += int(line.split()[1])
print(held)
print(len(gc.get_objects()))
assert Components(np.zeros((50, 50), np.uint8)).connected((0, 0), (49, 49))
assert njit(lambda x: x + 1)(1) == 2  # the compiler still works: its code is read again
"""


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_compiler_is_released_after_the_start_and_still_works() -> None:
    released, held_kib, _ = _run()
    assert released > 10_000_000
    assert held_kib < 8_000, "code and constants of the compiler, but for pages that its loading changed"


def test_collector_of_garbage_passes_over_what_the_start_has_made() -> None:
    _, _, looked_at = _run()
    assert looked_at < 1_000, "modules alone are more than 100,000 objects, which take 90 ms"


def test_what_is_loaded_without_collections_is_passed_over_by_later_ones() -> None:
    assert gc.isenabled()
    try:
        with process.loading(lambda: False):
            assert not gc.isenabled()
            made = [[number] for number in range(100)]
        assert gc.isenabled()
        looked_at = {id(found) for found in gc.get_objects()}
        assert not looked_at & {id(item) for item in made}
    finally:
        gc.unfreeze()


@pytest.mark.parametrize("made_garbage", [True, False])
def test_garbage_is_collected_when_much_was_made_while_loading(*, made_garbage: bool) -> None:
    try:
        with process.loading(lambda: made_garbage):
            cycle = Cycle()
            cycle.itself, gone = cycle, weakref.ref(cycle)
            del cycle
        assert (gone() is None) == made_garbage
    finally:
        gc.unfreeze()
        gc.collect()


async def test_memory_is_released_as_soon_as_the_process_is_ready(monkeypatch: pytest.MonkeyPatch) -> None:
    released: list[int] = []
    monkeypatch.setattr(process, "_POLL_S", 0.001)
    monkeypatch.setattr(process, "release_startup_memory", lambda: released.append(0))
    ready: list[str] = []
    waiting = asyncio.create_task(process.release_when(lambda: bool(ready)))
    await asyncio.sleep(0.01)
    assert released == []
    ready.append("map")
    await asyncio.wait_for(waiting, 60.0)
    assert released == [0]


LIBRARIES = """
import numpy as np
from fog_runtime.process import release_startup_memory

def held():
    with open("/proc/self/smaps") as maps:
        library, kib = False, 0
        for line in maps:
            if "-" in line.split()[0]:
                library = "numpy" in line and ".so" in line
            elif library and line.startswith("Rss:"):
                kib += int(line.split()[1])
    return kib

np.linalg.svd(np.ones((3, 3)))
before = held()
release_startup_memory()
print(before - held())
assert np.linalg.svd(np.ones((3, 3)))[1].size == 3
"""


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_code_of_any_library_that_only_the_start_needed_is_released() -> None:
    done = subprocess.run([sys.executable, "-c", LIBRARIES], capture_output=True, text=True, check=True, timeout=120)
    assert int(done.stdout) > 2_000


@cache
def _run() -> tuple[int, int, int]:
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True, timeout=120)
    released, held_kib, looked_at = map(int, done.stdout.split())
    return released, held_kib, looked_at
