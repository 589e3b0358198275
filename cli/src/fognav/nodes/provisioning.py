"""What a board gets when it is set up (`node.json`), and the broker's entry for it."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import secrets
import stat
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from fog_runtime.credentials import Credentials
from fog_runtime.files import PRIVATE, atomic_write
from fognav.output import WrongUseError

if TYPE_CHECKING:
    from pathlib import Path

    from fog_contracts.site import NodeSite
    from fog_runtime.locks.site_locks import SiteLocks

SETTINGS_FILE: Final = "node.json"
AUTHORITY_FILE: Final = "ca.pem"
ESPHOME_FILE: Final = "secrets.yaml"
ESPHOME_PINS: Final = {"standard": ((18, 22), (19, 21)), "thesis": ((26, 22), (17, 19))}
"""By profile, trigger and echo of both sonars of a D1 mini 32 (`board_pins.hpp`)."""
_ITERATIONS: Final = 20_000


@dataclass(frozen=True)
class Access:
    """How a board reaches the broker: Wi-Fi, the fog node's name, and whether the connection is encrypted."""

    wifi_name: str
    wifi_password: str
    broker: str
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
        "broker": access.broker,
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


def let_in(locks: SiteLocks, node: str) -> tuple[str, str]:
    """Let a node in by a site's locks; return its new password, and the authorities that its board shall trust (PEM).

    Raises `LocksError` or `AuthorityError`.
    """
    file = locks.add_node(node)
    credentials = Credentials.read(file)
    file.unlink()  # the board has it: nobody else needs it
    return credentials.passwords["mqtt"], credentials.authority


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
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(file, data, mode=PRIVATE if like is None else stat.S_IMODE(like.st_mode))
        if like is not None:
            os.chown(file, like.st_uid, like.st_gid)
    except OSError as error:
        raise WrongUseError(f"{file} can't be written: {error.strerror}") from error
