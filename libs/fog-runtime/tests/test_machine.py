"""What a process tells of itself, and what Linux tells of it: address, service manager, suspension, threads."""

from __future__ import annotations

import os
import socket
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import pytest

from fog_runtime import machine
from fog_runtime.health import reachable_address
from fog_runtime.machine import ServiceManager, SuspensionMonitor
from fog_runtime.usage import name_thread, sample

if TYPE_CHECKING:
    from pathlib import Path


def test_server_on_every_address_is_announced_with_the_address_on_the_way_to_the_fog():
    assert reachable_address("0.0.0.0", 9100, ["tcp/127.0.0.1:7447"]) == "127.0.0.1:9100"


def test_server_on_one_address_is_announced_with_it():
    assert reachable_address("192.0.2.7", 9100, ["tcp/127.0.0.1:7447"]) == "192.0.2.7:9100"


def test_server_on_the_loopback_is_announced_to_a_fog_on_the_same_machine():
    assert reachable_address("127.0.0.1", 9100, ["tcp/127.0.0.1:7447"]) == "127.0.0.1:9100"


def test_endpoint_that_nobody_knows_is_passed_over():
    endpoints = ["tcp/nowhere.invalid:7447", "tcp/127.0.0.1:7447?rel=1"]
    assert reachable_address("0.0.0.0", 9100, endpoints) == "127.0.0.1:9100"


def test_address_of_version_6_is_put_in_brackets():
    assert reachable_address("::", 9100, ["tcp/[::1]:7447"]) in ("[::1]:9100", "")  # empty: a kernel without IPv6


@pytest.mark.parametrize("endpoints", [[], ["tcp/nowhere.invalid:7447"], ["tcp/127.0.0.1"], ["tcp/127.0.0.1:door"]])
def test_nothing_is_announced_without_a_way_to_the_fog(endpoints):
    assert reachable_address("0.0.0.0", 9100, endpoints) == ""


def test_loopback_is_not_announced_to_a_fog_elsewhere(monkeypatch):
    monkeypatch.setattr("fog_runtime.health._own_side", lambda _towards: "192.0.2.20")
    assert reachable_address("127.0.0.1", 9100, ["tcp/192.0.2.1:7447"]) == ""
    assert reachable_address("localhost", 9100, ["tcp/192.0.2.1:7447"]) == ""


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
    monkeypatch.setattr(machine, "ALIVE_S", 0.0)
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


def test_suspension_is_the_growth_of_boot_time_over_monotonic_time():
    clocks = {"monotonic": 100.0, "boot": 130.0}
    monitor = SuspensionMonitor(lambda: clocks["monotonic"], lambda: clocks["boot"])
    clocks["monotonic"] += 5.0
    clocks["boot"] += 5.001
    assert monitor.suspended() == 0.0
    clocks["monotonic"] += 0.05
    clocks["boot"] += 60.05
    assert monitor.suspended() == pytest.approx(60.0)
    assert monitor.suspended() == 0.0


def test_running_computer_is_not_suspended():
    monitor = SuspensionMonitor()
    assert monitor.suspended() == 0.0


def test_named_thread_is_listed_by_its_name_among_the_threads_of_its_process():
    before = {thread.name for thread in sample(os.getpid()).values()}
    with ThreadPoolExecutor(1, initializer=name_thread, initargs=("decide-7",)) as pool:
        names = pool.submit(lambda: [thread.name for thread in sample(os.getpid()).values()]).result()
    assert "decide-7" not in before
    assert names.count("decide-7") == 1


def test_thread_keeps_its_name_where_the_list_can_not_be_written(tmp_path):
    name_thread("decide", tmp_path)
