"""Asking on a zenoh session: queries whose large replies come part by part, and who is present.

A reply that is sent in one piece to a client that has stopped reading fills the router's queues, and holds up what the
router carries for everybody else. So a large reply is only announced, and fetched in parts of one network packet each:
a client that stops reading stops asking.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from collections import OrderedDict
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

import msgspec
import zenoh

from fog_contracts.codec import ContractError

if TYPE_CHECKING:
    from collections.abc import Callable

    from fog_contracts.channels import Channel

PART_BYTES: Final = 32 * 1024
"""Replies up to this size are sent at once; the parts of larger ones have this size."""
PARTS_AT_ONCE: Final = 4
"""How many parts of a reply are requested at the same time."""
KEPT_REPLIES: Final = 32
KEPT_BYTES: Final = 64 * 1024 * 1024
"""Large replies that a key keeps for those who are still fetching them: the latest used ones, at least one."""
REPLY: Final = "reply"
PART: Final = "part"
"""The parameters of a query for a part: which reply, and the part's number from 0."""
GONE: Final = b"this reply is not kept any more: ask again"


class Announcement(msgspec.Struct, frozen=True):
    """Sent, as the attachment of an empty reply, in place of a large one: its name and size (bytes)."""

    reply: str
    size: int

    @property
    def parts(self) -> int:
        """How many parts it has."""
        return -(-self.size // PART_BYTES)

    def encoded(self) -> bytes:
        """Return the attachment (JSON)."""
        return msgspec.json.encode(self)


def decode_announcement(data: bytes) -> Announcement:
    """Return an announcement from its attachment; raises `msgspec.DecodeError`."""
    return msgspec.json.decode(data, type=Announcement)


class LargeReplies:
    """The latest large replies under one key."""

    def __init__(self) -> None:
        self._id = secrets.token_hex(4)
        self._kept: OrderedDict[str, bytes] = OrderedDict()

    def announce(self, data: bytes) -> Announcement:
        """Keep a reply, and return what announces it; the same bytes keep their name."""
        for name, kept in self._kept.items():
            if kept is data:
                self._kept.move_to_end(name)
                return Announcement(name, len(data))
        name = self._id + secrets.token_hex(8)
        self._kept[name] = data
        while len(self._kept) > KEPT_REPLIES or (
            len(self._kept) > 1 and sum(map(len, self._kept.values())) > KEPT_BYTES
        ):
            self._kept.popitem(last=False)
        return Announcement(name, len(data))

    def announced(self, reply: str) -> bool:
        """Whether a reply of this name was announced here, and not by another process under the same key."""
        return reply.startswith(self._id)

    def part(self, reply: str, number: str) -> bytes | None:
        """Return a part, or None when the reply is not kept or has no such part."""
        data = self._kept.get(reply)
        if data is None or not number.isascii() or not number.isdigit() or len(number) > 9:
            return None
        self._kept.move_to_end(reply)
        begin = int(number) * PART_BYTES
        return data[begin : begin + PART_BYTES] if begin < len(data) else None


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


_GRACE_S: Final = 0.5
"""How much longer than asked for a question may take (real seconds): on a congested link, even asking may block."""


class Presence(NamedTuple):
    """The keys of those who are present; `complete`: the router has answered, and not only this process itself."""

    keys: set[str]
    complete: bool


async def ask_who_is_present(threads: Threads, session: zenoh.Session, keys: str, timeout_s: float) -> Presence:
    """Return who is present under these keys, as far as routers answer within `timeout_s` (real seconds)."""
    found: set[str] = set()
    failures: list[str] = []
    done = asyncio.Event()

    def on_reply(reply: zenoh.Reply) -> None:
        # zenoh reports a router that does not answer in time as the error "Timeout".
        if reply.ok is not None:
            threads.call(found.add, str(reply.ok.key_expr))
        else:
            threads.call(failures.append, "no answer")

    get = partial(
        session.liveliness().get,
        keys,
        zenoh.handlers.Callback(on_reply, lambda: threads.call(done.set)),
        timeout=timeout_s,
    )
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(timeout_s + _GRACE_S):
            await threads.in_thread(get)
            await done.wait()
    return Presence(found, complete=done.is_set() and not failures)
