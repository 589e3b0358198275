"""What a process asks of the kernel so that nothing delays it."""

import os
import threading

from robot_agent.guardian.protection import run_in_real_time


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
