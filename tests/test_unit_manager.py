"""What stands for systemd in tests leaves nothing behind when they are killed."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

MANAGER = Path(__file__).parent / "support" / "unit_manager.py"
READY = "import os, socket, time; s = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM); \
s.connect(os.environ['NOTIFY_SOCKET']); s.send(b'READY=1'); time.sleep(600)"
LIMIT_S = 60.0


def is_running(pid: int) -> bool:
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text("utf-8")
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="only Linux tells of the end of any process")
def test_unit_ends_with_the_tests_that_it_was_started_for(tmp_path):
    units = tmp_path / ".config" / "systemd" / "user"
    units.mkdir(parents=True)
    (units / "fognav.service").write_text(f'[Service]\nExecStart={sys.executable} -S -c "{READY}"\n')
    with subprocess.Popen(["/bin/sleep", "600"]) as tests:
        known = {**os.environ, "HOME": str(tmp_path), "UNIT_MANAGER_FOR": str(tests.pid)}
        try:
            subprocess.run(
                [sys.executable, str(MANAGER), str(tmp_path), "start"], env=known, check=True, timeout=LIMIT_S
            )
            unit = int((tmp_path / "pid").read_text())
            os.kill(unit, 0)
        finally:
            tests.send_signal(signal.SIGKILL)
    deadline = time.monotonic() + LIMIT_S
    while is_running(unit):
        assert time.monotonic() < deadline, "the unit outlived the tests"
        time.sleep(0.02)
