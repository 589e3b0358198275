"""The settings of a node's board (`node.json`): the options of the commands that write them, and what they write."""

import base64
import functools
import hashlib
import inspect
import ipaddress
import json
import os
import re
import secrets
import shutil
import stat
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self, cast

import typer

from fog_contracts.site import NodeSite
from fog_runtime.configuration.site import LoadedSite
from fog_runtime.credentials import Credentials
from fog_runtime.files import PRIVATE, atomic_write
from fog_runtime.security.site_security import SiteSecurity
from fognav import checkout
from fognav.credentials import (
    CredentialsOption,
    changeable_security,
    credentials_folder,
    open_security,
    security_errors,
)
from fognav.operate.options import JsonOption
from fognav.output import WrongUseError, print_json, print_line, writing

SETTINGS_FILE: Final = "node.json"
AUTHORITY_FILE: Final = "ca.pem"
ESPHOME_FILE: Final = "secrets.yaml"
ESPHOME_PINS: Final = {"standard": ((18, 22), (19, 21)), "thesis": ((26, 22), (17, 19))}
"""By profile, trigger and echo of both sonars of a D1 mini 32 (`board_pins.hpp`)."""
_ITERATIONS: Final = 20_000


@dataclass(frozen=True)
class Access:
    """How a board reaches the broker: Wi-Fi, one or two fog nodes' names, and whether the connection is encrypted."""

    wifi_name: str
    wifi_password: str
    brokers: list[str]
    port: int
    tls: bool


def new_password() -> str:
    """Return a password that nobody has to type: 120 bits."""
    return secrets.token_urlsafe(15)


def settings(site: str, node: NodeSite, access: Access, password: str, profile: str) -> dict[str, Any]:
    """Return the members of a board's `node.json`, as firmware/README.md lists them; `profile` says which pins."""
    return {
        "site": site,
        "node": node.id,
        "wifi_name": access.wifi_name,
        "wifi_password": access.wifi_password,
        **dict(zip(("broker", "second_broker"), access.brokers, strict=False)),
        "port": access.port,
        "tls": access.tls,
        "user": node.id,
        "password": password,
        "profile": profile,
        "every_reading": node.every_reading,
        "sonars": [
            {
                "range_limit_m": sonar.range_limit,
                "range_max_m": sonar.range_max or 0.0,
                "no_echo_is_clear": sonar.no_echo_is_clear,
            }
            for sonar in node.sonars
        ],
    }


def esphome_secrets(members: dict[str, Any], authority: Path) -> dict[str, Any]:
    """Return what `fognav-node.yaml` reads, from a board's settings and the certificates that it trusts (PEM).

    JSON is YAML, too. Raises `WrongUseError` for a node of another kind than that file is for.
    """
    sonars = members["sonars"]
    pins = ESPHOME_PINS[members["profile"]]
    if len(sonars) != len(pins):
        raise WrongUseError(f"node {members['node']} has {len(sonars)} sonars: the configuration for ESPHome has two")
    try:
        kept = {name: value for name, value in members.items() if name not in ("sonars", "tls", "profile")}
        secrets = {**kept, "authority": authority.read_text("ascii")}
    except (OSError, UnicodeDecodeError) as error:
        raise WrongUseError(f"the authority's certificate {authority} can't be read: {error}") from error
    for number, (sonar, (trigger, echo)) in enumerate(zip(sonars, pins, strict=True), 1):
        for name in ("range_limit", "range_max"):
            secrets[f"{name}_{number}"] = str(sonar[f"{name}_m"])
        secrets |= {f"trigger_{number}": trigger, f"echo_{number}": echo}
    return secrets


def node_in(file: Path) -> str | None:
    """Return the id of the node that a `node.json` is for, or None without a file; raises `WrongUseError`."""
    try:
        return str(json.loads(file.read_bytes())["node"]) if file.exists() else None
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise WrongUseError(f"{file} is no node's settings, or can't be read: move it away") from error


def credentials_in(folder: Path, node: str) -> Credentials:
    """Return what a node's board logs in with, and whom it trusts; raises `WrongUseError` for another one's folder."""
    file, authority = folder / SETTINGS_FILE, folder / AUTHORITY_FILE
    if (found := node_in(file)) != node:
        raise WrongUseError(f"{file} is {f'that of node {found}' if found else 'missing'}: name the folder of {node}'s")
    members = json.loads(file.read_bytes())
    trusted = authority.read_text("ascii") if members["tls"] and authority.exists() else ""
    return Credentials(user=members["user"], passwords={"mqtt": members["password"]}, authority=trusted, file=file)


def provision(file: Path, members: dict[str, Any], passwords: Path | None) -> None:
    """Write `node.json`, readable for its owner only, and the password in it into the broker's file, if one is given.

    Raises `WrongUseError`, and leaves both as they were: a board with a password that no broker knows is of no use.
    """
    before = file.read_bytes() if file.exists() else None
    _write(file, (json.dumps(members, indent=2) + "\n").encode())
    try:
        if passwords is not None:
            set_password(passwords, members["user"], members["password"])
    except WrongUseError:
        if before is None:
            file.unlink()
        else:
            _write(file, before)
        raise


def let_in(security: SiteSecurity, site: str, node: str) -> Credentials:
    """Let a node of a site in; return its user, with a new password, and what its board shall trust (PEM).

    Raises `SecurityError` or `AuthorityError`.
    """
    file = security.add_node(security.user_on(site, node))
    credentials = Credentials.read(file)
    file.unlink()  # the board has it: nobody else needs it
    return credentials


def write_authority(file: Path, authority: str) -> None:
    """Write the certificates that a board trusts beside its settings; raises `WrongUseError`."""
    _write(file, authority.encode())


def set_password(file: Path, user: str, password: str) -> None:
    """Set a user's password in a Mosquitto password file; raises `WrongUseError`.

    A missing one is created for its owner only. Another one keeps its owner and permissions: the broker reads it, and
    mostly as a user of its own.
    """
    try:
        lines = file.read_text("utf-8").splitlines() if file.exists() else []
    except (OSError, UnicodeDecodeError) as error:
        raise WrongUseError(f"the broker's password file {file} can't be read: {error}") from error
    owner = file.stat() if file.exists() else None
    if owner is not None and os.geteuid() not in (0, owner.st_uid):
        raise WrongUseError(f"the broker's password file {file} belongs to another user: run this as that user or root")
    kept = [line for line in lines if line.partition(":")[0] != user]
    _write(file, ("\n".join([*kept, f"{user}:{_hashed(password)}"]) + "\n").encode(), owner)


def _hashed(password: str) -> str:
    """Return a password as Mosquitto stores it: `$7$`, PBKDF2 with SHA-512 (mosquitto_passwd(1))."""
    salt = secrets.token_bytes(12)
    key = hashlib.pbkdf2_hmac("sha512", password.encode(), salt, _ITERATIONS)
    return f"$7${_ITERATIONS}${base64.b64encode(salt).decode()}${base64.b64encode(key).decode()}"


def _write(file: Path, data: bytes, like: os.stat_result | None = None) -> None:
    """Write a file with the owner, group and permissions of `like`; None: for the caller only."""
    with writing(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(file, data, mode=PRIVATE if like is None else stat.S_IMODE(like.st_mode))
        if like is not None:
            os.chown(file, like.st_uid, like.st_gid)


SITE: Final = Path("estig")
SiteOption = Annotated[Path, typer.Option("--site", metavar="D", help="Folder of the site, or a name in sites/.")]
_TLS_PORT: Final = 8883
_OPEN_PORT: Final = 1883
_WIFI_NAME_BYTES: Final = 32
_WIFI_PASSWORD: Final = re.compile(r"[ -~]{8,63}|[0-9A-Fa-f]{64}")
"""Of WPA2: a shorter one is no access point's, and no board's library takes a longer one."""
_HOST_NAME: Final = re.compile(r"(?=.{1,64}\Z)([A-Za-z0-9-]+\.)*[A-Za-z0-9-]*[A-Za-z][A-Za-z0-9-]*")
_BROKERS: Final = 2
_IP: Final = 4
"""The boards' libraries are built without IPv6."""
_NOBODYS: Final = (0, 2**32 - 1)
_ESPHOME: Final = Path("firmware", "esphome", "fognav-node.yaml")
"""What ESPHome makes a node of; it reads the board's settings from beside its copy."""


@dataclass(frozen=True, kw_only=True)
class BoardOptions:
    """The options of a board's settings; `with_board_options` gives them to a command."""

    wifi: Annotated[str, typer.Option("--wifi", metavar="NAME", help="Name of the Wi-Fi network.")]
    wifi_password: Annotated[
        str | None,
        typer.Option(
            "--wifi-password",
            envvar="FOGNAV_WIFI_PASSWORD",
            help="Its password, empty for an open network; better in the variable. Asked for, if not given.",
        ),
    ] = None
    site: SiteOption = SITE
    fog_host: Annotated[
        str | None,
        typer.Option(
            "--fog-host",
            metavar="HOST",
            help="The fog node's address in the boards' network; of a floor with two copies two, after a comma. "
            "Asked for, if not given.",
        ),
    ] = None
    tls: Annotated[bool, typer.Option("--tls/--no-tls", help="Whether the broker's connections are encrypted.")] = True
    passwords: Annotated[
        Path | None,
        typer.Option("--passwords", metavar="F", help="Mosquitto's password file, which gets the node's password."),
    ] = None
    security: CredentialsOption = None
    firmware: Annotated[
        Literal["fognav", "esphome"],
        typer.Option("--firmware", help="What will run on the board; esphome: on a D1 mini 32, with two HC-SR04."),
    ] = "fognav"
    profile: Annotated[
        Literal["standard", "thesis"],
        typer.Option("--profile", help="How it is wired: docs/hardware.md draws both."),
    ] = "standard"
    out: Annotated[
        Path,
        typer.Option("--out", metavar="DIR", help="Where to write the settings; firmware/data is what pio uploads."),
    ] = Path("firmware/data")
    json: JsonOption = False

    @property
    def target(self) -> Path:
        """The file of the board's settings."""
        return self.out / (ESPHOME_FILE if self.firmware == "esphome" else SETTINGS_FILE)

    def completed(self) -> Self:
        """Return the options with what was missing, asked for on a terminal.

        Raises `WrongUseError` for what can't work on a board, and without a terminal for what is missing.
        """
        password, host = self.wifi_password, self.fog_host
        if password is None:
            password = _asked(f"Password of the Wi-Fi network {self.wifi}", "--wifi-password", hidden=True)
        if host is None:
            host = _asked("The fog node's address in the boards' network", "--fog-host")
        self._check_wifi(password)
        hosts = host.split(",")
        if len(hosts) > _BROKERS or (self.firmware == "esphome" and len(hosts) > 1):
            raise WrongUseError(f"--fog-host {host}: a board of this firmware knows fewer. Leave some out")
        for each in hosts:
            self._check_host(each)
            self._check_trust(each)
        return replace(self, wifi_password=password, fog_host=host)

    def _check_wifi(self, password: str) -> None:
        if not 1 <= len(self.wifi.encode()) <= _WIFI_NAME_BYTES:
            raise WrongUseError(f"--wifi {self.wifi!r}: a network's name has 1 to {_WIFI_NAME_BYTES} bytes")
        if password and not _WIFI_PASSWORD.fullmatch(password):
            raise WrongUseError(
                f"--wifi-password: this one has {len(password)} characters, and that of a network has 8 to 63, from "
                "space to ~ (or its key, 64 hexadecimal digits). Correct it, or give an empty one for an open network"
            )

    def _check_host(self, host: str) -> None:
        address = _address(host)
        if host.lower() == "localhost" or (address is not None and address.is_loopback):
            raise WrongUseError(
                f"--fog-host {host}: on the board that is the board itself. Give the fog node's address"
            )
        if address is None and not _HOST_NAME.fullmatch(host):
            raise WrongUseError(
                f"--fog-host {host!r} is neither a name nor an address. Give the fog node's address and nothing else, "
                "such as 192.168.7.1"
            )
        if address is not None and (address.version != _IP or address.is_multicast or int(address) in _NOBODYS):
            raise WrongUseError(
                f"--fog-host {host}: no board connects to that. Give the fog node's own IPv4 address, such as "
                "192.168.7.1"
            )
        if self.firmware == "fognav" and host.lower().endswith(".local"):
            raise WrongUseError(
                f"--fog-host {host}: a D1 mini can't look up names in .local. Give the fog node's address"
            )

    def _check_trust(self, host: str) -> None:
        if not self.tls:
            if self.firmware == "esphome":
                raise WrongUseError(
                    "--no-tls: the configuration for ESPHome speaks TLS only. Give --credentials instead"
                )
            return
        folder = credentials_folder(self.security)
        if folder is None:
            if not self._authority.exists():
                raise WrongUseError(
                    "TLS, and nothing says whom the board shall trust: give the folder of the fog node's credentials "
                    f"(--credentials), put the certificate of the broker's authority into {self._authority}, or use "
                    "--no-tls for a broker without certificates"
                )
            return
        # The firmware compares a name as it is given, but of an address a name that is in the certificate anyway.
        if self.firmware == "fognav" and _address(host) is not None:
            return
        with security_errors():
            known = open_security(folder).hosts
        if host not in known:
            raise WrongUseError(
                f"--fog-host {host} is not in the broker's certificate, so the board would not trust it: it is for "
                f"{', '.join(known)}. Give one of them, or add yours (fognav up --host, fognav ca issue --host)"
            )

    @property
    def _authority(self) -> Path:
        return self.out / AUTHORITY_FILE

    def provision(self, loaded: LoadedSite, node: NodeSite) -> None:
        """Write a board's settings with a new password, and let it in where `security` or `passwords` say so.

        Raises `WrongUseError`, and `FailedError` for credentials that can't be used.
        """
        if self.wifi_password is None or self.fog_host is None:
            raise TypeError("these options are not complete: see `completed`")
        port = _TLS_PORT if self.tls else _OPEN_PORT
        access = Access(self.wifi, self.wifi_password, self.fog_host.split(","), port, self.tls)
        members = settings(loaded.site.id, node, access, new_password(), self.profile)
        if (folder := credentials_folder(self.security)) is not None:
            with security_errors():
                own = let_in(changeable_security(folder), loaded.site.id, node.id)
            members |= {"user": own.user, "password": own.passwords["mqtt"]}
            write_authority(self._authority, own.authority)
        if self.firmware == "esphome":
            members = esphome_secrets(members, self._authority)
            shutil.copyfile(checkout.root() / _ESPHOME, self.out / _ESPHOME.name)
        provision(self.target, members, self.passwords)

    def report(self, verb: str, node: NodeSite) -> None:
        """Print what was written, and what to do with it."""
        if self.json:
            limits = [sonar.range_limit for sonar in node.sonars]
            values = {"node": node.id, "file": str(self.target), "range_limit_m": limits}
            print_json({**values, "passwords": None if self.passwords is None else str(self.passwords)})
            return
        words = " and ".join(f"{sonar.range_limit:.2f}" for sonar in node.sonars)
        print_line(f"{verb} {node.id} in area {node.area}: blocked below {words} m")
        if self.firmware == "esphome":
            print_line(f"wrote {self.target}, and what reads it: esphome run {self.out / _ESPHOME.name}")
        else:
            print_line(f"wrote {self.target}: flash it (firmware/README.md), then: fognav node calibrate {node.id}")
        if verb == "added":
            print_line("the hazard-aggregator reads the site at its start: restart it")


def _asked(what: str, option: str, *, hidden: bool = False) -> str:
    """Return what a person answers; raises `WrongUseError` where nobody can be asked."""
    if not sys.stdin.isatty():
        raise WrongUseError(f"{option} is missing: {what[0].lower()}{what[1:]}")
    return str(typer.prompt(what, hide_input=hidden, default="" if hidden else None, show_default=False, err=True))


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def with_board_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command each field of `BoardOptions` as an option of its own; it gets them together, as `board`."""
    own = [each for each in inspect.signature(command).parameters.values() if each.name != "board"]
    options = list(inspect.signature(BoardOptions).parameters.values())

    @functools.wraps(command)
    def called(**values: Any) -> None:  # noqa: ANN401  # whatever options the command has
        board = BoardOptions(**{option.name: values.pop(option.name) for option in options})
        command(**values, board=board)

    # What the command line is read by; the wrapped command would have it without the board's options.
    bare = cast("Any", called)
    del bare.__wrapped__
    bare.__signature__ = inspect.Signature([*own, *options])
    bare.__annotations__ = {each.name: each.annotation for each in [*own, *options]}
    return called
