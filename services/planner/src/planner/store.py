"""Redis as the record of the robots' missions, so that a planner that starts again goes on with them."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Self, cast

import msgspec
from redis.asyncio import Redis
from redis.asyncio.retry import Retry
from redis.backoff import NoBackoff
from redis.exceptions import RedisError

from fog_contracts.messages import Message, RobotGoal
from fog_runtime import logs

if TYPE_CHECKING:
    from collections.abc import Awaitable

_log = logs.get("store")

# One step for Redis, so that a crash leaves goal and audit entry both or neither. A goal is deleted only while it is
# the one that was meant: an operator's newer one stays.
_WRITE = """
local current = redis.call('HGET', KEYS[1], ARGV[1])
if ARGV[2] == '' then
  if not current or cjson.decode(current).goal.goal_id ~= ARGV[3] then return 0 end
  redis.call('HDEL', KEYS[1], ARGV[1])
else
  if current == ARGV[2] then return 1 end
  redis.call('HSET', KEYS[1], ARGV[1], ARGV[2])
end
redis.call('XADD', KEYS[2], 'MAXLEN', '~', 100000, '*', 'at', ARGV[4], 'who', ARGV[5], 'action', ARGV[6],
  'robot', ARGV[1], 'before', current or '', 'after', ARGV[2])
return 1
"""


class StoreError(Exception):
    """Redis can't be reached, did not take a write, or holds what is no goal; the message says which."""


class StoredGoal(Message, frozen=True, kw_only=True):
    """A mission as it is kept; `any_heading`: the goal's theta is no wish."""

    goal: RobotGoal
    any_heading: bool = False


class Store:
    """The planner's keys in Redis; every call may raise `StoreError` and may be repeated."""

    def __init__(self, url: str, site: str, *, timeout_s: float = 1.0) -> None:
        # One retry, because the first command after a restart of Redis meets a dead connection of the pool.
        self._redis = Redis.from_url(
            url, socket_timeout=timeout_s, socket_connect_timeout=timeout_s, retry=Retry(NoBackoff(), 1)
        )
        self._goals = f"fog:{site}:goals"
        self._audit = f"fog:{site}:audit"
        self._epoch = f"fog:{site}:planner:epoch"

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

    async def goals(self) -> dict[str, StoredGoal]:
        """Return all stored missions by robot; one that can't be read is left out and reported."""
        stored = await self._ask(self._redis.hgetall(self._goals))
        goals = {}
        for name, data in stored.items():
            robot = name.decode("utf-8", "replace")
            try:
                goals[robot] = msgspec.json.decode(data, type=StoredGoal)
            except msgspec.DecodeError as error:
                # Without a mission a robot stands: safe, and no reason to withhold the others' missions.
                _log.error("goal_unreadable", robot=robot, key=self._goals, error=error)
        return goals

    async def put(self, robot: str, goal: StoredGoal, who: str, at: float) -> None:
        """Write a mission durably, with its audit entry."""
        await self._write(robot, msgspec.json.encode(goal), goal.goal.goal_id, who, "goal", at)

    async def delete(self, robot: str, goal_id: str, who: str, action: str, at: float) -> None:
        """Delete a mission durably if it is still this one (`action`: cancel or reached)."""
        await self._write(robot, b"", goal_id, who, action, at)

    async def ping(self) -> None:
        """Return when Redis answers."""
        await self._ask(cast("Awaitable[Any]", self._redis.ping()))

    async def _write(self, robot: str, data: bytes, goal_id: str, who: str, action: str, at: float) -> None:
        arguments: list[str | bytes] = [robot, data, goal_id, f"{at:.3f}", who, action]
        await self._ask(self._redis.eval(_WRITE, 2, self._goals, self._audit, *cast("Any", arguments)))

    @staticmethod
    async def _ask(command: Awaitable[Any]) -> Any:
        try:
            return await command
        except (RedisError, OSError) as error:
            raise StoreError(f"Redis: {error}") from error
