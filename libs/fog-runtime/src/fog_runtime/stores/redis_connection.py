"""A connection to Redis, or through Sentinels to the primary of several, with errors that name cause and remedy.

    redis://[user:password@]host:port/db[?wait=N]       (rediss:// over TLS)
    redis+sentinel://[user:password@]host:port,host:port,.../name[/db][?wait=N]     (rediss+sentinel:// all over TLS)

`name` is the name under which the Sentinels monitor the primary. With `wait`, a write is acknowledged once N replicas
have it in memory (`WAIT`), so that it survives the loss of the primary.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar
from urllib.parse import parse_qsl, unquote, urlsplit

from prometheus_client import Gauge
from redis.asyncio import Redis
from redis.asyncio.retry import Retry
from redis.asyncio.sentinel import MasterNotFoundError, Sentinel, SentinelManagedSSLConnection
from redis.backoff import NoBackoff
from redis.exceptions import BusyLoadingError, OutOfMemoryError, ReadOnlyError, RedisError
from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import TimeoutError as RedisTimeoutError

from fog_runtime.concurrency import raise_if_cancelled
from fog_runtime.credentials import NOBODY, Credentials
from fog_runtime.files import atomic_write

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping, Sequence
    from pathlib import Path

_T = TypeVar("_T")
Argument = str | bytes | int
Command = tuple[Argument, ...]

SENTINEL_PORT: Final = 26379
_PORT: Final = 6379
_SCHEMES: Final = frozenset({"redis", "rediss", "redis+sentinel", "rediss+sentinel"})
_FORMS: Final = (
    "Redis's address must look like redis://host:6379/0 or, with Sentinels,"
    " redis+sentinel://host1:26379,host2:26379/NAME/0?wait=1 (NAME as in `sentinel monitor NAME ...`)"
)
_REFUSALS: Final = {
    "READONLY": "Redis is a read-only replica: let FOGNAV_REDIS_URL name the primary, or the Sentinels",
    "OOM": "Redis is full (`maxmemory` is reached): raise `maxmemory`, or delete zones that nobody needs",
    "NOREPLICAS": "Redis has too few replicas (`min-replicas-to-write`), so it refuses writes: start the replicas",
    "MISCONF": "Redis can't write to its disk, so it refuses writes: make room or repair it",
    "LOADING": "Redis is loading its data: wait",
}
"""Sentences for the errors of Redis that refuse a write, by their codes."""


class StoreError(Exception):
    """Redis can't be reached, refused a command, or contains an unreadable record; the message says which."""


class StoreRefusedError(StoreError):
    """Redis refused a command, so nothing was changed."""


class RedisAddress(NamedTuple):
    """A parsed address; `hosts` are the Sentinels' if `sentinel_name` is given, else one server's."""

    hosts: list[tuple[str, int]]
    username: str | None
    password: str | None
    db: int
    sentinel_name: str
    replicas: int
    tls: bool


def parse_address(url: str) -> RedisAddress:
    """Parse an address as in the module's docstring; raises `ValueError` that shows how it must look."""
    parts = urlsplit(url)
    sentinels = parts.scheme.endswith("+sentinel")
    credentials, _, hosts_text = parts.netloc.rpartition("@")
    username, _, password = credentials.partition(":")
    path = [segment for segment in parts.path.split("/") if segment]
    options = dict(parse_qsl(parts.query, keep_blank_values=True))
    try:
        hosts = [_host(text, SENTINEL_PORT if sentinels else _PORT) for text in hosts_text.split(",")]
        name = path.pop(0) if sentinels else ""
        db = int(path.pop(0)) if path else 0
        replicas = int(options.pop("wait", "0"))
        single = len(hosts) == 1 or sentinels
        valid = parts.scheme in _SCHEMES and single and not path and not options and min(db, replicas) >= 0
    except (ValueError, IndexError) as error:
        raise ValueError(_FORMS) from error
    if not valid:
        raise ValueError(_FORMS)
    return RedisAddress(
        hosts,
        unquote(username) or None,
        unquote(password) or None,
        db,
        name,
        replicas,
        parts.scheme.startswith("rediss"),
    )


class RedisConnection:
    """Executes commands; every failure is a `StoreError`, after which a write may or may not have happened.

    A command has a timeout of `timeout_s` and is tried twice: the first attempt after a restart of Redis may use a dead
    connection of the pool. So every command must be one that may be repeated.
    """

    def __init__(self, url: str, *, timeout_s: float = 1.0, credentials: Credentials = NOBODY) -> None:
        self._address = _with_login(parse_address(url), credentials)
        self._timeout_s = timeout_s
        self._client, self._sentinel = _connect(self._address, timeout_s, credentials)

    async def aclose(self) -> None:
        """Close the connections."""
        for client in (self._client, *(self._sentinel.sentinels if self._sentinel is not None else ())):
            with contextlib.suppress(RedisTimeoutError):  # one that hangs says no goodbye, and is left all the same
                await client.aclose()

    async def read(self, *command: Argument) -> Any:  # noqa: ANN401  # redis does not type its replies
        """Execute a command that changes nothing, and return its reply."""
        client = self._client
        return await self._twice(lambda: client.execute_command(*command))  # type: ignore[no-untyped-call]  # redis's

    async def write(self, *commands: Command) -> list[Any]:
        """Execute commands as one transaction and return their replies.

        With `wait` in the address it returns once that many replicas have the changes.
        """
        wait = self._address.replicas
        commands = commands if len(commands) == 1 else (("MULTI",), *commands, ("EXEC",))

        async def execute() -> list[Any]:
            pipeline: Any = self._client.pipeline(transaction=False)  # redis types a pipeline as Redis
            for command in commands:
                pipeline.execute_command(*command)
            if wait:
                # On the same connection: WAIT counts the replicas that have the connection's own last write.
                pipeline.execute_command("WAIT", wait, max(1, int(900 * self._timeout_s)))
            # Not raised by the pipeline, which would put the whole command into the message.
            return list(await pipeline.execute(raise_on_error=False))

        replies = await self._twice(execute)
        raise_if_cancelled()
        if (failed := next((reply for reply in replies if isinstance(reply, Exception)), None)) is not None:
            raise self._failure(failed) from failed
        if wait and (have := int(replies.pop())) < wait:
            raise StoreError(
                f"Redis: {have} of {wait} replicas have the write, so it may be lost with the primary:"
                " start the replicas, or lower `wait` in FOGNAV_REDIS_URL"
            )
        return replies if len(commands) == 1 else list(replies[-1])

    async def _twice(self, execute: Callable[[], Awaitable[_T]]) -> _T:
        """Execute something, and once more if the connection failed.

        The client's own second attempt goes to the address of the first one, though the primary is another one now.
        """
        try:
            with contextlib.suppress(RedisConnectionError, RedisTimeoutError):
                return await execute()
            raise_if_cancelled()
            return await execute()
        except (RedisError, OSError) as error:
            raise_if_cancelled()
            raise self._failure(error) from error

    def _failure(self, error: Exception) -> StoreError:
        """Return an error that names the cause, and the remedy where there is one."""
        if (refusal := _REFUSALS.get(_code(error))) is not None:
            return StoreRefusedError(refusal)
        if isinstance(error, MasterNotFoundError):
            name = self._address.sentinel_name
            return StoreError(f"Redis: no Sentinel knows a primary {name!r} that answers: start it, or correct it")
        if isinstance(error, RedisTimeoutError):
            return StoreError(f"Redis does not answer within {self._timeout_s:g} s: it hangs, or its host or network")
        return StoreError(f"Redis: {error}")


def _code(error: Exception) -> str:
    """Return Redis's code of an error; the client strips it from those that it has a class for."""
    kinds = {ReadOnlyError: "READONLY", OutOfMemoryError: "OOM", BusyLoadingError: "LOADING"}
    code = next((code for kind, code in kinds.items() if isinstance(error, kind)), "")
    # What the client makes of READONLY when the Sentinels name another primary.
    return code or ("READONLY" if "now a slave" in str(error) else str(error).partition(" ")[0])


class _PrimaryConnection(SentinelManagedSSLConnection):
    """Is closed without the server's goodbye: a primary that was cut off says none.

    The client closes all of its connections before the first one to another primary, and fails the command for which it
    does so if one of them takes longer than the timeout.
    """

    async def disconnect(self, *reasons: Any, **named: Any) -> None:  # noqa: ANN401  # the client's
        if self._writer is not None:
            self._writer.transport.abort()
        await super().disconnect(*reasons, **named)


class _Sentinels(Sentinel):
    """Asks the Sentinels for the primary, one question at a time.

    The client moves the Sentinel that answers to the front of its list. Two questions at once move two, after which one
    may be in the list twice and another one not at all.
    """

    def __init__(self, hosts: Sequence[tuple[str, int]], **options: object) -> None:
        super().__init__(hosts, **options)  # type: ignore[no-untyped-call]  # redis types it not
        self._asking = asyncio.Lock()

    async def discover_master(self, service_name: str) -> tuple[str, int]:
        async with self._asking:
            host, port = await super().discover_master(service_name)
            return host, port


def _host(text: str, default_port: int) -> tuple[str, int]:
    parts = urlsplit(f"//{text.strip()}")
    if not parts.hostname:
        raise ValueError(text)
    return parts.hostname, parts.port or default_port


def _with_login(address: RedisAddress, credentials: Credentials) -> RedisAddress:
    """Return an address with a user and password: its own, else those in the credentials for Redis."""
    if address.username is not None or address.password is not None:
        return address
    for host, port in address.hosts:
        login = credentials.login("redis", f"Redis at {host}:{port}", host, encrypted=address.tls)
        if login is not None:
            address = address._replace(username=login[0], password=login[1])
    return address


def _connect(address: RedisAddress, timeout_s: float, credentials: Credentials) -> tuple[Redis, Sentinel | None]:
    timeouts: dict[str, Any] = {"socket_timeout": timeout_s, "socket_connect_timeout": timeout_s}
    options = {
        **timeouts,
        "db": address.db,
        "username": address.username,
        "password": address.password,
        "retry": Retry(NoBackoff(), 0),
    }
    tls: dict[str, Any] = {"ssl": True, "ssl_ca_data": credentials.authority or None} if address.tls else {}
    options |= tls
    if not address.sentinel_name:
        ((host, port),) = address.hosts
        return Redis(host=host, port=port, **options), None
    sentinels: Sequence[tuple[str, int]] = address.hosts
    kind: dict[str, Any] = {"connection_class": _PrimaryConnection} if address.tls else {}
    own = {**timeouts, **tls, "retry": options["retry"]}
    sentinel = _Sentinels(sentinels, sentinel_kwargs=own, **options)
    return sentinel.master_for(address.sentinel_name, **kind), sentinel


LOST: Final = Gauge(
    "fognav_store_lost", "Whether Redis lost acknowledged records (1), so that writes are refused until it is decided"
)
_REMEDY: Final = (
    "writes are refused until an administrator decides: `fognav store restore` (write back what this service has in"
    " memory) or `fognav store accept` (go on with what Redis has), or POST /api/v1/store/recovery with"
    ' {"action": "restore"} or {"action": "accept"}; see docs/operations.md'
)


class StoreLostError(StoreRefusedError):
    """Redis lost acknowledged records; the message says how, and what an administrator can do."""

    def __init__(self, what: str) -> None:
        super().__init__(f"{what}: {_REMEDY}")
        self.what = what
        LOST.set(1)


class Expectation(NamedTuple):
    """What a store must have: its generation, empty if this service used none before, and at least these writes."""

    generation: str
    writes: dict[str, int]

    def covers(self, other: Expectation, generation: str) -> bool:
        """Whether who expected this, and was told to use a store of this generation all the same, knew what is missing.

        `other`: what somebody else expected of it. In a store of another generation everything of before is missing.
        """
        known = all(count <= self.writes.get(table, 0) for table, count in other.writes.items())
        return bool(generation) and self.generation == other.generation and (generation != other.generation or known)


def marker(folder: Path, service: str, site: str) -> Path:
    """Return the file in a service's data folder that remembers the generation of the store that it used last."""
    return folder / f"{service}.{site}.store"


class StoreIdentity:
    """Notices that Redis lost acknowledged records: that it was emptied, replaced, or went back to an older state.

    A site's store has a generation (a random text, written once) and counts the writes of each table. A service
    remembers both, and in the file `marker`, if there is one, the generation of the store that it used last, so that it
    notices a loss at its start too.

    `generation` is empty until the store was seen.
    """

    def __init__(self, marker: Path | None) -> None:
        self._marker = marker
        self._acknowledged: dict[str, int] = {}
        self.generation = ""
        LOST.set(0)

    def guard(self, table: str) -> dict[str, object]:
        """Return what must hold for a write to the table, for the scripts."""
        return {"generation": self.generation, "table": table, "acknowledged": self._acknowledged.get(table, 0)}

    def acknowledge(self, table: str, writes: int) -> None:
        """Record that Redis acknowledged a write; `writes` is the table's count of them."""
        self._acknowledged[table] = max(writes, self._acknowledged.get(table, 0))

    def expectation(self) -> Expectation:
        """Return what the store must have from now on; raises `StoreError` when the marker file can't be read.

        Take it before Redis is asked: a write that is acknowledged while the answer travels is not in that answer.
        """
        return Expectation(self.generation or self._remembered(), dict(self._acknowledged))

    def verify(self, expected: Expectation, generation: str, writes: Mapping[str, int]) -> None:
        """Compare the store (`generation` is empty if it has none) with what was expected of it.

        Raises `StoreLostError`, and `StoreError` when the marker file can't be read or written.
        """
        if expected.generation and generation != expected.generation:
            kind = "was emptied" if not generation else "was replaced by another store"
            raise StoreLostError(f"Redis {kind}, so acknowledged records are lost")
        for table, acknowledged in expected.writes.items():
            if (found := writes.get(table, 0)) < acknowledged:
                raise StoreLostError(
                    f"Redis went back to an older state: it has {found} of {acknowledged} writes of {table}"
                )
        if generation and not self.generation:
            self.adopt(generation, writes)
        LOST.set(0)

    def adopt(self, generation: str, writes: Mapping[str, int]) -> None:
        """Use this store from now on; raises `StoreError` when the marker file can't be written."""
        if self._marker is not None and generation != self._remembered():
            try:
                atomic_write(self._marker, generation.encode())
            except OSError as error:
                raise StoreError(
                    f"{self._marker} can't be written ({error}): let FOGNAV_DATA_DIR name a folder for it"
                ) from error
        self.generation, self._acknowledged = generation, dict(writes)
        LOST.set(0)

    def _remembered(self) -> str:
        if self._marker is None:
            return ""
        try:
            return self._marker.read_text("ascii").strip()
        except FileNotFoundError:
            return ""
        except (OSError, UnicodeDecodeError) as error:
            raise StoreError(f"{self._marker} can't be read ({error}): delete it to accept what Redis has") from error
