"""The link between the process that receives requests and the one whose core answers them.

Messages on a pair of Unix sockets, each as its length (4 bytes, big endian) and msgpack.
"""

from __future__ import annotations

import asyncio
import itertools
from collections import deque
from typing import TYPE_CHECKING, Final

import msgspec
from fastapi import Response

from fog_runtime.http.problems import RETRY_AFTER, HttpProblem, ProblemError

if TYPE_CHECKING:
    import socket
    from collections.abc import Awaitable, Callable

_BUFFER_BYTES: Final = 4 * 1024 * 1024
_LENGTH_BYTES: Final = 4
PAUSE_S: Final = 0.002
"""Between the starts of two calls: whatever clients send, most of the core's time is left for the fleet."""


class Call(msgspec.Struct, frozen=True, tag=True):
    """A well-formed request to a route (method and path of its declaration), with its arguments, msgpack."""

    id: int
    route: str
    arguments: bytes


class Reply(msgspec.Struct, frozen=True, tag=True):
    """The response to a call."""

    id: int
    status: int
    headers: list[tuple[bytes, bytes]]
    body: bytes


class Start(msgspec.Struct, frozen=True, tag=True):
    """Accept connections from now on."""


class Stop(msgspec.Struct, frozen=True, tag=True):
    """Accept no more connections; end once the open requests are answered."""


_ToHttpProcess = Reply | Start | Stop


class _Messages:
    """Reads and writes the messages on one end of the link."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer
        self._writing = asyncio.Lock()

    @classmethod
    async def over(cls, end: socket.socket) -> _Messages:
        """Open one end of a connected pair of sockets."""
        return cls(*await asyncio.open_connection(sock=end, limit=_BUFFER_BYTES))

    async def read(self) -> bytes | None:
        """Return the next message; None once the other end is closed."""
        try:
            size = int.from_bytes(await self._reader.readexactly(_LENGTH_BYTES), "big")
            return await self._reader.readexactly(size)
        except (asyncio.IncompleteReadError, ConnectionError):
            return None

    async def write(self, message: Call | _ToHttpProcess) -> None:
        """Send a message, and wait while the other end is slow; one for an end that is closed is lost."""
        data = msgspec.msgpack.encode(message)
        async with self._writing:
            try:
                self._writer.writelines([len(data).to_bytes(_LENGTH_BYTES, "big"), data])
                await self._writer.drain()
            except ConnectionError:
                return  # `read` returns None now, which ends this side

    def close(self) -> None:
        """Close this end."""
        self._writer.close()


class CoreLink:
    """The core's process as seen by the one that receives requests."""

    def __init__(self, messages: _Messages) -> None:
        self._messages = messages
        self._ids = itertools.count()
        self._open: dict[int, asyncio.Future[Reply]] = {}
        self._ended = False

    @classmethod
    async def over(cls, end: socket.socket) -> CoreLink:
        """Open this end of the link."""
        return cls(await _Messages.over(end))

    async def started(self) -> bool:
        """Wait for the start; return whether it came, and not the end of the core's process."""
        data = await self._messages.read()
        return data is not None and isinstance(msgspec.msgpack.decode(data, type=_ToHttpProcess), Start)

    async def run(self, stop: Callable[[], object]) -> None:
        """Pass replies to those who called, and call `stop` when the core's process says so; return when it ends."""
        while (data := await self._messages.read()) is not None:
            message = msgspec.msgpack.decode(data, type=_ToHttpProcess)
            if isinstance(message, Reply):
                called = self._open.get(message.id)
                if called is not None and not called.done():
                    called.set_result(message)
            elif isinstance(message, Stop):
                stop()
        self._ended = True
        for called in self._open.values():
            if not called.done():
                called.set_exception(_core_ended())

    async def call(self, route: str, arguments: bytes) -> Response:
        """Call a route in the core's process; return its response.

        Raises `ProblemError` when that process has ended: it may have done what it was called for.
        """
        if self._ended:
            raise _core_ended()
        number = next(self._ids)
        called = self._open[number] = asyncio.get_running_loop().create_future()
        try:
            await self._messages.write(Call(number, route, arguments))
            reply = await called
        finally:
            del self._open[number]
        response = Response(reply.body, reply.status)
        response.raw_headers = reply.headers
        return response


def _core_ended() -> ProblemError:
    return ProblemError(HttpProblem.RESTARTED, "the service has ended, and is started again", headers=RETRY_AFTER)


class HttpLink:
    """The process that receives requests as seen by the core's."""

    def __init__(self, messages: _Messages) -> None:
        self._messages = messages
        self._tasks: set[asyncio.Task[None]] = set()

    @classmethod
    async def over(cls, end: socket.socket) -> HttpLink:
        """Open this end of the link."""
        return cls(await _Messages.over(end))

    async def start(self) -> None:
        """Let the HTTP process accept connections."""
        await self._messages.write(Start())

    async def stop(self) -> None:
        """Let the HTTP process end; calls that are open are still answered."""
        await self._messages.write(Stop())

    async def answer_calls(
        self, answer: Callable[[str, bytes], Awaitable[Response]], rank: Callable[[str], int] = lambda _: 0
    ) -> None:
        """Answer calls with `answer(route, arguments)`, many at a time, until the HTTP process ends.

        Of those that wait to be begun, a route with a lower `rank` (0 to 2) comes before the others.
        """
        waiting: tuple[deque[Call], ...] = (deque(), deque(), deque())
        came = asyncio.Event()
        beginning = asyncio.create_task(self._begin_all(waiting, came, answer))
        try:
            while (data := await self._messages.read()) is not None:
                call = msgspec.msgpack.decode(data, type=Call)
                waiting[rank(call.route)].append(call)
                came.set()
        finally:
            beginning.cancel()

    async def _begin_all(
        self,
        waiting: tuple[deque[Call], ...],
        came: asyncio.Event,
        answer: Callable[[str, bytes], Awaitable[Response]],
    ) -> None:
        while True:
            first = next((calls for calls in waiting if calls), None)
            if first is None:
                came.clear()
                await came.wait()
                continue
            task = asyncio.create_task(self._reply(first.popleft(), answer))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)
            await asyncio.sleep(PAUSE_S)

    def close(self) -> None:
        """Close the link, and cancel what is being answered."""
        for task in self._tasks:
            task.cancel()
        self._messages.close()

    async def _reply(self, call: Call, answer: Callable[[str, bytes], Awaitable[Response]]) -> None:
        response = await answer(call.route, call.arguments)
        await self._messages.write(
            Reply(call.id, response.status_code, list(response.raw_headers), bytes(response.body))
        )
