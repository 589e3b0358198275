"""The keys that each service writes in Redis, below `fog:SITE:`, and the scripts that write them.

A service with a new key names it here: Redis refuses it every other one.

Every script begins with the guard: it writes nothing into a store that was emptied, replaced, or went back to an older
state, nor for a process that another one has replaced: the last key holds the epoch that was granted last, and
`request.epoch` is the writer's (0: it stands by, -1: it is no copy of a service and may write). Its first argument is a
JSON object; it returns an outcome, the number of writes of the table, and details.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

AREAS: Final = "areas"
HAZARDS: Final = "hazards"
OVERRIDES: Final = "overrides"
OVERRIDE_RESTS: Final = "override_rests"
ALERTS: Final = "alerts"
HISTORY: Final = "history"
"""Of each area: `history:AREA`."""
ZONES: Final = "zones"
ZONE_TIMES: Final = "zone_times"
GOALS: Final = "goals"

OWN: Final[Mapping[str, Sequence[str]]] = {
    "hazard-aggregator": (AREAS, HAZARDS, OVERRIDES, OVERRIDE_RESTS, ALERTS, f"{HISTORY}:*"),
    "map-service": (ZONES, ZONE_TIMES),
    "planner": (GOALS,),
}
"""The keys of each service's own records, as patterns."""
AUDITED: Final[Mapping[str, Sequence[str]]] = {
    "hazard-aggregator": ("alert", "area", "override", "store"),
    "map-service": ("zone", "store"),
    "planner": ("mission", "robot", "stop", "store"),
}
"""The kinds of records whose audit trail (`audit:KIND`) each service writes."""
BOOKKEEPING: Final = ("probe", "generation", "writes", "floors", "no-attempt", "idempotency:*")
"""Keys that every service of a site writes: by which they notice that Redis lost something."""

AUDIT_ENTRIES: Final = 100_000
"""Entries of the audit trail that are kept, for each kind of record."""

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
elseif expected == '0' and current then
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
while true do
  local oldest = redis.call('XRANGE', KEYS[3], '-', '+', 'COUNT', 2)
  if not oldest[2] or tonumber(field(oldest[2], 'at')) >= request.oldest then break end
  redis.call('XDEL', KEYS[3], oldest[1][1])
end
return {{'ok', redis.call('HINCRBY', KEYS[2], request.table, 1), ''}}
"""
"""Begin a period in a history, unless it is known or the last one has the same text `same`; forget what ended long ago.

Keys: `generation`, `writes`, history (a stream), epoch. `id_epoch` and `id_seq` order the periods; a period that is not
newer than the last one is known.
"""
