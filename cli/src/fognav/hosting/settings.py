"""How a fog node was last started, in a file of its data folder, by which other commands back it up and start it."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import msgspec

from fog_runtime.files import PRIVATE, atomic_write
from fognav.operate.systems import MQTTS_PORT, SERVICE_PORTS, ZENOH_PORT, port
from fognav.output import FailedError

FILE: Final = "up.json"
REDIS_PORT: Final = ("FOGNAV_REDIS_PORT", 6380)
"""Not 6379, where a Redis of the operating system listens."""
_PORTS: Final = (MQTTS_PORT, REDIS_PORT, ZENOH_PORT, *SERVICE_PORTS.values())


class NodeSettings(msgspec.Struct, frozen=True, kw_only=True):
    """The options of `fognav up`: `sites` are folders by their sites' ids, and `ports` are by their variables."""

    sites: dict[str, str]
    address: str
    hosts: list[str]
    simulate: bool = False
    ports: dict[str, int]

    @property
    def arguments(self) -> list[str]:
        """The options again, without the data folder."""
        sites = [word for folder in self.sites.values() for word in ("--site", folder)]
        hosts = [word for host in self.hosts for word in ("--host", host)]
        return [*sites, "--bind", self.address, *hosts, *(["--sim"] if self.simulate else [])]

    @property
    def environment(self) -> dict[str, str]:
        """The variables that give the ports."""
        return {name: str(number) for name, number in self.ports.items()}

    def command(self, data: Path) -> str:
        """Return what starts the node again from this shell, with the variables that it lacks."""
        here = _ports()
        lacking = [f"{name}={number}" for name, number in self.ports.items() if here.get(name) != number]
        return shlex.join([*lacking, "./fognav", "up", *self.arguments, "--data", str(data)])


def settings_of(sites: dict[str, Path], address: str, hosts: Sequence[str], *, simulate: bool) -> NodeSettings:
    """Return the settings of a node that is started from this shell."""
    return NodeSettings(
        sites={site: str(folder) for site, folder in sites.items()},
        address=address,
        hosts=list(hosts),
        simulate=simulate,
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
