"""The copy of a fog node's data that an upgrade lays aside, and what may not be written while it may be put back.

It is beside the data: `NAME.before-upgrade`. A lock on it says that the upgrade still runs. While it is made, and while
it is removed, `.part` is behind its name, so that a copy of that name is complete.
"""

import fcntl
import os
import shutil
import time
from pathlib import Path
from typing import Final

from fognav.output import FailedError

BACKUPS: Final = "backups"
_UNTOUCHED: Final = frozenset({BACKUPS, "recordings"})
"""Large folders that an upgrade leaves alone: they are in no copy, and stay whatever becomes of it."""
_COPY: Final = ".before-upgrade"
_PART: Final = ".before-upgrade.part"
TRIAL: Final = "FOGNAV_TRIAL_START"
"""In the environment of the start with which an upgrade tries the new version."""


def require_no_upgrade(path: Path) -> None:
    """Raise `FailedError` if a file or folder is in data that a running upgrade may replace by those of before."""
    path = path.resolve()
    for folder in [path, *path.parents][:-1]:
        for suffix in (_COPY, _PART):
            if _locked(folder.with_name(folder.name + suffix)):
                raise FailedError(
                    f"the fog node with its data in {folder} is being upgraded, and what is changed now may be undone: "
                    "nothing was changed. Repeat this when the upgrade has ended"
                )


def _locked(folder: Path) -> bool:
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        return False  # without it no upgrade runs, and another user's can't use this one's data
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


def finish_putting_back(data: Path) -> None:
    """Put the copy in the place of data that is missing: a power cut may have come between the two steps of that.

    Raises `OSError`, and `FailedError` while the upgrade still runs.
    """
    data = data.resolve()
    copy = data.with_name(data.name + _COPY)
    if not data.exists() and copy.exists():
        require_no_upgrade(data)
        copy.rename(data)


class Aside:
    """The copy of one data folder."""

    def __init__(self, data: Path) -> None:
        """Take a data folder; raises `FailedError` if there is a copy already, of an upgrade that was cut short."""
        self._data = data.resolve()
        self.copy = self._data.with_name(self._data.name + _COPY)
        self._part = self._data.with_name(self._data.name + _PART)
        self._lock: int | None = None
        self.since = ""
        """The time of day at which the copy was begun."""
        if self.copy.exists():
            raise FailedError(
                f"an upgrade was cut short: {self.copy} has the data of before. Check out the version that wrote it, "
                f"and move it to {data}; or remove it, if the fog node runs well"
            )

    @property
    def laid(self) -> bool:
        """Whether there is a complete copy."""
        return self.copy.exists()

    def lay(self) -> None:
        """Copy the data, which nothing may use meanwhile; raises `OSError`, and leaves no copy then: `remove` it."""
        self.remove()  # of an upgrade that was cut short
        self._part.mkdir(mode=0o700)
        self._lock = os.open(self._part, os.O_RDONLY | os.O_DIRECTORY)
        fcntl.flock(self._lock, fcntl.LOCK_EX)
        self.since = time.strftime("%H:%M:%S")
        shutil.copytree(self._data, self._part, symlinks=True, dirs_exist_ok=True, ignore=self._untouched)
        os.sync()  # after a power cut it has the name of a complete copy only if it is one
        self._part.rename(self.copy)

    def put_back(self) -> None:
        """Replace the data by the copy; raises `OSError`, and until then the copy has all of before. Then `remove`."""
        for each in list(self._data.iterdir()):
            if each.name in _UNTOUCHED:
                each.rename(self.copy / each.name)
        self._data.rename(self._part)
        self.copy.rename(self._data)
        self._release()

    def discard(self) -> None:
        """Let the copy count no longer; then `remove` it."""
        self.copy.rename(self._part)
        self._release()

    def remove(self) -> None:
        """Remove what is no complete copy; raises `OSError`."""
        self._release()
        if self._part.exists():
            shutil.rmtree(self._part)

    def _untouched(self, folder: str, names: list[str]) -> set[str]:
        return set(names) & _UNTOUCHED if Path(folder) == self._data else set()

    def _release(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
