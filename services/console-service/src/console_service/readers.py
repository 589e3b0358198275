"""The readers of the events: each connection gets what it has not read yet, and none waits for another.

Frames are written to the connections' transports directly, all readers in one pass: a task for each, that is woken for
each event and passes it through a web framework, costs five times as much. A reader is given more once it has taken
what it was given before. Who takes nothing for `PATIENCE_S` is disconnected: it comes back where it was.
"""

from __future__ import annotations

import asyncio
import socket
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import msgspec
from prometheus_client import Counter as Metric
from prometheus_client import Gauge, Histogram
from starlette.responses import Response

from console_service.log import Batch, frame
from console_service.views import Hello
from fog_runtime.http import RETRY_AFTER, HttpProblem, ProblemError
from fog_runtime.http.http_process import TRANSPORT

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from starlette.types import Receive, Scope, Send

    from console_service.log import CompactedLog

MOST: Final = 1024
"""Readers in all."""
MOST_OF_SESSION: Final = 8
"""Readers of one login, or token, from one address."""
AT_ONCE: Final = 128 * 1024
"""Bytes (and one entry) that are written to a reader before it has taken them."""
SEND_BUFFER: Final = 128 * 1024
"""Of the operating system, for each reader."""
PATIENCE_S: Final = 10.0
"""How long a reader may take for what it was given."""
PERIOD_S: Final = 0.05
"""The shortest time between two passes ..."""
SHARE: Final = 6.0
"""... in a pass's own processor time: with many readers each gets less often, and more at once."""
LONGEST_PERIOD_S: Final = 0.5
RETRY_MS: Final = 1000
"""After how long a browser connects again."""
CHECK_S: Final = 5.0
"""How often it is checked that a reader may still read."""

READERS = Gauge("fognav_console_readers", "Readers of the events")
SLOW = Metric("fognav_console_readers_slow_total", "Readers that were disconnected because they did not read")
SENT = Metric("fognav_console_sent_bytes_total", "Bytes of events that were sent to readers")
PASS_SECONDS = Histogram(
    "fognav_console_pass_seconds",
    "Duration of one pass over all readers",
    buckets=(0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25),
)


@dataclass(eq=False)
class Reader:
    """A connection: up to where it has read, when the first state is complete, and of which robots it wants scans."""

    transport: asyncio.Transport
    owner: str
    client: str
    position: int
    complete_at: int
    scans: frozenset[str]
    may_read: Callable[[], bool]
    greeting: bytes
    given: float
    begun: bool = False
    """Whether its response has begun."""
    seen: dict[str, int] = field(default_factory=dict)
    """The numbers of the scans that it has got, by robot."""


class Readers:
    """All readers of one log."""

    def __init__(self, log: CompactedLog, site: str) -> None:
        """Serve a log; nothing is sent before `run`."""
        self._log = log
        self._site = site
        self._readers: dict[Reader, None] = {}
        self._of: Counter[str] = Counter()
        """How many there are, by client."""
        self._scans: dict[str, tuple[int, bytes]] = {}
        self._batches: dict[int, Batch] = {}
        self._batches_of = -1
        self._news = asyncio.Event()

    def wake(self) -> None:
        """Send what is new, soon."""
        self._news.set()

    @property
    def scans_wanted(self) -> set[str]:
        """The robots of which somebody wants scans."""
        return {robot for reader in self._readers for robot in reader.scans}

    def on_scan(self, robot: str, data: bytes) -> None:
        """Send a scan to those who want it; it is in no log."""
        number, _ = self._scans.get(robot, (0, b""))
        self._scans[robot] = (number + 1, frame("scan", data))
        self._news.set()

    def add(
        self, transport: asyncio.Transport, owner: str, client: str, last_id: str | None, scans: Collection[str],
        may_read: Callable[[], bool],
    ) -> Reader:  # fmt: skip
        """Admit a reader, which the caller begins and removes; raises `ProblemError` when its client has too many.

        owner: whose token it has. client: its session, and its address. last_id: up to where it has read. When all
        places are taken, that owner loses a reader who has most.
        """
        if self._of[client] >= MOST_OF_SESSION:
            detail = f"{MOST_OF_SESSION} streams of this login are open: close a page of them"
            raise ProblemError(HttpProblem.OVERLOADED, detail, headers=RETRY_AFTER)
        if len(self._readers) >= MOST:
            self._make_room()
        position = self._log.resume(last_id)
        hello = Hello(run=self._log.run, fresh=position is None, site=self._site)
        greeting = f"retry: {RETRY_MS}\n".encode() + frame("hello", msgspec.json.encode(hello))
        reader = Reader(
            transport, owner, client, position or 0, self._log.revision, frozenset(scans), may_read, greeting,
            time.monotonic(),
        )  # fmt: skip
        self._readers[reader] = None
        self._of[client] += 1
        READERS.set(len(self._readers))
        return reader

    def begin(self, reader: Reader) -> None:
        """Send to a reader from now on: the head of its response is sent."""
        reader.begun = True
        self._news.set()

    def _make_room(self) -> None:
        owners = Counter(reader.owner for reader in self._readers)
        most, _ = owners.most_common(1)[0]
        self._drop(next(reader for reader in self._readers if reader.owner == most))

    def remove(self, reader: Reader) -> None:
        """Forget a reader; one that is forgotten already is no error."""
        if reader in self._readers:
            del self._readers[reader]
            self._of[reader.client] -= 1
            if not self._of[reader.client]:
                del self._of[reader.client]
            READERS.set(len(self._readers))

    async def run(self) -> None:
        """Send what is new to all, until cancelled; then end their connections."""
        try:
            while True:
                await self._news.wait()
                self._news.clear()
                begun, cpu = time.perf_counter(), time.thread_time()
                self.send()
                PASS_SECONDS.observe(time.perf_counter() - begun)
                took = time.thread_time() - cpu  # what others of the machine take is no reason to send less often
                await asyncio.sleep(min(max(PERIOD_S, SHARE * took), LONGEST_PERIOD_S))
        finally:
            for reader in list(self._readers):
                self._end(reader)

    async def tell_time(self, stamp: Callable[[], float]) -> None:
        """Send the time each second, and end what may not read any more."""
        checked = 0
        while True:
            data = chunk(frame("time", msgspec.json.encode({"stamp": round(stamp(), 3)})))
            for reader in list(self._readers):
                if not reader.greeting and reader.transport.get_write_buffer_size() == 0:
                    self._write(reader, data)
            # A part of them each second.
            for number, reader in enumerate(list(self._readers)):
                if number % int(CHECK_S) == checked and not reader.may_read():
                    self._end(reader)
            checked = (checked + 1) % int(CHECK_S)
            self._news.set()  # who does not read is noticed, even if there is nothing new
            await asyncio.sleep(1.0)

    def send(self) -> None:
        """Give each reader that has taken what it was given what is new."""
        now = time.monotonic()
        if self._batches_of != self._log.revision:
            self._batches, self._batches_of = {}, self._log.revision
        unread = False
        for reader in list(self._readers):
            if not reader.begun:
                continue
            if reader.transport.is_closing():
                self.remove(reader)
                continue
            if reader.transport.get_write_buffer_size():
                if now - reader.given > PATIENCE_S:
                    SLOW.inc()
                    self._drop(reader)
                continue
            reader.given = now
            if self._log.is_lost(reader.position):
                self._drop(reader)  # it comes back, and is told to begin anew
                continue
            if (data := self._next(reader)) is not None:
                self._write(reader, data)
                unread = unread or reader.position < self._log.revision
        if unread:
            self._news.set()

    def _next(self, reader: Reader) -> bytes | None:
        """Return what a reader gets now, and take it as read."""
        batch = self._batches.get(reader.position)
        if batch is None:
            read = self._log.read(reader.position, AT_ONCE)
            batch = self._batches[reader.position] = Batch(chunk(read.frames), read.position)
        own = b""
        if reader.greeting:
            own, reader.greeting = chunk(reader.greeting), b""
        after = b""
        if 0 <= reader.complete_at <= batch.position:
            after, reader.complete_at = chunk(frame("ready", b"{}")), -1
        for robot in reader.scans:
            number, scan = self._scans.get(robot, (0, b""))
            if number != reader.seen.get(robot, 0):
                reader.seen[robot] = number
                after += chunk(scan)
        reader.position = batch.position
        if own or after:
            return own + batch.frames + after
        return batch.frames or None

    def _write(self, reader: Reader, data: bytes) -> None:
        reader.transport.write(data)
        SENT.inc(len(data))

    def _drop(self, reader: Reader) -> None:
        """Cut a connection whose client takes nothing."""
        self.remove(reader)
        reader.transport.abort()

    def _end(self, reader: Reader) -> None:
        """End a connection in an orderly way."""
        self.remove(reader)
        reader.transport.write(b"0\r\n\r\n")
        reader.transport.close()


def chunk(frames: bytes) -> bytes:
    """Return frames as a chunk of an HTTP response (RFC 9112, 7.1); nothing stays nothing, as an empty one ends it."""
    return b"%x\r\n%b\r\n" % (len(frames), frames) if frames else b""


class EventStream(Response):
    """A response that is sent for as long as its client reads."""

    media_type = "text/event-stream"

    def __init__(
        self, readers: Readers, owner: str, client: str, last_id: str | None, scans: Collection[str],
        may_read: Callable[[], bool],
    ) -> None:  # fmt: skip
        """Take the arguments of `Readers.add`."""
        super().__init__(headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"})
        del self.headers["content-length"]  # it has no end
        self._arguments = (owner, client, last_id, scans, may_read)
        self._readers = readers

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send events until the client or the service ends it."""
        transport: asyncio.Transport | None = scope.get(TRANSPORT)
        if transport is None or scope["http_version"] != "1.1":
            raise ProblemError(HttpProblem.REQUEST_INVALID, "events are sent by HTTP/1.1 only")
        if (connection := transport.get_extra_info("socket")) is not None:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        reader = self._readers.add(transport, *self._arguments)
        try:
            await send({"type": "http.response.start", "status": 200, "headers": self.raw_headers})
            self._readers.begin(reader)
            while (await receive())["type"] != "http.disconnect":
                pass
        finally:
            self._readers.remove(reader)
