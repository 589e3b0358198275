"""What this machine has of what Fognav needs, what is missing, and how to get it."""

import os
import platform
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, Literal

import psutil

from fognav import checkout, kernels, system

State = Literal["ok", "missing", "optional"]

MIN_PYTHON: Final = (3, 11)
MIN_CORES: Final = 2
MIN_MEMORY_GB: Final = 2.0
_VERSION_TIMEOUT_S: Final = 10.0


@dataclass(frozen=True)
class Check:
    """One thing that was looked at; `remedy` says what to do unless it is `ok`."""

    name: str
    state: State
    found: str
    remedy: str = ""


def _version(path: Path, *options: str) -> str:
    """Return the first line that a program says of itself, or that it says none."""
    try:
        done = subprocess.run(
            [str(path), *(options or ("--version",))],
            check=False,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=_VERSION_TIMEOUT_S,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"does not run: {error}"
    # A wrapper script may complain before the program speaks.
    lines = [line for line in done.stdout.splitlines() if re.match(r"^[A-Za-z].*\d+\.\d+", line)]
    return lines[0] if lines else "(says no version)"


def check_python() -> Check:
    """Judge the version of Python."""
    found = f"{platform.python_version()} ({sys.executable})"
    if sys.version_info >= MIN_PYTHON:
        return Check("python", "ok", found)
    return Check("python", "missing", found, "install Python 3.11 or newer")


def check_uv() -> Check:
    """Look for the installer of the Python packages; ./fognav gets it by itself."""
    own = [checkout.root() / ".fognav" / folder / "bin" / "uv" for folder in ("uv", "uv-env")]
    path = next((candidate for candidate in own if candidate.is_file()), None) or shutil.which("uv")
    if path is None:
        return Check("uv", "optional", "not found", "none needed now: ./fognav gets it when packages change")
    return Check("uv", "ok", f"{_version(Path(path))} ({path})")


def check_packages() -> Check:
    """Whether the environment was made from the pins as they are."""
    if (checkout.root() / ".fognav" / "stamp").is_file():
        return Check("python packages", "ok", f"in {sys.prefix}")
    return Check("python packages", "optional", f"in {sys.prefix}, not made by ./fognav", "start ./fognav once")


def check_tool(tool: system.Tool) -> Check:
    """Look for a program from the system's packages."""
    path = system.find(tool)
    if path is not None:
        options = ("-h",) if tool is system.MOSQUITTO else ("--version",)
        return Check(tool.name, "ok", f"{_version(path, *options)} ({path})")
    state: State = "missing" if tool.required else "optional"
    return Check(tool.name, state, f"not found; {tool.purpose}", system.how_to_get([tool]))


def check_kernels() -> Check:
    """Whether the numba kernels lie compiled in their cache, so that no process compiles at its start."""
    if kernels.is_warm():
        return Check("kernel cache", "ok", "compiled for this CPU")
    return Check("kernel cache", "optional", "not compiled yet", "./fognav test or ./fognav demo do it at their start")


def check_ports() -> Check:
    """Whether a server can listen on the loopback address."""
    try:
        with socket.create_server(("127.0.0.1", 0)) as server:
            return Check("loopback ports", "ok", f"free ones can be had (such as {server.getsockname()[1]})")
    except OSError as error:
        return Check("loopback ports", "missing", str(error), "allow listening on 127.0.0.1")


def check_ptys() -> Check:
    """Whether the simulator can make its serial ports."""
    try:
        master, slave = os.openpty()
    except OSError as error:
        return Check("ptys", "missing", str(error), "mount devpts: the simulator's serial ports need it")
    os.close(master)
    os.close(slave)
    return Check("ptys", "ok", "can be made")


def check_machine() -> Check:
    """Count cores and memory."""
    cores = os.cpu_count() or 1
    memory = psutil.virtual_memory().total / 2**30
    found = f"{cores} cores, {memory:.1f} GiB of memory, {platform.machine()}"
    if cores >= MIN_CORES and memory >= MIN_MEMORY_GB:
        return Check("machine", "ok", found)
    return Check("machine", "optional", found, "the demo wants two cores and 2 GiB: it may run late on less")


def checks() -> Iterator[Check]:
    """Look at everything, one after the other."""
    first: tuple[Callable[[], Check], ...] = (check_python, check_uv, check_packages)
    for check in first:
        yield check()
    for tool in system.TOOLS:
        yield check_tool(tool)
    for check in (check_kernels, check_ports, check_ptys, check_machine):
        yield check()


def as_json(found: list[Check]) -> dict[str, object]:
    """Return the JSON of `fognav doctor --json`."""
    return {"ok": all(c.state != "missing" for c in found), "checks": [asdict(check) for check in found]}
