"""The base of all services' stores in Redis: versioned records, epochs, the audit trail, and what Redis may not lose.

A service's store adds its own keys and records. All keys of a site begin with `fog:SITE:`. Why writes are scripts, and
how a loss of acknowledged records is noticed: ADR 13.
"""

from __future__ import annotations

import hashlib
import math
import secrets
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, NamedTuple, Self, TypeVar, cast

import msgspec
from prometheus_client import Gauge

from fog_contracts.messages import Message
from fog_runtime import logs
from fog_runtime.credentials import NOBODY
from fog_runtime.stores.records import AUDIT_ENTRIES, KINDS, RECORD, SWAP, WRITE, AuditEntry, AuditPage, read_page
from fog_runtime.stores.redis_connection import (
    Expectation,
    RedisConnection,
    StoreError,
    StoreIdentity,
    StoreLostError,
    StoreRefusedError,
    marker,
)
from fog_runtime.stores.undo import undoable

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from fog_runtime.credentials import Credentials

LIFETIME_S: Final = 86_400
"""Seconds for which a result is remembered."""

_log = logs.get("store")


class IdempotencyError(ValueError):
    """An idempotency key was used for another request before."""


class _Result(msgspec.Struct, frozen=True):
    fingerprint: str
    record: msgspec.Raw


@dataclass(frozen=True, slots=True)
class Attempt:
    """One attempt at a request: the key in the store, and a fingerprint of the request.

    The result is stored in the same atomic step as the change itself, so there is never one without the other.
    """

    name: str
    fingerprint: str

    @classmethod
    def of(cls, caller: str, key: str, target: str, body: object) -> Attempt:
        """Return the attempt of a caller with this Idempotency-Key at a request: its target (a path) and body."""
        name = hashlib.sha256(f"{caller}\n{key}".encode()).hexdigest()
        fingerprint = hashlib.sha256(target.encode() + b"\n" + msgspec.json.encode(body)).hexdigest()
        return cls(f"idempotency:{name}", fingerprint)

    def result(self, record: bytes) -> object:
        """Return what is stored for this attempt."""
        return _Result(self.fingerprint, msgspec.Raw(record))

    def recorded(self, data: bytes) -> bytes:
        """Return the record in a stored result; raises `IdempotencyError` if it is another request's."""
        result = msgspec.json.decode(data, type=_Result)
        if result.fingerprint != self.fingerprint:
            raise IdempotencyError("this Idempotency-Key was used for another request: use a new one")
        return bytes(result.record)


M = TypeVar("M", bound=Message)

DURABLE: Final = Gauge(
    "fognav_store_durable", "Whether Redis writes to its disk before it acknowledges; not a number until it tells"
)
DURABLE.set(math.nan)
MEMORY: Final = Gauge(
    "fognav_store_memory_bytes", "Memory of Redis, as it tells each minute; not a number while it does not"
)
MEMORY.set(math.nan)
_MEASURED_EVERY: Final = 120
"""Checks, of which a service makes two a second."""

Outcome = Literal["ok", "exists", "missing", "stale"]
"""Result of a write: done (now or before), or refused because a record exists, is missing, or has another version."""

UNFENCED: Final = -1
"""The epoch of a writer that is no copy of a service: Redis does not ask who leads."""

ANY: Final = "*"
"""Expect no particular version: overwrite what is stored."""


class Audit(NamedTuple):
    """A change for the audit trail: when (s since the epoch), by whom, what; and its idempotency key, if it has one."""

    at: float
    who: str
    action: str
    attempt: Attempt | None = None


class RecoveryError(Exception):
    """There is nothing to recover: Redis lost nothing, or the service has nothing in memory."""


class StoreStatus(Message, frozen=True, kw_only=True):
    """Whether Redis lost acknowledged records, and how; and the numbers of records by table.

    `in_memory` is empty when the service was started after the loss, and has not loaded any.
    """

    lost: bool
    detail: str
    in_redis: dict[str, int]
    in_memory: dict[str, int]


class Table(NamedTuple):
    """A Redis hash of JSON records by id: `name` ends its key, `subject` is the kind of its records in the audit trail.

    `version` is the path of a record's version, which a writer expects to be unchanged.
    """

    name: str
    subject: str
    version: str = "version"


class RedisStore:
    """The site's keys; every call may raise `StoreError` and may be repeated.

    `data_dir` is a folder that survives restarts: in it the service `service` remembers which store it uses, so that it
    notices at its start that Redis was emptied. Without it, only a running service notices. Set `epoch` to that with
    which the service leads (`fog_runtime.lease`), and to 0 while it stands by: Redis refuses writes unless it
    granted that one last.
    """

    tables: ClassVar[Sequence[str]] = ()
    """The names of the service's tables, for people."""

    def __init__(  # what a store is
        self,
        url: str,
        site: str,
        *,
        service: str = "service",
        data_dir: Path | None = None,
        timeout_s: float = 1.0,
        credentials: Credentials = NOBODY,
    ) -> None:
        self._redis = RedisConnection(url, timeout_s=timeout_s, credentials=credentials)
        self._site = site
        self._service = service
        self._identity = StoreIdentity(None if data_dir is None else marker(data_dir, service, site))
        self._floors: dict[str, int] = {}
        self._checks = 0
        self.epoch = UNFENCED
        self.recoveries = 0
        """How often an administrator has decided here about a loss, after which Redis may lack what was written."""

    async def __aenter__(self) -> Self:
        """Return the store; it connects with the first command."""
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the connections."""
        await self._redis.aclose()

    async def check(self) -> None:
        """Check that Redis answers, accepts writes, and has all that it acknowledged; raises `StoreLostError` if not.

        A store that nobody has used yet is marked as this site's.
        """
        # Redis checks whether it may write (a read-only replica, full, too few replicas, a broken disk) before it finds
        # that an empty text changes nothing: a probe that neither changes anything nor waits for the disk.
        await self._redis.write(("SETRANGE", self._key("probe"), 0, ""))
        await self._verify()
        if self._checks % _MEASURED_EVERY == 0:
            MEMORY.set(await self._used_memory())
        self._checks += 1

    async def _used_memory(self) -> float:
        """Return the memory (bytes) of Redis; not a number where it hides it."""
        try:
            told = await self._redis.read("INFO", "memory")
        except StoreError:
            return math.nan  # or it is away, which the next check tells
        return float(told["used_memory"])

    async def durability_warning(self) -> str:
        """Return why acknowledged writes are not durable, or an empty text; also empty if Redis hides its settings."""
        try:
            answers = [await self._redis.read("CONFIG", "GET", name) for name in ("append*", "maxmemory-policy")]
        except StoreError:
            return ""
        values = {_text(name): _text(value) for answer in answers for name, value in _items(answer)}
        durable = values.get("appendonly") == "yes" and values.get("appendfsync") == "always"
        DURABLE.set(durable)
        if not durable:
            return "run Redis with `appendonly yes` and `appendfsync always`: it may lose acknowledged writes"
        if values.get("maxmemory-policy") != "noeviction":
            return "run Redis with `maxmemory-policy noeviction`: when it is full, it throws acknowledged records away"
        return ""

    async def recall(self, attempt: Attempt | None, kind: type[M]) -> M | None:
        """Return the result of an earlier attempt under the same idempotency key; None if there was none.

        Raises `IdempotencyError` when the key was used for another request.
        """
        if attempt is None:
            return None
        data = await self._redis.read("GET", self._key(attempt.name))
        return None if data is None else self._result_of(attempt, data, kind)

    async def audit(self, *, kinds: Sequence[str] = KINDS, cursor: str | None = None, limit: int = 100) -> AuditPage:
        """Return a page of the audit trail that all services of the site share; raises `CursorError` too."""
        return await read_page(self._redis, self._key("audit:"), kinds=kinds, cursor=cursor, limit=limit)

    async def undoable(self, entry: str, record: str, kinds: Sequence[str]) -> AuditEntry:
        """Return an entry of the audit trail, of this record, that may be undone; raises `UndoError`."""
        return await undoable(self._redis, self._key("audit:"), entry, record, kinds)

    async def status(self, in_memory: Mapping[str, int]) -> StoreStatus:
        """Return what Redis has of the service's tables, beside what the service has in memory."""
        lost, detail = False, ""
        try:
            await self.check()
        except StoreLostError as error:
            lost, detail = True, error.what
        in_redis = {name: int(await self._redis.read("HLEN", self._key(name))) for name in self.tables}
        return StoreStatus(lost=lost, detail=detail, in_redis=in_redis, in_memory=dict(in_memory))

    async def require_loss(self) -> None:
        """Raise `RecoveryError` unless Redis lost acknowledged records."""
        try:
            await self.check()
        except StoreLostError:
            return
        raise RecoveryError("Redis has all records that this service knows of: there is nothing to recover")

    async def accept_loss(self, audit: Audit) -> None:
        """Go on with what Redis has now, on an administrator's decision; the caller loads it then."""
        await self._adopt({}, audit)

    # --- For the services' stores -----------------------------------------------------------------------------------

    async def _readable_records(self, table: str, kind: type[M]) -> dict[str, M]:
        """Return the readable records of a table; an unreadable one is logged and left out."""
        records, failures = await self._decoded(table, kind)
        for name, reason in failures.items():
            _log.error("unreadable_record", kind=kind.__name__, key=self._key(table), id=name, reason=reason)
        return records

    async def _write_records(self, table: str, records: Mapping[str, Message]) -> None:
        """Write records durably, overwriting what is stored, without audit entries."""
        encoded = [part for name, record in records.items() for part in (name, msgspec.json.encode(record))]
        keys = [self._key(name) for name in ("generation", "writes", table, self._epoch_key)]
        await self._run(WRITE, keys, table, {}, *encoded)

    async def _adopt(self, tables: Mapping[str, Mapping[str, Message]], audit: Audit) -> None:
        """Use the store that Redis has now, and replace these tables in it by the given records, in one step.

        What this process had expected of it is left there, by which the service's other copies know that it is decided.
        """
        decided = msgspec.json.encode(self._identity.expectation())
        for name in self._floors:
            await self._load_floor(name)
        commands: list[tuple[str | bytes | int, ...]] = [
            ("SET", self._key("generation"), secrets.token_hex(8), "NX"),
            ("SET", self._decided_key, decided),
            *(("HSET", self._key("floors"), name, floor) for name, floor in self._floors.items()),
        ]
        for table, records in tables.items():
            encoded = [part for name, record in records.items() for part in (name, msgspec.json.encode(record))]
            commands.append(("DEL", self._key(table)))
            if encoded:
                commands.append(("HSET", self._key(table), *encoded))
        entry = {"at": f"{audit.at:.3f}", "who": audit.who, "action": audit.action, "id": self._service}
        fields = [text for pair in {**entry, "before": "", "after": ""}.items() for text in pair]
        trail = (self._key("audit:store"), "MAXLEN", "~", AUDIT_ENTRIES, "*")
        identity = (("GET", self._key("generation")), ("HGETALL", self._key("writes")))
        *_, generation, writes = await self._redis.write(*commands, ("XADD", *trail, *fields), *identity)
        self._identity.adopt(_text(generation), _pairs(writes))
        self.recoveries += 1
        _log.warning("store_recovered", action=audit.action, who=audit.who, generation=self._identity.generation)

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

        `expected` is the version as text, `0` when none may be stored yet but one of version 0, or ANY; `before` is the
        previous value for the audit entry when none was stored. A repeated attempt, after the first reply was lost, is
        `ok` for a write and `missing` for a deletion. A new record's version must be above `_floor`, or the outcome is
        `stale`.
        """
        data, attempt = b"" if record is None else msgspec.json.encode(record), audit.attempt
        names = ("generation", "writes", table.name, f"audit:{table.subject}", "floors")
        keys = [self._key(part) for part in (*names, attempt.name if attempt else "no-attempt", self._epoch_key)]
        arguments = {
            "id": name,
            "expected": expected,
            "version": table.version,
            "at": f"{audit.at:.3f}",
            "who": audit.who,
            "action": audit.action,
            "attempt_s": 0 if attempt is None else LIFETIME_S,
        }
        result = b"" if attempt is None else msgspec.json.encode(attempt.result(data))
        outcome, details = await self._run(
            SWAP, keys, table.name, arguments, data,
            b"" if before is None else msgspec.json.encode(before), result,
        )  # fmt: skip
        if outcome == "replay" and attempt is not None:
            # Usually this attempt itself, repeated after a lost reply; else another process was faster.
            return "ok" if attempt.recorded(details) == data else "exists"
        self._floors[table.name] = max(int(details or b"0"), self._floor(table.name))
        return cast("Outcome", outcome)

    async def _record(self, subject: str, name: str, after: bytes, audit: Audit, *, fenced: bool = False) -> None:
        """Add an entry of a kind (`KINDS`) to the audit trail, of something that is not stored; `after` is JSON.

        fenced: only if this process leads. What has happened already, as a stop, is recorded by whoever did it.
        """
        entry = {"at": f"{audit.at:.3f}", "who": audit.who, "action": audit.action, "id": name, "before": ""}
        fields = [text for pair in entry.items() for text in pair]
        keys = [self._key(f"audit:{subject}"), self._key(self._epoch_key)]
        epoch = self.epoch if fenced else UNFENCED
        (outcome,) = await self._redis.write(("EVAL", RECORD, len(keys), *keys, epoch, *fields, "after", after))
        if outcome == b"fenced":
            raise self._refused_by_lease()

    def _floor(self, table: str) -> int:
        """Return the highest version that a deleted record of the table had: versions are never used again."""
        return self._floors.get(table, 0)

    async def _load_floor(self, table: str) -> None:
        stored = await self._redis.read("HGET", self._key("floors"), table)
        self._floors[table] = max(int(stored or b"0"), self._floor(table))

    def _key(self, name: str) -> str:
        return f"fog:{self._site}:{name}"

    @property
    def _epoch_key(self) -> str:
        """The key of the highest epoch of the service (`leadership`)."""
        return f"{self._service}:epoch"

    # --- Inside -----------------------------------------------------------------------------------------------------

    @property
    def _decided_key(self) -> str:
        return self._key(f"{self._service}:decided")

    async def _verify(self) -> None:
        """Compare the store with what was acknowledged; this needs no right to write, except in a new store.

        A loss that an administrator has decided about at another copy of this service is none any more.
        """
        expected = self._identity.expectation()
        generation, writes = await self._read_identity()
        if not generation and not expected.generation:
            await self._redis.write(("SET", self._key("generation"), secrets.token_hex(8), "NX"))
            generation, writes = await self._read_identity()
        try:
            self._identity.verify(expected, generation, writes)
        except StoreLostError:
            decided = await self._redis.read("GET", self._decided_key)
            generation, writes = await self._read_identity()  # those of the decision, which may just have come
            if decided is None or not msgspec.json.decode(decided, type=Expectation).covers(expected, generation):
                raise
            self._identity.adopt(generation, writes)
            _log.warning("store_followed", generation=generation)

    async def _decoded(self, table: str, kind: type[M]) -> tuple[dict[str, M], dict[str, str]]:
        """Return the records of a table, and why others are unreadable."""
        await self._verify()
        records: dict[str, M] = {}
        failures: dict[str, str] = {}
        for name, data in _items(await self._redis.read("HGETALL", self._key(table))):
            try:
                records[_text(name)] = msgspec.json.decode(data, type=kind)
            except msgspec.DecodeError as error:
                failures[_text(name)] = str(error)
        return records, failures

    def _result_of(self, attempt: Attempt, data: bytes, kind: type[M]) -> M:
        try:
            return msgspec.json.decode(attempt.recorded(data), type=kind)
        except msgspec.DecodeError as error:
            raise IdempotencyError("this Idempotency-Key was used for another request: use a new one") from error

    async def _run(
        self, script: str, keys: list[str], table: str, arguments: Mapping[str, object], *data: str | bytes
    ) -> tuple[str, bytes]:
        """Run a script that begins with the guard; return its outcome and details. Raises `StoreLostError`."""
        if not self._identity.generation:
            await self.check()
        request = msgspec.json.encode({**self._identity.guard(table), "epoch": self.epoch, **arguments})
        ((outcome, writes, details),) = await self._redis.write(("EVAL", script, len(keys), *keys, request, *data))
        if outcome == b"lost":
            raise StoreLostError("Redis lost acknowledged records")
        if outcome == b"fenced":
            raise self._refused_by_lease()
        self._identity.acknowledge(table, int(writes))
        return _text(outcome), details

    def _refused_by_lease(self) -> StoreRefusedError:
        if self.epoch == 0:
            return StoreRefusedError(f"this {self._service} stands by: only the one that leads may write")
        return StoreRefusedError(f"the epoch {self.epoch} is not that of the {self._service} that Redis lets lead")

    async def _read_identity(self) -> tuple[str, dict[str, int]]:
        """Return the store's generation, empty if it has none, and the writes of each table."""
        generation = await self._redis.read("GET", self._key("generation"))
        return _text(generation or b""), _pairs(await self._redis.read("HGETALL", self._key("writes")))


def _text(value: object) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _items(reply: Any) -> list[tuple[bytes, bytes]]:  # noqa: ANN401  # redis does not type its replies
    """Return the pairs of a reply that is a dictionary or, inside a transaction, a flat list."""
    return list(reply.items()) if isinstance(reply, dict) else list(zip(reply[::2], reply[1::2], strict=True))


def _pairs(reply: Any) -> dict[str, int]:  # noqa: ANN401  # redis does not type its replies
    return {_text(name): int(value) for name, value in _items(reply)}
