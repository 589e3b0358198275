"""The line that wakes a base is free before and after a guardian, so that nothing holds the base's pin."""

from __future__ import annotations

import os
import pty
import signal
import socket
import tty

import pytest

from fog_runtime.configuration.robot_file import default_robot
from robot_agent.device_signature import LineCheck
from robot_agent.guardian.__main__ import Guardian, GuardianSettings
from robot_agent.guardian.core import GuardianCore
from robot_agent.hardware import Awakening, WakeLine
from robot_agent.registry import make_base, signatures
from robot_agent.serial_port import Port, open_port

pytestmark = pytest.mark.live


@pytest.fixture
def descriptors():
    """Return the ends of a serial line, of the heartbeat's pipe, and of the one that ends with the watchdog."""
    found = [*pty.openpty(), *os.pipe(), *os.pipe()]
    tty.setraw(found[1])
    yield found
    for descriptor in found:
        os.close(descriptor)


@pytest.mark.parametrize(("line", "released"), [(WakeLine("rts", 1.2), [("rts", False)] * 2), (None, [])])
def test_line_that_wakes_the_base_is_free_after_the_begin_and_the_end_of_a_guardian(
    descriptors, tmp_path, monkeypatch, line, released
):
    _, slave, _, beat, alive, _ = descriptors
    lines = []
    monkeypatch.setattr(Port, "set_line", lambda _port, name, *, on: lines.append((name, on)))
    core = GuardianCore(make_base(default_robot()))
    core.driver.awakening = Awakening(bauds=(115200,), line=line)
    path = str(tmp_path / "guardian.sock")
    with (
        open_port(os.ttyname(slave), 115200) as port,
        socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener,
    ):
        listener.bind(path)
        settings = GuardianSettings(base_fd=port.fileno(), heartbeat_fd=beat, watchdog_fd=alive, guardian_socket=path)
        guardian = Guardian(settings, core, listener, LineCheck(port.path, "roomba600", signatures()))
        guardian.end(signal.SIGTERM, None)
        assert guardian.run() == 0
    assert lines == released
