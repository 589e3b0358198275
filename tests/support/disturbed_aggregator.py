"""The aggregator with a wall clock and an event loop that a test can disturb: `python -m` this module.

The wall clock (`time.time`) is ahead by the seconds in the file FAULT_CLOCK; SIGUSR1 blocks the main thread, and so the
event loop, for FAULT_HANG_S seconds.
"""

import os
import runpy
import signal
import time
from pathlib import Path

import hazard_aggregator.__main__  # noqa: F401  # with all its imports, before the program is forked

if __name__ == "__main__":
    real_time = time.time
    file, hang_s = Path(os.environ["FAULT_CLOCK"]), float(os.environ["FAULT_HANG_S"])
    time.time = lambda: real_time() + float(file.read_text())
    signal.signal(signal.SIGUSR1, lambda *_: time.sleep(hang_s))
    runpy.run_module("hazard_aggregator", run_name="__main__", alter_sys=True)
