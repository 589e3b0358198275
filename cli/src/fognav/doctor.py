"""Checks whether this machine has what Fognav needs, with the remedy for what is missing."""

import datetime as dt
import os
import platform
import re
import shlex
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, Literal

import psutil
import typer
from rich.table import Table

from fognav import checkout, kernels, system
from fognav.credentials import VARIABLE as CREDENTIALS_DIR_VARIABLE
from fognav.credentials import credentials_folder, open_security, security_errors
from fognav.hosting.folders import SECURITY, SECURITY_FILE, default_data
from fognav.operate.options import JsonOption
from fognav.output import NOT_TRUE, OK, FailedError, WrongUseError, answers, print_json

State = Literal["ok", "missing", "optional"]

MIN_PYTHON: Final = (3, 11)
MIN_CORES: Final = 2
MIN_MEMORY_GB: Final = 2.0
_VERSION_TIMEOUT_S: Final = 10.0


@dataclass(frozen=True)
class Check:
    """The result of one check; `remedy` tells what to do unless the state is `ok`."""

    name: str
    state: State
    found: str
    remedy: str = ""


def _version(path: Path, *options: str) -> str:
    """Return the first line with a version that a program prints."""
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
    # A wrapper script may print warnings first.
    lines = [line for line in done.stdout.splitlines() if re.match(r"^[A-Za-z].*\d+\.\d+", line)]
    return lines[0] if lines else "(prints no version)"


def check_python() -> Check:
    """Check the version of Python."""
    found = f"{platform.python_version()} ({sys.executable})"
    if sys.version_info >= MIN_PYTHON:
        return Check("python", "ok", found)
    return Check("python", "missing", found, "install Python 3.11 or newer")


def _checkout() -> Path | None:
    """Return the folder of the checkout; None for an installed command, which has none."""
    try:
        return checkout.root()
    except WrongUseError:
        return None


def check_uv() -> Check:
    """Check for the installer of Python packages, which ./fognav installs by itself."""
    if (path := system.find_uv(_checkout())) is None:
        return Check("uv", "optional", "not found", "not needed now: ./fognav installs it when packages change")
    return Check("uv", "ok", f"{_version(path)} ({path})")


def check_packages() -> Check:
    """Check whether ./fognav has created the environment of its checkout from the pins."""
    root = _checkout()
    if root is None or (root / ".fognav" / "stamp").is_file():
        return Check("python packages", "ok", f"in {sys.prefix}")
    return Check("python packages", "optional", f"in {sys.prefix}, not created by ./fognav", "run ./fognav once")


def check_tool(tool: system.Tool) -> Check:
    """Check for a program from the system's packages."""
    path = system.find(tool)
    if path is not None:
        options = ("-h",) if tool is system.MOSQUITTO else ("--version",)
        return Check(tool.name, "ok", f"{_version(path, *options)} ({path})")
    state: State = "missing" if tool.required else "optional"
    return Check(tool.name, state, f"not found; {tool.purpose}", system.install_command([tool]))


def check_kernels() -> Check:
    """Check whether the numba kernels are compiled and cached, so that no process compiles them at its start."""
    if kernels.is_warm():
        return Check("kernel cache", "ok", "compiled for this CPU")
    return Check("kernel cache", "optional", "not compiled yet", "./fognav test and demo compile them at their start")


def check_certificates() -> Check | None:
    """Check until when certificates are valid: those that FOGNAV_CREDENTIALS_DIR names, else of this user's fog node.

    None without any.
    """
    own = default_data() / SECURITY
    folder = credentials_folder(None) or (own if (own / SECURITY_FILE).exists() else None)
    if folder is None:
        return None
    try:
        with security_errors():
            security = open_security(folder)
            expiring, first = security.expiring(), min(security.expiries().values())
    except FailedError as error:
        return Check("certificates", "missing", str(error), f"correct {CREDENTIALS_DIR_VARIABLE}, or restore a backup")
    found = f"the first expires on {first:%Y-%m-%d} ({folder})"
    if not expiring:
        return Check("certificates", "ok", found)
    remedy = f"fognav ca {'rotate' if 'authority' in expiring else 'issue'} --credentials {shlex.quote(str(folder))}"
    return Check("certificates", "missing" if first < dt.datetime.now(dt.UTC) else "optional", found, remedy)


def check_ports() -> Check:
    """Check whether a server can listen on the loopback address."""
    try:
        with socket.create_server(("127.0.0.1", 0)) as server:
            return Check("loopback ports", "ok", f"available (such as {server.getsockname()[1]})")
    except OSError as error:
        return Check("loopback ports", "missing", str(error), "allow listening on 127.0.0.1")


def check_ptys() -> Check:
    """Check whether the simulator can open ptys as its serial ports."""
    try:
        master, slave = os.openpty()
    except OSError as error:
        return Check("ptys", "missing", str(error), "mount devpts: the simulator's serial ports need it")
    os.close(master)
    os.close(slave)
    return Check("ptys", "ok", "available")


def check_machine() -> Check:
    """Check the number of cores and the memory."""
    cores = os.cpu_count() or 1
    memory = psutil.virtual_memory().total / 2**30
    found = f"{cores} cores, {memory:.1f} GiB of memory, {platform.machine()}"
    if cores >= MIN_CORES and memory >= MIN_MEMORY_GB:
        return Check("machine", "ok", found)
    return Check("machine", "optional", found, "the demo needs two cores and 2 GiB; with less its loops may run late")


def checks() -> Iterator[Check]:
    """Run all checks one after the other."""
    first: tuple[Callable[[], Check], ...] = (check_python, check_uv, check_packages)
    for check in first:
        yield check()
    for tool in system.TOOLS:
        yield check_tool(tool)
    for check in (check_kernels, check_ports, check_ptys, check_machine):
        yield check()
    if (certificates := check_certificates()) is not None:
        yield certificates


def as_json(found: list[Check]) -> dict[str, object]:
    """Return the JSON of `fognav doctor --json`."""
    return {"ok": all(c.state != "missing" for c in found), "checks": [asdict(check) for check in found]}


def doctor_command(*, json: JsonOption = False) -> None:
    """Show what is installed, what is missing and how to install it."""
    found = list(checks())
    if json:
        print_json(as_json(found))
    else:
        table = Table(box=None, padding=(0, 2), show_header=False)
        marks = {"ok": "[green]ok[/]", "missing": "[red]missing[/]", "optional": "[yellow]optional[/]"}
        for check in found:
            table.add_row(marks[check.state], check.name, check.found)
            if check.remedy:
                table.add_row("", "", f"[dim]remedy: {check.remedy}[/]")
        answers.print(table)
    raise typer.Exit(NOT_TRUE if any(check.state == "missing" for check in found) else OK)
