"""The robots' missions in Redis, so that a restarted planner continues them."""

from __future__ import annotations

from typing import Final

from fog_contracts.messages import Message, RobotGoal
from fog_runtime.redis_store import ANY, Audit, RedisStore, StoreError, Table

__all__ = ["Store", "StoreError", "StoredGoal"]

_GOALS: Final = Table("goals", "robot", version="goal.goal_id")


class StoredGoal(Message, frozen=True, kw_only=True):
    """A mission as it is stored; `any_heading`: ignore the goal's theta."""

    goal: RobotGoal
    any_heading: bool = False


class Store(RedisStore):
    """The planner's keys."""

    async def goals(self) -> dict[str, StoredGoal]:
        """Return all stored missions by robot; an unreadable one is left out and logged.

        A robot without a mission stands still, which is safe, and no reason to withhold the others' missions.
        """
        return await self._readable_records(_GOALS.name, StoredGoal)

    async def put(self, robot: str, goal: StoredGoal, who: str, stamp: float) -> None:
        """Write a mission durably, with its audit entry."""
        await self._swap(_GOALS, robot, goal, ANY, Audit(at=stamp, who=who, action="goal"))

    async def delete(self, robot: str, goal_id: str, who: str, action: str, stamp: float) -> None:
        """Delete a mission durably if it is still this one (`action`: cancel or reached): a newer one stays."""
        await self._swap(_GOALS, robot, None, goal_id, Audit(at=stamp, who=who, action=action))
