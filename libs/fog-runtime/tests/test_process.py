"""A process ends as it is told, and says why when it isn't."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.live

PROGRAM = """
import asyncio, sys
from fog_runtime import logs, process
logs.configure("p")
async def main():
    print("up", flush=True)
    try:
        await asyncio.sleep({seconds})
        {body}
    finally:
        print("cleaned", flush=True)
process.run(main)
"""


def start(body="pass", seconds=60.0):
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM.format(body=body, seconds=seconds)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signal_cancels_cleans_up_and_exits_zero(number):
    with start() as child:
        assert child.stdout.readline() == "up\n"
        child.send_signal(number)
        out, err = child.communicate(timeout=20)
    assert (out, child.returncode) == ("cleaned\n", 0)
    assert [json.loads(line)["event"] for line in err.splitlines()] == ["stopping", "stopped"]


def test_crash_is_one_event_and_status_one():
    body = "raise ExceptionGroup('many', [ValueError('the reason')])"
    with start(body, seconds=0.0) as child:
        out, err = child.communicate(timeout=20)
    (line,) = err.splitlines()
    assert (out, child.returncode) == ("up\ncleaned\n", 1)
    assert json.loads(line)["reason"] == "ValueError: the reason"


def test_child_dies_with_its_parent():
    parent = (
        "import subprocess, sys, time\n"
        "child = subprocess.Popen([sys.executable, '-c', "
        "'from fog_runtime.process import die_with_parent; import time; die_with_parent(); "
        'print("up", flush=True); time.sleep(60)\'])\n'
        "print(child.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE, text=True) as process:
        pid = int(process.stdout.readline())
        assert process.stdout.readline() == "up\n"
        process.kill()
    deadline = time.monotonic() + 10
    while alive(pid):
        assert time.monotonic() < deadline, "the child outlived its parent"
        time.sleep(0.02)


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
