"""The broker that a process connects to: its address, and the options of a connection."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Self, cast
from urllib.parse import unquote, urlsplit

import aiomqtt

from fog_runtime.credentials import NOBODY, Credentials

_KEEPALIVE_S: Final = 10
"""A connection without traffic for 1.5 times as long is considered lost by both sides."""
_TIMEOUT_S: Final = 5.0
_QUEUE: Final = 10_000


class Inbox(asyncio.Queue[aiomqtt.Message]):
    """Passes each message on as soon as it is read from the connection; until it is opened, it keeps them.

    A queue costs a task of the event loop for each message: several times what its handler costs.
    """

    def __init__(self, deliver: Callable[[aiomqtt.Message], object]) -> None:
        super().__init__(_QUEUE)
        self._deliver = deliver
        self._opened = False
        self.retained = 0
        """How many of the messages so far the broker had kept from before the subscription."""

    def open(self) -> None:
        """Deliver what has arrived, and from now on each message at once."""
        while not self.empty():
            self._deliver(self.get_nowait())
        self._opened = True

    def put_nowait(self, item: aiomqtt.Message) -> None:
        """Deliver a message, or keep it; raises `asyncio.QueueFull`."""
        self.retained += item.retain
        if self._opened:
            self._deliver(item)
        else:
            super().put_nowait(item)


@dataclass(frozen=True)
class Broker:
    """A broker's address, with the credentials of this process."""

    host: str
    port: int
    user: str | None
    password: str | None
    tls: bool
    credentials: Credentials = NOBODY

    @classmethod
    def of(cls, url: str, credentials: Credentials = NOBODY) -> Self:
        """Read an address, whose user and password, if it has any, replace those of `credentials`.

        Raises `ValueError` for an invalid one, and `CredentialsError` if it would reveal the password.
        """
        parts = urlsplit(url)
        if parts.scheme not in {"mqtt", "mqtts"} or not parts.hostname:
            raise ValueError("the broker's address must look like mqtt://host:1883 or mqtts://user:password@host:8883")
        tls = parts.scheme == "mqtts"
        user = unquote(parts.username) if parts.username else None
        password = unquote(parts.password) if parts.password else None
        if user is None and (login := credentials.login("mqtt", url, parts.hostname, encrypted=tls)) is not None:
            user, password = login
        return cls(
            host=parts.hostname,
            port=parts.port or (8883 if tls else 1883),
            user=user,
            password=password,
            tls=tls,
            credentials=credentials,
        )

    @classmethod
    def listed(cls, urls: str, credentials: Credentials = NOBODY) -> list[Self]:
        """Read comma separated addresses of bridged brokers; raises as `of`."""
        return [cls.of(url.strip(), credentials) for url in urls.split(",")]

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"

    def client(self, identifier: str, will: aiomqtt.Will | None, inbox: Inbox | None = None) -> aiomqtt.Client:
        """Return a client of this broker that is not connected yet; its messages go to `inbox`, if one is given."""
        client = aiomqtt.Client(
            self.host,
            self.port,
            username=self.user,
            password=self.password,
            identifier=identifier,
            protocol=aiomqtt.ProtocolVersion.V311,
            clean_session=True,
            will=will,
            timeout=_TIMEOUT_S,
            keepalive=_KEEPALIVE_S,
            queue_type=None if inbox is None else cast("type[asyncio.Queue[aiomqtt.Message]]", lambda **_: inbox),
            tls_context=self.credentials.tls_context() if self.tls else None,
        )
        client.pending_calls_threshold = 1000
        return client
