import asyncio
import os
import signal
import sys
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import psutil
import pytest

from fog_supervisor.supervisor import Event, NotReadyError, Program, Supervisor, log_tail

pytestmark = pytest.mark.live
DEADLINE_S = 60.0
"""For any wait, which ends with what it waits for."""


async def until(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, f"{what} did not happen"
        await asyncio.sleep(0.01)


class Bench:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.events: list[Event] = []
        self.supervisor = Supervisor(self.events.append)

    def add(self, name: str, code: str, ready: str | None = None, rank: int = 0) -> None:
        async def is_ready() -> str | None:
            return None if ready is None or (self.folder / ready).exists() else f"{ready} is missing"

        self.supervisor.add(
            Program(
                name=name,
                arguments=(sys.executable, "-S", "-c", code),
                log=self.folder / f"{name}.log",
                environment={"FOLDER": str(self.folder)},
                ready=is_ready,
                rank=rank,
            )
        )

    def event_kinds(self, name: str) -> list[str]:
        return [event.kind for event in self.events if event.program == name]


@pytest.fixture
async def bench(tmp_path: Path) -> AsyncIterator[Bench]:
    bench = Bench(tmp_path)
    async with bench.supervisor:
        yield bench


SLEEPER = "import time\nprint('up', flush=True)\ntime.sleep(600)"
STUBBORN = (
    "import os, pathlib, signal, time\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
    "(pathlib.Path(os.environ['FOLDER']) / 'ignores_sigterm').touch()\ntime.sleep(600)"
)
PARENT = (
    "import os, pathlib, subprocess, sys, time\n"
    "child = subprocess.Popen([sys.executable, '-S', '-c', 'import time; time.sleep(600)'])\n"
    "file = pathlib.Path(os.environ['FOLDER']) / 'child'\n"
    "file.with_suffix('.new').write_text(str(child.pid))\n"
    "file.with_suffix('.new').rename(file)\n"
    "time.sleep(600)"
)


async def test_killed_program_is_restarted(bench: Bench) -> None:
    bench.add("sleeper", SLEEPER)
    bench.supervisor.start("sleeper")
    await until(lambda: bench.supervisor.pid("sleeper") is not None, "the start")
    first = bench.supervisor.kill("sleeper")
    await until(lambda: bench.supervisor.pid("sleeper") not in {None, first}, "the restart")
    assert bench.event_kinds("sleeper") == ["started", "killed", "exited", "started"]
    assert not psutil.pid_exists(first)


async def test_program_that_ended_by_a_signal_without_a_name_is_restarted(bench: Bench) -> None:
    bench.add("sleeper", SLEEPER)
    bench.supervisor.start("sleeper")
    await until(lambda: bench.supervisor.pid("sleeper") is not None, "the start")
    first = bench.supervisor.pid("sleeper")
    assert first is not None
    os.kill(first, signal.SIGRTMIN + 6)
    await until(lambda: bench.supervisor.pid("sleeper") not in {None, first}, "the restart")
    assert f"ended by signal {signal.SIGRTMIN + 6}" in bench.events[1].detail


async def test_program_that_could_not_be_started_is_tried_again(bench: Bench) -> None:
    name = "logs/sleeper"  # in a folder that is missing for a moment
    bench.add(name, SLEEPER)
    bench.supervisor.start(name)
    await until(lambda: "exited" in bench.event_kinds(name), "the event")
    assert bench.events[0].detail.startswith("could not be started: [Errno 2] No such file or directory")
    with pytest.raises(NotReadyError, match="could not be started"):
        await bench.supervisor.wait_ready([name], 0.0)
    (bench.folder / "logs").mkdir()
    await until(lambda: bench.supervisor.pid(name) is not None, "the start")
    assert bench.event_kinds(name)[-1] == "started"
    await bench.supervisor.stop(name)


async def test_restart_delay_doubles_while_a_program_keeps_exiting(bench: Bench) -> None:
    bench.add("broken", "raise SystemExit(3)")
    bench.supervisor.start("broken")
    await until(lambda: bench.event_kinds("broken").count("exited") == 3, "the third exit")
    exits = [event for event in bench.events if event.kind == "exited"]
    assert [event.detail for event in exits] == [
        "exit code 3; restarting in 0.2 s",
        "exit code 3; restarting in 0.4 s",
        "exit code 3; restarting in 0.8 s",
    ]


async def test_stopped_program_stays_stopped_until_started(bench: Bench) -> None:
    bench.add("sleeper", SLEEPER)
    bench.supervisor.start("sleeper")
    await until(lambda: bench.supervisor.pid("sleeper") is not None, "the start")
    await bench.supervisor.stop("sleeper")
    assert bench.supervisor.pid("sleeper") is None
    assert bench.event_kinds("sleeper")[-1] == "stopped"
    bench.supervisor.start("sleeper")
    await until(lambda: bench.supervisor.starts("sleeper") == 2, "the second start")


async def test_stopping_during_the_restart_delay_cancels_the_restart(bench: Bench) -> None:
    bench.add("broken", "raise SystemExit(3)")
    bench.supervisor.start("broken")
    await until(lambda: bench.event_kinds("broken")[-1:] == ["exited"], "the exit")
    await bench.supervisor.stop("broken")
    starts = bench.supervisor.starts("broken")
    await asyncio.sleep(0.5)  # longer than the backoff that was cancelled
    assert bench.supervisor.starts("broken") == starts


async def test_program_that_ignores_sigterm_is_killed(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fog_supervisor.supervisor.END_TIMEOUT_S", 0.2)
    bench.add("stubborn", STUBBORN, ready="ignores_sigterm")
    bench.supervisor.start("stubborn")
    await bench.supervisor.wait_ready(["stubborn"], DEADLINE_S)
    pid = bench.supervisor.pid("stubborn")
    assert pid is not None
    await bench.supervisor.stop("stubborn")
    assert not psutil.pid_exists(pid)


async def test_program_paused_by_sigstop_can_be_stopped(bench: Bench) -> None:
    bench.add("sleeper", SLEEPER)
    bench.supervisor.start("sleeper")
    await until(lambda: bench.supervisor.pid("sleeper") is not None, "the start")
    pid = bench.supervisor.kill("sleeper", signal.SIGSTOP)
    await bench.supervisor.stop("sleeper")
    assert not psutil.pid_exists(pid)


async def test_children_of_a_program_end_with_it(bench: Bench) -> None:
    bench.add("parent", PARENT, ready="child")
    bench.supervisor.start("parent")
    await bench.supervisor.wait_ready(["parent"], DEADLINE_S)
    child = psutil.Process(int((bench.folder / "child").read_text()))
    bench.supervisor.kill("parent")
    await until(lambda: not child.is_running() or child.status() == psutil.STATUS_ZOMBIE, "the end of the child")


async def test_program_that_is_not_ready_in_time_is_named_with_its_log(bench: Bench) -> None:
    bench.add("sleeper", SLEEPER, ready="never")
    bench.supervisor.start("sleeper")
    await until(lambda: log_tail(bench.folder / "sleeper.log") == "up", "the log line")
    with pytest.raises(NotReadyError, match=r"(?s)sleeper is not ready: never is missing.*up"):
        await bench.supervisor.wait_ready(["sleeper"], 0.1)


async def test_programs_with_higher_rank_are_stopped_first(bench: Bench) -> None:
    bench.add("server", SLEEPER, rank=0)
    bench.add("robot", SLEEPER, rank=2)
    for name in ("server", "robot"):
        bench.supervisor.start(name)
    await until(lambda: bench.supervisor.starts("server") + bench.supervisor.starts("robot") == 2, "both starts")
    await bench.supervisor.close()
    assert [event.program for event in bench.events if event.kind == "stopped"] == ["robot", "server"]


def test_programs_end_with_their_supervising_process_even_when_it_is_killed(tmp_path: Path) -> None:
    code = (
        "import asyncio, os, pathlib, sys\n"
        "from fog_supervisor.supervisor import Program, Supervisor\n"
        "async def main():\n"
        "    supervisor = Supervisor(lambda event: None)\n"
        "    folder = pathlib.Path(sys.argv[1])\n"
        "    arguments = (sys.executable, '-S', '-c', 'import time; time.sleep(600)')\n"
        "    supervisor.add(Program(name='p', arguments=arguments, log=folder / 'log'))\n"
        "    supervisor.start('p')\n"
        "    while supervisor.pid('p') is None:\n"
        "        await asyncio.sleep(0.01)\n"
        "    (folder / 'new').write_text(str(supervisor.pid('p')))\n"
        "    (folder / 'new').rename(folder / 'pid')\n"
        "    await asyncio.sleep(600)\n"
        "asyncio.run(main())\n"
    )
    pid_of_command = os.spawnv(os.P_NOWAIT, sys.executable, [sys.executable, "-c", code, str(tmp_path)])
    deadline = time.monotonic() + DEADLINE_S
    while not (tmp_path / "pid").exists():
        assert time.monotonic() < deadline
        time.sleep(0.02)
    program = psutil.Process(int((tmp_path / "pid").read_text()))
    os.kill(pid_of_command, signal.SIGKILL)
    os.waitpid(pid_of_command, 0)
    while program.is_running() and program.status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < deadline, "the program outlived its parent"
        time.sleep(0.02)
