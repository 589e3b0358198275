"""Logs of a fog node's programs: bounded, for it runs for months on a small disk, and shown to people."""

import errno
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Final

LIMIT_BYTES: Final = 10_000_000
_BEFORE: Final = ".before"
_PERIOD_S: Final = 0.2


def bound(file: Path, limit: int = LIMIT_BYTES) -> None:
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


def show(files: Mapping[str, Path], lines: int, *, follow: bool) -> None:
    """Write the last lines of each log to standard output, with its name if there are several; to follow, then more."""
    tails = {name: Tail(file, lines) for name, file in files.items()}
    width = max(map(len, files), default=0)
    for name, tail in tails.items():
        _write(f"{name:{width}} | " if len(files) > 1 else "", tail.first())
    while follow:
        time.sleep(_PERIOD_S)
        for name, tail in tails.items():
            _write(f"{name:{width}} | " if len(files) > 1 else "", tail.added())


def _write(prefix: str, lines: list[str]) -> None:
    for line in lines:
        sys.stdout.write(f"{prefix}{line}\n")
    sys.stdout.flush()
