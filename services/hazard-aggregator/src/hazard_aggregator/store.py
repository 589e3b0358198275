"""Redis as the record of what was decided: areas that people changed, and the last hazard of every area."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeVar, cast

import msgspec
from redis.asyncio import Redis
from redis.asyncio.retry import Retry
from redis.backoff import NoBackoff
from redis.exceptions import RedisError

from fog_contracts.messages import AreaDefinition, AreaHazard, Message
from fog_runtime import logs

if TYPE_CHECKING:
    from collections.abc import Awaitable, Iterable

M = TypeVar("M", bound=Message)

_log = logs.get("store")


class StoreError(Exception):
    """Redis can't be reached or did not take a write; the message names the address and the trouble."""


class Stored(NamedTuple):
    """What an aggregator finds at its start; `epoch` is its own, larger than that of every start before."""

    epoch: int
    definitions: list[AreaDefinition]
    hazards: list[AreaHazard]


class Store:
    """The aggregator's keys in Redis; every call may raise `StoreError` and may be repeated."""

    def __init__(self, url: str, site: str, *, timeout_s: float = 1.0) -> None:
        # One retry, because the first command after a restart of Redis meets a dead connection of the pool.
        self._redis = Redis.from_url(
            url, socket_timeout=timeout_s, socket_connect_timeout=timeout_s, retry=Retry(NoBackoff(), 1)
        )
        self._site = site
        self._areas = f"fog:{site}:areas"
        self._hazards = f"fog:{site}:hazards"
        self._epoch = f"fog:{site}:aggregator:epoch"
        self._audit = f"fog:{site}:audit"

    async def __aenter__(self) -> Self:
        """Connect later, with the first command."""
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the connections."""
        await self._redis.aclose()

    async def load(self, epoch: int | None = None) -> Stored:
        """Return what is stored, and begin an epoch; with `epoch`, record that this one runs already."""
        last = int(await self._ask(self._redis.get(self._epoch)) or b"0")
        mine = max(last + 1, int(time.time() * 1000)) if epoch is None else max(last, epoch)
        await self._ask(self._redis.set(self._epoch, mine))
        areas = await self._ask(self._redis.hgetall(self._areas))
        hazards = await self._ask(self._redis.hgetall(self._hazards))
        return Stored(mine, _decoded(areas, AreaDefinition), _decoded(hazards, AreaHazard))

    async def save_hazards(self, hazards: Iterable[AreaHazard]) -> None:
        """Write hazards durably (Redis answers after its fsync: `appendfsync always`)."""
        values = {hazard.area: msgspec.json.encode(hazard) for hazard in hazards}
        await self._ask(self._redis.hset(self._hazards, mapping=cast("Any", values)))

    async def save_area(self, definition: AreaDefinition, audit: dict[str, str]) -> None:
        """Write an area durably, with an entry in the audit stream."""
        pipe = self._redis.pipeline(transaction=True)
        pipe.hset(self._areas, definition.id, msgspec.json.encode(definition))
        pipe.xadd(self._audit, cast("Any", audit), maxlen=100_000, approximate=True)
        await self._ask(pipe.execute())

    async def ping(self) -> None:
        """Ask Redis for a sign of life; raises `StoreError`."""
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

    @staticmethod
    async def _ask(command: Awaitable[Any]) -> Any:
        try:
            return await command
        except (RedisError, OSError) as error:
            raise StoreError(f"Redis: {error}") from error


async def load_or_begin(store: Store) -> tuple[Stored, bool]:
    """Return what is stored, and whether it could be read; without Redis nothing, and an epoch (ms) by the clock."""
    try:
        return await store.load(), True
    except StoreError as error:
        epoch = int(time.time() * 1000)
        _log.warning("start_without_store", epoch=epoch, reason=str(error))
        return Stored(epoch, [], []), False


def _decoded(values: dict[bytes, bytes], kind: type[M]) -> list[M]:
    """Decode stored messages; one that this version can't read is logged and left out, never the whole store."""
    result: list[M] = []
    for name, data in values.items():
        try:
            result.append(msgspec.json.decode(data, type=kind))
        except msgspec.DecodeError as error:
            _log.error("unreadable_record", kind=kind.__name__, id=name.decode(errors="replace"), reason=str(error))
    return result


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)
