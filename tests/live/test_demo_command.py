"""The command as its users start and end it: demos side by side, Ctrl-C, a request to end, and a kill."""

from __future__ import annotations

import asyncio
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import psutil
import pytest

from fog_contracts import channels as ch
from fog_contracts.messages import MapHeartbeat, SimTruth
from fog_runtime.clock import SystemClock
from fog_runtime.record import read
from fog_runtime.zenoh_edge import ZenohEdge

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

pytestmark = [pytest.mark.live, pytest.mark.timeout(120)]

DRIVES_S = 60.0
"""For everything to start, twice at the same time on a small machine."""
ENDS_S = 15.0
"""For everything to end; the supervisor gives each rank of programs 5 s before it uses force."""
PROCESSES = 10
"""Nine programs, and the guardian under its watchdog."""
NOT_TRUE = 1
ESTIG = Path(__file__).parents[2] / "sites" / "estig"
CORES = Path(__file__).parents[1] / "replay" / "cores.py"


def alive(process: psutil.Process) -> bool:
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


async def until(condition: Callable[[], bool], timeout_s: float, what: Callable[[], str]) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f"{timeout_s:.0f} s passed before {what()}"
        await asyncio.sleep(0.05)


class Command:
    """A demo in a process group of its own, as a shell starts it."""

    def __init__(self, folder: Path, name: str, *options: str) -> None:
        self.report = folder / f"{name}.json"
        self._said = folder / f"{name}.txt"
        command = [sys.executable, "-m", "fognav", "demo", "--headless", "--report", str(self.report), *options]
        with self._said.open("wb") as said:
            self.process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=said, stderr=said, process_group=0
            )

    @property
    def said(self) -> str:
        return self._said.read_text("utf-8")

    @property
    def folder(self) -> Path | None:
        """The folder of the attempt that runs, once it is told."""
        found = re.findall(r"^starting .* logs in (\S+)/logs$", self.said, re.MULTILINE)
        return Path(found[-1]) if found else None

    async def wait_for(self, pattern: str, timeout_s: float) -> None:
        def told() -> bool:
            assert self.process.poll() is None, f"it ended with {self.process.returncode}:\n{self.said}"
            return re.search(pattern, self.said, re.MULTILINE) is not None

        await until(told, timeout_s, lambda: f"it said {pattern!r}:\n{self.said}")

    def children(self) -> list[psutil.Process]:
        return psutil.Process(self.process.pid).children(recursive=True)

    async def ends(self, timeout_s: float) -> int:
        """Return the exit code."""
        await until(lambda: self.process.poll() is not None, timeout_s, lambda: f"its end:\n{self.said}")
        return self.process.returncode


def ports_of(processes: list[psutil.Process]) -> set[int]:
    return {
        connection.laddr.port
        for process in processes
        for connection in process.net_connections("tcp")
        if connection.status == psutil.CONN_LISTEN
    }


def those_of(folder: Path) -> list[psutil.Process]:
    """Return every process of this machine that was told of the folder, whoever its parent is by now."""
    found = []
    for process in psutil.process_iter():
        try:
            told = [*process.cmdline(), *process.environ().values()]
        except (psutil.NoSuchProcess, psutil.AccessDenied):
            continue
        if any(str(folder) in text for text in told) and alive(process):
            found.append(process)
    return found


@pytest.fixture
def begin(tmp_path: Path) -> Iterator[Callable[..., Command]]:
    """Start demos; whatever a failed test leaves of them is removed."""
    begun: list[Command] = []

    def start(name: str, *options: str) -> Command:
        begun.append(Command(tmp_path, name, *options))
        return begun[-1]

    yield start
    for command in begun:
        if command.process.poll() is None:
            command.process.kill()  # its programs die with it
            command.process.wait()
        if command.folder is not None:
            shutil.rmtree(command.folder, ignore_errors=True)


def has_left_nothing(command: Command, folder: Path, children: list[psutil.Process], ports: set[int]) -> None:
    assert [child for child in children if alive(child)] == []
    assert those_of(folder) == []
    assert not folder.exists()
    assert [port for port in sorted(ports) if listens(port)] == []
    report = json.loads(command.report.read_text("utf-8"))
    assert (report["outcome"], report["success"]) == ("stopped", False)


def leads_fresh_cores_to_the_recorded_maps(recording: Path, out: Path) -> None:
    """Replay a file as tests/replay does: that needs the first word of every service, and a whole end."""
    heard = list(read(recording))
    first = {channel.name: at_ns for at_ns, channel, _, _ in reversed(heard)}
    # The services beat while the simulator still starts, which takes longer than this: the file begins before both.
    assert first["sim_truth"] - first["map_heartbeat"] > 1e9
    out.mkdir()
    command = [sys.executable, str(CORES), str(recording), str(ESTIG), str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    drawn = [
        msgspec.json.decode(line, type=MapHeartbeat) for line in (out / "versions.jsonl").read_bytes().splitlines()
    ]
    hashes = {version.seq: version.hash for version in drawn}
    # Version 1 is the site's map as it is; a replay begins with it.
    told = {m.seq: m.hash for _, _, _, m in heard if isinstance(m, MapHeartbeat) and m.seq > 1}
    assert told
    assert told == {seq: hashes.get(seq) for seq in told}
    assert (out / "again.jsonl").read_bytes().count(b"\n") >= 1


async def test_of_two_demos_side_by_side_one_is_interrupted_and_the_other_drives_on(
    begin: Callable[..., Command], tmp_path: Path
) -> None:
    # At speed 1 a demo never begins anew because the machine is busy: it is the one that must go on.
    recording = tmp_path / "one.mcap"
    one = begin("one", "--seed", "7", "--speed", "3", "--record", str(recording))
    other = begin("other", "--seed", "8")
    for command in (one, other):
        await command.wait_for("^planner: plan 1", DRIVES_S)
    folders = [one.folder, other.folder]
    assert folders[0] is not None
    assert folders[1] is not None
    families = [one.children(), other.children()]
    assert [len(family) >= PROCESSES for family in families] == [True, True]
    ports = [ports_of(family) for family in families]
    assert [len(taken) > 3 for taken in ports] == [True, True]
    assert ports[0].isdisjoint(ports[1])

    os.killpg(one.process.pid, signal.SIGINT)  # what a terminal does at Ctrl-C
    assert await one.ends(ENDS_S) == NOT_TRUE
    has_left_nothing(one, folders[0], families[0], ports[0])
    leads_fresh_cores_to_the_recorded_maps(recording, tmp_path / "replayed")

    (router,) = {p.environ()["FOGNAV_ZENOH_CONNECT"] for p in families[1] if "FOGNAV_ZENOH_CONNECT" in p.environ()}
    opened = ZenohEdge.open(connect=[router], clock=SystemClock(), role="console", id="test", site="estig")
    async with opened as edge:
        truth = edge.latest(ch.SIM_TRUTH, SimTruth, robot="r1")

        def driven() -> float:
            told = truth.get()
            return told.distance if told is not None else 0.0

        await until(lambda: truth.get() is not None, 5, lambda: "the simulator of the other said what is so")
        before = driven()
        await until(lambda: driven() > before + 0.5, 15, lambda: f"the other drove on: {other.said}")
    assert [child for child in families[1] if not alive(child)] == []

    os.kill(other.process.pid, signal.SIGTERM)
    assert await other.ends(ENDS_S) == NOT_TRUE
    has_left_nothing(other, folders[1], families[1], ports[1])


async def test_a_demo_that_is_interrupted_while_it_starts_ends_what_it_has_started(
    begin: Callable[..., Command], tmp_path: Path
) -> None:
    command = begin("early", "--speed", "3")
    await until(lambda: command.folder is not None, DRIVES_S, lambda: f"it began: {command.said}")
    assert command.folder is not None
    await until(lambda: len(command.children()) > 3, DRIVES_S, lambda: "its services were started")
    children = command.children()
    os.kill(command.process.pid, signal.SIGINT)  # not its group: the programs end because it ends them
    assert await command.ends(ENDS_S) == NOT_TRUE
    has_left_nothing(command, command.folder, children, set())


async def test_nothing_of_a_demo_outlives_its_kill_but_files(begin: Callable[..., Command]) -> None:
    command = begin("killed", "--speed", "3")
    await command.wait_for("^operator: enable$", DRIVES_S)
    folder, children = command.folder, command.children()
    assert folder is not None
    assert len(children) >= PROCESSES
    ports = ports_of(children)
    command.process.kill()
    assert await command.ends(ENDS_S) == -signal.SIGKILL
    # A guardian whose watchdog is gone stops the wheels first, then ends by itself.
    await until(lambda: not any(alive(child) for child in children), 5, lambda: f"the end of {those_of(folder)}")
    assert those_of(folder) == []
    # The last thread of a killed process closes its sockets, which may be after the process counts as dead.
    await until(lambda: not any(listens(port) for port in ports), 5, lambda: f"none of {sorted(ports)} listened")
