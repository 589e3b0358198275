"""Redis as the record of what operators drew: zones with optimistic versions, and who did what when."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Literal, Self, cast

import msgspec
from redis.asyncio import Redis
from redis.asyncio.retry import Retry
from redis.backoff import NoBackoff
from redis.exceptions import RedisError

from fog_contracts.messages import Message, Zone
from fog_runtime import logs

if TYPE_CHECKING:
    from collections.abc import Awaitable

_log = logs.get("store")

Outcome = Literal["ok", "exists", "missing", "stale"]

# One step for Redis, so that a crash leaves zone and audit entry both or neither. Repeating it is harmless: a zone that
# is stored already as it should be counts as done.
_SWAP = """
local current = redis.call('HGET', KEYS[1], ARGV[1])
if current and current == ARGV[3] then return 'ok' end
if ARGV[2] == '0' then
  if current then return 'exists' end
else
  if not current then return 'missing' end
  if tostring(cjson.decode(current).version) ~= ARGV[2] then return 'stale' end
end
if ARGV[3] == '' then redis.call('HDEL', KEYS[1], ARGV[1]) else redis.call('HSET', KEYS[1], ARGV[1], ARGV[3]) end
redis.call('XADD', KEYS[2], 'MAXLEN', '~', 100000, '*', 'at', ARGV[4], 'who', ARGV[5], 'action', ARGV[6],
  'zone', ARGV[1], 'before', current or '', 'after', ARGV[3])
return 'ok'
"""


class StoreError(Exception):
    """Redis can't be reached, did not take a write, or holds what is no zone; the message says which."""


class Audit(Message, frozen=True, kw_only=True):
    """Who does what, when (`at`: seconds since the epoch)."""

    at: float
    who: str
    action: Literal["create", "replace", "delete"]


class AuditEntry(Audit, frozen=True, kw_only=True):
    """What was done to a zone; `before` and `after` are null where there was or is none."""

    zone: str
    before: Zone | None
    after: Zone | None


class Store:
    """The map-service's keys in Redis; every call may raise `StoreError` and may be repeated."""

    def __init__(self, url: str, site: str, *, timeout_s: float = 1.0) -> None:
        # One retry, because the first command after a restart of Redis meets a dead connection of the pool.
        self._redis = Redis.from_url(
            url, socket_timeout=timeout_s, socket_connect_timeout=timeout_s, retry=Retry(NoBackoff(), 1)
        )
        self._zones = f"fog:{site}:zones"
        self._audit = f"fog:{site}:audit"
        self._epoch = f"fog:{site}:map:epoch"

    async def __aenter__(self) -> Self:
        """Connect later, with the first command."""
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the connections."""
        await self._redis.aclose()

    async def begin_epoch(self) -> int:
        """Return an epoch (ms) larger than that of every start before; without Redis the clock alone must do."""
        now = int(time.time() * 1000)
        try:
            last = int(await self._ask(self._redis.get(self._epoch)) or b"0")
            epoch = max(last + 1, now)
            await self._ask(self._redis.set(self._epoch, epoch))
        except StoreError as error:
            _log.warning("epoch_by_clock", epoch=now, reason=str(error))
            return now
        return epoch

    async def zones(self) -> list[Zone]:
        """Return all stored zones; one that can't be read is an error: a no-go zone must not be missing silently."""
        stored = await self._ask(self._redis.hgetall(self._zones))
        try:
            return [msgspec.json.decode(data, type=Zone) for data in stored.values()]
        except msgspec.DecodeError as error:
            raise StoreError(f"{self._zones} holds what is no zone: {error}; repair or delete that field") from error

    async def put(self, zone: Zone, *, expected: int, audit: Audit) -> Outcome:
        """Write a zone durably if the stored version is `expected` (0: none is stored)."""
        return await self._swap(zone.id, expected, msgspec.json.encode(zone), audit)

    async def delete(self, zone: Zone, audit: Audit) -> Outcome:
        """Delete a zone durably if the stored version is this one's."""
        outcome = await self._swap(zone.id, zone.version, b"", audit)
        # Gone already is what was wanted: an attempt whose answer was lost, or somebody else's hand.
        return "ok" if outcome == "missing" else outcome

    async def audit(self, limit: int) -> list[AuditEntry]:
        """Return the newest entries about zones, newest first."""
        entries = await self._ask(self._redis.xrevrange(self._audit, count=limit))
        found = [{_text(name): value for name, value in fields.items()} for _, fields in entries]
        return [_entry(fields) for fields in found if "zone" in fields]

    async def ping(self) -> None:
        """Return when Redis answers."""
        await self._ask(cast("Awaitable[Any]", self._redis.ping()))

    async def weakness(self) -> str:
        """Return why Redis's acknowledgements can't be trusted, or an empty text (a server may refuse to tell)."""
        try:
            config = await self._redis.config_get("appendonly", "appendfsync")
        except (RedisError, OSError):
            return ""
        values = {_text(name): _text(value) for name, value in config.items()}
        if values.get("appendonly") != "yes" or values.get("appendfsync") != "always":
            return "run Redis with `appendonly yes` and `appendfsync always`: it may lose acknowledged writes"
        return ""

    async def _swap(self, zone_id: str, expected: int, data: bytes, audit: Audit) -> Outcome:
        arguments = [zone_id, str(expected), data, f"{audit.at:.3f}", audit.who, audit.action]
        answer = await self._ask(self._redis.eval(_SWAP, 2, self._zones, self._audit, *cast("Any", arguments)))
        return cast("Outcome", _text(answer))

    @staticmethod
    async def _ask(command: Awaitable[Any]) -> Any:
        try:
            return await command
        except (RedisError, OSError) as error:
            raise StoreError(f"Redis: {error}") from error


def _entry(fields: dict[str, bytes]) -> AuditEntry:
    before, after = (
        msgspec.json.decode(fields[name], type=Zone) if fields[name] else None for name in ("before", "after")
    )
    return AuditEntry(
        at=float(fields["at"]),
        who=_text(fields["who"]),
        action=cast("Any", _text(fields["action"])),
        zone=_text(fields["zone"]),
        before=before,
        after=after,
    )


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)
