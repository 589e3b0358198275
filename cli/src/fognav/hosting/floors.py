"""The sites of one fog node: each has its services and ports, all share broker, store and router."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fog_runtime.configuration.site import LoadedSite, SiteError, load_site
from fog_runtime.locks.site_locks import CREDENTIALS, SiteLocks
from fog_runtime.locks.users import on_floor
from fognav.hosting.folders import LOCKS_FILE
from fognav.operate.systems import SERVICE_PORTS, port
from fognav.output import WrongUseError

PORT_STEP: Final = 10
"""Between the ports of a service on one floor and on the next."""


@dataclass(frozen=True, kw_only=True)
class HostedSite:
    """A site of the fog node; `index` is its place among them, which it keeps, and 0 the first."""

    loaded: LoadedSite
    index: int

    @property
    def id(self) -> str:
        """Id of the site."""
        return self.loaded.site.id

    @property
    def directory(self) -> Path:
        """Its folder."""
        return self.loaded.directory

    def name(self, part: str) -> str:
        """Return the name of one of its programs or users: with the site's id, except on the first."""
        return part if self.index == 0 else on_floor(self.id, part)

    @property
    def ports(self) -> Mapping[str, int]:
        """The port of each service's REST API: those of the compose file, on each further floor 10 higher."""
        return {service: port(setting) + PORT_STEP * self.index for service, setting in SERVICE_PORTS.items()}

    def node_credentials(self, locks: SiteLocks) -> Path:
        """Return the folder with the credentials of its sensor nodes."""
        return locks.directory / CREDENTIALS / ("" if self.index == 0 else self.id)


def hosted_sites(folders: Sequence[Path], locks: Path, hosts: Sequence[str]) -> tuple[list[HostedSite], SiteLocks]:
    """Return the sites in these folders, and the locks at `locks` with everybody of them, made where they are missing.

    A site keeps its place, and so its ports, for as long as the locks exist. Raises `WrongUseError`, `LocksError` or
    `AuthorityError`.
    """
    loaded = _load(folders)
    first = next(iter(loaded))
    known = SiteLocks.open(locks).sites if (locks / LOCKS_FILE).exists() else [first]
    made = SiteLocks(locks, known[0])
    own = loaded.get(known[0])
    made.make(hosts, robots=_robots(own), nodes=_nodes(own))
    for site, each in loaded.items():
        if site != known[0]:
            made.add_floor(site, robots=_robots(each), nodes=_nodes(each))
    return [HostedSite(loaded=each, index=made.sites.index(site)) for site, each in loaded.items()], made


def _load(folders: Sequence[Path]) -> dict[str, LoadedSite]:
    loaded: dict[str, LoadedSite] = {}
    for folder in folders:
        try:
            each = load_site(folder)
        except SiteError as error:
            raise WrongUseError(str(error)) from error
        if each.site.id in loaded:
            raise WrongUseError(
                f"{folder} and {loaded[each.site.id].directory} have the same id {each.site.id!r}: "
                f"give one of them another in {folder / 'site.toml'}"
            )
        loaded[each.site.id] = each
    return loaded


def _robots(loaded: LoadedSite | None) -> list[str]:
    return [] if loaded is None else [robot.id for robot in loaded.site.robots]


def _nodes(loaded: LoadedSite | None) -> list[str]:
    return [] if loaded is None else [node.id for node in loaded.site.nodes]
