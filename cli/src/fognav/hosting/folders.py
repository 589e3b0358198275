"""The data of a fog node on this machine: one folder, which survives restarts and upgrades; its settings and sites.

`locks/` has certificates, users and credentials (`fog_runtime.security`), `keys/SITE/` the tokens and the key of a
site, `up.json` how the node was last started, by which other commands back it up and start it, and the rest is as in
`fognav.programs`. `format` is the version of this layout. Each site has its services and ports; all share broker, store
and router.
"""

import fcntl
import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import msgspec

from fog_runtime.configuration.site import LoadedSite, load_site
from fog_runtime.files import PRIVATE, atomic_write
from fog_runtime.keys import make_keys
from fog_runtime.security.site_security import CREDENTIALS, SiteSecurity
from fog_runtime.security.users import on_floor
from fognav.aside import TRIAL, finish_putting_back, require_no_upgrade
from fognav.credentials import require_owner, security_errors
from fognav.operate.systems import MQTTS_PORT, SERVICE_PORTS, ZENOH_PORT, port
from fognav.output import FailedError, WrongUseError
from fognav.programs import SystemFolder

FORMAT: Final = 1
"""Incremented when an older `fognav up` could not use what a newer one has written."""
_FORMAT_FILE: Final = "format"
_LOCK: Final = "in-use"
SECURITY: Final = "locks"
"""The folder of the credentials, in that of the data."""
SECURITY_FILE: Final = "locks.json"
"""What the folder of credentials has once they were made."""


def default_data() -> Path:
    """Return where this user's fog node keeps its data: `fognav` in the data folder of the XDG base directories."""
    home = os.environ.get("XDG_DATA_HOME", "")
    # The specification has relative paths ignored.
    return (Path(home) if home.startswith("/") else Path.home() / ".local" / "share") / "fognav"


class NodeFolder(SystemFolder):
    """The data of one fog node; only its user can read it."""

    def __init__(self, path: Path) -> None:
        """Make the folder where it is missing.

        Raises `FailedError` if it can't be used, or is of a newer version, and `WrongUseError` if it is another user's.
        """
        path = path.absolute()
        try:
            require_owner(path)
            finish_putting_back(path)
            path.mkdir(mode=0o700, parents=True, exist_ok=True)
            _check_format(path)
            super().__init__(path)
        except OSError as error:
            raise FailedError(
                f"the data folder {path} can't be used: {error.strerror}. Name another one with --data"
            ) from error

    @property
    def security(self) -> Path:
        """The folder of the site's credentials."""
        return self.path / SECURITY

    def keys(self, site: str) -> Path:
        """Return the folder of a site's tokens and key, and make those that are missing."""
        folder = self.path / "keys" / site
        try:
            make_keys(folder)
        except FileExistsError as error:
            raise FailedError(str(error)) from error
        return folder

    def used(self) -> bool:
        """Whether a fog node runs with this data now."""
        with (self.path / _LOCK).open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
        return False

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Keep the folder for this process; raises `FailedError` if another one uses it, or upgrades it."""
        if TRIAL not in os.environ:
            require_no_upgrade(self.path)
        with (self.path / _LOCK).open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise FailedError(
                    f"a fog node already runs with the data in {self.path}: end it first (fognav down), "
                    "or name another folder"
                ) from None
            yield


def require_node(path: Path) -> None:
    """Raise `WrongUseError` if a folder has no fog node's data, before `NodeFolder` would make it."""
    if not (path / _FORMAT_FILE).is_file():
        raise WrongUseError(f"{path} has no data of a fog node: name the folder that `fognav up` was given with --data")


def _check_format(path: Path) -> None:
    file = path / _FORMAT_FILE
    if not file.exists():
        atomic_write(file, f"{FORMAT}\n".encode())
        return
    text = file.read_text("ascii").strip()
    if not text.isdigit():
        raise FailedError(f"{file} has no version ({text!r}): restore it from a backup")
    if int(text) > FORMAT:
        raise FailedError(
            f"{path} was written by a newer Fognav (format {text}, this one knows {FORMAT}): upgrade this one, "
            "or restore a backup into another folder"
        )


FILE: Final = "up.json"
REDIS_PORT: Final = ("FOGNAV_REDIS_PORT", 6380)
"""Not 6379, where a Redis of the operating system listens."""
_PORTS: Final = (MQTTS_PORT, REDIS_PORT, ZENOH_PORT, *SERVICE_PORTS.values())


class NodeSettings(msgspec.Struct, frozen=True, kw_only=True):
    """The options of `fognav up`: `sites` are folders by their sites' ids, and `ports` are by their variables.

    `bridge` is the file of the bridges' settings, `floors` the list of floors on other machines, empty without any.
    """

    sites: dict[str, str]
    address: str
    hosts: list[str]
    simulate: bool = False
    bridge: str = ""
    floors: str = ""
    ports: dict[str, int]

    @property
    def arguments(self) -> list[str]:
        """The options again, without the data folder."""
        sites = [word for folder in self.sites.values() for word in ("--site", folder)]
        hosts = [word for host in self.hosts for word in ("--host", host)]
        bridge = ["--bridge", self.bridge] if self.bridge else []
        floors = ["--floors", self.floors] if self.floors else []
        return [*sites, "--bind", self.address, *hosts, *bridge, *floors, *(["--sim"] if self.simulate else [])]

    @property
    def environment(self) -> dict[str, str]:
        """The variables that give the ports."""
        return {name: str(number) for name, number in self.ports.items()}

    def command(self, data: Path) -> str:
        """Return what starts the node again from this shell, with the variables that it lacks."""
        here = _ports()
        lacking = [f"{name}={number}" for name, number in self.ports.items() if here.get(name) != number]
        return shlex.join([*lacking, "./fognav", "up", *self.arguments, "--data", str(data)])


def settings_of(  # the options of `fognav up`
    sites: dict[str, Path], address: str, hosts: Sequence[str], *, simulate: bool, bridge: Path | None = None,
    floors: Path | None = None,
) -> NodeSettings:  # fmt: skip
    """Return the settings of a node that is started from this shell."""
    return NodeSettings(
        sites={site: str(folder) for site, folder in sites.items()},
        address=address,
        hosts=list(hosts),
        simulate=simulate,
        bridge=str(bridge or ""),
        floors=str(floors or ""),
        ports=_ports(),
    )


def _ports() -> dict[str, int]:
    return {setting[0]: port(setting) for setting in _PORTS}


def remember(folder: Path, settings: NodeSettings) -> None:
    """Write the settings into a data folder."""
    atomic_write(folder / FILE, msgspec.json.format(msgspec.json.encode(settings)), mode=PRIVATE)


def recall(folder: Path) -> NodeSettings:
    """Return the settings in a data folder; raises `FailedError` if no node was started with it yet."""
    try:
        return msgspec.json.decode((folder / FILE).read_bytes(), type=NodeSettings)
    except (OSError, msgspec.DecodeError) as error:
        raise FailedError(
            f"{folder / FILE} does not say how the fog node was started ({error}): start it once "
            f"(fognav up --data {folder}), or name another folder"
        ) from error


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

    def node_credentials(self, security: SiteSecurity) -> Path:
        """Return the folder with the credentials of its sensor nodes."""
        return security.directory / CREDENTIALS / ("" if self.index == 0 else self.id)


def hosted_sites(
    folders: Sequence[Path], security: Path, hosts: Sequence[str]
) -> tuple[list[HostedSite], SiteSecurity]:
    """Return the sites in these folders, and their credentials at `security`, made where they are missing.

    A site keeps its place, and so its ports, for as long as the credentials exist. Raises `SecurityError` or
    `AuthorityError`, and as `load_sites`.
    """
    loaded = load_sites(folders)
    first = next(iter(loaded))
    known = SiteSecurity.open(security).sites if (security / SECURITY_FILE).exists() else [first]
    made = SiteSecurity(security, known[0])
    own = loaded.get(known[0])
    made.make(hosts, robots=_robots(own), nodes=_nodes(own))
    for site, each in loaded.items():
        if site != known[0]:
            made.add_floor(site, robots=_robots(each), nodes=_nodes(each))
    return [HostedSite(loaded=each, index=made.sites.index(site)) for site, each in loaded.items()], made


def renew_due(security: Path) -> list[str]:
    """Renew the servers' certificates that end soon; return whose. Raises `FailedError`."""
    with security_errors():  # opened anew: robots, nodes and devices may have been added meanwhile
        return SiteSecurity.open(security).renew(only_due=True)


def load_sites(folders: Sequence[Path]) -> dict[str, LoadedSite]:
    """Return the sites in these folders by their ids; raises `SiteError`, and `WrongUseError` for two of one id."""
    loaded: dict[str, LoadedSite] = {}
    for folder in folders:
        each = load_site(folder)
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
    return [] if loaded is None else loaded.site.senders
