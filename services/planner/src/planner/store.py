"""The robots' missions in Redis, so that a restarted planner continues them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from fog_contracts.messages import Message, RobotGoal
from fog_runtime.stores import store_keys
from fog_runtime.stores.redis_store import (
    ANY,
    Audit,
    Outcome,
    RecoveryError,
    RedisStore,
    StoreError,
    StoreLostError,
    Table,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fog_runtime.stores.idempotency import Attempt

__all__ = ["ANY", "Audit", "RecoveryError", "Store", "StoreError", "StoreLostError", "StoredGoal"]

_GOALS: Final = Table(store_keys.GOALS, "mission", version="goal.goal_id")


class StoredGoal(Message, frozen=True, kw_only=True):
    """A mission as it is stored; `any_heading`: ignore the goal's theta."""

    goal: RobotGoal
    any_heading: bool = False


class Store(RedisStore):
    """The planner's keys."""

    tables = (_GOALS.name,)

    async def goals(self) -> dict[str, StoredGoal]:
        """Return all stored missions by robot; an unreadable one is left out and logged.

        A robot without a mission stands still, which is safe, and no reason to withhold the others' missions.
        """
        return await self._readable_records(_GOALS.name, StoredGoal)

    async def put(self, robot: str, goal: StoredGoal, audit: Audit, *, expected: str = ANY) -> Outcome:
        """Write a mission durably, with its audit entry, if the stored one's id is `expected` (`0`: none is stored).

        `exists` also if another process used the same idempotency key.
        """
        return await self._swap(_GOALS, robot, goal, expected, audit)

    async def delete(self, robot: str, goal_id: str, audit: Audit) -> None:
        """Delete a mission durably if it is still this one: a newer one stays."""
        await self._swap(_GOALS, robot, None, goal_id, audit)

    async def record_command(self, robot: str, command: bytes, audit: Audit) -> None:
        """Record an operator's command to a robot (JSON) in the audit trail."""
        await self._record("robot", robot, command, audit)

    async def record_stop(self, robot: str, stop: bytes, audit: Audit) -> None:
        """Record a stop without a token (JSON), apart from what operators command: anybody may send any number."""
        await self._record("stop", robot, stop, audit)

    async def earlier_result(self, attempt: Attempt | None) -> StoredGoal | None:
        """Return the mission that an earlier attempt with the same idempotency key stored."""
        return await self.recall(attempt, StoredGoal)

    async def restore(self, goals: Mapping[str, StoredGoal], audit: Audit) -> None:
        """Replace the stored missions by these, on an administrator's decision after Redis lost them."""
        await self._adopt({_GOALS.name: goals}, audit)
