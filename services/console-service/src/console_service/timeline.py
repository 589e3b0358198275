"""What happened, newest first: operators' changes and alerts of the audit trail, hazards' history, robots' faults.

The audit trail and the histories are read from Redis, where their services write them. The faults of robots are those
that this service has seen since its start: nobody stores them.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from fog_contracts.messages import Message
from fog_runtime.stores.records import HISTORY, KINDS, CursorError, trail

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Collection, Iterable

    from console_service.core import Fault
    from fog_runtime.stores.redis_connection import RedisConnection

HAZARD: Final = "hazard"
FAULT: Final = "fault"
ALL_KINDS: Final = (*KINDS, HAZARD, FAULT)
_CHUNK: Final = 16
_NULL: Final = msgspec.Raw(b"null")
_CURSOR: Final = re.compile(r"([0-9]{1,16})~(.{1,200})")


class TimelineEntry(Message, frozen=True, kw_only=True):
    """Something that happened: when (s since the epoch), to what (`id` of a `kind`), what, by whom, and why in words.

    kind: one of the audit trail's, `hazard` (`action`: the area's state from then on), or `fault` of a robot (`began`,
    `ended`). `entry` names an entry of the audit trail, by which it can be undone; `before` and `after` are its
    record's values. `codes` identify the sentences of `text`: robots' reasons (`ReasonCode`), or why an area has its
    state by the node or source `decided_by` (`NodeCode`); `overridden` says that an operator decided.
    """

    at: float
    kind: str
    id: str
    action: str
    who: str = ""
    text: str = ""
    codes: list[str] = msgspec.field(default_factory=list)
    decided_by: str | None = None
    overridden: bool = False
    entry: str = ""
    before: msgspec.Raw
    after: msgspec.Raw


class _Period(msgspec.Struct):
    began: float
    state: str
    cause: str
    overridden: bool
    code: str = ""
    decided_by: str | None = None


class _Key(NamedTuple):
    """The order of entries: by time (ms), and of those of one time by their names."""

    ms: int
    name: str


class TimelinePage(NamedTuple):
    """Entries, newest first, and the cursor of the next page; None on the last one."""

    entries: list[TimelineEntry]
    next: str | None


async def read_timeline(  # noqa: PLR0913  # what a page is made of
    redis: RedisConnection,
    site: str,
    *,
    kinds: Collection[str],
    areas: Iterable[str],
    faults: Iterable[Fault],
    begin: float,
    end: float,
    cursor: str | None,
    limit: int,
) -> TimelinePage:
    """Return up to `limit` entries from `begin` to `end` (s since the epoch); raises `CursorError` and `StoreError`."""
    last = _Key(int(end * 1000), "\U0010ffff") if cursor is None else _parsed(cursor)
    sources = [_audit(redis, f"fog:{site}:audit:{kind}", kind, last.ms) for kind in kinds if kind in KINDS]
    if HAZARD in kinds:
        sources += [_history(redis, f"fog:{site}:{HISTORY}:{area}", area, last.ms) for area in areas]
    if FAULT in kinds:
        sources.append(_faults(faults, last.ms))
    heads = [(head, source) for source in sources if (head := await _next(source, last)) is not None]
    entries: list[TimelineEntry] = []
    while heads:
        number, ((key, entry), source) = max(enumerate(heads), key=lambda each: each[1][0][0])
        if entry.at < begin:
            return TimelinePage(entries, None)
        if len(entries) == limit:
            return TimelinePage(entries, f"{last.ms}~{last.name}")
        entries.append(entry)
        last = key
        head = await _next(source, last)
        if head is None:
            del heads[number]
        else:
            heads[number] = head, source
    return TimelinePage(entries, None)


def _parsed(cursor: str) -> _Key:
    found = _CURSOR.fullmatch(cursor)
    if found is None:
        raise CursorError(f"{cursor!r} is no cursor: take the address of the next page from the Link header")
    return _Key(int(found[1]), found[2])


async def _next(source: AsyncIterator[tuple[_Key, TimelineEntry]], last: _Key) -> tuple[_Key, TimelineEntry] | None:
    """Return a source's next entry that is older than another one; None after the last."""
    async for key, entry in source:
        if key < last:
            return key, entry
    return None


async def _audit(
    redis: RedisConnection, key: str, kind: str, last_ms: int
) -> AsyncIterator[tuple[_Key, TimelineEntry]]:
    async for ms, entry in trail(redis, key, kind, last_ms):
        yield (
            _Key(ms, f"{kind} {entry.entry}"),
            TimelineEntry(
                at=ms / 1000,  # when it was stored, by which all are in order
                kind=kind,
                id=entry.id,
                action=entry.action,
                who=entry.who,
                entry=entry.entry,
                before=entry.before,
                after=entry.after,
            ),
        )


async def _history(
    redis: RedisConnection, key: str, area: str, last_ms: int
) -> AsyncIterator[tuple[_Key, TimelineEntry]]:
    end = "+"
    while True:
        reply = await redis.read("XREVRANGE", key, end, "-", "COUNT", _CHUNK)
        for entry_id, fields in reply:
            pairs = fields.items() if isinstance(fields, dict) else zip(fields[::2], fields[1::2], strict=True)
            period = msgspec.json.decode(dict(pairs)[b"data"], type=_Period)
            if (ms := int(period.began * 1000)) <= last_ms:
                entry = TimelineEntry(
                    at=ms / 1000,
                    kind=HAZARD,
                    id=area,
                    action=period.state,
                    text=period.cause,
                    codes=[period.code] if period.code else [],
                    decided_by=period.decided_by,
                    overridden=period.overridden,
                    before=_NULL,
                    after=_NULL,
                )
                yield _Key(ms, f"{HAZARD} {area} {entry_id.decode()}"), entry
        if len(reply) < _CHUNK:
            return
        end = f"({reply[-1][0].decode()}"


async def _faults(faults: Iterable[Fault], last_ms: int) -> AsyncIterator[tuple[_Key, TimelineEntry]]:
    for number, fault in sorted(enumerate(faults), key=lambda each: (each[1].at, each[0]), reverse=True):
        if (ms := int(fault.at * 1000)) <= last_ms:
            action, text = "began" if fault.began else "ended", "; ".join(fault.reasons)
            entry = TimelineEntry(
                at=fault.at,
                kind=FAULT,
                id=fault.robot,
                action=action,
                text=text,
                codes=fault.codes,
                before=_NULL,
                after=_NULL,
            )
            yield _Key(ms, f"{FAULT} {fault.robot} {number:06d}"), entry
