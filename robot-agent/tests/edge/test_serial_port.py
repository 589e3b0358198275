from __future__ import annotations

import errno
import os
import pty
import select
import subprocess
import sys
import termios
import tty

import pytest

from robot_agent import serial_port
from robot_agent.serial_port import Port, PortLost, open_port

pytestmark = pytest.mark.live


@pytest.fixture
def line():
    master, slave = pty.openpty()
    tty.setraw(slave)
    path = os.ttyname(slave)
    os.close(slave)
    ends = [master]
    yield ends, path
    for fd in ends:
        os.close(fd)


def read_some(port: Port) -> bytes:
    assert select.select([port], [], [], 60.0)[0], "nothing was received for a minute"
    return port.read_available()


def test_every_byte_value_passes_both_ways(line):
    (master,), path = line
    every = bytes(range(256))
    with open_port(path, 115200) as port:
        assert port.read_available() == b""
        os.write(master, every)
        received = b""
        while len(received) < 256:
            received += read_some(port)
        assert received == every
        port.write(every)
        assert os.read(master, 4096) == every


def test_the_line_is_115200_8n1_and_raw(line):
    _, path = line
    with open_port(path, 115200) as port:
        iflag, oflag, cflag, lflag, ispeed, ospeed, _ = termios.tcgetattr(port.fileno())
    assert (iflag, oflag, lflag) == (0, 0, 0)
    assert cflag & termios.CSIZE == termios.CS8
    assert not cflag & (termios.PARENB | termios.CSTOPB | termios.CRTSCTS)
    assert (ispeed, ospeed) == (termios.B115200, termios.B115200)


def test_control_lines_of_a_pty_do_not_exist(line):
    _, path = line
    with open_port(path, 115200) as port:
        assert port.set_line("dtr", on=False) is False
        assert port.set_line("rts", on=True) is False


def test_the_rate_changes_for_all_who_share_the_terminal(line):
    (master,), path = line
    with open_port(path, 115200) as port:
        Port.from_fd(port.fileno()).set_baud(19200)
        assert termios.tcgetattr(port.fileno())[4:6] == [termios.B19200, termios.B19200]
        port.write(b"x")
        assert os.read(master, 1) == b"x"
        with pytest.raises(PortLost, match="no rate of 12345 baud"):
            port.set_baud(12345)


def test_lost_device_raises_port_lost_with_a_remedy(line):
    ends, path = line
    with open_port(path, 115200) as port:
        os.close(ends.pop())
        with pytest.raises(PortLost, match="plugged in") as lost:
            port.read_available()
        assert lost.value.path == path
        with pytest.raises(PortLost):
            port.write(b"\x80")


def test_missing_device_and_plain_file_are_refused(tmp_path):
    with pytest.raises(PortLost, match="No such file"):
        open_port(str(tmp_path / "none"), 115200)
    plain = tmp_path / "plain"
    plain.write_bytes(b"")
    with pytest.raises(PortLost, match="not a serial device"):
        open_port(str(plain), 115200)


def test_a_port_in_use_is_refused_and_free_after_close(line):
    _, path = line
    with open_port(path, 115200), pytest.raises(PortLost, match="another process has locked it"):
        open_port(path, 115200)
    open_port(path, 115200).close()


@pytest.mark.parametrize("number", [errno.EACCES, errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_lock_that_no_other_process_holds_but_the_system_refuses_is_named(line, monkeypatch, number):
    def refused(_fd, _operation):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(serial_port.fcntl, "flock", refused)
    with pytest.raises(PortLost, match=rf"can't be locked for this process alone \({os.strerror(number)}\)") as raised:
        open_port(line[1], 115200)
    assert "another process has locked it" not in str(raised.value)


def test_write_to_a_device_that_accepts_nothing_raises_port_lost(line):
    _, path = line
    with open_port(path, 115200) as port, pytest.raises(PortLost, match="no byte"):
        port.write(bytes(1_000_000))


def test_another_process_can_use_the_inherited_descriptor(line):
    (master,), path = line
    code = (
        "import sys; from robot_agent.serial_port import Port; "
        "port = Port.from_fd(int(sys.argv[1])); port.write(b'stop'); port.close()"
    )
    with open_port(path, 115200) as port:
        subprocess.run(
            [sys.executable, "-c", code, str(port.fileno())], pass_fds=(port.fileno(),), check=True, timeout=30
        )
        assert os.read(master, 100) == b"stop"
        os.write(master, b"on")
        assert read_some(port) == b"on"


def test_a_descriptor_that_is_not_open_is_refused():
    with pytest.raises(PortLost, match="inherited descriptor"):
        Port.from_fd(987654)


def test_closing_twice_is_harmless(line):
    _, path = line
    port = open_port(path, 115200)
    port.close()
    port.close()
    assert port.fileno() == -1


def test_a_real_device_is_opened_exclusively_and_without_added_latency(line, monkeypatch):
    _, path = line
    requests = []

    def ioctl(_fd, request, values=0):
        requests.append((request, bytes(values) if isinstance(values, bytearray) else values))

    monkeypatch.setattr(serial_port, "_is_pty", lambda _device: False)
    monkeypatch.setattr(serial_port.fcntl, "ioctl", ioctl)
    open_port(path, 115200).close()
    assert requests[0][0] == termios.TIOCEXCL
    assert [request for request, _ in requests[1:]] == [termios.TIOCGSERIAL, termios.TIOCSSERIAL]
    assert int.from_bytes(requests[2][1][16:20], sys.byteorder) == 1 << 13


def test_a_device_without_that_timer_is_opened_all_the_same(line, monkeypatch):
    (master,), path = line
    monkeypatch.setattr(serial_port, "_is_pty", lambda _device: False)
    monkeypatch.setattr(serial_port.termios, "TIOCEXCL", termios.TIOCNXCL)  # a pty would stay exclusive
    with open_port(path, 115200) as port:
        port.write(b"x")
        assert os.read(master, 1) == b"x"
