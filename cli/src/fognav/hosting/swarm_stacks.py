"""Stack files for Docker Swarm, one for each floor, made from docker-compose.yml: `fognav stack` (docs/campus.md).

A stack has what the compose file has for one floor, all of it on the machine whose label names the floor, or twice on
two of the three that are named (`swarm_copies`). What the
container `credentials` hands out there are secrets here, what is mounted from the checkout are configs; both have the
hash of their content in their names, so that the next `docker stack deploy` brings a change into force. The folder
that is written has all that the engine reads, and each floor's authority.
"""

import hashlib
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import yaml  # type: ignore[import-untyped]  # PyYAML ships no types
from PIL import Image

from fog_runtime.configuration.maps import read_keys
from fog_runtime.configuration.site import SITE_FILE, LoadedSite
from fog_runtime.credentials import Credentials, to_toml
from fog_runtime.files import SHARED, atomic_write
from fog_runtime.keys import TOKENS
from fog_runtime.security.__main__ import OWNERS, TOKEN, make_site, secrets_of
from fog_runtime.security.site_security import SiteSecurity
from fog_runtime.security.users import PEER
from fog_runtime.token_file import keep_token
from fognav.hosting.compose_floors import BASE
from fognav.hosting.folders import load_sites
from fognav.hosting.swarm_copies import HOSTS, MACHINES, SERVICES, shared_files, shared_secrets, with_copies
from fognav.output import WrongUseError
from fognav.programs import CONSOLE

_Part = dict[str, Any]

IMAGES: Final = "fognav/"
"""What the names of our images begin with in the compose file."""
LABEL: Final = "fognav.floor"
MACHINE: Final = "fognav.machine"
"""The label that numbers the machines of a floor that has several."""
LIMIT: Final = 500 * 1024
"""Bytes of a secret or config (Docker Engine 20.10)."""
KEPT: Final = frozenset(
    {"image", "user", "command", "entrypoint", "environment", "healthcheck", "init", "read_only"}
    | {"cap_add", "cap_drop", "logging", "sysctls"}
)
"""What a stack file has as the compose file has it."""
CHANGED: Final = frozenset({"volumes", "ports", "networks", "network_mode", "mem_limit", "scale", "tmpfs"})
DROPPED: Final = frozenset({"build", "pull_policy", "depends_on", "restart", "security_opt"})
"""What Swarm does not know, or does in its own way: it starts all at once, and again until they run."""
HEALTH: Final = {"timeout": "10s", "retries": 6}
"""Swarm kills, and forgets the name of, what compose only calls unhealthy: a busy machine must not lose its store."""
_DEFAULT: Final = re.compile(r"^\$\{\w+:-(.+)\}$")
ONCE_READY: Final = (
    "fognav-ready 8000 /readyz && touch /tmp/ready || { [ -e /tmp/ready ] && fognav-ready 8000 /healthz; }"
)
"""The check of a service: without Redis it goes on for its robots, and must not be killed then."""
_HEAD: Final = "# Written by `fognav stack`: run that again after an upgrade."
_FILES: Final = ("secrets", "configs")
_MOUNTED: Final = re.compile(r"^(?P<source>.+):(?P<target>/[^:]*)(:ro)?$")
_SITE: Final = "/site"
_NAME: Final = 64
_FLOORS: Final = "floors.toml"


@dataclass(frozen=True, kw_only=True)
class FloorAt:
    """A floor, and the names or addresses of its machine, or of its three."""

    loaded: LoadedSite
    hosts: Sequence[str]

    @property
    def twice(self) -> bool:
        """Whether it has two copies of each service."""
        return len(self.hosts) > 1

    @property
    def id(self) -> str:
        """Its site's id."""
        return self.loaded.site.id


def named_floors(words: Sequence[str]) -> list[tuple[Path, list[str]]]:
    """Return the folders and hosts of words like `sites/upstairs@fog2.local`; raises `WrongUseError`."""
    found = []
    for word in words:
        folder, at, hosts = word.rpartition("@")
        named = hosts.split(",")
        if not at or not folder or not all(re.fullmatch(r"[A-Za-z0-9.-]+", host) for host in named):
            raise WrongUseError(
                f"{word!r}: give a floor as its site's folder and its machine: sites/upstairs@fog2.local"
            )
        if (len(named), len(set(named))) not in ((1, 1), (MACHINES, MACHINES)):
            raise WrongUseError(
                f"{word!r}: a floor has one machine, or for two copies of each service {MACHINES}. The third one may "
                "be small: with it, two of them can tell which one is cut off"
            )
        found.append((Path(folder), named))
    return found


def write_stacks(floors: Sequence[tuple[Path, Sequence[str]]], root: Path, out: Path, images: str) -> dict[str, Any]:
    """Write a stack for each floor into `out`, where earlier credentials are kept; return the files.

    images: what the names of our images begin with, such as `registry.local:5000/fognav/`. Raises `WrongUseError`, and
    as `load_sites` and `make_site`.
    """
    loaded = load_sites([folder for folder, _ in floors])
    known = [FloorAt(loaded=each, hosts=hosts) for each, (_, hosts) in zip(loaded.values(), floors, strict=True)]
    securities = {
        floor.id: make_site(
            out / floor.id / "locks", floor.loaded.site, [*floor.hosts, *(HOSTS if floor.twice else ())],
            copies=floor.twice,
        )
        for floor in known
    }  # fmt: skip
    peers = {floor.id: _peers(floor, known, securities) for floor in known}  # before the tokens are read
    written = []
    for floor in known:
        site = floor.loaded.site
        secrets = secrets_of(securities[floor.id], robots=[robot.id for robot in site.robots], nodes=site.senders)
        secrets[CONSOLE] |= peers[floor.id]
        secrets["mosquitto-relay"] = secrets["mosquitto"]
        base, files = yaml.safe_load((root / BASE).read_text("utf-8")), {}
        if floor.twice:
            base, files = with_copies(base), shared_files(root / "deploy")
            secrets = shared_secrets(secrets, Credentials.read(securities[floor.id].credentials(PEER)))
        stack = _Stack(floor.id, out, secrets, _site_files(floor.loaded), files)
        made = stack.of(base, root, images)
        if peers[floor.id]:
            for name in made["services"].keys() & {CONSOLE, f"{CONSOLE}-2"}:
                made["services"][name]["environment"]["FOGNAV_FLOORS_FILE"] = f"/run/fognav/{_FLOORS}"
        parts = {f"{floor.id}.yml": made}
        if floor.twice:
            parts |= {f"{floor.id}.{machine}.yml": _part(made, machine) for machine in range(1, MACHINES + 1)}
        for name, part in parts.items():
            text = f"{_HEAD}\n{yaml.safe_dump(part, sort_keys=False)}"
            atomic_write(out / name, text.encode(), mode=SHARED)
            written.append(str(out / name))
    return {"files": written, "floors": {floor.id: ",".join(floor.hosts) for floor in known}}


def _part(stack: _Part, machine: int) -> _Part:
    """Return what a stack has on one of its machines, so that one can be upgraded after the other."""
    label = f"node.labels.{MACHINE} == {machine}"
    services = {
        name: each for name, each in stack["services"].items() if label in each["deploy"]["placement"]["constraints"]
    }
    used = {each["source"] for service in services.values() for kind in _FILES for each in service[kind]}
    return {**stack, "services": services} | {
        kind: {key: each for key, each in stack[kind].items() if key in used} for kind in _FILES
    }


def _peers(floor: FloorAt, floors: Sequence[FloorAt], securities: Mapping[str, SiteSecurity]) -> dict[str, bytes]:
    """Return a floor's list of the others, with a viewer's token of each."""
    found, listed = {}, ""
    for other in floors:
        if other.id == floor.id:
            continue
        security, name = securities[other.id], f"from-{floor.id}"
        token = security.directory / "peers" / floor.id / TOKEN
        keep_token(security.directory / TOKENS, name, "viewer", token)
        text = to_toml(name, authority=security.authority.trusted, passwords={}, token=token.read_text("ascii").strip())
        found[f"{other.id}.toml"] = text.encode()
        listed += f'[floors.{other.id}]\naddress = "https://{other.hosts[0]}"\ncredentials = "{other.id}.toml"\n'
        if other.twice:
            listed += f'second_address = "https://{other.hosts[1]}"\n'
    return found | {_FLOORS: listed.encode()} if found else {}


def _site_files(loaded: LoadedSite) -> dict[str, bytes]:
    """Return the files of a site that services read, its map as PNG: a PGM is too large for Swarm."""
    folder, described = loaded.directory, Path(loaded.site.map)
    if described.is_absolute() or ".." in described.parts:
        raise WrongUseError(f"{folder / SITE_FILE}: `map` is {str(described)!r}: put the map into the site's folder")
    keys, picture = read_keys(folder / described), io.BytesIO()
    with Image.open((folder / described).parent / keys["image"]) as opened:
        opened.save(picture, "PNG", optimize=True)
    text = yaml.safe_dump({**keys, "image": "map.png"}, sort_keys=False)
    return {
        SITE_FILE: (folder / SITE_FILE).read_bytes(),
        described.as_posix(): text.encode(),
        described.with_name("map.png").as_posix(): picture.getvalue(),
    }


class _Stack:
    """One floor's stack as it is made: its secrets and configs are written, and named by their content."""

    def __init__(
        self, floor: str, out: Path, secrets: Mapping[str, Mapping[str, bytes]], site: Mapping[str, bytes],
        files: Mapping[str, bytes],
    ) -> None:  # fmt: skip
        """`secrets` are files by the program that reads them, `site` those of the site.

        `files` replace what is in the checkout's folder `deploy`.
        """
        self._floor = floor
        self._out = out
        self._secrets = secrets
        self._site = site
        self._files = files
        self._made: _Part = {
            "version": "3.9",
            "services": {},
            "networks": {},
            "volumes": {},
            "secrets": {},
            "configs": {},
        }

    def of(self, base: Mapping[str, Any], root: Path, images: str) -> _Part:
        """Return the stack of a compose file, for the services that always run."""
        for name, service in base["services"].items():
            if service.get("restart") != "no" and "profiles" not in service:
                self._made["services"][name] = self._service(name, service, root, images)
        for name, settings in {**base["networks"], "alone": {"internal": True}}.items():
            self._made["networks"][name] = {"driver": "overlay", **(settings or {})}
        return self._made

    def _service(self, name: str, base: Mapping[str, Any], root: Path, images: str) -> _Part:
        machine, of = base.get("x-machine", 0), base.get("x-of", name)
        if unknown := base.keys() - KEPT - CHANGED - DROPPED - {"x-machine", "x-of"}:
            raise WrongUseError(f"{BASE}: {name} has {min(unknown)}, of which a stack is not made: take it out")
        service: _Part = {key: value for key, value in base.items() if key in KEPT}
        check = {"test": ["CMD-SHELL", ONCE_READY]} if of in SERVICES else base.get("healthcheck", {})
        service["healthcheck"] = {**check, **HEALTH}
        service["environment"] = dict(base.get("environment", {}))
        if base["image"].startswith(IMAGES):
            service["image"] = images + base["image"].removeprefix(IMAGES)
        # Who has no network there is alone in one here: Swarm's tasks have one.
        service["networks"] = base.get("networks", ["alone"])
        service["ports"] = [_port(text) for text in base.get("ports", [])]
        self._mount(service, name, of, base, root)
        service["deploy"] = {
            "replicas": base.get("scale", 1),
            "endpoint_mode": "dnsrr",
            "placement": {
                "constraints": [
                    f"node.labels.{LABEL} == {self._floor}",
                    *([f"node.labels.{MACHINE} == {machine}"] if machine else []),
                ]
            },
            "resources": {"limits": {"memory": base["mem_limit"]}},
            "restart_policy": {"condition": "any", "delay": "1s"},
            # Two at once would share ports and data.
            "update_config": {"order": "stop-first", "failure_action": "rollback"},
        }
        return service

    def _mount(self, service: _Part, name: str, of: str, base: Mapping[str, Any], root: Path) -> None:
        """Give a service its volumes, secrets and configs; `of` is the service of which it is a copy."""
        owner = str(OWNERS.get({"mosquitto-relay": "mosquitto", "sentinel": "redis"}.get(of, of), 0))
        # Stacks pass over `tmpfs`.
        volumes = service["volumes"] = [{"type": "tmpfs", "target": target} for target in base.get("tmpfs", [])]
        secrets, configs = service["secrets"], service["configs"] = [], []
        for text in base.get("volumes", []):
            found = _MOUNTED.match(text)
            assert found is not None, f"{BASE}: {text} is no mount"
            source, target = _DEFAULT.sub(r"\1", found["source"]), found["target"]
            if source.endswith("-locks"):
                for file, data in self._secrets[name].items():
                    key = self._add("secrets", f"{name}/{file}", data)
                    secrets.append({"source": key, "target": f"{target}/{file}", "uid": owner, "mode": 0o400})
            elif target == _SITE:
                for file, data in self._site.items():
                    configs.append({"source": self._add("configs", f"site/{file}", data), "target": f"{target}/{file}"})
            elif source.startswith("./"):
                for path, within in _files(root / source):
                    file = path.relative_to(root / "deploy").as_posix()
                    key = self._add("configs", file, self._files.get(file) or path.read_bytes())
                    configs.append({"source": key, "target": target + within})
            else:
                self._made["volumes"][source] = None
                volumes.append(text)

    def _add(self, kind: str, file: str, data: bytes) -> str:
        """Write a secret or config, and return its key in the stack file."""
        if len(data) > LIMIT:
            raise WrongUseError(
                f"{file} of the floor {self._floor} has {len(data)} bytes, and Swarm takes at most {LIMIT}: make the "
                "map's picture smaller, or run this floor by `fognav up`"
            )
        path = self._out / self._floor / kind / file
        if not path.is_file() or path.read_bytes() != data:
            atomic_write(path, data)
        digest = hashlib.sha256(data).hexdigest()[:12]
        words = re.sub(r"[^a-zA-Z0-9_.-]", "-", f"{self._floor}_{file}")
        key = words.replace(".", "-")
        name = f"{words[: _NAME - 13]}_{digest}"
        self._made[kind][key] = {"file": f"./{path.relative_to(self._out).as_posix()}", "name": name}
        return key


def _files(path: Path) -> list[tuple[Path, str]]:
    """Return a file, or those below a folder, each with what follows the mount's target."""
    if path.is_file():
        return [(path, "")]
    found = sorted(each for each in path.rglob("*") if each.is_file() and each.suffix != ".py" and each.name[0] != ".")
    return [(each, f"/{each.relative_to(path).as_posix()}") for each in found]


def _port(text: str) -> _Part:
    """Return a published port in the long form, on the machine itself: no other one answers for it."""
    _, published, target = re.split(r":(?![-}])(?=[$0-9])", text)
    return {"target": int(target), "published": published, "protocol": "tcp", "mode": "host"}
