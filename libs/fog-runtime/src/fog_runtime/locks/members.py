"""Which users of a site's servers are its robots, nodes and devices, and which names none of them may have."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from fog_contracts.channels import ROLES
from fog_runtime.locks import users
from fog_runtime.locks.server_files import ANYBODY

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from fog_runtime.locks.server_files import ServerFiles

_DEVICE_TOPIC: Final = re.compile(r"(?!fog/)[\w.-]+/(?:(?:[\w.-]+|\+)/)*(?:[\w.-]+|\+|#)", re.ASCII)
"""No topic of one level, such as the thesis's, and none of Fognav's own."""


class LocksError(ValueError):
    """Locks can't be made or changed so; the message names the file and the remedy."""


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
        return [name for own, name in map(users.of_floor, members) if own == floor]

    def is_reserved(self, user: str) -> bool:
        """Return whether a name belongs to a part of Fognav."""
        parts = {*ROLES, users.REDIS_ADMINISTRATOR, users.HEALTH, ANYBODY}
        return users.of_floor(user)[1] in parts or user in self._unrestricted

    def require_free_name(self, user: str) -> None:
        """Raise `LocksError` if the name belongs to a part of Fognav."""
        if self.is_reserved(user):
            raise LocksError(f"{user} is the name of a part of Fognav: give the robot, node or device another id")

    def require_different_ids(self, robots: Sequence[str], nodes: Sequence[str]) -> None:
        """Raise `LocksError` if one of these robots has the name of a node or device, or the other way round."""
        known_nodes, known_robots = (set(self._files.members(each)) for each in ("mosquitto", "zenoh"))
        taken = set(robots) & ({*nodes} | known_nodes) | set(nodes) & (known_robots | {*self._devices})
        if taken := {user for user in taken if not self.is_reserved(user)}:
            raise LocksError(
                f"{', '.join(sorted(taken))}: a robot, a node and a device of one site need different ids, since each "
                "is a user of its servers: rename one of them"
            )


def require_own_topics(device: str, topics: Sequence[str]) -> None:
    """Raise `LocksError` if a sensor or gateway of others can't have one of these MQTT topics (with wildcards)."""
    for topic in topics:
        if not _DEVICE_TOPIC.fullmatch(topic):
            raise LocksError(
                f"{device} can't have the topic {topic!r}: name one of its own with two levels at least, such as "
                "zigbee2mqtt/#, of letters, digits, '_', '.' and '-', and none below fog/"
            )
