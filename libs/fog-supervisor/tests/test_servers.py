"""Servers of a demo's or a test's process end with it, however it ends, and not with the thread that asked for them."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from fog_supervisor.net import LOOPBACK
from fog_supervisor.servers import Server, ServerProgram, start_redis

pytestmark = [
    pytest.mark.live,
    pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends programs with their parent"),
]

DEADLINE_S = 60.0
STARTING = """
import pathlib, sys, threading, time
from fog_supervisor.servers import start_mosquitto, start_redis

folder, servers = pathlib.Path(sys.argv[1]), []

def start():
    servers.append(start_mosquitto(folder / "mosquitto"))
    servers.append(start_redis(folder / "redis"))

starting = threading.Thread(target=start)
starting.start()
starting.join()
print(*(server.pid for server in servers), flush=True)
sys.stdin.readline()
print(*(server.running() and server.program.ready() for server in servers), flush=True)
time.sleep(600)
"""

FORKING = """
import os, pathlib, sys
from fog_supervisor.servers import start_redis

folder = pathlib.Path(sys.argv[1])
with start_redis(folder / "first"):
    if child := os.fork():
        sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
    with start_redis(folder / "second") as server:
        print(server.running() and server.program.ready(), flush=True)
    os._exit(7)
"""


def has_ended(process: psutil.Process) -> bool:
    try:
        return process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def test_servers_end_with_the_process_that_is_killed_and_outlive_the_thread_that_started_them(tmp_path: Path) -> None:
    command = [sys.executable, "-c", STARTING, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as starter:
        assert starter.stdin is not None
        assert starter.stdout is not None
        try:
            servers = [psutil.Process(int(pid)) for pid in starter.stdout.readline().split()]
            assert [each.name() for each in servers] == ["mosquitto", "redis-server"]
            starter.stdin.write("\n")
            starter.stdin.flush()
            assert starter.stdout.readline() == "True True\n"
        finally:
            os.kill(starter.pid, signal.SIGKILL)
    deadline = time.monotonic() + DEADLINE_S
    while not all(has_ended(each) for each in servers):
        assert time.monotonic() < deadline, "a server outlived the process that started it"
        time.sleep(0.02)


def test_process_that_was_forked_after_a_server_was_started_starts_servers_of_its_own(tmp_path: Path) -> None:
    command = [sys.executable, "-c", FORKING, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True) as starter:
        try:
            output, _ = starter.communicate(timeout=DEADLINE_S)
        finally:
            if starter.poll() is None:  # neither of the two ends
                os.killpg(starter.pid, signal.SIGKILL)
    assert (output, starter.returncode) == ("True\n", 7)


def test_what_goes_wrong_on_the_thread_that_starts_servers_is_told_and_the_next_server_starts(tmp_path: Path) -> None:
    impossible = ServerProgram(name="none", port=1, url="none", address=LOOPBACK, command=("no\0path",))
    with pytest.raises(ValueError, match="null byte"):
        Server(impossible, tmp_path)
    with start_redis(tmp_path) as server:
        assert server.program.ready()
