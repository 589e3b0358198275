"""What the two processes that keep the wheels safe load, and what they ask of the kernel so that nothing delays them.

They restart while the wheels are held, and must be small.
"""

import os
import subprocess
import sys
import threading

import pytest

from robot_agent.guardian.protection import run_in_real_time

CODE = "import importlib, sys; importlib.import_module(sys.argv[1]); print(*sys.modules)"


@pytest.mark.parametrize(
    ("module", "unneeded"),
    [
        (
            "robot_agent.guardian.__main__",
            {"numpy", "numba", "zenoh", "fastapi", "prometheus_client", "asyncio", "ssl", "hashlib"},
        ),
        ("robot_agent.guardian.watchdog", {"numpy", "msgspec", "asyncio", "dataclasses", "fog_contracts"}),
    ],
)
def test_process_of_the_wheels_loads_no_library_that_it_does_not_need(module: str, unneeded: set[str]) -> None:
    done = subprocess.run([sys.executable, "-c", CODE, module], capture_output=True, text=True, check=True)
    assert unneeded & set(done.stdout.split()) == set()


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
        assert run_in_real_time(5) == "SCHED_RR 5"
        assert (other.native_id, os.SCHED_RR, 5) in given
    finally:
        ended.set()
        other.join()


def refuse(*_):
    raise PermissionError


def test_priority_that_is_refused_is_told(monkeypatch):
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "setpriority", refuse)
    assert run_in_real_time(5).startswith("refused: ")
    assert run_in_real_time(0) == "not requested"


def test_program_that_gets_no_real_time_gets_more_of_the_processor_where_that_is_allowed(monkeypatch):
    given = []
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "setpriority", lambda *call: given.append(call))
    assert run_in_real_time(15).startswith("niceness -15, as SCHED_RR was refused: ")
    assert (os.PRIO_PROCESS, os.getpid(), -15) in given
