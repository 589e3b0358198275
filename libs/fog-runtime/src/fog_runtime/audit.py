"""Reading the site's audit trail: one stream for each kind of record, merged by time and read in pages.

A kind has a stream of its own, so that many entries of one kind never push out those of another.
"""

from __future__ import annotations

import heapq
import re
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from fog_contracts.messages import Message

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_runtime.redis_connection import RedisConnection

KINDS: Final = ("alert", "area", "mission", "override", "robot", "stop", "store", "zone")
"""The kinds of records that have an audit trail.

`alert`: alerts that began, ended or were acknowledged; `store`: what an administrator decided after a loss; `robot`:
operators' commands to robots; `stop`: stops without a token, of which anybody may send any number.
"""

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


async def read_page(
    redis: RedisConnection, prefix: str, *, kinds: Sequence[str], cursor: str | None, limit: int
) -> AuditPage:
    """Return up to `limit` entries of these kinds, older than the cursor; the streams' keys begin with `prefix`.

    Raises `CursorError` and `StoreError`.
    """
    before = None if cursor is None else _Position.parse(cursor)
    found: list[list[tuple[_Position, AuditEntry]]] = []
    for kind in sorted(set(kinds)):
        end = "+"
        if before is not None:
            # Entries of two kinds may have the same stream id: of these the kind decides the order.
            end = f"{'' if kind < before.kind else '('}{before.ms}-{before.number}"
        reply = await redis.read("XREVRANGE", f"{prefix}{kind}", end, "-", "COUNT", limit + 1)
        found.append([_entry(kind, entry_id, fields) for entry_id, fields in reply])
    merged = list(heapq.merge(*found, key=lambda item: item[0], reverse=True))
    entries = [entry for _, entry in merged[:limit]]
    return AuditPage(entries, str(merged[limit - 1][0]) if len(merged) > limit else None)


def _entry(kind: str, entry_id: bytes, fields: Any) -> tuple[_Position, AuditEntry]:  # noqa: ANN401  # as redis gives them
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
    return _Position(int(ms), int(number), kind), entry
