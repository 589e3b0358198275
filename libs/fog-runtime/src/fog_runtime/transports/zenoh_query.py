"""Asking on a zenoh session: sends a query and collects its reply, large ones part by part."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, Protocol

import msgspec
import zenoh

from fog_contracts.codec import ContractError
from fog_runtime.transports.reply_parts import GONE, PART, PARTS_AT_ONCE, REPLY, decode_announcement

if TYPE_CHECKING:
    from collections.abc import Callable

    from fog_contracts.channels import Channel

PART_TIMEOUT_S: Final = 2.0
"""After this time (real seconds) a part is requested again."""
_PAUSE_S: Final = 0.02
"""Between two requests of a part that got lost on a congested link."""


class Threads(Protocol):
    """The part of `ZenohEdge` that leads from zenoh's threads to the event loop and back."""

    def call(self, function: Callable[..., object], *arguments: object) -> bool:
        """Call a function on the loop's thread, from any thread."""

    async def in_thread(self, function: Callable[[], object]) -> None:
        """Run a call that may block on another thread."""


class _GoneError(Exception):
    """The answering side does not keep this reply any more."""


class _Answer(msgspec.Struct):
    data: bytes
    attachment: bytes | None


async def ask(  # all that one query consists of
    threads: Threads, session: zenoh.Session, channel: Channel, key: str, request: bytes | None, timeout_s: float
) -> bytes | None:
    """Return the first reply to a query, or None when there is none within `timeout_s` (real seconds).

    Raises `ContractError` for a reply that is an error or too large.
    """
    query = _Query(threads, session, channel, key)
    try:
        async with asyncio.timeout(timeout_s):
            while True:
                try:
                    return await query.reply(request, timeout_s)
                except _GoneError:
                    continue
    except TimeoutError:
        return None


@dataclass(frozen=True)
class _Query:
    """A query on one key, and those for the parts of its reply."""

    threads: Threads
    session: zenoh.Session
    channel: Channel
    key: str

    async def reply(self, request: bytes | None, timeout_s: float) -> bytes | None:
        """Return the whole reply; raises `ContractError`, and `_GoneError` when it has to be asked for again."""
        answer = await self._get({}, request, timeout_s)
        if answer is None:
            return None
        if answer.attachment is None:
            self._check_size(len(answer.data))
            return answer.data
        try:
            announced = decode_announcement(answer.attachment)
        except msgspec.DecodeError as error:
            raise ContractError(self.channel.name, f"the announcement of its parts is malformed: {error}") from error
        self._check_size(announced.size)
        few = asyncio.Semaphore(PARTS_AT_ONCE)
        fetching = [
            asyncio.ensure_future(self._part(announced.reply, number, few)) for number in range(announced.parts)
        ]
        try:
            data = b"".join(await asyncio.gather(*fetching))
        finally:
            for part in fetching:
                part.cancel()
        if len(data) != announced.size:
            raise ContractError(self.channel.name, f"its parts have {len(data)} bytes instead of {announced.size}")
        return data

    def _check_size(self, size: int) -> None:
        limit = self.channel.reply_limit if self.channel.kind == "query" else self.channel.limit
        if size > limit:
            raise ContractError(self.channel.name, f"{size} bytes are over the limit of {limit}")

    async def _part(self, reply: str, number: int, few: asyncio.Semaphore) -> bytes:
        async with few:
            while True:
                try:
                    async with asyncio.timeout(PART_TIMEOUT_S):
                        answer = await self._get({REPLY: reply, PART: str(number)}, None, PART_TIMEOUT_S)
                except TimeoutError:
                    continue
                if answer is not None:
                    return answer.data
                await asyncio.sleep(_PAUSE_S)

    async def _get(self, parameters: dict[str, str], request: bytes | None, timeout_s: float) -> _Answer | None:
        """Return the first reply, or None when the query ends without one; raises `ContractError`, `_GoneError`."""
        answer: asyncio.Future[_Answer | Exception | None] = asyncio.get_running_loop().create_future()

        def set_answer(value: _Answer | Exception | None) -> None:
            if not answer.done():
                answer.set_result(value)

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                attachment = reply.ok.attachment
                data = reply.ok.payload.to_bytes()
                self.threads.call(set_answer, _Answer(data, None if attachment is None else attachment.to_bytes()))
            elif reply.err is not None and (text := bytes(reply.err.payload)[:500]) != b"Timeout":
                # zenoh reports a missing reply as the error "Timeout": the same as none.
                error = ContractError(self.channel.name, f"refused: {text.decode('utf-8', 'replace')}")
                self.threads.call(set_answer, _GoneError() if text == GONE else error)

        get = partial(
            self.session.get,
            zenoh.Selector(self.key, parameters),
            zenoh.handlers.Callback(on_reply, lambda: self.threads.call(set_answer, None)),
            payload=request,
            timeout=timeout_s,
            # By it the answering side tells askers apart, each of whom may have only so many answers at once.
            source_info=zenoh.SourceInfo(self.session.id, 0),
            # Replies are sent as their query asks: on a congested link they are dropped, and others are not held up.
            congestion_control=zenoh.CongestionControl.DROP,
        )
        await self.threads.in_thread(get)
        result = await answer
        if isinstance(result, Exception):
            raise result
        return result
