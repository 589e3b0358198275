"""The base of all services' stores in Redis: connection, versioned records, epochs and the audit stream.

A service's store adds its own keys and records. All keys of a site begin with `fog:SITE:`.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, Self, TypeVar, cast

import msgspec
from redis.asyncio import Redis
from redis.asyncio.retry import Retry
from redis.backoff import NoBackoff
from redis.exceptions import RedisError

from fog_contracts.messages import Message
from fog_runtime import logs

if TYPE_CHECKING:
    from collections.abc import Awaitable

M = TypeVar("M", bound=Message)

Outcome = Literal["ok", "exists", "missing", "stale"]
"""Result of a write: done (now or before), or refused because a record exists, is missing, or has another version."""

ANY: Final = "*"
"""Expect no particular version: overwrite what is stored."""

# One atomic step of Redis: after a crash either both record and audit entry are stored or neither, and of two writers
# that expect the same version one is refused. It is idempotent: a record that is already stored is left unchanged.
_SWAP: Final = """
local current = redis.call('HGET', KEYS[1], ARGV[1])
local expected, data = ARGV[2], ARGV[3]
if current and current == data then return 'ok' end
if expected == '0' then
  if current then return 'exists' end
elseif expected ~= '*' or data == '' then
  if not current then return 'missing' end
  if expected ~= '*' then
    local version = cjson.decode(current)
    for part in string.gmatch(ARGV[4], '[^.]+') do version = version[part] end
    if tostring(version) ~= expected then return 'stale' end
  end
end
if data == '' then redis.call('HDEL', KEYS[1], ARGV[1]) else redis.call('HSET', KEYS[1], ARGV[1], data) end
redis.call('XADD', KEYS[2], 'MAXLEN', '~', 100000, '*', 'at', ARGV[5], 'who', ARGV[6], 'action', ARGV[7],
  ARGV[8], ARGV[1], 'before', current or ARGV[9], 'after', data)
return 'ok'
"""

_log = logs.get("store")


class StoreError(Exception):
    """Redis can't be reached, refused a write, or contains an unreadable record; the message says which."""


class Audit(Message, frozen=True, kw_only=True):
    """An audit entry: who does what, and when (`at`: seconds since the epoch)."""

    at: float
    who: str
    action: str


class Table(NamedTuple):
    """A Redis hash of JSON records by id: `name` ends its key, `subject` names its records in audit entries.

    `version` is the path of a record's version, which a writer expects to be unchanged.
    """

    name: str
    subject: str
    version: str = "version"


class RedisStore:
    """A connection to the site's keys; every call may raise `StoreError` and may be repeated.

    A command has a timeout of `timeout_s` and is tried twice: the first attempt after a restart of Redis may use a dead
    connection of the pool.
    """

    def __init__(self, url: str, site: str, *, timeout_s: float = 1.0) -> None:
        self._redis = Redis.from_url(
            url, socket_timeout=timeout_s, socket_connect_timeout=timeout_s, retry=Retry(NoBackoff(), 1)
        )
        self._site = site

    async def __aenter__(self) -> Self:
        """Return the store; it connects with the first command."""
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the connections."""
        await self._redis.aclose()

    async def ping(self) -> None:
        """Check that Redis answers."""
        await self._execute(cast("Awaitable[Any]", self._redis.ping()))

    async def durability_warning(self) -> str:
        """Return why acknowledged writes are not durable, or an empty text; also empty if Redis hides its settings."""
        try:
            config = await self._redis.config_get("appendonly", "appendfsync")
        except (RedisError, OSError):
            return ""
        values = {_text(name): _text(value) for name, value in config.items()}
        if values.get("appendonly") != "yes" or values.get("appendfsync") != "always":
            return "run Redis with `appendonly yes` and `appendfsync always`: it may lose acknowledged writes"
        return ""

    async def claim_epoch(self, service: str, running: int = 0) -> int:
        """Store and return an epoch (ms) larger than that of every earlier start.

        `running` is the epoch of a process that started without Redis; it is stored instead if it is larger.
        """
        key = self._key(f"{service}:epoch")
        last = int(await self._execute(self._redis.get(key)) or b"0")
        epoch = max(last, running) if running else max(last + 1, _now_ms())
        await self._execute(self._redis.set(key, epoch))
        return epoch

    async def begin_epoch(self, service: str) -> int:
        """Return an epoch (ms) larger than that of every earlier start; without Redis it is taken from the clock."""
        try:
            return await self.claim_epoch(service)
        except StoreError as error:
            epoch = _now_ms()
            _log.warning("epoch_from_clock", epoch=epoch, reason=str(error))
            return epoch

    async def audit_entries(self, limit: int) -> list[dict[str, str]]:
        """Return the newest entries of the site's audit stream, which all services share, newest first."""
        entries = await self._execute(self._redis.xrevrange(self._key("audit"), count=limit))
        return [{_text(name): _text(value) for name, value in fields.items()} for _, fields in entries]

    # --- For the services' stores -----------------------------------------------------------------------------------

    async def _records(self, table: str, kind: type[M]) -> dict[str, M]:
        """Return all records of a table; raises `StoreError` for an unreadable one, which must not be lost silently."""
        key = self._key(table)
        found: dict[str, M] = {}
        for name, data in (await self._execute(self._redis.hgetall(key))).items():
            try:
                found[_text(name)] = msgspec.json.decode(data, type=kind)
            except msgspec.DecodeError as error:
                raise StoreError(
                    f"{key} contains an invalid {kind.__name__} ({_text(name)}): {error}; repair or delete that field"
                ) from error
        return found

    async def _readable_records(self, table: str, kind: type[M]) -> dict[str, M]:
        """Return the readable records of a table; an unreadable one is logged and left out."""
        key = self._key(table)
        found: dict[str, M] = {}
        for name, data in (await self._execute(self._redis.hgetall(key))).items():
            try:
                found[_text(name)] = msgspec.json.decode(data, type=kind)
            except msgspec.DecodeError as error:
                _log.error("unreadable_record", kind=kind.__name__, key=key, id=_text(name), reason=str(error))
        return found

    async def _write_records(self, table: str, records: dict[str, Message]) -> None:
        """Write records durably, overwriting what is stored, without audit entries."""
        values = {name: msgspec.json.encode(record) for name, record in records.items()}
        await self._execute(self._redis.hset(self._key(table), mapping=cast("Any", values)))

    async def _swap(
        self,
        table: Table,
        name: str,
        record: Message | None,
        expected: str,
        audit: Audit,
        *,
        before: Message | None = None,
    ) -> Outcome:
        """Write a record durably, or delete it (None), with an audit entry, if the stored version is `expected`.

        `expected` is the version as text, `0` when none may be stored yet, or ANY; `before` is the previous value for
        the audit entry when none was stored. A repeated attempt, after the first reply was lost, is `ok` for a write
        and `missing` for a deletion.
        """
        data = b"" if record is None else msgspec.json.encode(record)
        arguments: list[str | bytes] = [
            name, expected, data, table.version, f"{audit.at:.3f}", audit.who, audit.action, table.subject,
            b"" if before is None else msgspec.json.encode(before),
        ]  # fmt: skip
        keys = (self._key(table.name), self._key("audit"))
        return cast("Outcome", _text(await self._execute(self._redis.eval(_SWAP, 2, *keys, *cast("Any", arguments)))))

    def _key(self, name: str) -> str:
        return f"fog:{self._site}:{name}"

    @staticmethod
    async def _execute(command: Awaitable[Any]) -> Any:  # noqa: ANN401  # redis does not type its replies
        try:
            return await command
        except (RedisError, OSError) as error:
            raise StoreError(f"Redis: {error}") from error


def _now_ms() -> int:
    return int(time.time() * 1000)


def _text(value: object) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
