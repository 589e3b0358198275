"""Messages to systemd, received on a real socket."""

import socket
from pathlib import Path

import pytest

from fog_runtime.machine import service_manager
from fog_runtime.machine.service_manager import ServiceManager


@pytest.mark.parametrize("kind", ["path", "abstract"])
def test_manager_gets_readiness_and_signs_of_life_in_its_own_words(tmp_path: Path, kind: str) -> None:
    name = f"fognav-test-{tmp_path.name}" if kind == "abstract" else str(tmp_path / "manager")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(f"\0{name}" if kind == "abstract" else name)
        listener.settimeout(5.0)
        manager = ServiceManager(f"@{name}" if kind == "abstract" else name)
        manager.ready()
        manager.alive("waiting for\nlidar")
        assert listener.recv(4096) == b"READY=1"
        assert listener.recv(4096) == b"WATCHDOG=1\nSTATUS=waiting for lidar"


def test_signs_of_life_that_follow_each_other_quickly_are_sent_once(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "manager"))
        manager = ServiceManager(str(tmp_path / "manager"))
        for _ in range(3):
            manager.alive()
        manager.ready()
        assert [listener.recv(4096), listener.recv(4096)] == [b"WATCHDOG=1\nSTATUS=", b"READY=1"]


def test_manager_that_does_not_read_or_is_gone_delays_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service_manager, "ALIVE_S", 0.0)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "manager"))
        manager = ServiceManager(str(tmp_path / "manager"))
        for _ in range(5000):
            manager.ready()
    manager.alive("still here")


def test_without_a_manager_nothing_is_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    manager = ServiceManager()
    manager.ready()
    manager.alive()
