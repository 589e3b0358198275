"""Mosquitto's `acl_file` and `password_file`, evaluated as Mosquitto does.

Of an `acl_file` only what Fognav writes: a right in each line, `%u` as the only variable of a `pattern`, and a name for
everybody who is admitted.
"""

import base64
import binascii
import hashlib
import hmac
from collections.abc import Iterable, Mapping, Sequence
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
        """Add a line's topic; raises `ValueError` for an unknown access."""
        levels = tuple(topic.split("/"))
        match access:
            case "deny":
                self.denied.append(levels)
            case "readwrite":
                self.allowed["read"].append(levels)
                self.allowed["write"].append(levels)
            case "read" | "write":
                self.allowed[access].append(levels)
            case _:
                raise ValueError(f"{access!r} is no access")

    def allow(self, right: Right, topic: Sequence[str], user: str) -> bool | None:
        """Whether these lines, in which `%u` is the user, allow a topic or deny it; None if none says anything."""
        if _covered(self.denied, topic, user):
            return False
        return _covered(self.allowed[right], topic, user) or None


def _covered(patterns: Iterable[_Levels], topic: Sequence[str], user: str) -> bool:
    return any(matches([user if level == "%u" else level for level in each], topic) for each in patterns)


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
                case _ if not word or word.startswith("#"):
                    continue
                case "user":
                    rules = made._users.setdefault(rest.strip(), _Rules())
                case "topic" | "pattern":
                    access, _, topic = rest.strip().partition(" ")
                    try:
                        (made._patterns if word == "pattern" else rules).add(access, topic.strip())
                    except ValueError as error:
                        raise _unknown(line) from error
                case _:
                    raise _unknown(line)
        return made

    def allows(self, user: str, right: Right, topic: str) -> bool:
        """Whether a user may publish or receive on a topic, or on each topic of a filter."""
        levels = topic.split("/")
        own = self._users.get(user, _Rules()).allow(right, levels, "%u")  # which is no variable there
        # What a user's own lines say goes before the patterns of all.
        return bool(self._patterns.allow(right, levels, user) if own is None else own)


def _unknown(line: str) -> ValueError:
    return ValueError(f"{line!r} is no line of an access list: write it again (fognav ca create)")


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
