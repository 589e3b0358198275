from __future__ import annotations

import os
import select
import subprocess
import sys
import time

import pytest

from fognav_sim.pty_port import PtyPort

pytestmark = pytest.mark.live


def open_host(port: PtyPort) -> int:
    return os.open(port.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)


def read_until(read, size: int) -> bytes:
    data, deadline = b"", time.monotonic() + 60.0
    while len(data) < size and time.monotonic() < deadline:
        data += read()
    return data


def read_host(fd: int) -> bytes:
    return os.read(fd, 4096) if select.select([fd], [], [], 0.2)[0] else b""


def test_every_byte_value_passes_both_ways():
    all_bytes = bytes(range(256))
    with PtyPort() as port:
        host = open_host(port)
        port.write(all_bytes)
        assert read_until(lambda: read_host(host), 256) == all_bytes
        os.write(host, all_bytes)
        assert select.select([port], [], [], 5.0)[0]
        assert read_until(port.read, 256) == all_bytes
        assert port.read() == b""
        os.close(host)


def test_hosts_can_reconnect_and_crash():
    code = "import os, sys; fd = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); os.write(fd, b'hi'); os._exit(3)"
    with PtyPort() as port:
        for _ in range(2):
            subprocess.run([sys.executable, "-c", code, str(port.path)], check=False, timeout=30)
            assert read_until(port.read, 2) == b"hi"
            assert port.read() == b""
            port.write(b"")


def test_host_that_does_not_read_loses_old_bytes_and_never_blocks():
    with PtyPort() as port:
        host = open_host(port)
        for number in range(40_000):
            port.write(number.to_bytes(2, "big"))
        assert port.lost_bytes > 40_000
        received = bytearray()
        while piece := read_host(host):
            received += piece
            port.write(b"")
        assert bytes(received[-2:]) == (39_999).to_bytes(2, "big")
        assert len(received) + port.lost_bytes == 80_000
        os.close(host)


def test_link_is_replaced_atomically_and_removed_on_close(tmp_path):
    link = tmp_path / "run" / "roomba"
    first = PtyPort(link)
    second = PtyPort(link)
    assert link.readlink() == second.slave_path
    first.close()
    assert link.readlink() == second.slave_path
    assert [entry.name for entry in link.parent.iterdir()] == ["roomba"]
    second.close()
    second.close()
    assert not link.is_symlink()


def test_regular_file_is_never_replaced_by_the_link(tmp_path):
    link = tmp_path / "roomba"
    link.write_text("mine")
    with pytest.raises(FileExistsError, match="not a symbolic link"):
        PtyPort(link)
    assert link.read_text() == "mine"
