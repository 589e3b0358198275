"""An MQTT broker in Python: `python -m fog_supervisor.embedded.broker --listen 127.0.0.1:8883 --locks FOLDER`.

With the locks that Mosquitto would have (`fog_runtime.locks`) it encrypts, and admits only their users, each to its own
topics. Without, it admits everybody, unencrypted.
"""

import argparse
import asyncio
import logging
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

from amqtt.broker import Broker
from amqtt.contexts import Action, BaseContext, BrokerConfig, ListenerConfig
from amqtt.plugins.base import BaseAuthPlugin, BaseTopicPlugin
from amqtt.session import Session

from fog_supervisor.embedded.access_list import AccessList, Passwords, Right

_CERTIFICATE, _KEY, _USERS, _ACCESS = "server.pem", "server.key", "users", "access"
_RIGHTS: Final[dict[Action, Right]] = {Action.PUBLISH: "write", Action.SUBSCRIBE: "read", Action.RECEIVE: "read"}
_MODULE: Final = "fog_supervisor.embedded.broker"
_REMEMBERED: Final = 10_000


class Users(BaseAuthPlugin):
    """Admits who knows the password of a user in the locks."""

    @dataclass
    class Config(BaseAuthPlugin.Config):
        """The folder of the locks."""

        locks: str = ""

    def __init__(self, context: BaseContext) -> None:
        super().__init__(context)
        self._passwords = Passwords.parse((Path(self.config.locks) / _USERS).read_text("utf-8"))

    async def authenticate(self, *, session: Session) -> bool:
        """Whether this user has this password; off the loop, for the hash takes milliseconds."""
        return await asyncio.to_thread(self._passwords.right, session.username or "", session.password or "")


class Topics(BaseTopicPlugin):
    """Lets each user publish and receive what the locks allow."""

    @dataclass
    class Config(BaseTopicPlugin.Config):
        """The folder of the locks."""

        locks: str = ""

    def __init__(self, context: BaseContext) -> None:
        super().__init__(context)
        access = AccessList.parse((Path(self.config.locks) / _ACCESS).read_text("utf-8"))
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


def configuration(listen: str, locks: Path | None) -> BrokerConfig:
    """Return the broker's configuration."""
    if locks is None:
        return BrokerConfig(
            listeners={"default": ListenerConfig(bind=listen)},
            plugins={"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}},
        )
    own: dict[str, Any] = {"locks": str(locks)}
    return BrokerConfig(
        listeners={
            "default": ListenerConfig(bind=listen, ssl=True, certfile=locks / _CERTIFICATE, keyfile=locks / _KEY)
        },
        plugins={f"{_MODULE}.{plugin.__name__}": own for plugin in (Users, Topics)},
    )


async def serve(listen: str, locks: Path | None) -> None:
    """Serve until SIGTERM or SIGINT; raises `BrokerError` if the address is taken."""
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    broker = _Broker(configuration(listen, locks))
    await broker.start()
    await stop.wait()
    await broker.shutdown()


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the broker until a signal."""
    parser = argparse.ArgumentParser(prog="fog_supervisor.embedded.broker", description="Run an MQTT broker.")
    parser.add_argument("--listen", required=True, metavar="ADDRESS:PORT")
    parser.add_argument("--locks", type=Path, metavar="DIR", help="Mosquitto's part of the locks")
    options = parser.parse_args(arguments)
    logging.basicConfig(stream=sys.stderr, level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    asyncio.run(serve(options.listen, options.locks))


if __name__ == "__main__":
    main()
