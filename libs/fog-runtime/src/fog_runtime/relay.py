"""Passes connections on to a server, once their encryption is agreed on, and admits those that the server has let in.

For servers that anybody could keep busy, or fill, without having proved anything (`admission`).
"""

from __future__ import annotations

import asyncio
import ssl
from typing import TYPE_CHECKING, Final, Protocol, TypeAlias
from urllib.parse import urlsplit

from fog_runtime import admission, logs
from fog_runtime.credentials import ServerCertificate

if TYPE_CHECKING:
    import socket
    from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence
    from pathlib import Path

Connect: TypeAlias = "Callable[[Callable[[], asyncio.Protocol]], Awaitable[tuple[asyncio.Transport, asyncio.Protocol]]]"

_WAITING_BYTES: Final = 64 * 1024
"""What may wait for a slow receiver before its sender has to wait."""
_FLUSH_S: Final = 5.0
"""How long a client may take to receive what its server said last."""
_OPEN_ACK: Final = 0x02
_MESSAGE_ID: Final = 0x1F
_OPEN_SYN: Final = 0x02
_ACK: Final = 0x20
_LENGTH_BYTES: Final = 2
_MORE: Final = 0x80
_EXTENSION: Final = 0x4F
"""What of an extension's header tells what it is: its number, and that it has a length."""
_AUTHENTICATION: Final = 0x43
_USER_AND_PASSWORD: Final = 0x42
OF_USER: Final = 128
"""Most connections of one user: whoever has one's password must not fill a server by it."""

_log = logs.get("relay")


class Opening(Protocol):
    """Reads what both say first, until that shows that the server has let the client in."""

    user: str
    """As whom the client asks to be let in; empty before it has said so, and if it does not."""

    def from_client(self, data: bytes) -> bytes:
        """Return what to pass on of the client's next bytes; a `ValueError` ends the connection."""

    def admits(self, data: bytes) -> bool:
        """Whether it has, with these next bytes of the server's."""

    def parts(self, data: bytes) -> Iterable[bytes]:
        """Return the server's next bytes in the parts that the client gets each in a TLS record of its own."""


class ZenohOpening:
    """A router sends InitAck, and OpenAck once the client has proved who it is, which says that in OpenSyn.

    Each message begins with its length (2 bytes, little endian) and its header, whose lower 5 bits name its kind
    (zenoh-protocol 1.x, `transport/mod.rs`, `id`).
    """

    def __init__(self) -> None:
        self.user = ""
        self._opened = False
        self._sent = bytearray()
        self._unread = bytearray()

    def from_client(self, data: bytes) -> bytes:
        """Pass everything on, and read who the client is; a `ValueError` if OpenSyn does not say it once."""
        if not self._opened:
            self._sent += data
        while not self._opened and len(self._sent) > _LENGTH_BYTES:
            whole = _LENGTH_BYTES + int.from_bytes(self._sent[:_LENGTH_BYTES], "little")
            if len(self._sent) < whole:
                break
            message = bytes(self._sent[_LENGTH_BYTES:whole])
            del self._sent[:whole]
            if message and message[0] & (_MESSAGE_ID | _ACK) == _OPEN_SYN:
                self._opened = True
                self.user = _user_of_open_syn(message)
        return data

    def parts(self, data: bytes) -> Iterable[bytes]:
        """Return them as they are."""
        return (data,)

    def admits(self, data: bytes) -> bool:
        """Whether OpenAck has come."""
        self._unread += data
        while len(self._unread) > _LENGTH_BYTES:
            if self._unread[_LENGTH_BYTES] & _MESSAGE_ID == _OPEN_ACK:
                return True
            whole = _LENGTH_BYTES + int.from_bytes(self._unread[:_LENGTH_BYTES], "little")
            if len(self._unread) < whole:
                return False
            del self._unread[:whole]
        return False


def _user_of_open_syn(message: bytes) -> str:
    """Return the user's name in OpenSyn, empty without one (zenoh-protocol 1.x, `transport/open.rs`)."""
    header, *body = message
    rest = bytes(body)
    for _ in ("lease", "first number"):
        _, rest = _number(rest)
    _, rest = _text(rest)  # the cookie
    names = []
    for kind, value in _extensions(rest) if header & _MORE else ():
        if kind == _AUTHENTICATION:
            names += [_text(inner)[0] for how, inner in _extensions(value) if how == _USER_AND_PASSWORD]
    if len(names) > 1:
        raise ValueError("OpenSyn names more than one user")
    return names[0].decode() if names else ""


def _extensions(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield kind and content of each extension; that of a kind without a length is a number, or nothing."""
    more = True
    while more:
        if not data:
            raise ValueError("a message ends too early")
        header, data = data[0], data[1:]
        more, value = bool(header & _MORE), b""
        if header & 0x60 == 0x40:
            value, data = _text(data)
        elif header & 0x60:
            _, data = _number(data)
        yield header & _EXTENSION, value


def _number(data: bytes) -> tuple[int, bytes]:
    """Return a number of variable length, and what is after it."""
    value = 0
    for index, byte in enumerate(data[:10]):
        value |= (byte & ~_MORE) << (7 * index)
        if not byte & _MORE:
            return value, data[index + 1 :]
    raise ValueError("a number that does not end")


def _text(data: bytes) -> tuple[bytes, bytes]:
    """Return bytes that have their length before them, and what is after them."""
    size, data = _number(data)
    if size > len(data):
        raise ValueError("a message ends too early")
    return data[:size], data[size:]


class _End(asyncio.Protocol):
    """One of two connections that are passed on to each other."""

    def __init__(self) -> None:
        self.transport: asyncio.Transport | None = None
        self.other: _End | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        transport.set_write_buffer_limits(high=_WAITING_BYTES)
        self.transport = transport

    def data_received(self, data: bytes) -> None:
        if self.other is not None and self.other.transport is not None:
            self.other.transport.write(data)

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002  # asyncio's signature
        self.transport = None
        if self.other is not None and (transport := self.other.transport) is not None:
            transport.close()
            asyncio.get_running_loop().call_later(_FLUSH_S, self.other.abort)

    def abort(self) -> None:
        """End the connection at once, if it still is one: a transport that is gone may fail."""
        if self.transport is not None:
            self.transport.abort()

    def pause_writing(self) -> None:
        if self.other is not None and self.other.transport is not None:
            self.other.transport.pause_reading()

    def resume_writing(self) -> None:
        if self.other is not None and self.other.transport is not None:
            self.other.transport.resume_reading()


class _Client(_End):
    def __init__(self, relay: Relay, visitor: admission.Visitor) -> None:
        super().__init__()
        self._relay = relay
        self._visitor = visitor
        self._user = ""

    def admit(self, user: str) -> None:
        """Know that the server has let it in, as this user."""
        self._visitor.admit()
        self._user = user
        self._relay.admitted(self, user, self._visitor.source)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        assert self.transport is not None
        self.transport.pause_reading()
        task = asyncio.create_task(self._connect())
        self._relay.connecting.add(task)
        task.add_done_callback(self._relay.connecting.discard)

    def data_received(self, data: bytes) -> None:
        if isinstance(self.other, _Server) and (opening := self.other.opening) is not None:
            try:
                data = opening.from_client(data)
            except ValueError:
                assert self.transport is not None
                self.transport.abort()
                return
        super().data_received(data)

    async def _connect(self) -> None:
        server = _Server(self, self._relay.make_opening())
        try:
            await self._relay.connect(lambda: server)
        except OSError as error:
            self._relay.unreachable(error)
            if self.transport is not None:
                self.transport.abort()
            return
        self._relay.reached()
        self.other = server
        if self.transport is None:  # left meanwhile
            assert server.transport is not None
            server.transport.abort()
        else:
            self.transport.resume_reading()

    def connection_lost(self, exc: Exception | None) -> None:
        self._visitor.left()
        self._relay.left(self, self._user)
        super().connection_lost(exc)


class _Server(_End):
    def __init__(self, client: _Client, opening: Opening) -> None:
        super().__init__()
        self.other = client
        self._client = client
        self.opening: Opening | None = opening
        self._parts = opening.parts

    def data_received(self, data: bytes) -> None:
        if self.opening is not None and self.opening.admits(data):
            user, self.opening = self.opening.user, None
            self._client.admit(user)
        for part in self._parts(data):
            super().data_received(part)


class Relay:
    """Passes the connections of an endpoint on to a server."""

    def __init__(
        self, connect: Connect, make_opening: Callable[[], Opening], tls: ssl.SSLContext | None = None
    ) -> None:
        """`connect` connects a protocol to the server; `tls` is what clients encrypt by."""
        self.connect = connect
        self.make_opening = make_opening
        self.connecting: set[asyncio.Task[None]] = set()
        self._admission = admission.Admission(lambda visitor: _Client(self, visitor), tls)
        self._was_unreachable = False
        self._of_users: dict[str, set[_Client]] = {}

    async def serve(self, listeners: Sequence[socket.socket]) -> None:
        """Pass on until cancelled."""
        await self._admission.serve(listeners)

    def admitted(self, client: _Client, user: str, source: str) -> None:
        """Count a connection of a user, or end one that is too many."""
        if not user or client.transport is None:
            return
        own = self._of_users.setdefault(user, set())
        if len(own) < OF_USER:
            own.add(client)
        else:
            self._admission.count_refused(source, f"{OF_USER} of {user} are open")
            client.abort()

    def left(self, client: _Client, user: str) -> None:
        """Forget a connection, if it still counts."""
        own = self._of_users.get(user, set())
        own.discard(client)
        if not own:
            self._of_users.pop(user, None)

    def unreachable(self, error: OSError) -> None:
        """Log, once, that the server accepts no connection."""
        if not self._was_unreachable:
            self._was_unreachable = True
            _log.error("server_unreachable", reason=str(error))

    def reached(self) -> None:
        """Log it again when it accepts none any more."""
        self._was_unreachable = False


def to_socket(path: Path) -> Connect:
    """Return what connects a protocol to a server on a Unix socket."""

    async def connect(make_protocol: Callable[[], asyncio.Protocol]) -> tuple[asyncio.Transport, asyncio.Protocol]:
        return await asyncio.get_running_loop().create_unix_connection(make_protocol, str(path))

    return connect


def server_tls(certificate: Path, key: Path) -> ssl.SSLContext:
    """Return what a server encrypts by; raises `CertificateError` when the files can't be used."""
    ServerCertificate.of(certificate, key)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.num_tickets = 0  # nobody resumes a session here
    context.load_cert_chain(certificate, key)
    return context


def place_of(endpoint: str) -> tuple[str, int]:
    """Return host and port of an endpoint such as `tls/[::]:7447`; raises `ValueError`."""
    parts = urlsplit("//" + endpoint.partition("/")[2])
    if not parts.hostname or parts.port is None:
        raise ValueError(f"{endpoint!r} is no endpoint: write tcp/ADDRESS:PORT or tls/ADDRESS:PORT")
    return parts.hostname, parts.port
