"""Further floors of a fog node in containers: an override of docker-compose.yml, made from it.

The floors share broker, Redis, router and the container that hands out credentials. Each has its own services, gateway,
Prometheus and Grafana, which are those of the compose file with the floor's id in their names. Its networks are its
own, too, and there its containers answer to the usual names (`planner`, `gateway`): so their settings and
configuration files are the same on every floor. Two floors share nothing else but what the gateways have in common:
the network of their way out, and their certificate.
"""

import copy
import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import yaml  # type: ignore[import-untyped]  # PyYAML ships no types

from fog_runtime.files import SHARED, atomic_write
from fognav.hosting.folders import PORT_STEP, load_sites
from fognav.output import WrongUseError

BASE: Final = "docker-compose.yml"
OVERRIDE: Final = "docker-compose.override.yml"
"""What compose reads besides, without being told."""
HEADER: Final = "# Written by `fognav site compose"
_OPTIONAL: Final = {"sim-credentials": {"simulation": "sim-locks"}, "bridge-credentials": {"bridge": "bridge-locks"}}
"""Who hands out what not every fog node has: each program's volume."""
_SHARED: Final = frozenset({"credentials", *_OPTIONAL, "kernels", "mosquitto", "mosquitto-relay", "redis", "zenoh"})
_SERVERS: Final = ("mosquitto-relay", "redis", "zenoh")
"""Those that are in a network of each floor."""
_OUTSIDE: Final = "outside"
"""The gateways' way out, which has no names that could be mixed up."""
_SITE: Final = re.compile(r"^\$\{FOGNAV_SITE:-[^}]*\}:/site")
_PORT: Final = re.compile(r"\$\{(FOGNAV_\w+_PORT):-(\d+)\}")
_OUT: Final = "/out/floors"
_PROGRAMS: Final = ("hazard-aggregator", "map-service", "planner", "console-service")
"""Those that have credentials of their own on each floor."""

_Part = dict[str, Any]


def write_override(folders: Sequence[Path], root: Path, out: Path) -> dict[str, object]:
    """Write the override of a checkout's compose file for further floors; without folders, remove it.

    Raises `WrongUseError` as `override`, and for a file that this command has not written.
    """
    if out.exists() and not out.read_text("utf-8").startswith(HEADER):
        raise WrongUseError(f"{out} is not by this command: move it, or name another file with --out")
    if folders:
        atomic_write(out, override(folders, (root / BASE).read_text("utf-8")).encode(), mode=SHARED)
    else:
        out.unlink(missing_ok=True)
    return {"file": str(out), "sites": [str(folder) for folder in folders]}


def override(folders: Sequence[Path], compose: str) -> str:
    """Return the override for these sites, in the order of their ports; `compose` is the text of the compose file.

    Raises as `load_sites`.
    """
    base = yaml.safe_load(compose)
    services: _Part = {name: {"networks": {}} for name in _SERVERS}
    services["credentials"] = {"environment": {"FOGNAV_FLOORS_DIR": "/floors"}, "volumes": []}
    services |= {name: copy.deepcopy(services["credentials"]) for name in _OPTIONAL}
    made: _Part = {"services": services, "networks": {}, "volumes": {}}
    for index, (site, folder) in enumerate(zip(load_sites(folders), folders, strict=True), start=1):
        _add(made, base, _Floor(site, folder, index))
    written = yaml.safe_dump(made, sort_keys=False)
    words = shlex.join(str(folder) for folder in folders)
    return f"{HEADER} {words}`: run that again after an upgrade.\n{written}"


class _Floor:
    """One further floor: how its parts are named, and where they listen."""

    def __init__(self, site: str, folder: Path, index: int) -> None:
        self.site = site
        self.folder = folder
        self._index = index

    def name(self, part: str) -> str:
        return f"{part}-{self.site}"

    def volume(self, text: str) -> str:
        """Return a mount of the compose file as it is on this floor."""
        source, colon, rest = _SITE.sub(f"{self.folder}:/site", text).partition(":")
        # Every volume with a name is the floor's own, but for kernels, which all compile alike, and what all share.
        shared = source.startswith((".", "/", "$")) or source in {"kernels", "gateway-locks"}
        return (source if shared else self.name(source)) + colon + rest

    def port(self, text: str) -> str:
        """Return a published port: each floor's are ten above those of the one before."""
        suffix = self.site.upper().replace("-", "_")
        return _PORT.sub(lambda found: f"${{{found[1]}_{suffix}:-{int(found[2]) + PORT_STEP * self._index}}}", text)


def _add(made: _Part, base: Mapping[str, Any], floor: _Floor) -> None:
    services: _Part = made["services"]
    own = [name for name in base["services"] if name not in _SHARED]
    for name in own:
        services[floor.name(name)] = _service(base["services"][name], name, own, floor)
    for network, settings in base["networks"].items():
        if network != _OUTSIDE:
            made["networks"][floor.name(network)] = settings
    for server in _SERVERS:
        networks = base["services"][server]["networks"]
        for network in networks:
            settings = networks[network] if isinstance(networks, dict) else None
            services[server]["networks"][floor.name(network)] = settings
    mounted = {text.partition(":")[0] for name in own for text in services[floor.name(name)].get("volumes", [])}
    made["volumes"] |= {name: None for name in sorted(map(floor.name, base["volumes"])) if name in mounted}
    _add_credentials(services, floor)


def _service(base: Mapping[str, Any], name: str, own: Sequence[str], floor: _Floor) -> _Part:
    """Return a service of the compose file as it is on a floor."""
    service = copy.deepcopy(dict(base))
    if "volumes" in service:
        service["volumes"] = [floor.volume(text) for text in service["volumes"]]
    if "ports" in service:
        service["ports"] = [floor.port(text) for text in service["ports"]]
    if "networks" in service:
        service["networks"] = {
            network if network == _OUTSIDE else floor.name(network): None
            if network == _OUTSIDE
            else {"aliases": [name]}
            for network in service["networks"]
        }
    if "depends_on" in service:
        service["depends_on"] = {
            floor.name(other) if other in own else other: condition
            for other, condition in service["depends_on"].items()
        }
    environment: _Part = service.get("environment", {})
    if "FOGNAV_TOKENS_FILE" in environment and name == "backup":
        # The first floor's backup has everybody's credentials; this one has what the floor has of its own.
        environment["FOGNAV_TOKENS_FILE"] = f"/locks/floors/{floor.site}/tokens.toml"
    return service


def _add_credentials(services: _Part, floor: _Floor) -> None:
    """Let the containers that hand out credentials know the floor, and give them a place for each of its programs."""
    places = {service: f"{service}-locks-{floor.site}" for service in _PROGRAMS}
    for name in ("credentials", *_OPTIONAL):
        own = places | {program: f"{volume}-{floor.site}" for program, volume in _OPTIONAL.get(name, {}).items()}
        services[name]["volumes"] += [
            f"{floor.folder}:/floors/{floor.site}:ro",
            *(f"{volume}:{_OUT}/{floor.site}/{program}" for program, volume in own.items()),
        ]
