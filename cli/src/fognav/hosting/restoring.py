"""Restores a backup into the data of a fog node of `fognav up` that is down: only its Redis runs meanwhile."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Final

from fog_runtime import backup
from fog_runtime.access.credentials import Credentials
from fog_runtime.backup_archive import Backup, read_archive
from fog_runtime.locks.site_locks import SiteLocks
from fog_runtime.locks.users import REDIS_ADMINISTRATOR
from fog_supervisor import net, servers
from fog_supervisor.supervisor import Event, Supervisor
from fognav.hosting.folders import NodeFolder
from fognav.programs import MAP_SERVICE, REDIS, ProgramSet

_READY_S: Final = 60.0


@asynccontextmanager
async def redis_of(folder: NodeFolder, site: str, directory: Path) -> AsyncIterator[backup.Place]:
    """Run the Redis of a fog node that is down; yield the place of a site of it, whose folder is `directory`.

    Raises `LocksError` without the node's locks, `CredentialsError`, `ServerError` and `NotReadyError`.
    """
    locks = SiteLocks.open(folder.locks)
    credentials = Credentials.read(locks.credentials(REDIS_ADMINISTRATOR))
    program = servers.redis_program(folder.data(REDIS), net.free_port(), locks=locks.folder("redis"))
    supervisor = Supervisor(_ignore)
    ProgramSet(supervisor, folder, {}).add_server(program)
    async with supervisor:
        supervisor.start(REDIS)
        await supervisor.wait_ready([REDIS], _READY_S)
        folders = {backup.SITE: directory, backup.SECRETS: folder.path / "keys" / site}
        yield backup.Place(program.url, site, folders, folder.data(MAP_SERVICE), credentials)


def _ignore(_: Event) -> None:
    """Leave out what happens to Redis: if it does not become ready, `NotReadyError` says why."""


async def restore(file: Path, folder: NodeFolder, directory: Path, *, replace: bool) -> Backup:
    """Restore a backup of one site as `backup.restore` does; raises as this, and as `redis_of`."""
    with folder.in_use():
        async with redis_of(folder, read_archive(file).site, directory) as place:
            return await backup.restore(file, place, replace=replace)
