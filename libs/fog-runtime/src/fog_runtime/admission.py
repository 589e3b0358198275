"""Accepts a server's connections so that those of strangers, however many, leave room for everybody else.

Everybody in the network may open connections and say nothing, or something that never ends. A connection is a
stranger's until its protocol admits it. Strangers have a limited number of places and a limited time. Who comes when
all places are taken gets that of another: the oldest connection of the address with the most. So whoever floods a
server displaces itself, and a client that proves itself soon gets in, even from the same address. An address from which
somebody was admitted goes before those that nobody knows, as long as few wait there (ADR 55).
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import resource
import socket
from collections import Counter
from functools import partial
from typing import TYPE_CHECKING, Final

from fog_runtime import logs

if TYPE_CHECKING:
    import ssl
    from collections.abc import Callable, Collection, Iterator, Sequence

SILENT: Final = 1024
"""Most connections that have sent nothing: each is a descriptor, and nothing else. Fewer where descriptors are few."""
QUEUE: Final = 50
"""Most connections that wait for their TLS handshake: the last of them for half a second."""
STRANGERS: Final = 96
"""Most connections that have sent something and are not admitted; below what zenoh accepts of them (100)."""
PATIENCE_S: Final = 10.0
"""How long a stranger may take until it is admitted."""
HANDSHAKE_PACE_S: Final = 0.01
"""Between the starts of two TLS handshakes, each of which costs a millisecond and more."""
KNOWN: Final = 1024
"""Addresses that are remembered because somebody was admitted from there."""
FEW: Final = 4
"""How many may wait at such an address that goes before others."""
REPORT_S: Final = 10.0
"""How often the refused connections are logged, together."""
BACKLOG: Final = 1024
"""Connections that the operating system keeps until they are accepted."""
_NO_DESCRIPTORS_S: Final = 0.1

_log = logs.get("admission")


def listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens; raises `OSError`, for one when the port is taken."""
    family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    both = family == socket.AF_INET6 and address[0] == "::"
    return socket.create_server(address[:2], family=family, backlog=BACKLOG, dualstack_ipv6=both)


def source_of(host: str) -> str:
    """Return what counts as one client: an IPv4 address, or the network (/64) that IPv6 gives each of them."""
    address = ipaddress.ip_address(host.partition("%")[0])
    if address.version == 4:
        return host
    return str(address.ipv4_mapped or ipaddress.ip_network((address, 64), strict=False))


class Visitor:
    """A connection, as its protocol sees it."""

    def __init__(self, admission: Admission, connection: socket.socket, source: str) -> None:
        """Use `Admission`."""
        self.source = source
        self.connection = connection
        self.places: Places | None = None
        self.timer: asyncio.TimerHandle | None = None
        self.greeting: asyncio.Task[None] | None = None
        self.transport: asyncio.BaseTransport | None = None
        self._admission = admission

    def admit(self) -> None:
        """Take it for no stranger any more: nobody takes its place, and it has as much time as it wants."""
        self._admission.know(self.source)
        self.release()

    def release(self) -> None:
        """Take its place and its time from it."""
        if self.places is not None:
            self.places.remove(self)
        if self.timer is not None:
            self.timer.cancel()

    def estrange(self, patience_s: float = PATIENCE_S) -> None:
        """Take it for a stranger again, with new time: for one, between two requests."""
        self.release()
        self._admission.place(self, patience_s)

    def left(self) -> None:
        """Forget it: its connection is lost."""
        self.release()
        self.transport = None


class Places:
    """Connections that share a number of places, by source, the oldest first; `known` are sources that go before."""

    def __init__(self, limit: int, known: Collection[str] = ()) -> None:
        self._limit = limit
        self._known = known
        self._known_is_next = True
        self._by_source: dict[str, dict[Visitor, None]] = {}
        self._taken = 0

    def add(self, visitor: Visitor) -> Visitor | None:
        """Give it a place; return the visitor that has lost its own for that, if any."""
        displaced = None
        if self._taken >= self._limit:
            most = max(self._by_source, key=self._weight)
            displaced = next(iter(self._by_source[most]))
            self.remove(displaced)
        self._by_source.setdefault(visitor.source, {})[visitor] = None
        self._taken += 1
        visitor.places = self
        return displaced

    def remove(self, visitor: Visitor) -> None:
        """Free its place."""
        visitor.places = None
        own = self._by_source[visitor.source]
        del own[visitor]
        if not own:
            del self._by_source[visitor.source]
        self._taken -= 1

    def next(self) -> Visitor | None:
        """Return the oldest of a source, and of another one the next time; None when all places are free.

        Every other time it is of a source that goes before, if one waits.
        """
        if not self._by_source:
            return None
        source = next(iter(self._by_source))
        if self._known_is_next:
            source = next((each for each in self._by_source if self._weight(each) <= 0), source)
        self._known_is_next = not self._known_is_next
        own = self._by_source.pop(source)
        self._by_source[source] = own  # the last from now on
        return next(iter(own))

    def _weight(self, source: str) -> int:
        """Return how many places a source has, 0 or less while it goes before others."""
        return len(self._by_source[source]) - (FEW if source in self._known else 0)


class Admission:
    """Accepts connections, and gives each that has sent something a protocol, which admits it or not."""

    def __init__(
        self,
        make_protocol: Callable[[Visitor], asyncio.Protocol],
        tls: ssl.SSLContext | None = None,
    ) -> None:
        """Make a protocol for each; it must tell its visitor `admit` and, when the connection is lost, `left`.

        With `tls` connections are encrypted before a protocol is made.
        """
        self._make_protocol = make_protocol
        self._tls = tls
        self._known: dict[str, None] = {}
        """Sources from which somebody was admitted, the latest last."""
        self._silent = Places(min(SILENT, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 4), self._known)
        self._strangers = Places(STRANGERS, self._known)
        self._queue = Places(QUEUE, self._known)
        self._filled = asyncio.Event()
        self._greetings: set[asyncio.Task[None]] = set()
        self._refused: Counter[tuple[str, str]] = Counter()

    async def serve(self, listeners: Sequence[socket.socket]) -> None:
        """Accept connections until cancelled; those that are open then stay so, the listeners too."""
        async with asyncio.TaskGroup() as tasks:
            for listener in listeners:
                listener.setblocking(False)  # noqa: FBT003  # its only way to be called
                tasks.create_task(self._accept(listener))
            tasks.create_task(self._greet_all())
            tasks.create_task(self._report())

    def know(self, source: str) -> None:
        """Remember that somebody was admitted from there."""
        self._known.pop(source, None)
        self._known[source] = None
        if len(self._known) > KNOWN:
            del self._known[next(iter(self._known))]

    def place(self, visitor: Visitor, patience_s: float) -> None:
        """Give a visitor that has sent something a stranger's place and time."""
        visitor.timer = asyncio.get_running_loop().call_later(patience_s, self._refuse, visitor, "slow")
        if (displaced := self._strangers.add(visitor)) is not None:
            self._refuse(displaced, "displaced")

    def count_refused(self, source: str, reason: str) -> None:
        """Count a connection that its protocol has ended, for the log."""
        self._refused[source, reason] += 1

    async def _accept(self, listener: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                connection, address = await loop.sock_accept(listener)
            except ConnectionError:
                continue
            except OSError as error:  # no descriptors, which may pass
                self._refused["", str(error.strerror)] += 1
                await asyncio.sleep(_NO_DESCRIPTORS_S)
                continue
            with contextlib.suppress(OSError):  # it may have left already
                # Else what follows an unacknowledged write waits up to 40 ms. asyncio sets it for its own sockets only.
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            visitor = Visitor(self, connection, source_of(address[0]))
            visitor.timer = loop.call_later(PATIENCE_S, self._refuse, visitor, "silent")
            if (displaced := self._silent.add(visitor)) is not None:
                self._refuse(displaced, "displaced")
            loop.add_reader(connection, self._heard, visitor)
            await asyncio.sleep(0)  # a flood must not keep the loop from everything else

    def _heard(self, visitor: Visitor) -> None:
        asyncio.get_running_loop().remove_reader(visitor.connection)
        try:
            gone = not visitor.connection.recv(1, socket.MSG_PEEK)
        except OSError:
            gone = True
        if gone:
            visitor.release()
            visitor.connection.close()
            return
        assert visitor.places is not None
        visitor.places.remove(visitor)
        if (displaced := self._queue.add(visitor)) is not None:
            self._refuse(displaced, "displaced")
        self._filled.set()

    async def _greet_all(self) -> None:
        while True:
            await self._filled.wait()
            if (visitor := self._queue.next()) is None:
                self._filled.clear()
                continue
            visitor.estrange()
            visitor.greeting = asyncio.create_task(self._greet(visitor))
            self._greetings.add(visitor.greeting)
            visitor.greeting.add_done_callback(partial(self._greeted, visitor))
            await asyncio.sleep(0 if self._tls is None else HANDSHAKE_PACE_S)

    async def _greet(self, visitor: Visitor) -> None:
        loop = asyncio.get_running_loop()
        options = {} if self._tls is None else {"ssl_handshake_timeout": PATIENCE_S, "ssl_shutdown_timeout": 1.0}
        try:
            visitor.transport, _ = await loop.connect_accepted_socket(
                lambda: self._make_protocol(visitor), visitor.connection, ssl=self._tls, **options
            )
        except OSError:
            self._refused[visitor.source, "no handshake"] += 1

    def _greeted(self, visitor: Visitor, task: asyncio.Task[None]) -> None:
        self._greetings.discard(task)
        visitor.greeting = None
        if visitor.transport is None:  # refused, perhaps before its task had run at all
            visitor.left()
            visitor.connection.close()

    def _refuse(self, visitor: Visitor, reason: str) -> None:
        """End a stranger's connection, whatever it is at."""
        self._refused[visitor.source, reason] += 1
        visitor.release()
        if visitor.transport is not None:
            visitor.transport.abort()  # type: ignore[attr-defined]  # every transport of a connection has it
        elif visitor.greeting is not None:
            visitor.greeting.cancel()
        else:
            asyncio.get_running_loop().remove_reader(visitor.connection)
            visitor.connection.close()

    async def _report(self) -> None:
        while True:
            await asyncio.sleep(REPORT_S)
            if self._refused:
                _log.warning("connections_refused", count=self._refused.total(), most=list(self._most()))
                self._refused.clear()

    def _most(self) -> Iterator[str]:
        for (source, reason), count in self._refused.most_common(3):
            yield f"{count} of {source or 'all'}: {reason}"
