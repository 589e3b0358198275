"""Worker processes of drives beside each other."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

DEADLINE_S = 60.0
PARENT = """
import os, time
from fognav_experiments import worker_pool

def drive():
    print(os.getpid(), flush=True)
    time.sleep(1e6)

if __name__ == "__main__":
    with worker_pool.open_pool(2) as pool:
        pool.submit(drive)
        pool.submit(drive).result()
"""


def is_alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text("utf-8").rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_workers_of_a_killed_experiment_end(tmp_path):
    program = tmp_path / "parent.py"
    program.write_text(PARENT)
    with subprocess.Popen([sys.executable, str(program)], stdout=subprocess.PIPE, text=True) as parent:
        try:
            workers = [int(parent.stdout.readline()) for _ in range(2)]
            assert all(is_alive(pid) for pid in workers)
        finally:
            parent.kill()
    end = time.monotonic() + DEADLINE_S
    while any(is_alive(pid) for pid in workers):
        assert time.monotonic() < end, f"workers {workers} outlive the process that started them"
        time.sleep(0.05)
