"""What the two processes that keep the wheels safe load: they restart while the wheels are held, and must be small."""

import subprocess
import sys

import pytest

CODE = "import importlib, sys; importlib.import_module(sys.argv[1]); print(*sys.modules)"


@pytest.mark.parametrize(
    ("module", "unneeded"),
    [
        (
            "robot_agent.guardian.__main__",
            {"numpy", "numba", "zenoh", "fastapi", "prometheus_client", "asyncio", "ssl", "hashlib"},
        ),
        ("robot_agent.guardian.watchdog", {"numpy", "msgspec", "asyncio", "dataclasses", "fog_contracts"}),
    ],
)
def test_process_of_the_wheels_loads_no_library_that_it_does_not_need(module: str, unneeded: set[str]) -> None:
    done = subprocess.run([sys.executable, "-c", CODE, module], capture_output=True, text=True, check=True)
    assert unneeded & set(done.stdout.split()) == set()
