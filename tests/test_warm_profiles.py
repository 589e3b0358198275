"""The kernels that an install step compiles must be all that a process uses: no process compiles at its start."""

import subprocess
import sys

import pytest

from fog_kernels.warm import PROFILES

CODE = """
import importlib, os, sys
import fastapi, numba, redis.asyncio, zenoh  # once; Fognav's own modules in a process for each program
for program in sys.argv[1:]:
    if os.fork() == 0:
        importlib.import_module(program)
        print(program, *(name.removeprefix("fog_kernels.") for name in sys.modules if name.startswith("fog_kernels.")))
        sys.stdout.flush()
        os._exit(0)
    os.wait()
"""
PROGRAMS = {
    "robot": "robot_agent.agent.service",
    "planner": "planner.__main__",
    "map": "map_service.__main__",
    "sim": "fognav_sim.__main__",
}


@pytest.fixture(scope="module")
def imported() -> dict[str, set[str]]:
    """The modules of kernels that each program imports."""
    command = [sys.executable, "-c", CODE, *PROGRAMS.values()]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    lines = [line.split() for line in done.stdout.splitlines()]
    return {program: {name for name in names if name in PROFILES["all"]} for program, *names in lines}


@pytest.mark.drive
@pytest.mark.parametrize("profile", PROGRAMS)
def test_profile_contains_every_kernel_that_its_process_imports(profile: str, imported: dict[str, set[str]]) -> None:
    used = imported[PROGRAMS[profile]]
    assert used
    assert used <= set(PROFILES[profile])
