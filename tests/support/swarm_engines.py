"""Docker engines in network namespaces of this machine, joined into a swarm: machines that can be killed and cut off.

Each has a namespace, a folder and a cgroup of its own, and a cable (veth) to one bridge. Images come from the engine
that `docker` reaches. Needs root, `dockerd`, `ip` and `nsenter`. Everything is removed at the end, whatever was killed.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

NETWORK: Final = "10.77.{}"
BRIDGE: Final = "fognav-test"
START_S: Final = 60.0
COMMAND_S: Final = 600.0
_PROGRAMS: Final = ("dockerd", "docker", "ip", "nsenter")


def missing() -> str | None:
    """Return what this machine lacks to run engines of its own, or None."""
    if os.geteuid() != 0:
        return "needs root, for network namespaces"
    lacking = [program for program in _PROGRAMS if shutil.which(program) is None]
    return f"needs {', '.join(lacking)}" if lacking else None


def run(*command: str, timeout_s: float = COMMAND_S) -> str:
    """Run a command and return its output; raises AssertionError with all of it if it fails."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
    assert done.returncode == 0, f"{' '.join(command)} ended with {done.returncode}:\n{done.stdout}\n{done.stderr}"
    return done.stdout


def wait(condition: Callable[[], object], seconds: float, what: str) -> None:
    """Wait until something is true, looked at ten times a second."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"{what} within {seconds:.0f} s"
        time.sleep(0.1)


class Engine:
    """One machine with an engine."""

    def __init__(self, number: int, folder: Path, part: int) -> None:
        """Prepare; `number` counts from 1, `part` tells the networks of tests apart that run at the same time."""
        self.name = f"node{number}"
        self.address = f"{NETWORK.format(part)}.{number}"
        self._gateway = f"{NETWORK.format(part)}.254"
        self._folder = folder / self.name
        self._space = f"{BRIDGE}{part}-{number}"
        self._cable = f"fn{part}-{number}"
        self._bridge = f"{BRIDGE}{part}"
        self._cgroup = f"/{self._space}"
        self.socket = f"unix://{self._folder}/docker.sock"
        self._program: subprocess.Popen[bytes] | None = None

    def plug(self) -> None:
        """Make its namespace and its cable to the bridge."""
        run("ip", "netns", "add", self._space)
        run("ip", "link", "add", self._cable, "type", "veth", "peer", "name", "eth0", "netns", self._space)
        run("ip", "link", "set", self._cable, "master", self._bridge, "up")
        for command in (
            f"address add {self.address}/24 dev eth0", "link set eth0 up", "link set lo up",
            f"route add default via {self._gateway}",
        ):  # fmt: skip
            self.inside("ip", *command.split())

    def inside(self, *command: str) -> str:
        """Run a command in its namespace."""
        return run("nsenter", f"--net=/run/netns/{self._space}", *command)

    def start(self) -> None:
        """Start the engine, and wait until it answers; also after `kill`."""
        self._folder.mkdir(parents=True, exist_ok=True)
        (self._folder / "pid").unlink(missing_ok=True)
        command = [
            "nsenter", f"--net=/run/netns/{self._space}", "dockerd", "--storage-driver=overlay2",
            f"--data-root={self._folder}/data", f"--exec-root={self._folder}/exec", f"--host={self.socket}",
            f"--pidfile={self._folder}/pid", f"--cgroup-parent={self._cgroup}", "--dns-opt=ndots:1",
        ]  # fmt: skip
        with (self._folder / "log").open("ab") as log:
            self._program = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
        wait(self.answers, START_S, f"no engine in {self._folder / 'log'}")

    def answers(self) -> bool:
        """Whether the engine answers."""
        command = ["docker", "--host", self.socket, "version"]
        return subprocess.run(command, capture_output=True, check=False, timeout=START_S).returncode == 0

    def docker(self, *arguments: str, timeout_s: float = COMMAND_S) -> str:
        """Run a command of docker here."""
        return run("docker", "--host", self.socket, *arguments, timeout_s=timeout_s)

    def load(self, images: Sequence[str]) -> None:
        """Take images over from the engine that `docker` reaches."""
        with subprocess.Popen(["docker", "save", *images], stdout=subprocess.PIPE) as saving:
            command = ["docker", "--host", self.socket, "load", "--quiet"]
            subprocess.run(command, stdin=saving.stdout, check=True, timeout=COMMAND_S, stdout=subprocess.DEVNULL)
        assert saving.returncode == 0

    def cut_off(self) -> None:
        """Pull its cable."""
        run("ip", "link", "set", self._cable, "down")

    def reconnect(self) -> None:
        """Put it back."""
        run("ip", "link", "set", self._cable, "up")

    def containers(self) -> dict[str, dict[str, Any]]:
        """Return the containers that run here, by their service's name in the stack."""
        ids = self.docker("ps", "--quiet").split()
        command = [
            "docker",
            "--host",
            self.socket,
            "inspect",
            *ids,
        ]  # it fails for what has just ended, and has the others
        found = json.loads(subprocess.run(command, capture_output=True, check=False).stdout) if ids else []
        label = "com.docker.swarm.service.name"
        return {each["Config"]["Labels"].get(label, "").partition("_")[2]: each for each in found}

    def logs(self, label: str) -> str:
        """Return what all containers here have said that have a label, those that ended among them."""
        ids = self.docker("ps", "--all", "--quiet", "--filter", f"label={label}").split()
        return "".join(run("sh", "-c", f"docker --host {self.socket} logs {each} 2>&1") for each in ids)

    def _pids(self) -> list[int]:
        """Return the engine's processes, and those in its containers."""
        found = []
        place = Path(f"/run/netns/{self._space}")
        space = place.stat().st_ino if place.exists() else None
        for process in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                groups, words = (process / "cgroup").read_text(), (process / "cmdline").read_bytes()
                here = (process / "ns" / "net").stat().st_ino == space
                if here or f"{self._cgroup}/" in groups or str(self._folder).encode() + b"/" in words:
                    found.append(int(process.name))
        return [pid for pid in found if pid != os.getpid()]

    def kill(self) -> None:
        """Kill everything on it at once, as a machine that loses its power."""
        for _ in range(3):  # what has started meanwhile
            for pid in self._pids():
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        if self._program is not None:
            self._program.wait(START_S)

    def remove(self) -> None:
        """Kill it, and remove all traces."""
        self.kill()
        mounted = [line.split()[4] for line in Path("/proc/self/mountinfo").read_text().splitlines()]
        for place in reversed([place for place in mounted if place.startswith(f"{self._folder}/")]):
            subprocess.run(["umount", "--lazy", place], check=False, capture_output=True)
        for command in (f"link delete {self._cable}", f"netns delete {self._space}"):
            subprocess.run(["ip", *command.split()], check=False, capture_output=True)
        shutil.rmtree(self._folder, ignore_errors=True)


class Swarm:
    """Engines that are all managers of one swarm; use it as a context manager."""

    def __init__(self, folder: Path, count: int = 3) -> None:
        """Prepare engines in a folder."""
        self._part = os.getpid() % 250
        self._bridge = f"{BRIDGE}{self._part}"
        self.engines = [Engine(number, folder, self._part) for number in range(1, count + 1)]

    def __enter__(self) -> Self:
        try:
            run("ip", "link", "add", self._bridge, "type", "bridge")
            run("ip", "address", "add", f"{NETWORK.format(self._part)}.254/24", "dev", self._bridge)
            run("ip", "link", "set", self._bridge, "up")
            for engine in self.engines:
                engine.plug()
                engine.start()
            first, *others = self.engines
            first.docker("swarm", "init", "--advertise-addr", first.address)
            token = first.docker("swarm", "join-token", "--quiet", "manager").strip()
            for engine in others:
                engine.docker(
                    "swarm", "join", "--advertise-addr", engine.address, "--token", token, f"{first.address}:2377"
                )
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for engine in self.engines:
            engine.remove()
        subprocess.run(["ip", "link", "delete", self._bridge], check=False, capture_output=True)

    def nodes(self) -> list[str]:
        """Return the ids of the engines, in their order."""
        return [engine.docker("info", "--format", "{{.Swarm.NodeID}}").strip() for engine in self.engines]

    def unsettled(self) -> set[str]:
        """Return the services that don't have the tasks that they should have, as the third engine knows."""
        command = ["docker", "--host", self.engines[2].socket, "service", "ls", "--format", "{{.Name}} {{.Replicas}}"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            return {"no manager leads"}
        return {line for line in done.stdout.splitlines() if not line.endswith(" 1/1")}

    def label(self, labels: Iterable[dict[str, str]]) -> None:
        """Give each engine its labels."""
        for node, own in zip(self.nodes(), labels, strict=True):
            words = [word for key, value in own.items() for word in ("--label-add", f"{key}={value}")]
            self.engines[0].docker("node", "update", *words, node)
