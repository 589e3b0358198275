"""The users of a site's servers, each in the form in which its server reads them.

A password is random and long, so that the cheapest hash is enough; the router needs it as it is.
"""

from __future__ import annotations

import base64
import hashlib
import secrets
from typing import TYPE_CHECKING, Final

from fog_runtime.credentials import SERVERS, Server
from fog_runtime.stores import store_keys

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

PASSWORD_BYTES: Final = 24
_ITERATIONS: Final = 101
"""Of MQTT's passwords: as few as Mosquitto's own tool takes. Nobody guesses random ones from their hashes, but the
broker does nothing else while it checks one, and who knows a user's name may have it check as many as come."""

SERVICES: Final[Mapping[str, Sequence[Server]]] = {
    "hazard-aggregator": SERVERS,
    "map-service": SERVERS,
    "planner": ("zenoh", "redis"),
}
"""Which servers each service uses."""
TOOLS: Final[Mapping[str, Sequence[Server]]] = {
    "console": ("mqtt", "zenoh"),
    "recorder": ("mqtt", "zenoh"),
    "sim": ("zenoh",),
    "home-assistant": ("mqtt",),
}
"""The same for the tools of the fog node's administrator, and for a simulated world."""
THESIS: Final[Mapping[str, Sequence[Server]]] = {"thesis-node": ("mqtt",), "thesis-robot": ("mqtt",)}
"""Nodes and robots of the master's thesis, of the first site only: its topics name no site."""
REDIS_ADMINISTRATOR: Final = "administrator"
HEALTH: Final = "health"
"""Who asks broker, router and Redis whether they are well, and may do nothing else."""
_COMMANDS: Final = (
    "+get +set +setrange +del +hget +hset +hdel +hgetall +hlen +hincrby +xadd +xdel +xrange +xrevrange +pttl"
    " +eval +multi +exec +wait +ping +config|get +client|setname +client|id +hello +auth +select"
)


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

    It may read the whole audit trail. Raises `KeyError` for a user that is no service.
    """
    _, service = of_floor(user)
    audited = (f"audit:{kind}" for kind in store_keys.AUDITED[service])
    own = [*store_keys.OWN[service], *store_keys.BOOKKEEPING, *audited, f"{service}:*"]
    keys = " ".join([*(f"~fog:{site}:{name}" for name in own), f"%R~fog:{site}:audit:*"])
    return f"user {user} on {_redis_secret(password)} resetchannels -@all {_COMMANDS} {keys}"


def redis_administrator_line(user: str, password: str) -> str:
    """Return a line of Redis's `aclfile` for somebody who may do everything, such as a backup."""
    return f"user {user} on {_redis_secret(password)} ~* &* +@all"


def redis_health_line(user: str, password: str) -> str:
    """Return a line of Redis's `aclfile` for who only asks whether it answers."""
    return f"user {user} on {_redis_secret(password)} resetchannels -@all +ping"


REDIS_NOBODY: Final = "user default off resetpass ~* &* +@all"
"""The line that refuses who gives no name.

It needs the rights that it seems to give away: in this user's name Redis repeats its log when it starts, and leaves out
transactions for which the user has no right (7.0). Nobody can log in as a user that is off.
"""


def _redis_secret(password: str) -> str:
    return "#" + hashlib.sha256(password.encode()).hexdigest()
