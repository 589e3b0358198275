"""Mosquitto's `acl_file` and `password_file`, evaluated as Mosquitto does."""

import base64
import binascii
import hashlib
import hmac
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import Literal, Self

Right = Literal["read", "write"]
_Levels = tuple[str, ...]


def matches(pattern: Sequence[str], topic: Sequence[str]) -> bool:
    """Whether a pattern covers a topic, or each topic of a filter, both as levels (MQTT 3.1.1, section 4.7).

    Wildcards at the first level do not cover topics that begin with `$`.
    """
    if topic and topic[0].startswith("$") and pattern[0] in ("+", "#"):
        return False
    for wanted, level in zip_longest(pattern, topic):
        if wanted == "#":
            return True
        if level is None or wanted is None or level == "#":
            return False
        if wanted not in ("+", level):
            return False
    return True


@dataclass
class _Rules:
    allowed: dict[Right, list[_Levels]] = field(default_factory=lambda: {"read": [], "write": []})
    denied: list[_Levels] = field(default_factory=list)

    def add(self, access: str, topic: str) -> None:
        levels = tuple(topic.split("/"))
        if access == "deny":
            self.denied.append(levels)
        for right in ("read", "write") if access == "readwrite" else (access,):
            if right in self.allowed:
                self.allowed[right].append(levels)


class AccessList:
    """What each user may publish (`write`) and receive (`read`); what no line allows is denied."""

    def __init__(self) -> None:
        self._users: dict[str, _Rules] = {}
        self._patterns = _Rules()

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read an `acl_file`; raises `ValueError` for a line that it does not know."""
        made = cls()
        rules = _Rules()  # of nobody: without a name nobody is admitted
        for line in text.splitlines():
            word, _, rest = line.strip().partition(" ")
            match word:
                case "" | "#":
                    continue
                case "user":
                    rules = made._users.setdefault(rest.strip(), _Rules())
                case "topic" | "pattern":
                    access, _, topic = rest.strip().partition(" ")
                    (made._patterns if word == "pattern" else rules).add(access, topic.strip())
                case _:
                    raise ValueError(f"{line!r} is no line of an access list: write it again (fognav ca create)")
        return made

    def allows(self, user: str, right: Right, topic: str) -> bool:
        """Whether a user may publish or receive on a topic, or on each topic of a filter."""
        levels = topic.split("/")
        rules = self._users.get(user, _Rules())
        if any(matches(each, levels) for each in rules.denied):
            return False
        patterns = (tuple(user if level == "%u" else level for level in each) for each in self._patterns.allowed[right])
        return any(matches(each, levels) for each in (*rules.allowed[right], *patterns))


class Passwords:
    """Mosquitto's password file, of hashes `$7$` (PBKDF2 with SHA-512)."""

    def __init__(self, hashes: Mapping[str, str]) -> None:
        self._hashes = hashes

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read a `password_file`."""
        return cls({user: hashed for user, _, hashed in (line.partition(":") for line in text.splitlines()) if hashed})

    def right(self, user: str, password: str) -> bool:
        """Whether this is the user's password."""
        try:
            _, kind, iterations, salt, key = self._hashes.get(user, "").split("$")
            found = hashlib.pbkdf2_hmac("sha512", password.encode(), base64.b64decode(salt), int(iterations))
            return kind == "7" and hmac.compare_digest(found, base64.b64decode(key))
        except (ValueError, binascii.Error):
            return False
