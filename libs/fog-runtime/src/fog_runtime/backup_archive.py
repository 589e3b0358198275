"""The file of a backup: a `tar.gz` of named folders and of Redis's keys, with a manifest that has each part's hash.

    manifest.json          what it contains: a `Manifest`
    redis.msgpack          a list of `Key`
    folders/NAME/...       the files of each folder

It holds secrets (tokens' hashes, the key that signs commands), so only its owner reads it.
"""

from __future__ import annotations

import hashlib
import io
import tarfile
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from fog_runtime.files import PRIVATE, atomic_write

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

FORMAT: Final = 1
STAMP: Final = "last-backup"
"""File in the services' data folder that is written with each backup: its modification time is the backup's."""
_MANIFEST: Final = "manifest.json"
_REDIS: Final = "redis.msgpack"
_FOLDERS: Final = "folders"


class BackupError(Exception):
    """A backup can't be made, read or restored; the message names the place and the remedy."""


class Key(NamedTuple):
    """A key of Redis: its value as `DUMP` returns it, and its lifetime (ms; 0: without end)."""

    name: bytes
    lifetime_ms: int
    value: bytes


class File(NamedTuple):
    """A file's content, its permissions, and the ids of its owner and group."""

    data: bytes
    mode: int = PRIVATE
    uid: int = 0
    gid: int = 0


class Manifest(msgspec.Struct, frozen=True, kw_only=True):
    """What a backup contains; `parts` are the SHA-256 digests of its other members, by their paths in the archive."""

    format: int
    site: str
    version: str
    created: float
    parts: dict[str, str]


class Backup(NamedTuple):
    """A backup in memory: `folders` are the contents of each folder's files, by name and path."""

    site: str
    version: str
    created: float
    keys: Sequence[Key]
    folders: Mapping[str, Mapping[str, File]]


def read_folder(folder: Path) -> dict[str, File]:
    """Return the files below a folder by their paths in it; raises `BackupError`."""
    try:
        files = sorted(path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
        if not folder.is_dir():
            raise BackupError(f"{folder} is no folder: name the right one")
        return {path.relative_to(folder).as_posix(): _read(path) for path in files}
    except OSError as error:
        raise BackupError(f"{error.filename} can't be read ({error.strerror}): run this as a user who may") from error


def write_archive(file: Path, backup: Backup) -> Manifest:
    """Write the file durably, and read it again; raises `BackupError`, and leaves no part of a file."""
    parts = {_REDIS: File(msgspec.msgpack.encode(list(backup.keys)))}
    for name, files in backup.folders.items():
        parts |= {f"{_FOLDERS}/{name}/{path}": found for path, found in files.items()}
    manifest = Manifest(
        format=FORMAT, site=backup.site, version=backup.version, created=backup.created,
        parts={path: hashlib.sha256(data).hexdigest() for path, (data, *_) in parts.items()},
    )  # fmt: skip
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:gz") as archive:
        for path, content in {_MANIFEST: File(msgspec.json.encode(manifest)), **parts}.items():
            member = tarfile.TarInfo(path)
            member.size, member.mode = len(content.data), content.mode
            member.uid, member.gid = content.uid, content.gid
            archive.addfile(member, io.BytesIO(content.data))
    try:
        atomic_write(file, packed.getvalue())
    except OSError as error:
        raise BackupError(f"{file} can't be written ({error.strerror}): name a file in a folder with room") from error
    read_archive(file)
    return manifest


def read_archive(file: Path) -> Backup:
    """Return a backup that is complete and undamaged; raises `BackupError` for any other file."""
    try:
        with tarfile.open(file, "r:gz") as archive:
            members = {member.name: _content(archive, member) for member in archive}
        manifest = msgspec.json.decode(members.pop(_MANIFEST).data, type=Manifest)
        if manifest.format != FORMAT:
            raise BackupError(
                f"{file} has format {manifest.format}, this version reads {FORMAT}: use the version of Fognav that"
                f" wrote it ({manifest.version})"
            )
        found = {path: hashlib.sha256(data).hexdigest() for path, (data, *_) in members.items()}
        if wrong := sorted(path for path in {*found, *manifest.parts} if found.get(path) != manifest.parts.get(path)):
            raise BackupError(f"{file} is damaged: {wrong[0]} is not what was backed up. Use another backup")
        keys = msgspec.msgpack.decode(members.pop(_REDIS).data, type=list[Key])
    except (OSError, tarfile.TarError, EOFError, KeyError, msgspec.MsgspecError) as error:
        raise BackupError(f"{file} is no backup, or a damaged one ({error}): use another one") from error
    folders: dict[str, dict[str, File]] = {}
    for path, content in members.items():
        parts = PurePosixPath(path).parts
        if parts[0] != _FOLDERS or len(parts) < 3 or ".." in parts:
            raise BackupError(f"{file} has an unexpected part {path}: use a backup that Fognav made")
        folders.setdefault(parts[1], {})["/".join(parts[2:])] = content
    return Backup(manifest.site, manifest.version, manifest.created, keys, folders)


def _read(path: Path) -> File:
    status = path.stat()
    return File(path.read_bytes(), status.st_mode & 0o777, status.st_uid, status.st_gid)


def _content(archive: tarfile.TarFile, member: tarfile.TarInfo) -> File:
    stream = archive.extractfile(member)
    if stream is None:
        raise tarfile.TarError(f"{member.name} is no file")
    with stream:
        return File(stream.read(), member.mode & 0o777, member.uid, member.gid)
