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


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT])
def test_signal_cancels_main_and_exits_with_status_zero(number):
    with start() as child:
        assert child.stdout.readline() == "up\n"
        child.send_signal(number)
        out, err = child.communicate(timeout=60)
    assert (out, child.returncode) == ("cleaned\n", 0)
    assert [json.loads(line)["event"] for line in err.splitlines()] == ["stopping", "stopped"]


@pytest.mark.parametrize("ends_itself", [False, True])
def test_process_that_does_not_end_when_it_is_to_shows_where_it_hangs_and_exits_with_status_one(tmp_path, ends_itself):
    folder = f"Path({str(tmp_path)!r})"
    changes = f"maps = UploadedMaps({folder}); ({folder} / FILE).write_text('another'); await maps.until_changed()"
    program = "from pathlib import Path\nfrom fog_runtime.configuration.uploaded_maps import FILE, UploadedMaps\n"
    program += PROGRAM.format(body=changes if ends_itself else "pass", seconds=0.0 if ends_itself else 60.0).replace(
        'print("cleaned", flush=True)', "await asyncio.Event().wait()"
    )
    command = [sys.executable, "-c", program.replace("process.run(main)", "process.ENDING_S = 0.3; process.run(main)")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as child:
        assert child.stdout.readline() == "up\n"
        if not ends_itself:
            child.send_signal(signal.SIGTERM)
        _, err = child.communicate(timeout=20)
    assert child.returncode == 1
    assert "Timeout (0:00:00.300000)!" in err
    assert "_run_once" in err


def test_crash_is_logged_once_and_exits_with_status_one():
    body = "raise ExceptionGroup('many', [ValueError('the reason')])"
    with start(body, seconds=0.0) as child:
        out, err = child.communicate(timeout=60)
    (line,) = err.splitlines()
    assert (out, child.returncode) == ("up\ncleaned\n", 1)
    assert json.loads(line)["reason"] == "ValueError: the reason"


def test_process_that_is_to_be_started_again_ends_in_order_unless_something_else_went_wrong():
    again = "process.AgainError('another map')"
    with start(f"raise ExceptionGroup('many', [{again}])", seconds=0.0) as child:
        _, err = child.communicate(timeout=60)
    assert (child.returncode, json.loads(err)["event"], json.loads(err)["reason"]) == (
        0, "starting_again", "another map",
    )  # fmt: skip
    with start(f"raise ExceptionGroup('many', [{again}, ValueError('the reason')])", seconds=0.0) as child:
        child.communicate(timeout=60)
    assert child.returncode == 1


def test_hang_up_ends_no_process_that_nohup_started():
    with subprocess.Popen(
        ["nohup", sys.executable, "-c", PROGRAM.format(body="pass", seconds=60.0)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as child:
        assert child.stdout.readline() == "up\n"
        child.send_signal(signal.SIGHUP)
        child.send_signal(signal.SIGTERM)
        _, err = child.communicate(timeout=60)
    assert [json.loads(line).get("signal") for line in err.splitlines() if "stopping" in line] == ["SIGTERM"]


def test_second_hang_up_does_not_cut_the_orderly_end_short():
    body = "pass\n    except asyncio.CancelledError:\n        await asyncio.sleep(0.5)\n        raise"
    with start(body) as child:
        assert child.stdout.readline() == "up\n"
        child.send_signal(signal.SIGHUP)
        assert "stopping" in child.stderr.readline()
        child.send_signal(signal.SIGHUP)
        out, _ = child.communicate(timeout=60)
    assert (out, child.returncode) == ("cleaned\n", 0)


ASIDE = """
import asyncio, threading
from fog_runtime import logs, process
logs.configure("p")
def load():
    {load}
async def main():
    try:
        print(await process.load_aside(load), flush=True)
    finally:
        print("cleaned", flush=True)
process.run(main)
"""


def start_loading(load):
    command = [sys.executable, "-c", ASIDE.format(load=load)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_signal_ends_a_process_in_order_that_loads_something_for_ever():
    with start_loading("print('up', flush=True); threading.Event().wait()") as child:
        assert child.stdout.readline() == "up\n"
        child.send_signal(signal.SIGTERM)
        out, err = child.communicate(timeout=60)
    assert (out, child.returncode) == ("cleaned\n", 0)
    assert [json.loads(line)["event"] for line in err.splitlines()] == ["stopping", "stopped"]


def test_what_was_loaded_aside_is_returned_and_its_error_is_logged_with_status_one():
    with start_loading(
        "import gc; return f'on {threading.current_thread().name}, collects: {gc.isenabled()}'"
    ) as child:
        out, _ = child.communicate(timeout=60)
    assert (out, child.returncode) == ("on loading, collects: False\ncleaned\n", 0)
    with start_loading("raise ImportError('no such kernel')") as child:
        out, err = child.communicate(timeout=60)
    assert (out, child.returncode) == ("cleaned\n", 1)
    assert json.loads(err)["reason"] == "ImportError: no such kernel"


HELD = """
import threading
class Held(threading.Thread):
    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.joined = threading.Event()
    def run(self):
        print("held", flush=True)
        self.joined.wait()
        super().run()
    def join(self, timeout=None):
        self.joined.set()
        super().join(timeout)
threading.Thread = Held
"""


def test_what_a_signal_cancels_before_its_thread_begins_is_not_loaded_and_does_not_delay_the_end():
    """The thread gets to its first line when the loop waits for it, which is after the cancellation."""
    load = "print('loading', flush=True); threading.Event().wait()"
    command = [sys.executable, "-c", HELD + ASIDE.format(load=load)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as child:
        assert child.stdout.readline() == "held\n"
        child.send_signal(signal.SIGTERM)
        out, err = child.communicate(timeout=60)
    assert (out, child.returncode) == ("cleaned\n", 0)
    assert [json.loads(line)["event"] for line in err.splitlines()] == ["stopping", "stopped"]
