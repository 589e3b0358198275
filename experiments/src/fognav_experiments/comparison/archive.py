"""All records of an experiment in one compressed file, small enough for version control.

A machine that drove for hours is replaced, and what it drove would be lost with it: from this file a report is made
again, and the drives that are missing are added on another machine. It is a text of one JSON document per line,
compressed by xz: the first line says of which experiment, every further one is a record with the name of its folder.
"""

from __future__ import annotations

import lzma
from typing import TYPE_CHECKING, Any, Final

import msgspec

from fog_runtime.files import SHARED, atomic_write
from fognav_experiments.comparison.measured import KINDS, MeasuredDrive
from fognav_experiments.comparison.records import LOCKSTEP, Asked, Folder, FolderError, Record

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

NAME: Final = "drives.jsonl.xz"
_FORMAT: Final = 1
_FOLDERS: Final = (LOCKSTEP, *KINDS)
_MOST_BYTES: Final = 1 << 30
"""Bytes that the records of an archive may have together when they are decompressed."""


class _Head(msgspec.Struct, frozen=True, kw_only=True):
    """The first line: what `experiment.json` of the folder says."""

    format: int
    experiment: dict[str, Any]


class _Machine(msgspec.Struct, frozen=True, kw_only=True):
    """What drives were measured on, as far as a folder compares it."""

    machine: dict[str, Any] = msgspec.field(default_factory=dict)
    versions: dict[str, Any] = msgspec.field(default_factory=dict)


class _Experiment(msgspec.Struct, frozen=True, kw_only=True):
    """What a folder needs of its `experiment.json`: without it nothing could be read there any more."""

    asked: Asked
    measured_on: _Machine
    also_on: list[_Machine] = msgspec.field(default_factory=list)


class _Line(msgspec.Struct, frozen=True, kw_only=True):
    folder: str
    record: msgspec.Raw


def pack(folder: Folder) -> bytes:
    """Return all records of a folder as an archive; the same records give the same bytes. Raises `FolderError`."""
    lines = [msgspec.json.encode(_Head(format=_FORMAT, experiment=folder.description()))]
    lines += [msgspec.json.encode({"folder": LOCKSTEP, "record": record}) for record in folder.drives.read()]
    for kind in KINDS:
        lines += [msgspec.json.encode({"folder": kind, "record": drive}) for drive in folder.measured(kind).read()]
    text = b"\n".join(lines) + b"\n"
    return lzma.compress(text, check=lzma.CHECK_SHA256, preset=9 | lzma.PRESET_EXTREME)


def write(folder: Folder, file: Path) -> int:
    """Write a folder's archive, as a whole or not at all; return its size in bytes. Raises `FolderError`."""
    data = pack(folder)
    try:
        atomic_write(file, data, mode=SHARED)
    except OSError as error:
        raise FolderError(f"{file} can't be written: {error.strerror}. Name another file") from error
    return len(data)


def unpack(file: Path, folder: Folder, wanted: Asked | None = None) -> int:
    """Add the records of an archive that the folder does not have; return how many these are.

    What the folder has already, it keeps. Nothing is written if the archive is damaged, or of another experiment than
    the folder's or the one that is `wanted`; then it raises `FolderError`.
    """
    experiment, records = _read(file)
    try:
        asked = msgspec.convert(experiment, _Experiment).asked
    except msgspec.ValidationError as error:
        raise _damaged(file, error) from error
    if wanted is not None and asked != wanted:
        raise FolderError(f"{file} holds drives of another experiment ({asked}, not {wanted}): leave --from out")
    folder.adopt(experiment)
    added = 0
    for record in records:
        files = folder.drives if isinstance(record, Record) else folder.measured(record.kind)
        if not files.has(record.name):
            files.write(record)  # type: ignore[arg-type]  # a folder of records of its own kind
            added += 1
    return added


def _read(file: Path) -> tuple[dict[str, Any], list[Record | MeasuredDrive]]:
    """Return what an archive is about, and its records."""
    try:
        lines = iter(_decompressed(file).splitlines())
        head = msgspec.json.decode(next(lines, b""), type=_Head)
        if head.format != _FORMAT:
            raise FolderError(f"{file} has format {head.format}: read it with a newer version of Fognav")
        return head.experiment, list(_records(lines))
    except (OSError, EOFError, lzma.LZMAError, msgspec.DecodeError, ValueError) as error:
        if isinstance(error, FolderError):
            raise
        raise _damaged(file, error) from error


def _decompressed(file: Path) -> bytes:
    with lzma.open(file) as packed:
        text = packed.read(_MOST_BYTES + 1)
    if len(text) > _MOST_BYTES:
        raise ValueError(f"it has more than {_MOST_BYTES} bytes")
    return text


def _records(lines: Iterator[bytes]) -> Iterator[Record | MeasuredDrive]:
    for number, line in enumerate(lines, start=2):
        found = msgspec.json.decode(line, type=_Line)
        if found.folder not in _FOLDERS:
            raise ValueError(f"line {number} is of a folder {found.folder!r}, which no experiment has")
        record = (
            msgspec.json.decode(found.record, type=Record)
            if found.folder == LOCKSTEP
            else msgspec.json.decode(found.record, type=MeasuredDrive)
        )
        # The name becomes that of a file.
        if "/" in record.name or "\\" in record.name or "\0" in record.name:
            raise ValueError(f"line {number} is a drive with the name {record.name!r}, which is none of a file")
        yield record


def _damaged(file: Path, error: Exception) -> FolderError:
    return FolderError(f"{file} is no archive of an experiment, or damaged: {error}. Fetch it again, or leave it out")
