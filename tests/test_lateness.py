"""The time for which the kernel let processes wait, which limits of tests are longer by."""

import os
import subprocess
import sys
import time

import pytest
from lateness import Lateness

SPINNING = "import os, sys\nos.sched_setaffinity(0, {int(sys.argv[1])})\nprint('on', flush=True)\nwhile True: pass"
LIMIT_S = 60.0


@pytest.mark.skipif(not os.path.exists("/proc/self/schedstat"), reason="this kernel has no statistics of its scheduler")  # noqa: PTH110
def test_processes_that_share_a_core_wait_and_one_that_sleeps_does_not():
    core = str(min(os.sched_getaffinity(0)))
    spinning = [subprocess.Popen([sys.executable, "-c", SPINNING, core], stdout=subprocess.PIPE) for _ in range(2)]
    sleeping = subprocess.Popen(["/bin/sleep", "600"])
    try:
        for each in spinning:
            assert each.stdout is not None
            assert each.stdout.readline() == b"on\n"
        both, none = Lateness(lambda: [each.pid for each in spinning]), Lateness(lambda: [sleeping.pid])
        deadline = time.monotonic() + LIMIT_S
        while both.seconds() < 0.05:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert none.seconds() < both.seconds()
    finally:
        for each in (*spinning, sleeping):
            each.kill()
            each.wait()
    assert both.seconds() == 0.0, "they have ended"
