"""The users of a site's servers: which they are, and their passwords and rights as each server reads them, and where.

A password is random and long, so that the cheapest hash is enough; the router needs it as it is.
"""

from __future__ import annotations

import base64
import hashlib
import os
import re
import secrets
import stat
from typing import TYPE_CHECKING, Final

from fog_contracts.channels import ROLES
from fog_runtime.credentials import SERVERS, Server
from fog_runtime.files import atomic_write
from fog_runtime.stores import records

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence
    from pathlib import Path

PASSWORD_BYTES: Final = 24
_ITERATIONS: Final = 101
"""Of MQTT's passwords: as few as Mosquitto's own tool takes. Nobody guesses random ones from their hashes, but the
broker does nothing else while it checks one, and who knows a user's name may have it check as many as come."""

SERVICES: Final[Mapping[str, Sequence[Server]]] = {
    "hazard-aggregator": SERVERS,
    "map-service": SERVERS,
    "planner": ("zenoh", "redis"),
    "console-service": SERVERS,
}
"""Which servers each service uses."""
TOOLS: Final[Mapping[str, Sequence[Server]]] = {
    "console": ("mqtt", "zenoh"),
    "recorder": ("mqtt", "zenoh"),
    "sim": ("zenoh",),
    "home-assistant": ("mqtt",),
    "bridge": ("mqtt", "zenoh"),
}
"""The same for the tools of the fog node's administrator, and for a simulated world."""
THESIS: Final[Mapping[str, Sequence[Server]]] = {"thesis-node": ("mqtt",), "thesis-robot": ("mqtt",)}
"""Nodes and robots of the master's thesis, of the first site only: its topics name no site."""
REDIS_ADMINISTRATOR: Final = "administrator"
HEALTH: Final = "health"
"""Who asks broker, router and Redis whether they are well, and may do nothing else."""
PEER: Final = "peer"
"""The other copy of a server, where there are two: it gets, and passes on, all that the server has."""
_COMMANDS: Final = (
    "+get +set +setrange +del +hget +hset +hdel +hgetall +hlen +hincrby +xadd +xdel +xrange +xrevrange +pttl"
    " +eval +multi +exec +wait +ping +info +config|get +client|setname +client|id +hello +auth +select"
)
_PEER_COMMANDS: Final = (
    "+psync +replconf +slaveof +multi +exec +config|rewrite +subscribe +publish +ping +role +info"
    " +client|setname +client|kill +script|kill +hello +auth"
)
"""What a replica asks of its primary, and a Sentinel of both (Redis's documentation of Sentinel)."""
_READING: Final = "+xrange +xrevrange +ping +client|setname +client|id +hello +auth +select"


def new_password() -> str:
    """Return a password that nobody has to type: 192 bits."""
    return secrets.token_urlsafe(PASSWORD_BYTES)


def on_floor(floor: str, user: str) -> str:
    """Return how the servers call a user of a further site; ids have no dots."""
    return f"{floor}.{user}"


def of_floor(user: str) -> tuple[str, str]:
    """Return the further site of a user (an empty text: the first site), and its name there."""
    floor, _, name = user.rpartition(".")
    return floor, name


def line(server: Server, user: str, password: str, site: str) -> str:
    """Return a user's line in a server's list; `site` is the first one's, to which users without a floor belong."""
    if server == "mqtt":
        return mqtt_line(user, password)
    if server == "zenoh":
        return zenoh_line(user, password)
    if user == REDIS_ADMINISTRATOR:
        return redis_administrator_line(user, password)
    if user == HEALTH:
        return redis_health_line(user, password)
    if user == PEER:
        return redis_peer_line(user, password)
    return redis_line(user, password, of_floor(user)[0] or site)


def mqtt_line(user: str, password: str) -> str:
    """Return a line of Mosquitto's password file: `$7$`, PBKDF2 with SHA-512 (mosquitto_passwd(1))."""
    salt = secrets.token_bytes(12)
    key = hashlib.pbkdf2_hmac("sha512", password.encode(), salt, _ITERATIONS)
    return f"{user}:$7${_ITERATIONS}${base64.b64encode(salt).decode()}${base64.b64encode(key).decode()}"


def has_mqtt_cost(line: str) -> bool:
    """Whether a line of Mosquitto's password file takes no longer to check than a new one."""
    return line.partition(":")[2].startswith(f"$7${_ITERATIONS}$")


def zenoh_line(user: str, password: str) -> str:
    """Return a line of the router's dictionary of users."""
    return f"{user}:{password}"


def redis_line(user: str, password: str, site: str) -> str:
    """Return a line of Redis's `aclfile` for a service: its own tables, the audit trail of what it may do, its lease.

    It may read the whole audit trail; the console-service only reads. Raises `KeyError` for a user that is no service.
    """
    _, service = of_floor(user)
    read = " ".join(f"%R~fog:{site}:{name}" for name in ("audit:*", *records.READ.get(service, ())))
    if service in records.READ:
        return f"user {user} on {_redis_secret(password)} resetchannels -@all {_READING} {read}"
    audited = (f"audit:{kind}" for kind in records.AUDITED[service])
    own = [*records.OWN[service], *records.BOOKKEEPING, *audited, f"{service}:*"]
    keys = " ".join([*(f"~fog:{site}:{name}" for name in own), read])
    return f"user {user} on {_redis_secret(password)} resetchannels -@all {_COMMANDS} {keys}"


def redis_administrator_line(user: str, password: str) -> str:
    """Return a line of Redis's `aclfile` for somebody who may do everything, such as a backup."""
    return f"user {user} on {_redis_secret(password)} ~* &* +@all"


def redis_health_line(user: str, password: str) -> str:
    """Return a line of Redis's `aclfile` for who only asks whether it answers."""
    return f"user {user} on {_redis_secret(password)} resetchannels -@all +ping"


def redis_peer_line(user: str, password: str) -> str:
    """Return a line of Redis's `aclfile` for its replicas and its Sentinels."""
    return f"user {user} on {_redis_secret(password)} resetchannels &__sentinel__:hello -@all {_PEER_COMMANDS}"


REDIS_NOBODY: Final = "user default off resetpass ~* &* +@all"
"""The line that refuses who gives no name.

It needs the rights that it seems to give away: in this user's name Redis repeats its log when it starts, and leaves out
transactions for which the user has no right (7.0). Nobody can log in as a user that is off.
"""


def _redis_secret(password: str) -> str:
    return "#" + hashlib.sha256(password.encode()).hexdigest()


USERS: Final = "users"
ANYBODY: Final = "default"
"""Redis's name for who gives none."""
_OF_ALL: Final = 0o077


class ServerFiles:
    """The programs' folders below one folder; `mode` are the permissions of files that are new there."""

    def __init__(self, folder: Path, mode: int) -> None:
        self._folder = folder
        self._mode = mode

    def folder(self, program: str) -> Path:
        """Return the folder of a program."""
        return self._folder / program

    def lines(self, program: str) -> list[str]:
        """Return a program's list of users, a line for each; that of a new Redis refuses who gives no name."""
        file = self.folder(program) / USERS
        if file.exists():
            return file.read_text("utf-8").splitlines()
        return [REDIS_NOBODY] if program == "redis" else []

    def members(self, program: str) -> list[str]:
        """Return whom a program admits."""
        return [user for line in self.lines(program) if (user := user_of(line)) != ANYBODY]

    def write_lines(self, program: str, lines: Iterable[str]) -> None:
        """Replace a program's list of users."""
        self.write(program, USERS, "".join(f"{line}\n" for line in lines))

    def write(self, program: str, name: str, text: str) -> None:
        """Write a file of a program, for those who could read it before."""
        file = self.folder(program) / name
        file.parent.mkdir(mode=0o755 if self._mode & _OF_ALL else 0o700, parents=True, exist_ok=True)
        # A file stays readable for whom an administrator gave it to: servers mostly run as users of their own.
        before = file.stat() if file.exists() else None
        atomic_write(file, text.encode(), mode=self._mode if before is None else stat.S_IMODE(before.st_mode))
        if before is not None and os.geteuid() == 0:
            os.chown(file, before.st_uid, before.st_gid)


def user_of(line: str) -> str:
    """Return whose line it is, in any of the lists: `name:…`, or Redis's `user name …`."""
    return line.split()[1] if line.startswith("user ") else line.partition(":")[0]


_DEVICE_TOPIC: Final = re.compile(r"(?!fog/)[\w.-]+/(?:(?:[\w.-]+|\+)/)*(?:[\w.-]+|\+|#)", re.ASCII)
"""No topic of one level, such as the thesis's, and none of Fognav's own."""


class SecurityError(ValueError):
    """Credentials can't be made or changed so; the message names the file and the remedy."""


class Members:
    """The users in the servers' files that are no parts of Fognav."""

    def __init__(self, files: ServerFiles, *, unrestricted: Sequence[str], devices: Collection[str]) -> None:
        """Take the servers' files, the users who may do everything, and the sensors and gateways of others."""
        self._files = files
        self._unrestricted = unrestricted
        self._devices = devices

    def of(self, program: str, floor: str) -> list[str]:
        """Return the members who use a program, by their names on a floor (empty: the first site)."""
        members = [user for user in self._files.members(program) if not self.is_reserved(user)]
        return [name for own, name in map(of_floor, members) if own == floor]

    def is_reserved(self, user: str) -> bool:
        """Return whether a name belongs to a part of Fognav."""
        parts = {*ROLES, REDIS_ADMINISTRATOR, HEALTH, PEER, ANYBODY}
        return of_floor(user)[1] in parts or user in self._unrestricted

    def require_free_name(self, user: str) -> None:
        """Raise `SecurityError` if the name belongs to a part of Fognav."""
        if self.is_reserved(user):
            raise SecurityError(f"{user} is the name of a part of Fognav: give the robot, node or device another id")

    def require_different_ids(self, robots: Sequence[str], nodes: Sequence[str]) -> None:
        """Raise `SecurityError` if one of these robots has the name of a node or device, or the other way round."""
        known_nodes, known_robots = (set(self._files.members(each)) for each in ("mosquitto", "zenoh"))
        taken = set(robots) & ({*nodes} | known_nodes) | set(nodes) & (known_robots | {*self._devices})
        if taken := {user for user in taken if not self.is_reserved(user)}:
            raise SecurityError(
                f"{', '.join(sorted(taken))}: a robot, a node and a device of one site need different ids, since each "
                "is a user of its servers: rename one of them"
            )


def require_own_topics(device: str, topics: Sequence[str]) -> None:
    """Raise `SecurityError` if a sensor or gateway of others can't have one of these MQTT topics (with wildcards)."""
    for topic in topics:
        if not _DEVICE_TOPIC.fullmatch(topic):
            raise SecurityError(
                f"{device} can't have the topic {topic!r}: name one of its own with two levels at least, such as "
                "zigbee2mqtt/#, of letters, digits, '_', '.' and '-', and none below fog/"
            )
