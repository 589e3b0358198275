"""The data of a fog node on this machine: one folder, which survives restarts and upgrades.

`locks/` has certificates, users and credentials (`fog_runtime.locks`), `keys/SITE/` the tokens and the key of a site,
and the rest is as in `fognav.programs`. `format` is the version of this layout.
"""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from fog_runtime.files import atomic_write
from fog_runtime.keys import make_keys
from fognav.output import FailedError, WrongUseError
from fognav.programs import SystemFolder

FORMAT: Final = 1
"""Incremented when an older `fognav up` could not use what a newer one has written."""
_FORMAT_FILE: Final = "format"
_LOCK: Final = "in-use"
LOCKS_FILE: Final = "locks.json"
"""What the folder of locks has once they were made."""


def default_data() -> Path:
    """Return where this user's fog node keeps its data: `fognav` in the data folder of the XDG base directories."""
    home = os.environ.get("XDG_DATA_HOME", "")
    # The specification has relative paths ignored.
    return (Path(home) if home.startswith("/") else Path.home() / ".local" / "share") / "fognav"


class NodeFolder(SystemFolder):
    """The data of one fog node; only its user can read it."""

    def __init__(self, path: Path) -> None:
        """Make the folder where it is missing; raises `FailedError` if it can't be used, or is of a newer version."""
        path = path.absolute()
        try:
            path.mkdir(mode=0o700, parents=True, exist_ok=True)
            _check_format(path)
            super().__init__(path)
        except OSError as error:
            raise FailedError(
                f"the data folder {path} can't be used: {error.strerror}. Name another one with --data"
            ) from error

    @property
    def locks(self) -> Path:
        """The folder of the site's locks."""
        return self.path / "locks"

    def keys(self, site: str) -> Path:
        """Return the folder of a site's tokens and key, and make those that are missing."""
        folder = self.path / "keys" / site
        try:
            make_keys(folder)
        except FileExistsError as error:
            raise FailedError(str(error)) from error
        return folder

    def used(self) -> bool:
        """Whether a fog node runs with this data now."""
        with (self.path / _LOCK).open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
        return False

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Keep the folder for this process; raises `FailedError` if another one uses it."""
        with (self.path / _LOCK).open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise FailedError(
                    f"a fog node already runs with the data in {self.path}: end it first (fognav down), "
                    "or name another folder with --data"
                ) from None
            yield


def require_node(path: Path) -> None:
    """Raise `WrongUseError` if a folder has no fog node's data, before `NodeFolder` would make it."""
    if not (path / _FORMAT_FILE).is_file():
        raise WrongUseError(f"{path} has no data of a fog node: name the folder that `fognav up` was given with --data")


def _check_format(path: Path) -> None:
    file = path / _FORMAT_FILE
    if not file.exists():
        atomic_write(file, f"{FORMAT}\n".encode())
        return
    text = file.read_text("ascii").strip()
    if not text.isdigit():
        raise FailedError(f"{file} has no version ({text!r}): restore it from a backup")
    if int(text) > FORMAT:
        raise FailedError(
            f"{path} was written by a newer Fognav (format {text}, this one knows {FORMAT}): upgrade this one, "
            "or restore a backup into another folder"
        )
