"""Which files of a site's locks each program of a fog node gets: in a folder of its own, which only it can read.

    mosquitto/  server.pem server.key users access authority.pem mosquitto_sub     the last two: its check of health
    redis/      server.pem server.key users authority.pem health                   as above
    zenoh/      server.pem server.key users access.json5 health.toml               the last one: as above
    gateway/    server.pem server.key
    hazard-aggregator/, map-service/, planner/    credentials.toml tokens.toml, the planner also operator.key
    simulation/ operator.key token credentials/NAME.toml                           of a simulated robot and its nodes
    floors/SITE/    the services' and simulation's of each further floor

A folder that does not exist is left out: containers get one each, as a volume.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

from fog_runtime.credentials import Credentials, to_toml
from fog_runtime.files import atomic_write
from fog_runtime.keys import OPERATOR_KEY, TOKENS
from fog_runtime.locks import users
from fog_runtime.locks.site_locks import CREDENTIALS
from fog_runtime.token_file import create_token, read_tokens, revoke_token, token_hash

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from fog_runtime.locks.site_locks import SiteLocks

SIMULATION: Final = "simulation"
FLOORS: Final = "floors"
"""The folder of what further floors have of their own, among the locks and among what is handed out."""
TOKEN: Final = "token"  # noqa: S105  # a file's name
_FOGNAV_UID: Final = 10001
"""The user of our images (deploy/images)."""
OWNERS: Final[Mapping[str, int]] = {
    "mosquitto": 1883,
    "redis": 999,
    "zenoh": _FOGNAV_UID,
    "gateway": 10002,
    **dict.fromkeys([*users.SERVICES, SIMULATION], _FOGNAV_UID),
}
"""As which user each program runs in its container: those of the images, and of docker-compose.yml."""
_BROKER_CHECK: Final = """\
-h localhost
-p 8883
--cafile {folder}/authority.pem
-u {user}
-P {password}
"""


def hand_out(
    locks: SiteLocks, out: Path, *, robots: Sequence[str], nodes: Sequence[str], seen_as: str = "/run/locks"
) -> list[Path]:
    """Bring the programs' folders in `out` up to date; return the files that changed.

    The locks' folder also has the site's keys (`fog_runtime.keys`); `seen_as` is a folder's path in its container.
    Raises `OSError`, and `CredentialsError` or `TokensError` for files that can't be used.
    """
    return _write(out, _servers(locks, seen_as)) + _hand_out_keys(locks, out, "", robots, nodes)


def hand_out_on_floor(
    locks: SiteLocks, out: Path, floor: str, *, robots: Sequence[str], nodes: Sequence[str]
) -> list[Path]:
    """Do the same for what a further floor has of its own, in `out/floors/SITE`; its keys are in `keys_of`."""
    return _hand_out_keys(locks, out / FLOORS / floor, floor, robots, nodes)


def keys_of(locks: Path, floor: str) -> Path:
    """Return the folder of a site's tokens and operators' key; without `floor`, the first site's."""
    return locks / FLOORS / floor if floor else locks


def _hand_out_keys(locks: SiteLocks, out: Path, floor: str, robots: Sequence[str], nodes: Sequence[str]) -> list[Path]:
    """Write what each site has for itself: its services' files, and those of a simulated robot."""
    keys = keys_of(locks.directory, floor)
    if (out / SIMULATION).is_dir():
        _make_token(keys / TOKENS, out / SIMULATION / TOKEN)
    named = partial(users.on_floor, floor) if floor else str
    tokens, key = (keys / TOKENS).read_bytes(), (keys / OPERATOR_KEY).read_bytes()
    found = {
        service: {"credentials.toml": locks.credentials(named(service)).read_bytes(), TOKENS: tokens}
        for service in users.SERVICES
    }
    found["planner"][OPERATOR_KEY] = key
    # Those of robots and nodes may have been handed out already, and removed here.
    known = (locks.credentials(named(user)) for user in ("console", "sim", *robots, *nodes))
    simulated = {f"{CREDENTIALS}/{file.name}": file.read_bytes() for file in known if file.exists()}
    return _write(out, {**found, SIMULATION: {OPERATOR_KEY: key, **simulated}})


def _servers(locks: SiteLocks, seen_as: str) -> dict[str, dict[str, bytes]]:
    """Return the files of what all sites share, by their names."""
    trusted = locks.authority.trusted.encode()
    health = Credentials.read(locks.credentials(users.HEALTH)).passwords
    check = _BROKER_CHECK.format(folder=seen_as, user=users.HEALTH, password=health["mqtt"])
    router_check = to_toml(users.HEALTH, authority=trusted.decode(), passwords={"zenoh": health["zenoh"]})
    return {
        "mosquitto": {**_folder(locks, "mosquitto"), "authority.pem": trusted, "mosquitto_sub": check.encode()},
        "redis": {**_folder(locks, "redis"), "authority.pem": trusted, "health": health["redis"].encode()},
        "zenoh": {**_folder(locks, "zenoh"), "health.toml": router_check.encode()},
        "gateway": _folder(locks, "http"),
    }


def _write(out: Path, contents: Mapping[str, Mapping[str, bytes]]) -> list[Path]:
    """Write the files that differ, each with its program's owner; return them."""
    changed = []
    for program, files in contents.items():
        folder = out / program
        if not folder.is_dir():
            continue
        for name, data in files.items():
            if not (folder / name).exists() or (folder / name).read_bytes() != data:
                atomic_write(folder / name, data, owner=OWNERS[program])
                changed.append(folder / name)
    return changed


def _folder(locks: SiteLocks, program: str) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in sorted(locks.folder(program).iterdir()) if file.is_file()}


def _make_token(tokens: Path, file: Path) -> None:
    """Give the simulated robot's operator a token of its own, if it has none that is valid."""
    known = [entry for entry in read_tokens(tokens) if entry.name == SIMULATION]
    if known:
        if file.exists() and token_hash(file.read_text("ascii").strip()) == known[0].sha256:
            return
        revoke_token(tokens, SIMULATION)
    token = create_token(tokens, SIMULATION, "operator")
    atomic_write(file, f"{token}\n".encode(), owner=OWNERS[SIMULATION])
