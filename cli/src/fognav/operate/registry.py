"""The register of the demos and fog nodes of this machine: a private folder per user with one file for each.

A demo writes its file when it is up, keeps it current, and removes it at its end. A killed demo leaves its file behind:
whoever reads the register notices, by process id and start time, that the demo is gone, and removes the file.
"""

import contextlib
import os
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Final, Literal, Self

import msgspec
import psutil

from fog_runtime.files import atomic_write
from fognav.output import FailedError

PRIVATE: Final = 0o700

Kind = Literal["demo", "fog node", "robot"]


class System(msgspec.Struct, frozen=True, kw_only=True):
    """A system that runs on this machine, with all that an operator's commands need to reach it.

    `urls` has the address of each part, and `pids` the process ids, by the parts' names. `speed` is how many times
    faster than real time its clock runs. `data` is the folder of a fog node that `fognav up` runs.
    """

    name: str
    kind: Kind
    site: str
    urls: dict[str, str]
    pids: dict[str, int]
    token_file: str | None = None
    credentials_file: str | None = None
    robots: list[str] = []
    speed: float = 1.0
    data: str | None = None


class _Entry(msgspec.Struct, frozen=True, kw_only=True):
    """A file of the register: the system, and the process that keeps the file."""

    pid: int
    started: float
    system: System


def folder() -> Path:
    """Return this user's private folder, and create it; raises `FailedError` if it is not private."""
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    if runtime and os.access(runtime, os.W_OK):
        path = Path(runtime) / "fognav"
    else:
        path = Path(tempfile.gettempdir()) / f".fognav-{os.getuid()}"
    try:
        path.mkdir(mode=PRIVATE, exist_ok=True)
        found = path.lstat()
    except OSError as error:
        raise FailedError(
            f"the register of running systems, {path}, can't be used: {error.strerror}. "
            "Set XDG_RUNTIME_DIR to a folder of your own"
        ) from error
    # In a shared folder such as /tmp, somebody else could have put theirs there: commands would go to their system.
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise FailedError(
            f"{path} is not a private folder of yours, so the systems registered in it can't be trusted. "
            "Remove it, or set XDG_RUNTIME_DIR to a folder of your own"
        )
    return path


class Registration:
    """This process's entry in the register, from its first `update` to the end of the context."""

    def __init__(self, describe: Callable[[], System]) -> None:
        self._describe = describe
        self._written: System | None = None
        self._file: Path | None = None

    def update(self) -> None:
        """Write the entry if the system has changed; raises `FailedError` without a usable folder."""
        system = self._describe()
        if system == self._written:
            return
        own = psutil.Process()
        # Two fog nodes of one site have the same name, and each its own entry.
        self._file = folder() / f"{system.name}.{own.pid}.json"
        entry = _Entry(pid=own.pid, started=own.create_time(), system=system)
        atomic_write(self._file, msgspec.json.encode(entry))
        self._written = system

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            self._file.unlink(missing_ok=True)


def registered() -> list[System]:
    """Return the registered systems that still run, and remove the entries of those that do not."""
    found = []
    for file in sorted(folder().glob("*.json")):
        try:
            entry = msgspec.json.decode(file.read_bytes(), type=_Entry)
        except FileNotFoundError:
            continue  # it has just ended
        except msgspec.DecodeError:
            entry = None  # of another version of this command, which would write it again
        if entry is not None and _runs(entry):
            found.append(entry.system)
        else:
            with contextlib.suppress(FileNotFoundError):
                file.unlink()
    return found


def _runs(entry: _Entry) -> bool:
    """Whether the process of an entry still runs: another one may have got its process id since."""
    try:
        return abs(psutil.Process(entry.pid).create_time() - entry.started) < 0.5
    except psutil.NoSuchProcess:
        return False
