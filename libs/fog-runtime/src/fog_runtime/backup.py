"""Backup of a fog node: `python -m fog_runtime.backup create FILE` and `... restore FILE [--replace]`.

Configured like the services: FOGNAV_REDIS_URL, FOGNAV_SITE_DIR, FOGNAV_TOKENS_FILE (whose folder has the secrets) and
FOGNAV_DATA_DIR, where the time of the last backup is noted for the metrics. What is backed up: the site's keys of
Redis, the site's folder, the maps that were uploaded, and the secrets. A backup may be made while everything runs;
restore one while the services are stopped. What they remember of Redis and of the map in force is then the backup's.

The file is a `tar.gz`, with a hash of each part in its manifest. It holds secrets (tokens' hashes, the key that signs
commands), so only its owner reads it:

    manifest.json          what it contains: a `Manifest`
    redis.msgpack          a list of `Key`
    folders/NAME/...       the files of each folder
"""

from __future__ import annotations

import argparse
import asyncio
import hashlib
import io
import os
import sys
import tarfile
import time
import tomllib
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from fog_runtime.configuration.settings import CommonSettings, SettingsError, load
from fog_runtime.configuration.site import SITE_FILE, SiteError, load_site
from fog_runtime.configuration.uploaded_maps import FILE as MAP_IN_FORCE
from fog_runtime.credentials import NOBODY, Credentials, CredentialsError
from fog_runtime.files import PRIVATE, atomic_write
from fog_runtime.stores.redis_connection import Command, RedisConnection, StoreError, marker
from fog_runtime.version import VERSION

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

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


SITE: Final = "site"
SECRETS: Final = "secrets"
MAPS: Final = "maps"
"""Maps that were uploaded: a folder that may be missing."""
_TIMEOUT_S: Final = 30.0
_SHORT_LIVED_MS: Final = 10_000
"""Keys that end sooner, such as leases, are not backed up."""


_SERVICES: Final = ("hazard-aggregator", "map-service", "planner")
"""What keeps records in Redis."""


class Place(NamedTuple):
    """A fog node: its Redis, its site's id, and its folders by name.

    `data_dir` is where the last backup is noted, and where the services keep what they remember of Redis; `own_data`
    are the folders of services that have one of their own for that.
    """

    redis_url: str
    site: str
    folders: dict[str, Path]
    data_dir: Path
    credentials: Credentials = NOBODY
    own_data: Mapping[str, Path] = {}

    @property
    def markers(self) -> list[Path]:
        """Where each service remembers which store it uses."""
        return [marker(self.own_data.get(each, self.data_dir), each, self.site) for each in _SERVICES]

    @property
    def map_in_force(self) -> Path:
        """What says which of the uploaded maps is in force."""
        return self.folders[MAPS] / MAP_IN_FORCE


async def create(file: Path, place: Place, now: float) -> Backup:
    """Back up a fog node, which may be running; `now` is in s since the epoch. Raises `BackupError`."""
    redis = RedisConnection(place.redis_url, timeout_s=_TIMEOUT_S, credentials=place.credentials)
    try:
        keys = await _dump(redis, place.site)
    except StoreError as error:
        raise BackupError(str(error)) from error
    finally:
        await redis.aclose()
    there = {name: folder for name, folder in place.folders.items() if name != MAPS or folder.is_dir()}
    folders = {name: await asyncio.to_thread(read_folder, folder) for name, folder in there.items()}
    backup = Backup(place.site, VERSION, now, keys, folders)
    await asyncio.to_thread(write_archive, file, backup)
    try:
        atomic_write(place.data_dir / STAMP, f"{now}\n".encode())
    except OSError as error:
        raise BackupError(
            f"{file} is complete, but {place.data_dir / STAMP} can't be written ({error.strerror}), so the metrics do"
            " not show it: let FOGNAV_DATA_DIR name the services' folder"
        ) from error
    return backup


async def restore(file: Path, place: Place, *, replace: bool, keep: Collection[str] = ()) -> Backup:
    """Restore a backup into Redis and into the folders; everything is checked before anything is changed.

    What is there already is only replaced with `replace`, another site never, and the folders named in `keep` are not
    touched at all. Returns what was restored. Raises `BackupError`.
    """
    backup = await asyncio.to_thread(read_archive, file)
    require_same_site(backup, place.folders[SITE])
    backup = backup._replace(folders={name: files for name, files in backup.folders.items() if name not in keep})
    if unknown := sorted(set(backup.folders) - set(place.folders)):
        raise BackupError(f"{file} has a folder {unknown[0]!r}, for which there is no place: name it by its variable")
    redis = RedisConnection(place.redis_url, timeout_s=_TIMEOUT_S, credentials=place.credentials)
    try:
        found = await _names(redis, backup.site)
        await _require_no_leader(redis, backup.site)
        _require_room(backup, place, found, replace=replace)
        await _restore_keys(redis, backup.keys, found)
        generation = await redis.read("GET", f"fog:{backup.site}:generation")
    except StoreError as error:
        raise BackupError(f"{error}. Restore again: it replaces what is there with --replace") from error
    finally:
        await redis.aclose()
    try:
        await asyncio.to_thread(_forget_what_was_before, backup, place, generation)
    except OSError as error:
        raise BackupError(
            f"{error.filename} can't be changed ({error.strerror}): Redis is restored, the folders are not. Run this as"
            " a user who may, with --replace"
        ) from error
    for name, files in backup.folders.items():
        for path, content in files.items():
            try:
                await asyncio.to_thread(_write, place.folders[name] / path, content)
            except OSError as error:
                raise BackupError(
                    f"{place.folders[name] / path} can't be written ({error.strerror}): Redis is restored, the folders"
                    " are not. Make room or grant access, then restore again with --replace"
                ) from error
    return backup


def _forget_what_was_before(backup: Backup, place: Place, generation: bytes | None) -> None:
    """Let services that ran here before take the restored records for theirs, and no other map than the backup's."""
    for path in place.markers:
        if path.exists():
            _write(path, _read(path)._replace(data=generation or b""))
    if MAP_IN_FORCE not in backup.folders.get(MAPS, {}):
        place.map_in_force.unlink(missing_ok=True)


def require_same_site(backup: Backup, folder: Path) -> None:
    """Raise `BackupError` if a folder has another site than the backup; one that can't be read may be the same."""
    file = folder / SITE_FILE
    stored = backup.folders.get(SITE, {}).get(SITE_FILE)
    if stored is None or not file.is_file():
        return
    own, there = (_site_id(data) for data in (stored.data, file.read_bytes()))
    if own is not None and there is not None and own != there:
        raise BackupError(
            f"{folder} has the site {there}, and the backup is of the site {own}: nothing was changed. Name the folder"
            f" of {own}, or one that is empty"
        )


def _site_id(data: bytes) -> object:
    try:
        return tomllib.loads(data.decode()).get("id")
    except (UnicodeDecodeError, tomllib.TOMLDecodeError):
        return None


async def _require_no_leader(redis: RedisConnection, site: str) -> None:
    """Raise `BackupError` while a service runs, which would write what it has in memory over the backup."""
    for service in _SERVICES:
        if await redis.read("EXISTS", f"fog:{site}:{service}:lease"):
            raise BackupError(f"the {service} of site {site} runs: nothing was changed. Stop the services first")


def _write(path: Path, content: File) -> None:
    atomic_write(path, content.data, mode=content.mode)
    if os.geteuid() == 0:  # only root gives files to others: the services' secrets stay theirs
        os.chown(path, content.uid, content.gid)


def _require_room(backup: Backup, place: Place, found: Sequence[bytes], *, replace: bool) -> None:
    """Raise `BackupError` if something would be overwritten without consent."""
    if replace:
        return
    if found:
        raise BackupError(
            f"Redis has {len(found)} keys of site {backup.site} already: nothing was changed. --replace deletes them"
        )
    for name, files in backup.folders.items():
        for path, content in files.items():
            target = place.folders[name] / path
            if target.exists() and target.read_bytes() != content.data:
                raise BackupError(f"{target} exists already: nothing was changed. --replace overwrites it")
    if place.map_in_force.exists() and MAP_IN_FORCE not in backup.folders.get(MAPS, {}):
        raise BackupError(
            f"{place.map_in_force} names a map, and the backup has none: nothing was changed. --replace removes it"
        )


async def _names(redis: RedisConnection, site: str) -> list[bytes]:
    """Return the names of the site's keys, without those that end soon."""
    names: set[bytes] = set()
    cursor = 0
    while True:
        reply: Any = await redis.read("SCAN", cursor, "MATCH", f"fog:{site}:*", "COUNT", 1000)
        cursor, found = int(reply[0]), reply[1]
        names |= set(found)
        if cursor == 0:
            break
    lifetimes = [int(await redis.read("PTTL", name)) for name in sorted(names)]
    return [name for name, left in zip(sorted(names), lifetimes, strict=True) if left == -1 or left > _SHORT_LIVED_MS]


async def _dump(redis: RedisConnection, site: str) -> list[Key]:
    """Return the site's keys: streams one by one, for they only grow, and all others of one moment."""
    names = await _names(redis, site)
    streams = [name for name in names if bytes(await redis.read("TYPE", name)) == b"stream"]
    others = [name for name in names if name not in set(streams)]
    keys: list[Key] = []
    for group in ([others] if others else []) + [[name] for name in streams]:
        commands = [command for name in group for command in (("DUMP", name), ("PTTL", name))]
        replies = await redis.write(*commands)
        keys += [
            Key(name, max(int(left), 0), bytes(value))
            for name, value, left in zip(group, replies[::2], replies[1::2], strict=True)
            if value is not None  # it ended, or was deleted, meanwhile
        ]
    return keys


async def _restore_keys(redis: RedisConnection, keys: Sequence[Key], found: Sequence[bytes]) -> None:
    """Replace the keys that were found by those of the backup, in one transaction."""
    deleted: list[Command] = [("DEL", *found)] if found else []
    await redis.write(*deleted, *(("RESTORE", key.name, key.lifetime_ms, key.value, "REPLACE") for key in keys))


def place_of(settings: CommonSettings, site: str) -> Place:
    """Return the fog node of this site that the settings describe."""
    folders = {SITE: settings.site_dir, MAPS: settings.maps_folder / site}
    if settings.tokens_file is not None:
        folders[SECRETS] = settings.tokens_file.parent
    return Place(settings.redis_url, site, folders, settings.data_dir, settings.credentials())


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out the command line; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m fog_runtime.backup", description="Back up a fog node.")
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("create", help="write a backup").add_argument("file", type=Path)
    restoring = commands.add_parser("restore", help="restore a backup; stop the services before")
    restoring.add_argument("file", type=Path)
    restoring.add_argument("--replace", action="store_true", help="replace what is there already")
    options = parser.parse_args(arguments)
    try:
        settings = load(CommonSettings, environ=os.environ)
        if options.command == "create":
            site = settings.site or load_site(settings.site_dir).site.id
            backup = asyncio.run(create(options.file, place_of(settings, site), time.time()))
        else:
            # On an empty machine there is no site yet that has an id.
            place = place_of(settings, read_archive(options.file).site)
            backup = asyncio.run(restore(options.file, place, replace=options.replace))
    except (BackupError, CredentialsError, SettingsError, SiteError, ValueError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    files = ", ".join(f"{len(content)} files of the {name}" for name, content in backup.folders.items())
    done = "backed up" if options.command == "create" else "restored"
    sys.stdout.write(f"{done} site {backup.site}: {len(backup.keys)} keys of Redis, {files}: {options.file}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
