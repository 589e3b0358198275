"""Backup of a fog node: `python -m fog_runtime.backup create FILE` and `... restore FILE [--replace]`.

Configured like the services: FOGNAV_REDIS_URL, FOGNAV_SITE_DIR, FOGNAV_TOKENS_FILE (whose folder has the secrets) and
FOGNAV_DATA_DIR, where the time of the last backup is noted for the metrics. What is backed up: the site's keys of
Redis, the site's folder and the secrets. A backup may be made while everything runs; restore one while the services
are stopped.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
import time
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from fog_runtime.access.credentials import NOBODY, Credentials, CredentialsError
from fog_runtime.backup_archive import STAMP, Backup, BackupError, File, Key, read_archive, read_folder, write_archive
from fog_runtime.configuration.settings import CommonSettings, SettingsError, load
from fog_runtime.configuration.site import SITE_FILE, SiteError, load_site
from fog_runtime.files import atomic_write
from fog_runtime.stores.redis_connection import Command, RedisConnection, StoreError
from fog_runtime.version import VERSION

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

SITE: Final = "site"
SECRETS: Final = "secrets"
_TIMEOUT_S: Final = 30.0
_SHORT_LIVED_MS: Final = 10_000
"""Keys that end sooner, such as leases, are not backed up."""


class Place(NamedTuple):
    """A fog node: its Redis, its site's id, and its folders by name."""

    redis_url: str
    site: str
    folders: dict[str, Path]
    data_dir: Path
    credentials: Credentials = NOBODY


async def create(file: Path, place: Place, now: float) -> Backup:
    """Back up a fog node, which may be running; `now` is in s since the epoch. Raises `BackupError`."""
    redis = RedisConnection(place.redis_url, timeout_s=_TIMEOUT_S, credentials=place.credentials)
    try:
        keys = await _dump(redis, place.site)
    except StoreError as error:
        raise BackupError(str(error)) from error
    finally:
        await redis.aclose()
    folders = {name: await asyncio.to_thread(read_folder, folder) for name, folder in place.folders.items()}
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
    except StoreError as error:
        raise BackupError(f"{error}. Restore again: it replaces what is there with --replace") from error
    finally:
        await redis.aclose()
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
    for service in ("hazard-aggregator", "map-service", "planner"):
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
    folders = {SITE: settings.site_dir}
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
