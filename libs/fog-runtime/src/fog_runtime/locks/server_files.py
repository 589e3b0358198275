"""What the servers read of a site's locks: a folder for each program, with its list of users."""

from __future__ import annotations

import os
import stat
from typing import TYPE_CHECKING, Final

from fog_runtime.files import atomic_write
from fog_runtime.locks import users

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

USERS: Final = "users"
ANYBODY: Final = "default"
"""Redis's name for who gives none."""
_OF_ALL: Final = 0o077


class ServerFiles:
    """The programs' folders below one folder; `mode` are the permissions of files that are new there."""

    def __init__(self, folder: Path, mode: int) -> None:
        self._folder = folder
        self._mode = mode

    def folder(self, program: str) -> Path:
        """Return the folder of a program."""
        return self._folder / program

    def lines(self, program: str) -> list[str]:
        """Return a program's list of users, a line for each; that of a new Redis refuses who gives no name."""
        file = self.folder(program) / USERS
        if file.exists():
            return file.read_text("utf-8").splitlines()
        return [users.REDIS_NOBODY] if program == "redis" else []

    def members(self, program: str) -> list[str]:
        """Return whom a program admits."""
        return [user for line in self.lines(program) if (user := user_of(line)) != ANYBODY]

    def write_lines(self, program: str, lines: Iterable[str]) -> None:
        """Replace a program's list of users."""
        self.write(program, USERS, "".join(f"{line}\n" for line in lines))

    def write(self, program: str, name: str, text: str) -> None:
        """Write a file of a program, for those who could read it before."""
        file = self.folder(program) / name
        file.parent.mkdir(mode=0o755 if self._mode & _OF_ALL else 0o700, parents=True, exist_ok=True)
        # A file stays readable for whom an administrator gave it to: servers mostly run as users of their own.
        before = file.stat() if file.exists() else None
        atomic_write(file, text.encode(), mode=self._mode if before is None else stat.S_IMODE(before.st_mode))
        if before is not None and os.geteuid() == 0:
            os.chown(file, before.st_uid, before.st_gid)


def user_of(line: str) -> str:
    """Return whose line it is, in any of the lists: `name:…`, or Redis's `user name …`."""
    return line.split()[1] if line.startswith("user ") else line.partition(":")[0]
