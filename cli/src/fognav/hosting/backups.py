"""Backs up and restores a fog node of `fognav up`: one file for each site, with the credentials of all.

A backup may be made while the node runs. It is restored while the node is down, on an empty machine, too; only its
Redis runs meanwhile. Recordings are large, and kept elsewhere; a backup has an index of what lies in `recordings/` of
the data folder, by which somebody who restores it sees what there was, and what is missing.
"""

import asyncio
import os
import struct
import time
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import IO, Final, NamedTuple

import msgspec
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Statistics

from fog_runtime import backup
from fog_runtime.backup import Backup, BackupError, File, read_archive
from fog_runtime.configuration.site import SiteError
from fog_runtime.credentials import Credentials, CredentialsError
from fog_runtime.files import PRIVATE, atomic_write
from fog_runtime.keys import TOKENS
from fog_runtime.security.site_security import AUTHORITY, SiteSecurity
from fog_runtime.security.users import ANYBODY, REDIS_ADMINISTRATOR, USERS, on_floor, user_of
from fog_supervisor import net, servers
from fog_supervisor.supervisor import Event, Supervisor
from fognav import checkout
from fognav.credentials import own_credentials, security_errors
from fognav.hosting.folders import REDIS_PORT, SECURITY, SECURITY_FILE, NodeFolder, recall, require_node
from fognav.output import FailedError, WrongUseError, print_line
from fognav.programs import MAP_SERVICE, REDIS, SERVICES, ProgramSet

RECORDINGS: Final = "recordings"
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
    return data / RECORDINGS / _INDEX


def write_index(data: Path) -> list[Recording]:
    """Bring the index up to date, and return it; raises `OSError` if it can't be written.

    A recording that is damaged, cut off or can't be read is in it, too.
    """
    folder = data / RECORDINGS
    found = [_described(file, folder) for file in sorted(folder.rglob("*.mcap")) if not file.is_dir()]
    index_folder(data).mkdir(mode=0o700, parents=True, exist_ok=True)
    atomic_write(index_folder(data) / _FILE, msgspec.json.format(msgspec.json.encode(found)), mode=PRIVATE)
    return found


def missing_recordings(data: Path, index: Mapping[str, File]) -> list[str]:
    """Return which recordings of a backup's index are not there; `index` are the files of its folder.

    Raises `msgspec.DecodeError`.
    """
    file = index.get(_FILE)
    listed = msgspec.json.decode(file.data, type=list[Recording]) if file is not None else []
    return [each.path for each in listed if not (data / RECORDINGS / each.path).exists()]


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


_READY_S: Final = 60.0


class Created(NamedTuple):
    """What a backup has; `no_index` says why it lacks the index of the recordings, if it does."""

    backup: Backup
    no_index: str | None


class Restored(NamedTuple):
    """What a restore has done.

    `refused` are those whom the backup's credentials would have admitted besides, and `missing` the recordings of the
    backup's index that are not there.
    """

    backup: Backup
    refused: Sequence[str]
    missing: Sequence[str]


class _Sites(msgspec.Struct):
    """What the description of credentials says of their sites."""

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
        await asyncio.to_thread(write_index, folder.path)
    except OSError as error:
        no_index = (
            f"the index of {folder.path / RECORDINGS} can't be written to "
            f"{index_folder(folder.path)} ({error.strerror or error}): make room there, or grant access"
        )
    async with _redis(folder, site, path) as place:
        if no_index is not None:  # an older index would name as missing what was deleted since
            del place.folders[RECORDINGS]
        return Created(await backup.create(file, place, time.time()), no_index)


async def restore(file: Path, folder: NodeFolder, directory: Path, *, replace: bool) -> Restored:
    """Restore a backup of one site, whose folder is to be `directory`, while the node is down.

    With `replace`, credentials of the same authority stay, and the site's tokens and keys with them: they are newer,
    and the backup's would admit again whoever was shut out since. Raises `FailedError` while the node runs,
    `BackupError`, and as `redis_of`.
    """
    with folder.in_use():
        archive = await asyncio.to_thread(read_archive, file)
        if not (folder.security / SECURITY_FILE).exists():
            # Redis needs them to start; where there are none, nothing is replaced.
            for name, content in archive.folders.get(SECURITY, {}).items():
                atomic_write(folder.security / name, content.data, mode=content.mode)
        stay = replace and _same_authority(archive, folder.security)
        if replace and not stay:
            _require_same_sites(archive, folder.security)
        refused = sorted(_users(archive) - SiteSecurity.open(folder.security).users()) if stay else []
        # Another floor's backup has brought one of another moment: it stays, and the next backup writes a new one.
        indexed = not replace and index_folder(folder.path).exists()
        keep = ({SECURITY} if stay else set()) | ({RECORDINGS} if indexed else set())
        if stay and (folder.path / "keys" / archive.site / TOKENS).exists():
            keep.add(backup.SECRETS)
        async with redis_of(folder, archive.site, directory) as place:
            made = await backup.restore(file, place, replace=replace, keep=keep)
        return Restored(made, refused, missing_recordings(folder.path, archive.folders.get(RECORDINGS, {})))


def _same_authority(archive: Backup, security: Path) -> bool:
    """Whether somebody who trusts the backup's servers may trust those of the credentials here, too."""
    file, own = archive.folders.get(SECURITY, {}).get(AUTHORITY), security / AUTHORITY
    return (
        file is not None and own.exists() and not _certificates(file.data).isdisjoint(_certificates(own.read_bytes()))
    )


def _require_same_sites(archive: Backup, security: Path) -> None:
    """Raise `BackupError` if credentials of a backup, of another authority, would shut out a site of these."""
    file = archive.folders.get(SECURITY, {}).get(SECURITY_FILE)
    if file is None:
        return
    theirs = msgspec.json.decode(file.data, type=_Sites)
    if others := set(SiteSecurity.open(security).sites) - {theirs.site, *theirs.floors}:
        raise BackupError(
            f"{security} has the credentials of {', '.join(sorted(others))} too, and the backup's are of another "
            "authority, which nobody there would trust: nothing was changed. Name another folder with --up"
        )


def _certificates(authority: bytes) -> set[bytes]:
    return set(authority.split(b"-----BEGIN CERTIFICATE-----")[1:])


def _users(archive: Backup) -> set[str]:
    """Return everybody whom a server of the backup's credentials admits."""
    lists = [file.data.decode() for name, file in archive.folders[SECURITY].items() if Path(name).name == USERS]
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

    Raises `SecurityError` without the node's credentials, `CredentialsError`, `ServerError` and `NotReadyError`.
    """
    program = servers.redis_program(
        folder.data(REDIS), net.free_port(), security=SiteSecurity.open(folder.security).folder("redis")
    )
    supervisor = Supervisor(_ignore)
    ProgramSet(supervisor, folder, {}).add_server(program)
    async with supervisor:
        supervisor.start(REDIS)
        await supervisor.wait_ready([REDIS], _READY_S)
        yield _place(folder, site, directory, program.url)


def _place(folder: NodeFolder, site: str, directory: Path, redis: str) -> backup.Place:
    security = SiteSecurity.open(folder.security)
    credentials = Credentials.read(security.credentials(REDIS_ADMINISTRATOR))
    folders = {
        backup.SITE: directory,
        backup.SECRETS: folder.path / "keys" / site,
        SECURITY: folder.security,
        RECORDINGS: index_folder(folder.path),
        backup.MAPS: folder.data("maps") / site,
    }
    first = site == security.sites[0]
    own = {service: folder.data(service if first else on_floor(site, service)) for service in SERVICES}
    return backup.Place(redis, site, folders, own[MAP_SERVICE], credentials, own)


def _ignore(_: Event) -> None:
    """Leave out what happens to Redis: if it does not become ready, `NotReadyError` says why."""


@contextmanager
def backup_errors() -> Iterator[None]:
    """Turn errors of backups into those of commands."""
    with security_errors():
        try:
            yield
        except WrongUseError:
            raise
        except (BackupError, CredentialsError, SiteError, ValueError) as error:
            raise FailedError(str(error)) from error


def _named(site: Path | None) -> Path | None:
    """Return a site's folder, also by its name in `sites/`; a folder without a site, to restore one, as it is."""
    try:
        return site and checkout.site_folder(site)
    except WrongUseError:
        return site


def create_of_node(file: Path, up: Path, site: Path | None) -> Created:
    """Back up a site of the node with its data in `up`; raises `WrongUseError` without any, and as `create`."""
    require_node(up)
    return asyncio.run(create(file, NodeFolder(up), _named(site)))


def restore_into_node(file: Path, up: Path, site: Path, *, replace: bool) -> Backup:
    """Restore a backup into the node with its data in `up`, and tell what differs from it; raises as `restore`."""
    directory = _named(site) or site
    backup.require_same_site(read_archive(file), directory)  # before the node's folder is made
    made, refused, gone = asyncio.run(restore(file, NodeFolder(up), directory, replace=replace))
    if SECURITY not in made.folders:
        kept = "credentials" if backup.SECRETS in made.folders else "credentials, tokens and keys"
        print_line(f"the {kept} in {up} stay: they have the same authority, and what was changed since")
    if refused:
        print_line(f"they do not admit {', '.join(refused)}, whom the backup has: add them again, if they shall be")
    if gone:
        print_line(f"recordings that are not in {up / 'recordings'}: {', '.join(gone)}")
    return made


def place_of(redis: str, name: str, site: Path, secrets: Path | None, data: Path) -> backup.Place:
    """Return the place of a fog node that is not by `fognav up`: whoever has its folders may back it up."""
    folders = {backup.SITE: site, backup.MAPS: data / "maps" / name, **({backup.SECRETS: secrets} if secrets else {})}
    return backup.Place(redis, name, folders, data, own_credentials(None))


def report(done: str, made: Backup, file: Path) -> None:
    """Tell a person what was backed up or restored."""
    files = ", ".join(f"{len(content)} files of the {name}" for name, content in made.folders.items())
    print_line(f"{done} site {made.site}: {len(made.keys)} keys of Redis, {files}: {file}")
