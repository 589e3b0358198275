"""The index of a fog node's recordings: what lies in `recordings/` of its data folder, for its backups.

Recordings are large, and kept elsewhere; a backup has this list of them, by which somebody who restores it sees what
there was, and what is missing.
"""

import os
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Final

import msgspec
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Statistics

from fog_runtime.backup import File
from fog_runtime.files import PRIVATE, atomic_write

FOLDER: Final = "recordings"
_INDEX: Final = "index"
_FILE: Final = "recordings.json"
_NANOSECONDS: Final = 1e9
_MAGIC: Final = b"\x89MCAP0\r\n"
"""With these bytes a recording begins and, unless it was cut off, ends."""
_DAMAGED: Final = (McapError, struct.error, OSError, ValueError, LookupError, MemoryError)
"""What the reader raises for a damaged summary: `OSError` if it leads to a place before the file's beginning."""


class Recording(msgspec.Struct, frozen=True, kw_only=True):
    """A recording: its path below `recordings/`, its size, and its messages; times in s since the epoch.

    Who was killed while recording left no summary: then there are no times, and no number of messages. `unreadable`
    says why a file could not be looked at; its size is then 0.
    """

    path: str
    bytes: int
    messages: int | None = None
    begins: float | None = None
    ends: float | None = None
    unreadable: str | None = None


def index_folder(data: Path) -> Path:
    """Return the folder of a node's data that has the index alone."""
    return data / FOLDER / _INDEX


def write_index(data: Path) -> list[Recording]:
    """Bring the index up to date, and return it; raises `OSError` if it can't be written.

    A recording that is damaged, cut off or can't be read is in it, too.
    """
    folder = data / FOLDER
    found = [_described(file, folder) for file in sorted(folder.rglob("*.mcap")) if not file.is_dir()]
    index_folder(data).mkdir(mode=0o700, parents=True, exist_ok=True)
    atomic_write(index_folder(data) / _FILE, msgspec.json.format(msgspec.json.encode(found)), mode=PRIVATE)
    return found


def missing(data: Path, index: Mapping[str, File]) -> list[str]:
    """Return which recordings of a backup's index are not there; `index` are the files of its folder.

    Raises `msgspec.DecodeError`.
    """
    file = index.get(_FILE)
    listed = msgspec.json.decode(file.data, type=list[Recording]) if file is not None else []
    return [each.path for each in listed if not (data / FOLDER / each.path).exists()]


def _described(file: Path, folder: Path) -> Recording:
    # A file's name may be no text at all, which the index could not hold.
    path = os.fsencode(file.relative_to(folder)).decode(errors="backslashreplace")
    try:
        if not file.is_file():
            return Recording(path=path, bytes=0, unreadable="no file, or a link to what is not there")
        with file.open("rb") as stream:
            size = stream.seek(0, os.SEEK_END)
            statistics = _statistics(stream, size)
    except OSError as error:
        return Recording(path=path, bytes=0, unreadable=error.strerror or str(error))
    made = Recording(path=path, bytes=size)
    if statistics is None:
        return made
    return msgspec.structs.replace(
        made,
        messages=statistics.message_count,
        begins=statistics.message_start_time / _NANOSECONDS,
        ends=statistics.message_end_time / _NANOSECONDS,
    )


def _statistics(stream: IO[bytes], size: int) -> Statistics | None:
    """Return what a recording's summary says, `None` without a usable one; raises `OSError`."""
    if size < 2 * len(_MAGIC):
        return None
    stream.seek(-len(_MAGIC), os.SEEK_END)
    if stream.read() != _MAGIC:
        return None
    stream.seek(0)
    try:
        summary = SeekingReader(stream, record_size_limit=size).get_summary()
    except _DAMAGED:
        return None
    return summary.statistics if summary is not None else None
