"""Attacks of strangers on a server's port: many connections, which say nothing, nonsense, or half of something."""

import asyncio
import contextlib
import fcntl
import resource
import socket
import ssl
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager

from fog_supervisor import net

LIMIT_S = 60.0
FLOOD = 1100
"""More connections than a process usually has descriptors."""


@contextmanager
def few_files(number: int = 1024) -> Iterator[None]:
    """Start servers with as many descriptors as on a usual system; attackers have enough."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (number, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


class Attack:
    """Opens connections from one address, `rate` a second, says something on each, and closes it after a while."""

    def __init__(self, port: int, said: bytes, *, rate: int, held_s: float, encrypts: bool = False) -> None:
        self._port = port
        self._said = said
        self.rate = rate
        self._held_s = held_s
        # Of connections that soon end no more pile up after a moment.
        self.enough = min(FLOOD, rate * (6 if held_s >= 1.0 else 2))
        self._tls = net.unverified() if encrypts else None
        self.made = 0

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        begun = loop.time()
        async with asyncio.TaskGroup() as tasks:
            while True:
                # What a busy machine delayed is not made up for: it would be another attack, at many times the rate.
                begun = max(begun, loop.time() - (self.made + 20) / self.rate)
                for _ in range(int((loop.time() - begun) * self.rate) - self.made):
                    self.made += 1
                    tasks.create_task(self._hold())
                await asyncio.sleep(0.01)

    async def _hold(self) -> None:
        with contextlib.suppress(OSError, TimeoutError):
            async with asyncio.timeout(30.0):
                connection = _numbered_high()
                try:
                    await asyncio.get_running_loop().sock_connect(connection, (net.LOOPBACK, self._port))
                except BaseException:
                    connection.close()
                    raise
                name = None if self._tls is None else "localhost"
                reader, writer = await asyncio.open_connection(sock=connection, ssl=self._tls, server_hostname=name)
            try:
                writer.write(self._said)
                async with asyncio.timeout(self._held_s):
                    await reader.read()
            finally:
                writer.transport.abort()


def _numbered_high() -> socket.socket:
    """Return a socket whose descriptor leaves those below 1024 to clients in this process that use select."""
    with socket.socket() as low:
        connection = socket.socket(fileno=fcntl.fcntl(low.fileno(), fcntl.F_DUPFD_CLOEXEC, 1024))
    connection.setblocking(False)  # noqa: FBT003  # its only way to be called
    return connection


def client_hello() -> bytes:
    """What a TLS client says first."""
    incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
    client = net.unverified().wrap_bio(incoming, outgoing, server_hostname="localhost")
    with contextlib.suppress(ssl.SSLWantReadError):
        client.do_handshake()
    return outgoing.read()


ATTACKS: dict[str, Callable[[int], Attack]] = {
    "say nothing and leave": lambda port: Attack(port, b"", rate=20, held_s=0.0),
    "say nothing and stay": lambda port: Attack(port, b"", rate=300, held_s=600.0),
    "begin to encrypt and leave": lambda port: Attack(port, client_hello(), rate=20, held_s=0.0),
    "begin to encrypt and stay": lambda port: Attack(port, client_hello(), rate=60, held_s=600.0),
    "encrypt and stay": lambda port: Attack(port, b"", rate=40, held_s=600.0, encrypts=True),
    "say nonsense": lambda port: Attack(port, b"GET / HTTP/1.1\r\n\r\n", rate=50, held_s=0.5),
}


@asynccontextmanager
async def running(attack: Attack) -> AsyncIterator[None]:
    """Run an attack, from its second or, if connections stay, sixth second, or from its 1,100th connection on.

    These are more than a process has descriptors.
    """
    task = asyncio.create_task(attack.run())
    try:
        async with asyncio.timeout(LIMIT_S):
            while attack.made < attack.enough:  # noqa: ASYNC110  # the attack sets no event
                await asyncio.sleep(0.1)
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
