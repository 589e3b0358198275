"""The floor's events as the bridges read them."""

from __future__ import annotations

import asyncio

import httpx
import msgspec
import pytest

from console_service.log import frame
from fog_bridges.floor import Floor, whole_lines


class Heard:
    """An adapter that keeps what it is told."""

    name, problem = "heard", ""

    def __init__(self, until: str) -> None:
        self.told: list[tuple[str, object]] = []
        self.done = asyncio.Event()
        self._until = until

    def on_event(self, name: str, data: dict[str, object]) -> None:
        self.told.append((name, data.get("reason")))
        if name == self._until:
            self.done.set()

    def on_lost(self) -> None:
        self.told.append(("lost", None))
        self.done.set()


async def test_events_are_read_whatever_characters_words_of_operators_have_and_however_they_arrive():
    words = "wet\u2028until\u2029noon\x85\x0b\x0c\x1c: ä"
    body = b"".join(
        frame(name, msgspec.json.encode({"reason": words}), "r.7") for name in ("hello", "zone", "ready")
    ).replace(b"\n\n", b"\r\n\r\n", 1)
    assert "\u2028".encode() in body, "the console writes it as it is"

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\nTransfer-Encoding: chunked\r\n\r\n")
        for byte in body:
            writer.write(b"1\r\n%c\r\n" % byte)
        await writer.drain()
        writer.close()
        await writer.wait_closed()

    async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
        port = server.sockets[0].getsockname()[1]
        floor, heard = Floor(f"http://127.0.0.1:{port}", "token", trusted=True), Heard("ready")
        following = asyncio.create_task(floor.follow([heard]))
        await asyncio.wait_for(heard.done.wait(), 10.0)
        following.cancel()
        await asyncio.gather(following, return_exceptions=True)
        await floor.aclose()
    assert heard.told[:3] == [(name, words) for name in ("hello", "zone", "ready")]


async def test_line_without_an_end_fills_no_memory():
    async def endless():
        while True:
            yield b"data: " + b"x" * 60

    with pytest.raises(httpx.DecodingError, match="more than 1000 bytes"):
        await anext(whole_lines(endless(), 1000))
