"""A process ends cleanly on a signal, and logs the reason when it crashes."""

import json
import signal
import subprocess
import sys

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
def test_signal_cancels_main_and_exits_with_status_zero(number):
    with start() as child:
        assert child.stdout.readline() == "up\n"
        child.send_signal(number)
        out, err = child.communicate(timeout=20)
    assert (out, child.returncode) == ("cleaned\n", 0)
    assert [json.loads(line)["event"] for line in err.splitlines()] == ["stopping", "stopped"]


def test_crash_is_logged_once_and_exits_with_status_one():
    body = "raise ExceptionGroup('many', [ValueError('the reason')])"
    with start(body, seconds=0.0) as child:
        out, err = child.communicate(timeout=20)
    (line,) = err.splitlines()
    assert (out, child.returncode) == ("up\ncleaned\n", 1)
    assert json.loads(line)["reason"] == "ValueError: the reason"
