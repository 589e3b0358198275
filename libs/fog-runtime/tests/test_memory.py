"""Memory that only the start needed is given back, and the process works on."""

from __future__ import annotations

import subprocess
import sys

import pytest

CODE = """
import numpy as np
from numba import njit
from fog_kernels.components import Components
from fog_runtime.memory import release_startup_memory

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
assert Components(np.zeros((50, 50), np.uint8)).connected((0, 0), (49, 49))
assert njit(lambda x: x + 1)(1) == 2  # the compiler still works: its code is read again
"""


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_compiler_is_released_after_the_start_and_still_works() -> None:
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True, timeout=120)
    released, held_kib = map(int, done.stdout.split())
    assert released > 10_000_000
    assert held_kib < 8_000, "code and constants of the compiler, but for pages that its loading changed"
