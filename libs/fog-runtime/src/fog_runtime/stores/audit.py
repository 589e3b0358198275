"""Reading the site's audit trail: one stream for each kind of record, merged by time and read in pages.

A kind has a stream of its own, so that many entries of one kind never push out those of another.
"""

from __future__ import annotations

import re
from collections import deque
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from fog_contracts.messages import Message

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_runtime.stores.redis_connection import RedisConnection

KINDS: Final = ("alert", "area", "mission", "override", "robot", "stop", "store", "zone")
"""The kinds of records that have an audit trail.

`alert`: alerts that began, ended or were acknowledged; `store`: what an administrator decided after a loss; `robot`:
operators' commands to robots; `stop`: stops without a token, of which anybody may send any number.
"""

PAGE_BYTES: Final = 256 * 1024
"""A page ends with the entry that reaches this size: what changed may be a shape of 500 corners, twice."""
_AT_ONCE: Final = 8
"""How many entries are read at a time, so that whoever asks for a thousand delays the event loop by milliseconds."""
_CURSOR: Final = re.compile(r"([0-9]{1,16})-([0-9]{1,16})\.([a-z]+)")


class CursorError(ValueError):
    """A cursor that no page gave."""


class AuditEntry(Message, frozen=True, kw_only=True):
    """A change: when (s since the epoch), by whom, what, of which record; `before` and `after` are the record's values.

    They are null where there was none before, or is none any more.
    """

    at: float
    who: str
    action: str
    kind: str
    id: str
    before: msgspec.Raw
    after: msgspec.Raw


class AuditPage(NamedTuple):
    """Entries, newest first, and the cursor of the next page; None on the last one."""

    entries: list[AuditEntry]
    next: str | None


class _Position(NamedTuple):
    """Position of an entry: its stream id, which Redis makes of its clock (ms) and a number, and its kind."""

    ms: int
    number: int
    kind: str

    @classmethod
    def parse(cls, cursor: str) -> _Position:
        found = _CURSOR.fullmatch(cursor)
        if found is None or found[3] not in KINDS:
            raise CursorError(f"{cursor!r} is no cursor: take the address of the next page from the Link header")
        return cls(int(found[1]), int(found[2]), found[3])

    def __str__(self) -> str:
        return f"{self.ms}-{self.number}.{self.kind}"


class _Placed(NamedTuple):
    position: _Position
    entry: AuditEntry


class _Trail:
    """The entries of one kind, newest first, read from Redis a few at a time."""

    def __init__(self, redis: RedisConnection, key: str, kind: str, before: _Position | None) -> None:
        self._redis = redis
        self._key = key
        self._kind = kind
        self._end: str | None = "+"
        if before is not None:
            # Entries of two kinds may have the same stream id: of these the kind decides the order.
            self._end = f"{'' if kind < before.kind else '('}{before.ms}-{before.number}"
        self._read: deque[_Placed] = deque()

    async def first(self) -> _Placed | None:
        """Return the newest entry that was not taken yet; None after the last one."""
        if not self._read and self._end is not None:
            reply = await self._redis.read("XREVRANGE", self._key, self._end, "-", "COUNT", _AT_ONCE)
            self._read.extend(_entry(self._kind, entry_id, fields) for entry_id, fields in reply)
            self._end = f"({reply[-1][0].decode()}" if len(reply) == _AT_ONCE else None
        return self._read[0] if self._read else None

    def take(self) -> None:
        """Go on to the next entry."""
        self._read.popleft()


async def read_page(
    redis: RedisConnection, prefix: str, *, kinds: Sequence[str], cursor: str | None, limit: int
) -> AuditPage:
    """Return up to `limit` entries of these kinds, older than the cursor; the streams' keys begin with `prefix`.

    A page ends earlier once its entries have `PAGE_BYTES`. Raises `CursorError` and `StoreError`.
    """
    before = None if cursor is None else _Position.parse(cursor)
    trails = [_Trail(redis, f"{prefix}{kind}", kind, before) for kind in sorted(set(kinds))]
    entries: list[AuditEntry] = []
    last, size = "", 0
    while True:
        heads = [(head, trail) for trail in trails if (head := await trail.first()) is not None]
        if not heads or len(entries) == limit or size >= PAGE_BYTES:
            return AuditPage(entries, last if heads else None)
        (position, entry), trail = max(heads, key=lambda found: found[0].position)
        trail.take()
        entries.append(entry)
        last, size = str(position), size + len(bytes(entry.before)) + len(bytes(entry.after))


def _entry(kind: str, entry_id: bytes, fields: Any) -> _Placed:  # noqa: ANN401  # as redis gives them
    pairs = fields.items() if isinstance(fields, dict) else zip(fields[::2], fields[1::2], strict=True)
    values = {name.decode(): value for name, value in pairs}
    ms, _, number = entry_id.decode().partition("-")
    entry = AuditEntry(
        at=float(values["at"]),
        who=values["who"].decode(),
        action=values["action"].decode(),
        kind=kind,
        id=values["id"].decode(),
        before=msgspec.Raw(values["before"] or b"null"),
        after=msgspec.Raw(values["after"] or b"null"),
    )
    return _Placed(_Position(int(ms), int(number), kind), entry)
