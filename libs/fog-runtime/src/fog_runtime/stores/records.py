"""What each service keeps in Redis below `fog:SITE:`: its keys, the scripts that write them, and the audit trail.

A service with a new key names it here: Redis refuses it every other one.

Every script that changes records begins with the guard: it writes nothing into a store that was emptied, replaced, or
went back to an older state, nor for a process that another one has replaced: the last key holds the epoch that was
granted last, and `request.epoch` is the writer's (0: it stands by, -1: it is no copy of a service and may write). Its
first argument is a JSON object; it returns an outcome, the number of writes of the table, and details.

The audit trail has one stream for each kind of record, so that many entries of one kind never push out those of
another. They are merged by time and read in pages.
"""

from __future__ import annotations

import re
from collections import deque
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from fog_contracts.messages import Message

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping, Sequence

    from fog_runtime.stores.redis_connection import RedisConnection

AREAS: Final = "areas"
HAZARDS: Final = "hazards"
OVERRIDES: Final = "overrides"
OVERRIDE_RESTS: Final = "override_rests"
ALERTS: Final = "alerts"
HISTORY: Final = "history"
"""Of each area: `history:AREA`."""
ZONES: Final = "zones"
ZONE_TIMES: Final = "zone_times"
ZONE_SETS: Final = "zone_sets"
ZONE_SOURCES: Final = "zone_sources"
PLACES: Final = "places"
SITE_MAPS: Final = "site_maps"
GOALS: Final = "goals"
OUT_OF_SERVICE: Final = "out_of_service"
BERTHS: Final = "berths"
SCHEDULES: Final = "schedules"
BLOCKS: Final = "blocks"
PACES: Final = "paces"

OWN: Final[Mapping[str, Sequence[str]]] = {
    "hazard-aggregator": (AREAS, HAZARDS, OVERRIDES, OVERRIDE_RESTS, ALERTS, f"{HISTORY}:*"),
    "map-service": (ZONES, ZONE_TIMES, ZONE_SETS, ZONE_SOURCES, PLACES, SITE_MAPS),
    "planner": (GOALS, OUT_OF_SERVICE, BERTHS, SCHEDULES, BLOCKS, PACES),
}
"""The keys of each service's own records, as patterns."""
READ: Final[Mapping[str, Sequence[str]]] = {"console-service": (f"{HISTORY}:*",)}
"""Others' records that a service reads, as patterns."""
AUDITED: Final[Mapping[str, Sequence[str]]] = {
    "hazard-aggregator": ("alert", "area", "override", "store"),
    "map-service": ("map", "place", "set", "source", "zone", "store"),
    "planner": ("mission", "robot", "schedule", "service", "stop", "store"),
}
"""The kinds of records whose audit trail (`audit:KIND`) each service writes."""
BOOKKEEPING: Final = ("probe", "generation", "writes", "floors", "no-attempt", "idempotency:*")
"""Keys that every service of a site writes: by which they notice that Redis lost something."""

AUDIT_ENTRIES: Final = 10_000
"""Entries of the audit trail that are kept, for each kind of record.

An entry is 1 kB, that of a mission of ten stops or of a large zone 2.6 kB: all kinds together stay below what Redis's
container may have.
"""

_GUARD: Final = """
local request = cjson.decode(ARGV[1])
if redis.call('GET', KEYS[1]) ~= request.generation then return {'lost', 0, ''} end
local writes = tonumber(redis.call('HGET', KEYS[2], request.table) or '0')
if writes < request.acknowledged then return {'lost', 0, ''} end
if request.epoch >= 0 and redis.call('GET', KEYS[#KEYS]) ~= string.format('%.0f', request.epoch) then
  return {'fenced', 0, ''}
end
"""

WRITE: Final = f"""{_GUARD}
for i = 2, #ARGV, 2 do redis.call('HSET', KEYS[3], ARGV[i], ARGV[i + 1]) end
return {{'ok', redis.call('HINCRBY', KEYS[2], request.table, 1), ''}}
"""
"""Overwrite records: keys `generation`, `writes`, table, epoch; further arguments: ids and records, alternating."""

SWAP: Final = f"""{_GUARD}
local id, expected, data = request.id, request.expected, ARGV[2]
local attempted = request.attempt_s > 0
if attempted then
  local earlier = redis.call('GET', KEYS[6])
  if earlier then return {{'replay', writes, earlier}} end
end

local function version_of(record)
  local readable, version = pcall(function()
    local found = cjson.decode(record)
    for part in string.gmatch(request.version, '[^.]+') do found = found[part] end
    return found
  end)
  return readable and version or nil
end

local function as_json(record)
  return pcall(cjson.decode, record) and record or cjson.encode(record)
end

local floor = tonumber(redis.call('HGET', KEYS[5], request.table) or '0')
local current = redis.call('HGET', KEYS[3], id)
local outcome = 'ok'
if current and current == data then
  -- A repeated attempt whose first reply was lost.
elseif expected == '0' and current and version_of(current) ~= 0 then
  outcome = 'exists'
elseif not current and (data == '' or (expected ~= '0' and expected ~= '*')) then
  outcome = 'missing'
elseif current and expected ~= '*' and tostring(version_of(current)) ~= expected then
  outcome = 'stale'
elseif not current and type(version_of(data)) == 'number' and version_of(data) <= floor then
  outcome = 'stale'
else
  if data == '' then
    local version = version_of(current)
    redis.call('HDEL', KEYS[3], id)
    if type(version) == 'number' and version > floor then
      floor = version
      redis.call('HSET', KEYS[5], request.table, string.format('%d', floor))
    end
  else
    redis.call('HSET', KEYS[3], id, data)
  end
  redis.call('XADD', KEYS[4], 'MAXLEN', '~', {AUDIT_ENTRIES}, '*', 'at', request.at, 'who', request.who,
    'action', request.action, 'id', id, 'before', current and as_json(current) or ARGV[3], 'after', data)
  writes = redis.call('HINCRBY', KEYS[2], request.table, 1)
  if attempted then redis.call('SET', KEYS[6], ARGV[4], 'EX', request.attempt_s) end
end
return {{outcome, writes, string.format('%d', floor)}}
"""
"""Write or delete one record if its version is the expected one, with its audit entry.

Keys: `generation`, `writes`, table, audit trail, `floors`, idempotency key, epoch. Further arguments: the record
(empty: delete), the value before for the audit entry if none is stored, and the result to remember for the idempotency
key.
A deleted record leaves its version as the table's floor, above which every new record's version must be, so that a
version never names two states. It is idempotent: a record that is already stored is left unchanged.
"""

RECORD: Final = f"""
if tonumber(ARGV[1]) >= 0 and redis.call('GET', KEYS[2]) ~= ARGV[1] then return 'fenced' end
local entry = {{unpack(ARGV, 2)}}
for _, known in ipairs(redis.call('XREVRANGE', KEYS[1], '+', '-', 'COUNT', 20)) do
  if table.concat(known[2], ' ') == table.concat(entry, ' ') then return 'ok' end
end
redis.call('XADD', KEYS[1], 'MAXLEN', '~', {AUDIT_ENTRIES}, '*', unpack(entry))
return 'ok'
"""
"""Add an entry to the audit trail alone, once: keys audit trail, epoch; arguments: the writer's epoch, and the fields.

It has no guard: what happened is recorded in a store that lost records, too.
"""

PERIOD: Final = f"""{_GUARD}
local function field(entry, name)
  for i = 1, #entry[2], 2 do if entry[2][i] == name then return entry[2][i + 1] end end
end

local last = redis.call('XREVRANGE', KEYS[3], '+', '-', 'COUNT', 1)[1]
if last then
  local epoch, seq = string.match(last[1], '(%d+)-(%d+)')
  epoch, seq = tonumber(epoch), tonumber(seq)
  if request.id_epoch < epoch or (request.id_epoch == epoch and request.id_seq <= seq)
      or field(last, 'same') == request.same then
    return {{'exists', writes, ''}}
  end
end
redis.call('XADD', KEYS[3], 'MAXLEN', '~', request.entries,
  string.format('%.0f-%.0f', request.id_epoch, request.id_seq), 'at', request.at, 'same', request.same,
  'data', ARGV[2])
for _ = 1, 2 do
  local oldest = redis.call('XRANGE', KEYS[3], '-', '+', 'COUNT', 2)
  if not oldest[2] or tonumber(field(oldest[2], 'at')) >= request.oldest then break end
  redis.call('XDEL', KEYS[3], oldest[1][1])
end
return {{'ok', redis.call('HINCRBY', KEYS[2], request.table, 1), ''}}
"""
"""Begin a period in a history, unless it is known or the last one has the same text `same`; forget what ended long ago.

Each time two at most are forgotten: a clock that is years ahead after a boot must not cost the whole history.

Keys: `generation`, `writes`, history (a stream), epoch. `id_epoch` and `id_seq` order the periods; a period that is not
newer than the last one is known.
"""

FORGET: Final = """
local last = redis.call('XREVRANGE', KEYS[1], '+', '-', 'COUNT', 1)[1]
for i = 1, last and #last[2] or 0, 2 do
  if last[2][i] == 'at' and tonumber(last[2][i + 1]) < tonumber(ARGV[1]) then redis.call('DEL', KEYS[1]) end
end
"""
"""Delete a history (the key) whose last period began before a time (s since the epoch): its area is gone."""


KINDS: Final = (
    "alert", "area", "map", "mission", "override", "place", "robot", "schedule", "service", "set", "source", "stop",
    "store", "zone",
)  # fmt: skip
"""The kinds of records that have an audit trail.

`alert`: alerts that began, ended or were acknowledged; `store`: what an administrator decided after a loss; `robot`:
operators' commands to robots; `schedule`: missions that begin by the clock; `service`: robots that are out of service;
`set`: sets of zones; `source`: muted sources of zones; `stop`: stops without a token, of which anybody may send any
number.
"""

PAGE_BYTES: Final = 256 * 1024
"""A page ends with the entry that reaches this size: what changed may be a shape of 500 corners, twice."""
_AT_ONCE: Final = 8
"""How many entries are read at a time, so that whoever asks for a thousand delays the event loop by milliseconds."""
_NEWER: Final = 50
"""How many new entries of a kind are read at once."""
_CURSOR: Final = re.compile(r"([0-9]{1,16})-([0-9]{1,16})\.([a-z]+)")


class CursorError(ValueError):
    """A cursor that no page gave."""


class AuditEntry(Message, frozen=True, kw_only=True):
    """A change: when (s since the epoch), by whom, what, of which record; `before` and `after` are the record's values.

    They are null where there was none before, or is none any more. `entry` is its name, by which it can be undone.
    """

    at: float
    who: str
    action: str
    kind: str
    id: str
    before: msgspec.Raw
    after: msgspec.Raw
    entry: str = ""


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


async def read_newer(redis: RedisConnection, prefix: str, after: dict[str, str]) -> list[AuditEntry]:
    """Return the entries since the last call with `after`, oldest first; at first the newest.

    The streams' keys begin with `prefix`. Some may be left for the next call. Raises `StoreError`.
    """
    found: list[_Placed] = []
    for kind in KINDS:
        key = f"{prefix}{kind}"
        if kind in after:
            reply = await redis.read("XRANGE", key, f"({after[kind]}", "+", "COUNT", _NEWER)
        else:
            reply = list(reversed(await redis.read("XREVRANGE", key, "+", "-", "COUNT", _NEWER)))
        found += [_entry(kind, entry_id, fields) for entry_id, fields in reply]
        after[kind] = reply[-1][0].decode() if reply else after.get(kind, "0-0")
    return [placed.entry for placed in sorted(found, key=lambda placed: placed.position)]


async def trail(redis: RedisConnection, key: str, kind: str, last_ms: int) -> AsyncIterator[tuple[int, AuditEntry]]:
    """Yield the entries of one kind with the times (ms) of Redis's clock, newest first, from `last_ms` on.

    Raises `StoreError`.
    """
    found = _Trail(redis, key, kind, _Position(last_ms + 1, 0, ""))
    while (placed := await found.first()) is not None:
        found.take()
        yield placed.position.ms, placed.entry


def _entry(kind: str, entry_id: bytes, fields: Any) -> _Placed:  # noqa: ANN401  # as redis gives them
    pairs = fields.items() if isinstance(fields, dict) else zip(fields[::2], fields[1::2], strict=True)
    values = {name.decode(): value for name, value in pairs}
    ms, _, number = entry_id.decode().partition("-")
    position = _Position(int(ms), int(number), kind)
    entry = AuditEntry(
        at=float(values["at"]),
        who=values["who"].decode(),
        action=values["action"].decode(),
        kind=kind,
        id=values["id"].decode(),
        before=msgspec.Raw(values["before"] or b"null"),
        after=msgspec.Raw(values["after"] or b"null"),
        entry=str(position),
    )
    return _Placed(position, entry)


async def entry_at(redis: RedisConnection, prefix: str, name: str) -> AuditEntry | None:
    """Return the entry of this name, None without one; raises `StoreError`."""
    if _CURSOR.fullmatch(name) is None:
        return None
    place, _, kind = name.rpartition(".")
    reply = await redis.read("XRANGE", f"{prefix}{kind}", place, place)
    return _entry(kind, *reply[0]).entry if reply else None


async def newer_entries(redis: RedisConnection, prefix: str, name: str) -> AsyncIterator[AuditEntry]:
    """Yield the entries of a kind from the newest on, the one of this name last; raises `StoreError`."""
    place, _, kind = name.rpartition(".")
    end = "+"
    while True:
        reply = await redis.read("XREVRANGE", f"{prefix}{kind}", end, place, "COUNT", _AT_ONCE)
        for entry_id, fields in reply:
            yield _entry(kind, entry_id, fields).entry
        if len(reply) < _AT_ONCE:
            return
        end = f"({reply[-1][0].decode()}"
