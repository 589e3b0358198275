"""The kernels that an install step compiles must be all that a process uses: no process compiles at its start."""

import subprocess
import sys

import pytest

from fog_kernels.warm import PROFILES

CODE = """
import importlib, sys
importlib.import_module(sys.argv[1])
print(*sorted(name.removeprefix("fog_kernels.") for name in sys.modules if name.startswith("fog_kernels.")))
"""


@pytest.mark.parametrize(
    ("profile", "module"),
    [
        ("robot", "robot_agent.__main__"),
        ("planner", "planner.__main__"),
        ("map", "map_service.__main__"),
        ("sim", "fognav_sim.__main__"),
    ],
)
def test_profile_contains_every_kernel_that_its_process_imports(profile: str, module: str) -> None:
    done = subprocess.run([sys.executable, "-c", CODE, module], capture_output=True, text=True, check=True, timeout=60)
    used = {name for name in done.stdout.split() if name in PROFILES["all"]}
    assert used
    assert used <= set(PROFILES[profile])
