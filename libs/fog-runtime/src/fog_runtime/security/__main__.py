"""The credentials of a fog node in containers: `python -m fog_runtime.security [make | COMMAND …]`.

`make` creates what is missing, and hands out to each program what is its own; every other command does
so afterwards. With `FOGNAV_FLOORS_DIR`, a folder with one of each further floor's site, these get theirs, too; `--floor
SITE` names one in the other commands. Where the command `fognav` is installed, `fognav ca`, `robot add`, `node add`
and `token` do the same in the folder of the credentials.

Each program gets a folder of its own, which only it can read:

    mosquitto/  server.pem server.key users access mosquitto_sub                   the last one: its check of health
    redis/      server.pem server.key users authority.pem health                   the last two: as above
    zenoh/      server.pem server.key users access.json5 health.toml               the last one: as above
    gateway/    server.pem server.key
    bridge/     credentials.toml token                                             of the bridges to other systems
    hazard-aggregator/, map-service/, planner/, console-service/    credentials.toml tokens.toml session.key, the
                planner also operator.key
    simulation/ operator.key token credentials/NAME.toml                           of a simulated robot and its nodes
    floors/SITE/    the services', bridge's and simulation's of each further floor

A folder that does not exist is left out: containers get one each, as a volume.
"""

from __future__ import annotations

import argparse
import datetime as dt
import os
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from fog_contracts.messages import Id
from fog_runtime.configuration.settings import SettingsError, load
from fog_runtime.configuration.site import SiteError, load_site
from fog_runtime.credentials import Credentials, CredentialsError, to_toml
from fog_runtime.files import atomic_write
from fog_runtime.keys import OPERATOR_KEY, SESSION_KEY, TOKENS, make_keys
from fog_runtime.security import users
from fog_runtime.security.authority import AuthorityError
from fog_runtime.security.site_security import CREDENTIALS, SiteSecurity
from fog_runtime.security.users import SecurityError, on_floor
from fog_runtime.token_file import ROLES, TokensError, create_token, keep_token, read_tokens, revoke_token

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from fog_contracts.site import Site

SIMULATION: Final = "simulation"
BRIDGE: Final = "bridge"
FLOORS: Final = "floors"
"""The folder of what further floors have of their own, among the credentials and among what is handed out."""
TOKEN: Final = "token"  # noqa: S105  # a file's name
_FOGNAV_UID: Final = 10001
"""The user of our images (deploy/images)."""
OWNERS: Final[Mapping[str, int]] = {
    "mosquitto": 1883,
    "redis": 999,
    "zenoh": _FOGNAV_UID,
    "gateway": 10002,
    **dict.fromkeys([*users.SERVICES, BRIDGE, SIMULATION], _FOGNAV_UID),
}
"""As which user each program runs in its container: those of the images, and of docker-compose.yml."""
_BROKER_CHECK: Final = """\
--unix /mosquitto/data/socket
-u {user}
-P {password}
"""


def hand_out(security: SiteSecurity, out: Path, *, robots: Sequence[str], nodes: Sequence[str]) -> list[Path]:
    """Bring the programs' folders in `out` up to date; return the files that changed.

    The credentials' folder also has the site's keys (`fog_runtime.keys`). Raises `OSError`, and `CredentialsError` or
    `TokensError` for files that can't be used.
    """
    return _write(out, _servers(security)) + _hand_out_keys(security, out, "", robots, nodes)


def hand_out_on_floor(
    security: SiteSecurity, out: Path, floor: str, *, robots: Sequence[str], nodes: Sequence[str]
) -> list[Path]:
    """Do the same for what a further floor has of its own, in `out/floors/SITE`; its keys are in `keys_of`."""
    return _hand_out_keys(security, out / FLOORS / floor, floor, robots, nodes)


def keys_of(security: Path, floor: str) -> Path:
    """Return the folder of a site's tokens and operators' key; without `floor`, the first site's."""
    return security / FLOORS / floor if floor else security


def _hand_out_keys(
    security: SiteSecurity, out: Path, floor: str, robots: Sequence[str], nodes: Sequence[str]
) -> list[Path]:
    """Write what each site has for itself: its services' files, and those of a simulated robot."""
    keys = keys_of(security.directory, floor)
    for program in (BRIDGE, SIMULATION):
        if (out / program).is_dir():
            keep_token(keys / TOKENS, program, "operator", out / program / TOKEN, owner=OWNERS[program])
    return _write(out, _of_site(security, floor, robots, nodes))


def secrets_of(security: SiteSecurity, *, robots: Sequence[str], nodes: Sequence[str]) -> dict[str, dict[str, bytes]]:
    """Return the files of each program by their names, as `hand_out` writes them; raises as that.

    The tokens of bridge and simulation are not among them.
    """
    return {**_servers(security), **_of_site(security, "", robots, nodes)}


def _of_site(
    security: SiteSecurity, floor: str, robots: Sequence[str], nodes: Sequence[str]
) -> dict[str, dict[str, bytes]]:
    """Return what each site has for itself."""
    keys = keys_of(security.directory, floor)
    named = partial(users.on_floor, floor) if floor else str
    tokens, key, sessions = ((keys / name).read_bytes() for name in (TOKENS, OPERATOR_KEY, SESSION_KEY))
    found = {
        service: {
            "credentials.toml": security.credentials(named(service)).read_bytes(),
            TOKENS: tokens,
            SESSION_KEY: sessions,
        }
        for service in users.SERVICES
    }
    found["planner"][OPERATOR_KEY] = key
    found[BRIDGE] = {"credentials.toml": security.credentials(named(BRIDGE)).read_bytes()}
    # Those of robots and nodes may have been handed out already, and removed here.
    known = (security.credentials(named(user)) for user in ("console", "sim", *robots, *nodes))
    simulated = {f"{CREDENTIALS}/{file.name}": file.read_bytes() for file in known if file.exists()}
    return {**found, SIMULATION: {OPERATOR_KEY: key, **simulated}}


def _servers(security: SiteSecurity) -> dict[str, dict[str, bytes]]:
    """Return the files of what all sites share, by their names."""
    trusted = security.authority.trusted.encode()
    health = Credentials.read(security.credentials(users.HEALTH)).passwords
    check = _BROKER_CHECK.format(user=users.HEALTH, password=health["mqtt"])
    router_check = to_toml(users.HEALTH, authority=trusted.decode(), passwords={"zenoh": health["zenoh"]})
    return {
        "mosquitto": {**_folder(security, "mosquitto"), "mosquitto_sub": check.encode()},
        "redis": {**_folder(security, "redis"), "authority.pem": trusted, "health": health["redis"].encode()},
        "zenoh": {**_folder(security, "zenoh"), "health.toml": router_check.encode()},
        "gateway": _folder(security, "http"),
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


def _folder(security: SiteSecurity, program: str) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in sorted(security.folder(program).iterdir()) if file.is_file()}


_SERVERS: Final = ("mosquitto", "redis", "zenoh", "gateway", "localhost", "127.0.0.1")
"""How containers, and the host itself, reach the servers."""


class Settings(msgspec.Struct, frozen=True, kw_only=True):
    """Where the credentials are, and for which site and hosts."""

    site_dir: Path
    locks_dir: Path
    handed_out_dir: Path
    hosts: str = ""
    """Names and addresses by which robots, nodes and people reach the fog node, comma separated."""
    floors_dir: Path | None = None
    """A folder with the folders of further floors; None: there are none."""


def _floors(settings: Settings) -> list[Site]:
    """Return the further floors, in the order of their folders' names; raises `SiteError`."""
    folders = [] if settings.floors_dir is None else sorted(settings.floors_dir.iterdir())
    return [load_site(folder).site for folder in folders]


def make_site(folder: Path, site: Site, hosts: Sequence[str], *, copies: bool = False) -> SiteSecurity:
    """Create what is missing of a site's credentials in a folder; robots, nodes and people reach it by `hosts`.

    `copies` as for `SiteSecurity.make`. Raises `AuthorityError`, `SecurityError` and `OSError`.
    """
    security = SiteSecurity(folder, site.id)
    robots = [robot.id for robot in site.robots]
    security.make([*_SERVERS, *hosts], robots=robots, nodes=site.senders, copies=copies)
    make_keys(folder)
    return security


def _make(settings: Settings, site: Site, floors: Sequence[Site]) -> SiteSecurity:
    """Create what is missing."""
    hosts = [host for host in (part.strip() for part in settings.hosts.split(",")) if host]
    security = make_site(settings.locks_dir, site, hosts)
    for index, floor in enumerate(floors):
        if floor.id in {site.id, *(each.id for each in floors[:index])}:
            raise SecurityError(f"two floors have the same id {floor.id!r}: give one of them another in its site.toml")
        security.add_floor(
            floor.id, robots=[robot.id for robot in floor.robots], nodes=floor.senders
        )  # fmt: skip
        make_keys(keys_of(settings.locks_dir, floor.id))
    return security


def _carry_out(options: argparse.Namespace, security: SiteSecurity) -> str:
    """Carry out a command; return its answer. Raises `SecurityError`, `AuthorityError`, `TokensError`, `OSError`."""
    match options.command:
        case "robot" | "node" | "device":
            return _added(options, security).read_text("utf-8")
        case "remove":
            if not security.remove(_named(options)):
                raise SecurityError(f"{options.id} is unknown. Known are: {', '.join(sorted(security.users()))}")
        case "certificate":
            return security.authority.trusted
        case "show":
            return _shown(security, options.file)
        case "token":
            return _change_tokens(options, keys_of(security.directory, options.floor) / TOKENS)
        case "rotate":
            _rotate(security, finish=options.finish)
    return ""


def _added(options: argparse.Namespace, security: SiteSecurity) -> Path:
    _id(options.id)
    name = _named(options)
    if options.command == "device":
        return security.add_device(name, options.topic)
    return security.add_robot(name) if options.command == "robot" else security.add_node(name)


def _named(options: argparse.Namespace) -> str:
    """Return how the servers call the robot, node or device that is named."""
    return on_floor(options.floor, options.id) if options.floor else str(options.id)


def _change_tokens(options: argparse.Namespace, file: Path) -> str:
    if options.action == "create":
        return create_token(file, options.name, options.role) + "\n"
    if options.action == "revoke":
        revoke_token(file, options.name)
        return ""
    return "".join(f"{entry.name}: {entry.role}\n" for entry in read_tokens(file))


def _rotate(security: SiteSecurity, *, finish: bool) -> None:
    if finish:
        security.authority.finish()
    else:
        security.authority.rotate(now=dt.datetime.now(dt.UTC))
    security.trust_again()
    security.renew(only_due=False)


def _require_floor(floor: str, security: SiteSecurity) -> None:
    _, *known = security.sites
    if floor and floor not in known:
        raise SecurityError(f"{floor} is no further floor of this fog node. There are: {', '.join(known) or 'none'}")


def _id(text: str) -> None:
    try:
        msgspec.convert(text, Id)
    except msgspec.ValidationError as error:
        raise SecurityError(f"{text} is no id: use only a to z, 0 to 9 and -, at most 32") from error


def _shown(security: SiteSecurity, name: str) -> str:
    file = (security.directory / name).resolve()
    if not file.is_relative_to(security.directory.resolve()) or not file.is_file():
        files = sorted(path for path in security.directory.rglob("*") if path.is_file())
        names = ", ".join(path.relative_to(security.directory).as_posix() for path in files)
        raise SecurityError(f"there is no file {name}. There are: {names}")
    return file.read_text("utf-8")


def _keep_owner(folder: Path) -> None:
    """Give what was created as root to the owner of the folder, who may be a user of the host."""
    owner = folder.stat()
    if os.geteuid() == 0 and owner.st_uid != 0:
        for path in folder.rglob("*"):
            os.chown(path, owner.st_uid, owner.st_gid, follow_symlinks=False)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="credentials", description="The certificates, users and secrets of a fog node in containers."
    )
    parser.add_argument("--floor", metavar="SITE", default="", help="the floor that is meant; default: the first one")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    commands.add_parser("make", help="create what is missing, and hand it out (default)")
    commands.add_parser("certificate", help="print the authority's certificate, for browsers and curl")
    commands.add_parser("robot", help="let a robot in; prints its credentials").add_argument("id")
    commands.add_parser("node", help="let a sensor node in; prints its credentials").add_argument("id")
    device = commands.add_parser("device", help="let a sensor of others use topics of its own; prints its credentials")
    device.add_argument("id")
    device.add_argument("topic", nargs="+", help="such as zigbee2mqtt/#")
    commands.add_parser("remove", help="let a robot, node or device in no longer").add_argument("id")
    commands.add_parser("show", help="print a file: admin.token, credentials/NAME.toml, …").add_argument("file")
    rotating = commands.add_parser("rotate", help="replace the authority; both are trusted until --finish")
    rotating.add_argument("--finish", action="store_true")
    actions = commands.add_parser("token", help="who may use the REST APIs").add_subparsers(
        dest="action", metavar="ACTION", required=True
    )
    creating = actions.add_parser("create", help="prints the token, once")
    creating.add_argument("name")
    creating.add_argument("role", choices=ROLES)
    actions.add_parser("list")
    actions.add_parser("revoke").add_argument("name")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out the command line; return the exit code."""
    options = _parser().parse_args(arguments)
    try:
        settings = load(Settings, environ=os.environ)
        site, floors = load_site(settings.site_dir).site, _floors(settings)
        security = _make(settings, site, floors)
        _require_floor(options.floor, security)
        # At once: what is printed only once must not be lost when handing out fails.
        sys.stdout.write(_carry_out(options, security))
        _keep_owner(settings.locks_dir)
        changed = hand_out(
            security,
            settings.handed_out_dir,
            robots=[robot.id for robot in site.robots],
            nodes=site.senders,
        )
        for floor in floors:
            changed += hand_out_on_floor(
                security,
                settings.handed_out_dir,
                floor.id,
                robots=[robot.id for robot in floor.robots],
                nodes=floor.senders,
            )
    except (AuthorityError, CredentialsError, SecurityError, SettingsError, SiteError, TokensError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    for file in changed:
        sys.stderr.write(f"handed out {file.relative_to(settings.handed_out_dir)}\n")
    return 0


if __name__ == "__main__":
    os.umask(0o077)
    sys.exit(main())
