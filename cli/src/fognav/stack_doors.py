"""The locks of one stack: made for its run, and who of its processes has which credentials."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fog_contracts.site import Site
from fog_runtime.credentials import NOBODY, Credentials
from fog_runtime.locks.site_locks import CREDENTIALS, SiteLocks
from fog_supervisor import net

FOLDER: Final = "locks"


@dataclass(frozen=True, kw_only=True)
class Doors:
    """For whom the servers are to be locked: the site's id, and its robots and sensor nodes by id."""

    site: str
    robots: tuple[str, ...] = ()
    nodes: tuple[str, ...] = ()
    unrestricted: tuple[str, ...] = ()
    """Users who may do everything on broker and router, for tests."""


def doors_of(site: Site, *, unrestricted: tuple[str, ...] = ()) -> Doors:
    """Return the doors of a site for its robots and nodes."""
    return Doors(
        site=site.id,
        robots=tuple(robot.id for robot in site.robots),
        nodes=tuple(node.id for node in site.nodes),
        unrestricted=unrestricted,
    )


class StackDoors:
    """The doors of a stack in its folder; without `Doors` they stand open, and nobody has credentials."""

    def __init__(self, folder: Path, doors: Doors | None) -> None:
        self._locks: SiteLocks | None = None
        if doors is not None:
            self._locks = SiteLocks(folder / FOLDER, doors.site, unrestricted=doors.unrestricted)
            self._locks.make([net.LOOPBACK, "localhost"], robots=doors.robots, nodes=doors.nodes)

    def of(self, program: str) -> Path | None:
        """Return the folder with the locks of a server program."""
        return None if self._locks is None else self._locks.folder(program)

    def file(self, user: str) -> Path | None:
        """Return the file of a user's credentials."""
        return None if self._locks is None else self._locks.credentials(user)

    def credentials(self, user: str) -> Credentials:
        """Read a user's credentials."""
        return NOBODY if self._locks is None else Credentials.read(self._locks.credentials(user))

    def settings(self, user: str) -> Mapping[str, str]:
        """Return the settings of a process that is this user."""
        return {} if self._locks is None else {"CREDENTIALS_FILE": str(self._locks.credentials(user))}

    def node_settings(self) -> Mapping[str, str]:
        """Return the settings of a process that is every sensor node."""
        return {} if self._locks is None else {"NODE_CREDENTIALS_DIR": str(self._locks.directory / CREDENTIALS)}
