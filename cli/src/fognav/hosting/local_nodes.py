"""The fog nodes of this user on this machine: those that run, by the register; their logs; and the systemd unit of one.

Logs are bounded, for a node runs for months on a small disk.
"""

import contextlib
import errno
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import psutil

from fognav import checkout
from fognav.operate.systems import System, registered
from fognav.output import FailedError, WrongUseError

KIND: Final = "fog node"
UP: Final = "up"
"""The name of the process that runs the others."""
_STOP_S: Final = 60.0
_POLL_S: Final = 0.05


class RunningNode(NamedTuple):
    """A fog node: the process that runs the others, its data folder, and its sites' names in `fognav status`."""

    pid: int
    data: Path
    names: Sequence[str]

    def __str__(self) -> str:
        return f"{', '.join(self.names)} (--data {self.data})"


def running_nodes() -> list[RunningNode]:
    """Return all of them."""
    systems: dict[int, list[System]] = {}
    for each in registered():
        if each.kind == KIND and UP in each.pids and each.data is not None:
            systems.setdefault(each.pids[UP], []).append(each)
    return [
        RunningNode(pid, Path(str(sites[0].data)), sorted(each.name for each in sites))
        for pid, sites in systems.items()
    ]


def systems_of(checkout: Path) -> list[System]:
    """Return the registered systems, fog nodes and others, with a program that runs the code of a checkout."""
    environment = checkout / ".venv"
    return [
        each for each in registered() if any(_program(pid).is_relative_to(environment) for pid in each.pids.values())
    ]


def _program(pid: int) -> Path:
    try:
        return Path(next(iter(psutil.Process(pid).cmdline()), ""))
    except (psutil.NoSuchProcess, psutil.AccessDenied):
        return Path()


def named_node(name: str | None, data: Path | None) -> RunningNode | None:
    """Return the node with a site's name in `fognav status` and this data folder, or the only one; None without any.

    Raises `WrongUseError` when several match, or when nodes run, but none of them matches.
    """
    nodes = running_nodes()
    folder = None if data is None else data.absolute()
    found = [node for node in nodes if folder in (None, node.data) and (name is None or name in node.names)]
    if len(found) > 1:
        raise WrongUseError(f"several fog nodes run: {'; '.join(map(str, found))}. Name one of them")
    if nodes and not found:
        raise WrongUseError(f"no such fog node runs, only: {'; '.join(map(str, nodes))}. Name one of these")
    return found[0] if found else None


def end_node(pid: int) -> None:
    """End a fog node by the process that runs the others; raises `FailedError` if it does not end."""
    try:
        process = psutil.Process(pid)
        process.terminate()
        deadline = time.monotonic() + _STOP_S
        # One that has ended stays a zombie until its parent looks.
        while process.is_running() and process.status() != psutil.STATUS_ZOMBIE:
            if time.monotonic() > deadline:
                raise FailedError(
                    f"process {pid} has not ended within {_STOP_S:.0f} s: look at its terminal, or kill it"
                )
            time.sleep(_POLL_S)
    except psutil.NoSuchProcess:
        pass


UNIT: Final = "fognav.service"
_TEXT: Final = """\
# Written by `fognav up --systemd`: run that again to change it.
[Unit]
Description=Fognav's fog node

[Service]
Type=notify
ExecStart={command}
{environment}\
# The programs are restarted by this one, and it by systemd.
Restart=on-failure
RestartSec=2
WatchdogSec=30
# The first start compiles the kernels.
TimeoutStartSec=600
TimeoutStopSec=60
KillMode=mixed

[Install]
WantedBy=default.target
"""


def unit_folder() -> Path:
    """Return where systemd looks for the units of this user."""
    home = os.environ.get("XDG_CONFIG_HOME", "")
    return (Path(home) if home.startswith("/") else Path.home() / ".config") / "systemd" / "user"


def unit_text(arguments: Sequence[str]) -> str:
    """Return the unit that runs `fognav` with these arguments and the settings (FOGNAV_*) of this shell."""
    settings = sorted((name, value) for name, value in os.environ.items() if name.startswith("FOGNAV_"))
    environment = "".join(f"Environment={_quoted(f'{name}={value}')}\n" for name, value in settings)
    # In a command line, unlike in the environment, `$` has a meaning, too (systemd.service(5)).
    command = " ".join(_quoted(word).replace("$", "$$") for word in [*_this_command(), *arguments])
    return _TEXT.format(command=command, environment=environment)


def write_unit(arguments: Sequence[str]) -> Path:
    """Write the unit; return its file."""
    file = unit_folder() / UNIT
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(unit_text(arguments), "utf-8")
    file.chmod(0o600)  # settings may be secrets
    return file


def systemd_runs(pid: int) -> bool:
    """Whether this process is the one that systemd runs as the unit."""
    command = ["systemctl", "--user", "show", "--property=MainPID", "--value", UNIT]
    try:
        done = subprocess.run(command, check=False, capture_output=True, text=True)
    except OSError:
        return False  # a computer without systemd
    return done.returncode == 0 and done.stdout.strip() == str(pid)


def start_unit() -> None:
    """Let systemd start the unit; raises `FailedError`."""
    done = subprocess.run(["systemctl", "--user", "start", UNIT], check=False, capture_output=True, text=True)
    if done.returncode != 0:
        raise FailedError(f"systemd did not start {UNIT}: {done.stderr.strip()}. Look at: journalctl --user -u {UNIT}")


def _this_command() -> list[str]:
    try:
        return [str(checkout.root() / "fognav")]
    except WrongUseError:
        return [sys.executable, "-m", "fognav"]


def _quoted(word: str) -> str:
    """Return a word as systemd reads it: `%` has a meaning there (systemd.syntax(7))."""
    escaped = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")
    return escaped if shlex.quote(word) == word else f'"{escaped}"'


LIMIT_BYTES: Final = 10_000_000
_BEFORE: Final = ".before"
_FOLLOW_S: Final = 0.2


def bound_log(file: Path, limit: int = LIMIT_BYTES) -> None:
    """Begin a log anew when it has reached the limit (bytes), and keep what it had in NAME.log.before.

    The program goes on writing to the same file. What it writes between the copy and the cut is lost. Raises `OSError`;
    where there is no space for the copy, the log is cut without it before that.
    """
    try:
        if file.stat().st_size < limit:
            return
    except FileNotFoundError:
        return
    before = file.with_name(file.name + _BEFORE)
    try:
        before.write_bytes(file.read_bytes())
    except OSError as error:
        if error.errno in {errno.ENOSPC, errno.EDQUOT}:
            before.unlink(missing_ok=True)  # a part of a copy would take space, and pass for the whole
            _cut(file)
        raise
    _cut(file)


def _cut(file: Path) -> None:
    # Supervised programs append, so they write on at the new end.
    with file.open("r+b") as log:
        log.truncate(0)


class Troubles:
    """Bookkeeping that fails without ending the fog node: each trouble is printed once, until it is over."""

    def __init__(self, print_line: Callable[[str], None]) -> None:
        self._print_line = print_line
        self._lasting: set[str] = set()

    @contextlib.contextmanager
    def told(self, trouble: str) -> Iterator[None]:
        """Print the trouble, if an `OSError` or `FailedError` leaves this context for the first time in a row."""
        try:
            yield
        except (OSError, FailedError) as error:
            if trouble not in self._lasting:
                self._lasting.add(trouble)
                self._print_line(f"{trouble}: {error}")
        else:
            self._lasting.discard(trouble)


class Tail:
    """Reads the lines that are added to a log, from its last `lines` on."""

    def __init__(self, file: Path, lines: int) -> None:
        self._file = file
        self._offset = 0
        text = self._read()
        self._first = text.splitlines()[-lines:] if lines else []

    def first(self) -> list[str]:
        """Return the last lines at the beginning."""
        return self._first

    def added(self) -> list[str]:
        """Return the whole lines that were added since."""
        return self._read().splitlines()

    def _read(self) -> str:
        try:
            with self._file.open("rb") as log:
                if log.seek(0, 2) < self._offset:
                    self._offset = 0  # it was begun anew
                log.seek(self._offset)
                data = log.read()
        except FileNotFoundError:
            return ""
        whole = data[: data.rfind(b"\n") + 1]
        self._offset += len(whole)
        return whole.decode("utf-8", "replace")


def show_logs(files: Mapping[str, Path], lines: int, *, follow: bool) -> None:
    """Write the last lines of each log to standard output, with its name if there are several; to follow, then more."""
    tails = {name: Tail(file, lines) for name, file in files.items()}
    width = max(map(len, files), default=0)
    for name, tail in tails.items():
        _write(f"{name:{width}} | " if len(files) > 1 else "", tail.first())
    while follow:
        time.sleep(_FOLLOW_S)
        for name, tail in tails.items():
            _write(f"{name:{width}} | " if len(files) > 1 else "", tail.added())


def _write(prefix: str, lines: list[str]) -> None:
    for line in lines:
        sys.stdout.write(f"{prefix}{line}\n")
    sys.stdout.flush()
