"""Programs forked for tests behave as `python -m` would have it, and end with the tests."""

import os
import subprocess
import sys
import time
from pathlib import Path

import programs
import pytest

MODULE = "hazard_aggregator"
FORGETFUL = """
import os, pathlib, sys
import programs
running = programs.start(sys.argv[1], os.environ, pathlib.Path(sys.argv[2]))
print(running.pid, flush=True)
os._exit(0)
"""


def environment(**more: str) -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if not name.startswith("FOGNAV_")} | more


def reasons(log: str) -> list[str]:
    return [line for line in log.splitlines() if "Error: " in line]


def test_forked_program_reads_its_environment_and_ends_as_the_module_would(tmp_path):
    forked = programs.start(MODULE, environment(), tmp_path / "log")
    usual = subprocess.run(
        [sys.executable, "-m", MODULE], env=environment(), capture_output=True, text=True, check=False
    )
    assert forked.wait(60.0) == usual.returncode == 1
    log = (tmp_path / "log").read_text()
    assert "FOGNAV_SITE_DIR" in log
    assert reasons(log) == reasons(usual.stdout + usual.stderr) != []

    again = programs.start(MODULE, environment(FOGNAV_SITE_DIR="/nowhere"), tmp_path / "again")
    assert again.wait(60.0) == 1
    assert "FOGNAV_SITE_DIR" not in "".join(reasons((tmp_path / "again").read_text()))
    assert forked.pid != again.pid


def test_killed_program_is_gone_and_its_end_is_known(tmp_path):
    site = tmp_path / "site.toml"
    os.mkfifo(site)  # it waits for a writer
    running = programs.start(MODULE, environment(FOGNAV_SITE_DIR=str(tmp_path), FOGNAV_DATA_DIR="/x"), tmp_path / "log")
    assert running.poll() is None
    with pytest.raises(subprocess.TimeoutExpired):
        running.wait(0.01)
    running.kill()
    assert running.wait(60.0) == -9
    running.kill()
    with pytest.raises(ProcessLookupError):
        os.kill(running.pid, 0)


def test_variable_that_comes_too_late_is_refused(tmp_path):
    with pytest.raises(ValueError, match="NUMBA_DISABLE_JIT"):
        programs.start(MODULE, environment(NUMBA_DISABLE_JIT="1"), tmp_path / "log")


def test_program_ends_with_the_process_that_started_it(tmp_path):
    os.mkfifo(tmp_path / "site.toml")
    variables = environment(
        FOGNAV_SITE_DIR=str(tmp_path), FOGNAV_DATA_DIR="/x", PYTHONPATH=str(Path(programs.__file__).parent)
    )
    command = [sys.executable, "-c", FORGETFUL, MODULE, str(tmp_path / "log")]
    pid = int(subprocess.run(command, env=variables, capture_output=True, text=True, check=True).stdout)
    deadline = time.monotonic() + 60.0
    while Path(f"/proc/{pid}").exists():
        assert time.monotonic() < deadline
        time.sleep(0.02)
