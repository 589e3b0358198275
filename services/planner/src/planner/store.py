"""The robots' missions and what else the planner keeps in Redis: its keys and records."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

from fog_contracts.messages import Berth, FloorGoal, Message, OutOfService, RobotGoal, Stop, Tour
from fog_runtime import logs
from fog_runtime.stores import records
from fog_runtime.stores.redis_store import ANY, Audit, Outcome, Table
from planner.stops import Ride, ScheduledMission
from planner.waits.persistence import LearnedStore

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fog_runtime.stores.redis_store import Attempt

_GOALS: Final = Table(records.GOALS, "mission", version="goal.goal_id")
_SERVICE: Final = Table(records.OUT_OF_SERVICE, "service", version="id")
_BERTHS: Final = Table(records.BERTHS, "robot", version="epoch")
_SCHEDULES: Final = Table(records.SCHEDULES, "schedule")

_log = logs.get("planner")


class StoredGoal(Message, frozen=True, kw_only=True):
    """A mission as it is stored; `any_heading`: ignore the goal's theta. `visit`: it belongs to a visit (ADR 69).

    `tour`: its other stops and rules, if it has any. `ride`: it leads to another floor (ADR 76).
    """

    goal: RobotGoal
    any_heading: bool = False
    visit: bool = False
    tour: Tour | None = None
    ride: Ride | None = None

    @property
    def stop(self) -> Stop:
        """The stop that it leads to, by the lift or not."""
        if self.ride is not None:
            goal = self.ride.goal or FloorGoal()
            return Stop(place=goal.place, pose=goal.pose, any_heading=goal.any_heading, floor=self.ride.floor)
        return Stop(pose=self.goal.pose, place=self.goal.place, any_heading=self.any_heading)


class Store(LearnedStore):
    """The planner's keys."""

    tables = (_GOALS.name, _SERVICE.name, _BERTHS.name, _SCHEDULES.name)

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

    async def out_of_service(self) -> dict[str, OutOfService]:
        """Return all robots that are out of service; one whose record can't be read is, too."""
        found, unreadable = await self._decoded(_SERVICE.name, OutOfService)
        for robot, reason in unreadable.items():
            _log.error("unreadable_record", kind="OutOfService", key=self._key(_SERVICE.name), id=robot, reason=reason)
            found[robot] = OutOfService(id="", reason="why is stored, but can't be read", by="unknown", since=0.0)
        return found

    async def put_service(self, robot: str, out: OutOfService | None, audit: Audit, *, expected: str = ANY) -> Outcome:
        """Take a robot out of service durably, or put it back (None), if the record's id is `expected`.

        `0`: it is in service.
        """
        return await self._swap(_SERVICE, robot, out, expected, audit)

    async def berths(self) -> dict[str, Berth]:
        """Return on which floor each robot is that was ever handed over, as far as this floor knows."""
        return await self._readable_records(_BERTHS.name, Berth)

    async def put_berth(self, robot: str, berth: Berth, known: Berth | None, audit: Audit) -> Outcome:
        """Write durably on which floor a robot is, if what is stored is of the epoch that is `known`.

        None: nothing is stored. Epoch 0 is as good as that: the robot was put back here with a record that is new.
        """
        return await self._swap(_BERTHS, robot, berth, "0" if known is None else str(known.epoch), audit)

    async def schedules(self) -> dict[str, ScheduledMission]:
        """Return the scheduled missions by id."""
        return await self._readable_records(_SCHEDULES.name, ScheduledMission)

    async def put_schedule(
        self, name: str, schedule: ScheduledMission | None, audit: Audit, *, expected: str = ANY
    ) -> Outcome:
        """Write a scheduled mission durably, or delete it (None), if the stored one's version is `expected`."""
        return await self._swap(_SCHEDULES, name, schedule, expected, audit)

    async def record_command(self, robot: str, command: bytes, audit: Audit) -> None:
        """Record an operator's command to a robot (JSON) in the audit trail."""
        await self._record("robot", robot, command, audit)

    async def record_stop(self, robot: str, stop: bytes, audit: Audit) -> None:
        """Record a stop without a token (JSON), apart from what operators command: anybody may send any number."""
        await self._record("stop", robot, stop, audit)

    async def earlier_result(self, attempt: Attempt | None) -> StoredGoal | None:
        """Return the mission that an earlier attempt with the same idempotency key stored."""
        return await self.recall(attempt, StoredGoal)

    async def restore(
        self,
        goals: Mapping[str, StoredGoal],
        out: Mapping[str, OutOfService],
        berths: Mapping[str, Berth],
        schedules: Mapping[str, ScheduledMission],
        audit: Audit,
    ) -> None:
        """Replace the stored missions, robots out of service, floors and schedules, as an administrator decides.

        They are those of this process's memory, after a loss.
        """
        tables = {_GOALS.name: goals, _SERVICE.name: out, _BERTHS.name: berths, _SCHEDULES.name: schedules}
        await self._adopt(tables, audit)


VISIT_ENDED: Final = "visit_ended"
"""The audit trail's word for the end of a visit's mission."""
NO_MISSION: Final = ""
"""Instead of a mission's id: expect that a robot has none."""


class MissionConflictError(Exception):
    """A robot has another mission than the writer expected; the message names it."""

    def __init__(self, robot: str, stored: StoredGoal | None) -> None:
        has = "no mission" if stored is None else f"the mission {stored.goal.goal_id}"
        super().__init__(f"robot {robot} has {has}, and not the one that was expected: read it again, then retry")


class OutOfServiceError(Exception):
    """A robot gets no goal: an operator keeps it out of service; the message says why, and till when."""

    def __init__(self, robot: str, out: OutOfService) -> None:
        until = "an operator puts it back"
        if out.until is not None:
            until = f"{datetime.fromtimestamp(out.until, UTC):%Y-%m-%d %H:%M UTC}"
        super().__init__(f"robot {robot} is out of service until {until}: {out.reason} ({out.by})")
