"""Large replies to queries, fetched in parts by who asked.

A reply that is sent in one piece to a client that has stopped reading fills the router's queues, and holds up what the
router carries for everybody else. So a large reply is only announced, and fetched in parts of one network packet each:
a client that stops reading stops asking.
"""

from __future__ import annotations

import secrets
from collections import OrderedDict
from typing import Final

import msgspec

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
