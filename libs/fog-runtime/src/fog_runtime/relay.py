"""Passes connections on to a server, once their encryption is agreed on, and admits those that the server has let in.

For servers that anybody could keep busy, or fill, without having proved anything (`admission`).
"""

from __future__ import annotations

import asyncio
import ssl
from typing import TYPE_CHECKING, Final, Protocol, TypeAlias
from urllib.parse import urlsplit

from fog_runtime import admission, logs
from fog_runtime.access.server_certificate import ServerCertificate

if TYPE_CHECKING:
    import socket
    from collections.abc import Awaitable, Callable, Sequence
    from pathlib import Path

Connect: TypeAlias = "Callable[[Callable[[], asyncio.Protocol]], Awaitable[tuple[asyncio.Transport, asyncio.Protocol]]]"

_WAITING_BYTES: Final = 64 * 1024
"""What may wait for a slow receiver before its sender has to wait."""
_FLUSH_S: Final = 5.0
"""How long a client may take to receive what its server said last."""
_OPEN_ACK: Final = 0x02
_MESSAGE_ID: Final = 0x1F
_LENGTH_BYTES: Final = 2

_log = logs.get("relay")


class Opening(Protocol):
    """Reads what both say first, until that shows that the server has let the client in."""

    def from_client(self, data: bytes) -> bytes:
        """Return what to pass on of the client's next bytes; a `ValueError` ends the connection."""

    def admits(self, data: bytes) -> bool:
        """Whether it has, with these next bytes of the server's."""


class ZenohOpening:
    """A router sends InitAck, and OpenAck once the client has proved who it is.

    Each message begins with its length (2 bytes, little endian) and its header, whose lower 5 bits name its kind
    (zenoh-protocol 1.x, `transport/mod.rs`, `id`).
    """

    def __init__(self) -> None:
        self._unread = bytearray()

    def from_client(self, data: bytes) -> bytes:
        """Pass everything on."""
        return data

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
        server = _Server(self, self._visitor, self._relay.make_opening())
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
        super().connection_lost(exc)


class _Server(_End):
    def __init__(self, client: _Client, visitor: admission.Visitor, opening: Opening) -> None:
        super().__init__()
        self.other = client
        self._visitor = visitor
        self.opening: Opening | None = opening

    def data_received(self, data: bytes) -> None:
        if self.opening is not None and self.opening.admits(data):
            self.opening = None
            self._visitor.admit()
        super().data_received(data)


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

    async def serve(self, listeners: Sequence[socket.socket]) -> None:
        """Pass on until cancelled."""
        await self._admission.serve(listeners)

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
