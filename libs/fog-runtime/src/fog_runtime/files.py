"""Atomic replacement of files."""

import errno
import os
import tempfile
from pathlib import Path
from typing import Final

PRIVATE: Final = 0o600
"""Only the owner reads and writes: secrets, and what a process stores for itself."""
SHARED: Final = 0o644
"""Everyone reads: what a person makes with one command and gives to programs of other users, such as a site."""


def atomic_write(path: Path, data: bytes, *, mode: int = PRIVATE, owner: int | None = None) -> None:
    """Write a file durably; readers, even after a power cut, see either the old content or the new, never a part.

    `mode` are the file's permissions, whatever those of an earlier one were; as root one may name an `owner` (uid), who
    also owns the file's folder if that is created. What a symbolic link names is replaced, never the link: /dev/stdout
    is one. Raises `OSError`, for what is there and no file (a device), too.
    """
    path = path.resolve() if path.is_symlink() else path
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "it is no regular file", str(path))
    if not path.parent.is_dir():
        path.parent.mkdir(parents=True, exist_ok=True)
        if owner is not None:
            os.chown(path.parent, owner, owner)
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(descriptor, "wb") as file:
            os.fchmod(descriptor, mode)
            if owner is not None:
                os.fchown(descriptor, owner, owner)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    directory = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


def write_port_file(path: Path | None, port: int) -> None:
    """Write the chosen port to `path`, if given, for other processes."""
    if path is not None:
        atomic_write(path, f"{port}\n".encode())
