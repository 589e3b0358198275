"""Worker processes of drives beside each other."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

DEADLINE_S = 60.0
PARENT = """
import os, time
from fognav_experiments import machine

def drive():
    print(os.getpid(), flush=True)
    time.sleep(1e6)

if __name__ == "__main__":
    with machine.open_pool(2) as pool:
        pool.submit(drive)
        pool.submit(drive).result()
"""


def is_alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text("utf-8").rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGINT], ids=["killed", "interrupted"])
def test_workers_of_an_experiment_that_ends_early_end_in_the_middle_of_their_drives(tmp_path, end):
    program = tmp_path / "parent.py"
    program.write_text(PARENT)
    with subprocess.Popen([sys.executable, str(program)], stdout=subprocess.PIPE, text=True) as parent:
        try:
            workers = [int(parent.stdout.readline()) for _ in range(2)]
            assert all(is_alive(pid) for pid in workers)
            parent.send_signal(end)
            parent.wait(DEADLINE_S)
        finally:
            parent.kill()
    deadline = time.monotonic() + DEADLINE_S
    while any(is_alive(pid) for pid in workers):
        assert time.monotonic() < deadline, f"workers {workers} outlive the process that started them"
        time.sleep(0.05)
