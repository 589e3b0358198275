"""What a process tells of itself, what Linux tells of it and gives it, and the memory that it gives back."""

from __future__ import annotations

import asyncio
import os
import socket
import subprocess
import sys
import threading
from functools import cache
from typing import TYPE_CHECKING

import pytest

from fog_runtime import machine, process
from fog_runtime.health import reachable_address
from fog_runtime.machine import ServiceManager, SuspensionMonitor

if TYPE_CHECKING:
    from pathlib import Path


NEAR = ["tcp/127.0.0.1:7447"]


@pytest.mark.parametrize(
    ("host", "endpoints", "announced"),
    [
        ("0.0.0.0", NEAR, ["127.0.0.1:9100"]),  # every address: that on the way to the fog
        ("192.0.2.7", NEAR, ["192.0.2.7:9100"]),
        ("127.0.0.1", NEAR, ["127.0.0.1:9100"]),
        ("0.0.0.0", ["tcp/nowhere.invalid:7447", "tcp/127.0.0.1:7447?rel=1"], ["127.0.0.1:9100"]),
        ("::", ["tcp/[::1]:7447"], ["[::1]:9100", ""]),  # empty: a kernel without IPv6
        ("0.0.0.0", [], [""]),
        ("0.0.0.0", ["tcp/nowhere.invalid:7447"], [""]),
        ("0.0.0.0", ["tcp/127.0.0.1"], [""]),
        ("0.0.0.0", ["tcp/127.0.0.1:door"], [""]),
    ],
)
def test_server_is_announced_with_its_address_on_the_way_to_the_fog_if_there_is_one(host, endpoints, announced):
    assert reachable_address(host, 9100, endpoints) in announced


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
    clocks["monotonic"] += 0.5  # held up since it has read the other clock
    assert monitor.suspended() == 0.0
    clocks["boot"] += 0.5
    assert monitor.suspended() == 0.0


def test_running_computer_is_not_suspended():
    monitor = SuspensionMonitor()
    assert monitor.suspended() == 0.0


class Cycle:
    """Garbage that only a collection frees."""

    itself: Cycle


CODE = """
import gc
import numpy as np
from numba import njit
from fog_kernels.components import Components
from fog_runtime.process import release_startup_memory

Components(np.zeros((50, 50), np.uint8))
print(release_startup_memory())
compiler = held = 0
with open("/proc/self/smaps") as maps:
    for line in maps:
        if "-" in line.split()[0]:
            compiler = "libllvmlite" in line and " r" in line and " rw" not in line
        elif compiler and line.startswith("Rss:"):
            held += int(line.split()[1])
print(held)
print(len(gc.get_objects()))
assert Components(np.zeros((50, 50), np.uint8)).connected((0, 0), (49, 49))
assert njit(lambda x: x + 1)(1) == 2  # the compiler still works: its code is read again
"""


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_compiler_is_released_after_the_start_and_still_works() -> None:
    released, held_kib, _ = _run()
    assert released > 10_000_000
    assert held_kib < 8_000, "code and constants of the compiler, but for pages that its loading changed"


def test_collector_of_garbage_passes_over_what_the_start_has_made() -> None:
    _, _, looked_at = _run()
    assert looked_at < 1_000, "modules alone are more than 100,000 objects, which take 90 ms"


async def test_memory_is_released_as_soon_as_the_process_is_ready(monkeypatch: pytest.MonkeyPatch) -> None:
    released: list[int] = []
    monkeypatch.setattr(process, "_POLL_S", 0.001)
    monkeypatch.setattr(process, "release_startup_memory", lambda: released.append(0))
    ready: list[str] = []
    waiting = asyncio.create_task(process.release_when(lambda: bool(ready)))
    await asyncio.sleep(0.01)
    assert released == []
    ready.append("map")
    await asyncio.wait_for(waiting, 60.0)
    assert released == [0]


LIBRARIES = """
import numpy as np
from fog_runtime.process import release_startup_memory

def held():
    with open("/proc/self/smaps") as maps:
        library, kib = False, 0
        for line in maps:
            if "-" in line.split()[0]:
                library = "numpy" in line and ".so" in line
            elif library and line.startswith("Rss:"):
                kib += int(line.split()[1])
    return kib

np.linalg.svd(np.ones((3, 3)))
before = held()
release_startup_memory()
print(before - held())
assert np.linalg.svd(np.ones((3, 3)))[1].size == 3
"""


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_code_of_any_library_that_only_the_start_needed_is_released() -> None:
    done = subprocess.run([sys.executable, "-c", LIBRARIES], capture_output=True, text=True, check=True, timeout=120)
    assert int(done.stdout) > 2_000


@cache
def _run() -> tuple[int, int, int]:
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True, timeout=120)
    released, held_kib, looked_at = map(int, done.stdout.split())
    return released, held_kib, looked_at


def test_thread_that_ends_meanwhile_keeps_no_other_from_its_priority(monkeypatch):
    given = []

    def set_scheduler(thread, policy, parameters):
        if thread == os.getpid():
            raise ProcessLookupError
        given.append((thread, policy, parameters.sched_priority))

    monkeypatch.setattr(os, "sched_setscheduler", set_scheduler)
    ended = threading.Event()
    other = threading.Thread(target=ended.wait)
    other.start()
    try:
        assert machine.run_in_real_time(5) == "SCHED_RR 5"
        assert (other.native_id, os.SCHED_RR, 5) in given
    finally:
        ended.set()
        other.join()


def refuse(*_: object):
    raise PermissionError


def test_priority_that_is_refused_is_told(monkeypatch):
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "setpriority", refuse)
    assert machine.run_in_real_time(5).startswith("refused: ")
    assert machine.run_in_real_time(0) == "not requested"


def test_program_that_gets_no_real_time_gets_more_of_the_processor_where_that_is_allowed(monkeypatch):
    given = []
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "setpriority", lambda *call: given.append(call))
    assert machine.run_in_real_time(15).startswith("niceness -15, as SCHED_RR was refused: ")
    assert (os.PRIO_PROCESS, os.getpid(), -15) in given
