"""The time for which the kernel let processes wait, which limits of tests are longer by."""

import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
from lateness import Lateness

SPINNING = "import os, sys\nos.sched_setaffinity(0, {int(sys.argv[1])})\nprint('on', flush=True)\nwhile True: pass"
LIMIT_S = 60.0


@pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="this kernel has no statistics of its scheduler")
def test_processes_that_share_a_core_wait_and_stopped_or_ended_ones_do_not():
    core = str(min(os.sched_getaffinity(0)))
    with ExitStack() as stack:
        spinning = [
            stack.enter_context(subprocess.Popen([sys.executable, "-c", SPINNING, core], stdout=subprocess.PIPE))
            for _ in range(2)
        ]
        for each in spinning:
            stack.callback(each.kill)
            assert each.stdout is not None
            assert each.stdout.readline() == b"on\n"
        both = Lateness(lambda: [each.pid for each in spinning])
        deadline = time.monotonic() + LIMIT_S
        while both.seconds() < 0.05:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        for each in spinning:
            each.send_signal(signal.SIGSTOP)
            os.waitid(os.P_PID, each.pid, os.WSTOPPED)
        stopped = Lateness(lambda: [each.pid for each in spinning])
        time.sleep(0.05)
        assert stopped.seconds() == 0.0
    assert both.seconds() == 0.0, "they have ended"


def test_process_that_ends_between_two_looks_counts_for_nothing() -> None:
    """Engines start and end helpers all the time: one that is gone when it is read must not fail a test."""
    with subprocess.Popen([sys.executable, "-c", ""]) as gone:
        gone.wait(60.0)
    assert Lateness(lambda: [gone.pid]).seconds() == 0.0
