"""Backs up and restores a fog node of `fognav up`: one file for each site, with the locks of all.

A backup may be made while the node runs. It is restored while the node is down, on an empty machine, too; only its
Redis runs meanwhile.
"""

import asyncio
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from fog_runtime import backup
from fog_runtime.backup import Backup, BackupError, read_archive
from fog_runtime.credentials import Credentials
from fog_runtime.files import atomic_write
from fog_runtime.locks.site_locks import AUTHORITY, SiteLocks
from fog_runtime.locks.users import ANYBODY, REDIS_ADMINISTRATOR, USERS, on_floor, user_of
from fog_supervisor import net, servers
from fog_supervisor.supervisor import Event, Supervisor
from fognav.hosting import recordings
from fognav.hosting.folders import LOCKS_FILE, NodeFolder
from fognav.hosting.settings import REDIS_PORT, recall
from fognav.output import WrongUseError
from fognav.programs import MAP_SERVICE, REDIS, ProgramSet

LOCKS: Final = "locks"
_READY_S: Final = 60.0


class Created(NamedTuple):
    """What a backup has; `no_index` says why it lacks the index of the recordings, if it does."""

    backup: Backup
    no_index: str | None


class Restored(NamedTuple):
    """What a restore has done.

    `refused` are those whom the backup's locks would have admitted besides, and `missing` the recordings of the
    backup's index that are not there.
    """

    backup: Backup
    refused: Sequence[str]
    missing: Sequence[str]


class _Sites(msgspec.Struct):
    """What the description of locks says of their sites."""

    site: str
    floors: list[str] = []


def site_of(folder: NodeFolder, directory: Path | None) -> tuple[str, Path]:
    """Return id and folder of a node's site, of its only one without `directory`.

    Raises `WrongUseError` if there is none or several, and as `recall`.
    """
    sites = {site: Path(path) for site, path in recall(folder.path).sites.items()}
    found = {site: path for site, path in sites.items() if directory is None or path == directory.resolve()}
    if len(found) != 1:
        known = ", ".join(map(str, sites.values()))
        raise WrongUseError(
            f"name one of the sites of {folder.path} with --site: {known}. Each has a backup of its own"
        )
    return next(iter(found.items()))


async def create(file: Path, folder: NodeFolder, directory: Path | None) -> Created:
    """Back up a site of a node, which may be running; raises as `site_of`, `redis_of` and `backup.create`.

    An index of the recordings that can't be written is left out: what people decided, and the keys, matter more.
    """
    site, path = site_of(folder, directory)
    no_index = None
    try:
        await asyncio.to_thread(recordings.write_index, folder.path)
    except OSError as error:
        no_index = (
            f"the index of {folder.path / recordings.FOLDER} can't be written to "
            f"{recordings.index_folder(folder.path)} ({error.strerror or error}): make room there, or grant access"
        )
    async with _redis(folder, site, path) as place:
        if no_index is not None:  # an older index would name as missing what was deleted since
            del place.folders[recordings.FOLDER]
        return Created(await backup.create(file, place, time.time()), no_index)


async def restore(file: Path, folder: NodeFolder, directory: Path, *, replace: bool) -> Restored:
    """Restore a backup of one site, whose folder is to be `directory`, while the node is down.

    With `replace`, locks of the same authority stay: they are those of all sites, and newer. Raises `FailedError` while
    the node runs, `BackupError`, and as `redis_of`.
    """
    with folder.in_use():
        archive = await asyncio.to_thread(read_archive, file)
        if not (folder.locks / LOCKS_FILE).exists():
            # Redis needs them to start; where there are none, nothing is replaced.
            for name, content in archive.folders.get(LOCKS, {}).items():
                atomic_write(folder.locks / name, content.data, mode=content.mode)
        stay = replace and _same_authority(archive, folder.locks)
        if replace and not stay:
            _require_same_sites(archive, folder.locks)
        refused = sorted(_users(archive) - SiteLocks.open(folder.locks).users()) if stay else []
        # Another floor's backup has brought one of another moment: it stays, and the next backup writes a new one.
        indexed = not replace and recordings.index_folder(folder.path).exists()
        keep = ({LOCKS} if stay else set()) | ({recordings.FOLDER} if indexed else set())
        async with redis_of(folder, archive.site, directory) as place:
            made = await backup.restore(file, place, replace=replace, keep=keep)
        return Restored(made, refused, recordings.missing(folder.path, archive.folders.get(recordings.FOLDER, {})))


def _same_authority(archive: Backup, locks: Path) -> bool:
    """Whether somebody who trusts the backup's servers may trust those of the locks here, too."""
    file, own = archive.folders.get(LOCKS, {}).get(AUTHORITY), locks / AUTHORITY
    return (
        file is not None and own.exists() and not _certificates(file.data).isdisjoint(_certificates(own.read_bytes()))
    )


def _require_same_sites(archive: Backup, locks: Path) -> None:
    """Raise `BackupError` if the locks of a backup, of another authority, would lock out a site of these locks."""
    file = archive.folders.get(LOCKS, {}).get(LOCKS_FILE)
    if file is None:
        return
    theirs = msgspec.json.decode(file.data, type=_Sites)
    if others := set(SiteLocks.open(locks).sites) - {theirs.site, *theirs.floors}:
        raise BackupError(
            f"{locks} has the credentials of {', '.join(sorted(others))} too, and the backup's are of another "
            "authority, which nobody there would trust: nothing was changed. Name another folder with --up"
        )


def _certificates(authority: bytes) -> set[bytes]:
    return set(authority.split(b"-----BEGIN CERTIFICATE-----")[1:])


def _users(archive: Backup) -> set[str]:
    """Return everybody whom a server of the backup's locks admits."""
    lists = [file.data.decode() for name, file in archive.folders[LOCKS].items() if Path(name).name == USERS]
    return {user_of(line) for text in lists for line in text.splitlines()} - {ANYBODY}


@asynccontextmanager
async def _redis(folder: NodeFolder, site: str, directory: Path) -> AsyncIterator[backup.Place]:
    """Yield the place of a site of a node that runs, or else run its Redis."""
    if folder.used():
        port = recall(folder.path).ports[REDIS_PORT[0]]
        yield _place(folder, site, directory, f"rediss://{net.LOOPBACK}:{port}/0")
        return
    with folder.in_use():
        async with redis_of(folder, site, directory) as place:
            yield place


@asynccontextmanager
async def redis_of(folder: NodeFolder, site: str, directory: Path) -> AsyncIterator[backup.Place]:
    """Run the Redis of a fog node that is down; yield the place of a site of it, whose folder is `directory`.

    Raises `LocksError` without the node's locks, `CredentialsError`, `ServerError` and `NotReadyError`.
    """
    program = servers.redis_program(
        folder.data(REDIS), net.free_port(), locks=SiteLocks.open(folder.locks).folder("redis")
    )
    supervisor = Supervisor(_ignore)
    ProgramSet(supervisor, folder, {}).add_server(program)
    async with supervisor:
        supervisor.start(REDIS)
        await supervisor.wait_ready([REDIS], _READY_S)
        yield _place(folder, site, directory, program.url)


def _place(folder: NodeFolder, site: str, directory: Path, redis: str) -> backup.Place:
    locks = SiteLocks.open(folder.locks)
    credentials = Credentials.read(locks.credentials(REDIS_ADMINISTRATOR))
    folders = {
        backup.SITE: directory,
        backup.SECRETS: folder.path / "keys" / site,
        LOCKS: folder.locks,
        recordings.FOLDER: recordings.index_folder(folder.path),
    }
    service = MAP_SERVICE if site == locks.sites[0] else on_floor(site, MAP_SERVICE)
    return backup.Place(redis, site, folders, folder.data(service), credentials)


def _ignore(_: Event) -> None:
    """Leave out what happens to Redis: if it does not become ready, `NotReadyError` says why."""
