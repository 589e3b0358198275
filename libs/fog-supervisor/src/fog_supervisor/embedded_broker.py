"""An MQTT broker in Python: `python -m fog_supervisor.embedded_broker --listen 127.0.0.1:8883 --security FOLDER`.

With the credentials that Mosquitto would have (`fog_runtime.security`) it encrypts, and admits only their users, each
to its own topics: `acl_file` and `password_file` are evaluated as Mosquitto does. Of an `acl_file` only what Fognav
writes: a right in each line, `%u` as the only variable of a `pattern`, and a name for everybody who is admitted.
Without credentials, it admits everybody, unencrypted.
"""

import argparse
import asyncio
import base64
import binascii
import hashlib
import hmac
import logging
import signal
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import zip_longest
from pathlib import Path
from typing import Any, Final, Literal, Self

from amqtt.broker import Broker
from amqtt.contexts import Action, BaseContext, BrokerConfig, ListenerConfig
from amqtt.plugins.base import BaseAuthPlugin, BaseTopicPlugin
from amqtt.session import Session

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


_CERTIFICATE, _KEY, _USERS, _ACCESS = "server.pem", "server.key", "users", "access"
_RIGHTS: Final[dict[Action, Right]] = {Action.PUBLISH: "write", Action.SUBSCRIBE: "read", Action.RECEIVE: "read"}
_MODULE: Final = "fog_supervisor.embedded_broker"
_REMEMBERED: Final = 10_000


class Users(BaseAuthPlugin):
    """Admits who knows the password of a user in the credentials."""

    @dataclass
    class Config(BaseAuthPlugin.Config):
        """The folder of the credentials."""

        security: str = ""

    def __init__(self, context: BaseContext) -> None:
        super().__init__(context)
        self._passwords = Passwords.parse((Path(self.config.security) / _USERS).read_text("utf-8"))

    async def authenticate(self, *, session: Session) -> bool:
        """Whether this user has this password; off the loop, for the hash takes milliseconds."""
        return await asyncio.to_thread(self._passwords.right, session.username or "", session.password or "")


class Topics(BaseTopicPlugin):
    """Lets each user publish and receive what the credentials allow."""

    @dataclass
    class Config(BaseTopicPlugin.Config):
        """The folder of the credentials."""

        security: str = ""

    def __init__(self, context: BaseContext) -> None:
        super().__init__(context)
        access = AccessList.parse((Path(self.config.security) / _ACCESS).read_text("utf-8"))
        self._allows = lru_cache(_REMEMBERED)(access.allows)

    async def topic_filtering(
        self, *, session: Session | None = None, topic: str | None = None, action: Action | None = None
    ) -> bool:
        """Whether the session's user may do this with a topic, or a filter."""
        if session is None or topic is None or action is None:
            return False
        return self._allows(session.username or "", _RIGHTS[action], topic)


class _Broker(Broker):
    async def _publish_retained_messages_for_subscription(
        self, subscription: tuple[str, int], session: Session
    ) -> None:
        """Send retained messages for the session's own subscriptions only.

        amqtt 0.12 would send a client that connects those of everybody's subscriptions.
        """
        if any(each.client_id == session.client_id for each, _ in self.subscriptions.get(subscription[0], [])):
            await super()._publish_retained_messages_for_subscription(subscription, session)


def configuration(listen: str, security: Path | None) -> BrokerConfig:
    """Return the broker's configuration."""
    if security is None:
        return BrokerConfig(
            listeners={"default": ListenerConfig(bind=listen)},
            plugins={"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}},
        )
    own: dict[str, Any] = {"security": str(security)}
    return BrokerConfig(
        listeners={
            "default": ListenerConfig(bind=listen, ssl=True, certfile=security / _CERTIFICATE, keyfile=security / _KEY)
        },
        plugins={f"{_MODULE}.{plugin.__name__}": own for plugin in (Users, Topics)},
    )


async def serve(listen: str, security: Path | None) -> None:
    """Serve until SIGTERM or SIGINT; raises `BrokerError` if the address is taken."""
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    broker = _Broker(configuration(listen, security))
    await broker.start()
    await stop.wait()
    await broker.shutdown()


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the broker until a signal."""
    parser = argparse.ArgumentParser(prog="fog_supervisor.embedded_broker", description="Run an MQTT broker.")
    parser.add_argument("--listen", required=True, metavar="ADDRESS:PORT")
    parser.add_argument("--security", type=Path, metavar="DIR", help="Mosquitto's certificate, users and access list")
    options = parser.parse_args(arguments)
    logging.basicConfig(stream=sys.stderr, level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    asyncio.run(serve(options.listen, options.security))


if __name__ == "__main__":
    main()
