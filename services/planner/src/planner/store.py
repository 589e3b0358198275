"""The robots' missions in Redis: what is ordered is stored first, then in force; a restarted planner continues it."""

from __future__ import annotations

import asyncio
import secrets
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING, Final

from fog_contracts.messages import Berth, Message, OutOfService, RobotGoal
from fog_runtime import logs
from fog_runtime.stores import records
from fog_runtime.stores.redis_connection import StoreError, StoreLostError, StoreRefusedError
from fog_runtime.stores.redis_store import ANY, Audit, Outcome, RecoveryError, Table
from planner.stops import Ends, Ride, ScheduledMission, Tour
from planner.waits.persistence import LearnedPersistence, LearnedStore

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from typing import Literal

    from fog_runtime.clock import Clock
    from fog_runtime.health import Health
    from fog_runtime.stores.redis_store import Attempt, StoreStatus
    from planner.core import PlannerCore
    from planner.stops import Order

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
        """Write durably on which floor a robot is, if what is stored is what is `known` (None: nothing)."""
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


STORE_PERIOD_S = 0.5
VISIT_ENDED: Final = "visit_ended"
"""The audit trail's word for the end of a visit's mission."""
NO_MISSION: Final = ""
"""Instead of a mission's id: expect that a robot has none."""
_ATTEMPTS: Final = 2
"""How often a conditional write is tried: what is stored may differ from what this process knows, once."""


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


class MissionPersistence:
    """Keeps the missions of store and core equal; `change_core` passes a change to the core's thread."""

    def __init__(
        self,
        core: PlannerCore,
        store: Store,
        clock: Clock,
        health: Health,
        change_core: Callable[[Callable[[], object]], None],
        synchronized: Callable[[], bool] = lambda: True,
    ) -> None:
        """Load nothing yet. `synchronized` tells whether the time of day is right."""
        self._core = core
        self._store = store
        self._clock = clock
        self._health = health
        self._change_core = change_core
        self._learned = LearnedPersistence(core.waits.blocks, core.paces, store, clock, change_core)
        self._loaded = asyncio.Event()
        self._lock = asyncio.Lock()
        self._reload = True
        self._leading = False
        self._reached: dict[str, str] = {}
        self.goals: dict[str, StoredGoal] = {}
        """The missions by robot."""
        self._out: dict[str, OutOfService] = {}
        self._ends = Ends(clock, synchronized)
        """Of missions (`Tour.id`) with a deadline, and of `OutOfService.id`."""
        self.berths: dict[str, Berth] = {}
        """Where each robot is that was ever handed over, as this floor knows."""
        self.schedules: dict[str, ScheduledMission] = {}
        """The missions that begin by the clock, by id."""
        self.overruled: Callable[[str], object] = lambda _robot: None
        """Called for a robot whose mission, or service, somebody else than a visit has changed."""

    async def lead(self, epoch: int, *, confirmed: bool) -> None:
        """Load the stored missions and continue with this epoch; raises `StoreError` for a confirmed one.

        With a provisional epoch, while the store can't be read, or when it lost records, only the known missions go on.
        """
        self._store.epoch = epoch
        try:
            async with self._lock:
                await self._load()
        except StoreError as error:
            if confirmed and not isinstance(error, StoreLostError):
                raise
            self._reload = True
        self._leading = True
        self._change_core(partial(self._core.lead, epoch, knows_missions=not self._reload))

    def stand_by(self) -> None:
        """Forget the missions: another planner changes them until this one leads again."""
        self._leading, self._reload = False, True
        self._store.epoch = 0
        self._loaded.clear()
        self.goals.clear()
        self._out.clear()
        self._reached.clear()
        self._change_core(self._core.stand_by)
        self._health.set("goals", ok=True, detail="loaded when this process leads")

    async def earlier_result(self, attempt: Attempt | None) -> StoredGoal | None:
        """Return the mission that an earlier attempt stored, which is in force; None for a first attempt.

        Raises `IdempotencyError` for another request's attempt, and `StoreError`.
        """
        with self._uncertain_write():
            earlier = await self._store.earlier_result(attempt)
            if earlier is not None and self._reload:
                async with self._lock:
                    await self._load()
            return earlier

    async def send(self, order: Order) -> StoredGoal:
        """Give a robot a mission.

        Raises `OutOfServiceError`, `MissionConflictError`, and `StoreError`, after which the mission may or may not be
        stored.
        """
        async with self._lock:
            with self._uncertain_write():
                if self._reload:
                    await self._load()  # the robot may be out of service although the request for it failed
            self.require_in_service(order.robot)
            stamp, place, pose = self._clock.stamp(), order.place, order.pose
            goal_id = secrets.token_hex(8) if order.tour is None else order.tour.goal_id
            goal = RobotGoal(goal_id=goal_id, pose=pose, place=place, stamp=stamp, idle=order.idle)
            stored = StoredGoal(
                goal=goal, any_heading=order.any_heading, visit=order.visit, tour=order.tour,
                ride=order.ride,
            )  # fmt: skip
            await self._store_mission(order, stored, Audit(stamp, order.who, order.action, order.attempt))
            self._begin(order.robot, stored)
        _log.info("goal_accepted", robot=order.robot, goal=goal.goal_id, x=pose.x, y=pose.y, place=place, who=order.who)
        return stored

    async def cancel(self, robot: str, who: str, expected: str | None = None, *, action: str = "cancel") -> bool:
        """End a robot's mission; False when it has none. With `expected`, only the mission of that id.

        Raises `MissionConflictError` and `StoreError`.
        """
        async with self._lock:
            with self._uncertain_write():
                if self._reload:
                    # It may have one that was stored although its request failed: "none" would be wrong.
                    await self._load()
            stored = self.goals.get(robot)
            if stored is None:
                return False
            if expected not in (None, stored.goal.goal_id):
                raise MissionConflictError(robot, stored)
            await self._end(robot, stored, who, action)
        return True

    def out_of_service(self, robot: str) -> OutOfService | None:
        """Return why the robot gets no goal; None when it is in service."""
        out = self._out.get(robot)
        return out if out is not None and not self._ends.passed(out.id, out.until) else None

    def require_in_service(self, robot: str) -> None:
        """Raise `OutOfServiceError` for a robot that is out of service."""
        out = self.out_of_service(robot)
        if out is not None:
            raise OutOfServiceError(robot, out)

    async def take_out(
        self, robot: str, out: OutOfService, who: str, *, expected: str = ANY, action: str = "out"
    ) -> bool:
        """End a robot's mission, and keep it out of service; False if its record is not `expected` (id; `0`: none).

        Raises `StoreError`: then it may or may not be out of service, and its mission may be ended.
        """
        async with self._lock:
            with self._uncertain_write():
                if self._reload:
                    await self._load()
            known = self._out.get(robot)
            if expected not in (ANY, "0" if known is None else known.id):
                return False  # before its mission ends: what is refused changes nothing
            if (stored := self.goals.get(robot)) is not None:
                await self._end(robot, stored, who, "cancel")
            with self._uncertain_write():
                audit = Audit(self._clock.stamp(), who, action)
                done = await self._store.put_service(robot, out, audit, expected=expected) == "ok"
            if done:
                if out.until is not None:
                    self._ends.count(out.id, out.until)
                self._set_service(robot, out)
        return done

    async def put_back(self, robot: str, who: str, *, expected: str = ANY, action: str = "in") -> bool:
        """Put a robot back into service; False if it is, or if its record is not `expected`. Raises `StoreError`."""
        async with self._lock:
            with self._uncertain_write():
                audit = Audit(self._clock.stamp(), who, action)
                outcome = await self._store.put_service(robot, None, audit, expected=expected)
            if outcome in {"ok", "missing"}:
                self._set_service(robot, None)
        return outcome == "ok"

    async def store_status(self) -> StoreStatus:
        """Return what Redis and this process have; raises `StoreError`."""
        known = {
            "goals": len(self.goals), "out_of_service": len(self._out), "berths": len(self.berths),
            "schedules": len(self.schedules),
        }  # fmt: skip
        return await self._store.status(known if self._loaded.is_set() else {})

    async def recover_store(self, action: Literal["restore", "accept"], who: str) -> None:
        """Restore the missions from memory, or accept those in Redis, after Redis lost records.

        Raises `RecoveryError` and `StoreError`.
        """
        await self._store.require_loss()
        async with self._lock:
            audit = Audit(self._clock.stamp(), who, action)
            if action == "accept":
                await self._store.accept_loss(audit)
                self._reload = True
            elif self._loaded.is_set():
                await self._store.restore(self.goals, self._out, self.berths, self.schedules, audit)
            else:
                raise RecoveryError(
                    "this service was started after the loss and has no missions: restore a backup of Redis, or accept"
                )

    def end(self, robot: str, goal_id: str) -> None:
        """Mark a reached goal for deletion, unless the robot has another one by now."""
        stored = self.goals.get(robot)
        if stored is not None and stored.goal.goal_id == goal_id:
            del self.goals[robot]
            self._reached[robot] = goal_id
            _log.info("goal_reached", robot=robot, goal=goal_id)

    async def store_loop(self) -> None:
        """Load the missions, retrying until the store answers; then delete ended ones, and monitor the store."""
        while True:
            try:
                if self._leading and self._reload:
                    async with self._lock:
                        await self._load()
                    self._change_core(partial(self._core.lead, self._store.epoch, knows_missions=True))
                await self._end_reached()
                for robot, out in list(self._out.items()):
                    if self._leading and self._ends.passed(out.id, out.until):
                        await self.put_back(robot, "planner", expected=out.id, action="end")
                if self._leading:
                    await self._learned.save()
                await self._store.check()
                self._health.set("store", ok=True)
            except StoreError as error:
                # What was stored but never acknowledged may have gone with a failed primary.
                self._reload = True
                self._health.set("store", ok=False, detail=str(error))
                if self._leading and not self._loaded.is_set():
                    self._health.set("goals", ok=False, detail=f"not loaded yet: {error}")
            await asyncio.sleep(STORE_PERIOD_S)

    async def _end_reached(self) -> None:
        """Delete the missions that are reached; raises `StoreError`."""
        for robot, goal_id in list(self._reached.items()):
            stored = self.goals.get(robot)
            if stored is not None and stored.goal.goal_id == goal_id:
                continue  # a stop of a mission that goes on, reached while another robot's was stored
            async with self._lock:  # whoever loads the missions meanwhile would begin it again
                await self._store.delete(robot, goal_id, Audit(self._clock.stamp(), robot, "reached"))
                if self._reached.get(robot) == goal_id:
                    del self._reached[robot]

    @contextmanager
    def _uncertain_write(self) -> Iterator[None]:
        """Reload the missions after a failure: one may have been written although the reply was lost."""
        if not self._loaded.is_set():
            raise StoreRefusedError("the stored missions are not loaded yet")
        try:
            yield
        except StoreError as error:
            self._reload = True
            self._health.set("store", ok=False, detail=str(error))
            raise

    async def _store_mission(self, order: Order, stored: StoredGoal, audit: Audit) -> None:
        """Store a mission if the robot's mission is the expected one; raises `MissionConflictError`, `StoreError`."""
        robot, expected = order.robot, order.expected
        for _ in range(_ATTEMPTS):
            if expected is not None:
                await self._require(expected, robot)
            # One that is reached may still be stored.
            idle = self._idle_goal(robot) or self._reached.get(robot, "0")
            before = ANY if expected is None else expected or idle
            with self._uncertain_write():
                outcome = await self._store.put(robot, stored, audit, expected=before)
            if outcome == "ok":
                return
            if expected is None:
                raise StoreError("another request with this Idempotency-Key is in progress: repeat it")
            self._reload = True
        raise MissionConflictError(robot, self.goals.get(robot))

    async def _require(self, expected: str, robot: str) -> None:
        """Raise `MissionConflictError` unless the robot's mission is the expected one; raises `StoreError`, too."""
        with self._uncertain_write():
            if self._reload:
                await self._load()
        known = self.goals.get(robot)
        if expected == NO_MISSION and self._idle_goal(robot):
            return
        if expected != (NO_MISSION if known is None else known.goal.goal_id):
            raise MissionConflictError(robot, known)

    def _idle_goal(self, robot: str) -> str:
        """Return the id of a mission that counts as none, empty without one."""
        known = self.goals.get(robot)
        return known.goal.goal_id if known is not None and known.goal.idle else ""

    async def _load(self) -> None:
        """Put the stored missions into force, and end those that are not stored; hold the lock.

        Raises `StoreError`.
        """
        stored, out = await self._store.goals(), await self._store.out_of_service()
        await self._learned.load()
        for robot in {*self._out, *out}:
            self._set_service(robot, out.get(robot))
        for robot in [robot for robot in self.goals if robot not in stored or self.out_of_service(robot) is not None]:
            self._cancel(robot)
        orphans: dict[str, str] = {}
        for robot, mission in stored.items():
            # One that is reached may still be stored, until its deletion succeeds.
            ended = mission.goal.goal_id == self._reached.get(robot) or self.out_of_service(robot) is not None
            if mission == self.goals.get(robot) or ended:
                continue
            if not mission.visit:
                self._begin(robot, mission)
                continue
            # Its visit was in the memory of a process that is gone: nobody waits for the robot.
            orphans[robot] = mission.goal.goal_id
            if robot in self.goals:
                self._cancel(robot)
        # Last: a store that can't be written to must not keep the other robots from their missions.
        for robot, goal_id in orphans.items():
            await self._store.delete(robot, goal_id, Audit(self._clock.stamp(), robot, VISIT_ENDED))
        self._reload = False
        self._loaded.set()
        self._health.set("goals", ok=True, detail=f"{len(self.goals)} loaded")

    def _set_service(self, robot: str, out: OutOfService | None) -> None:
        if out == self._out.get(robot):
            return
        if out is None:
            del self._out[robot]
        else:
            self._out[robot] = out
        self.overruled(robot)
        self._change_core(partial(self._core.set_service, robot, out))
        _log.info("robot_service", robot=robot, out=out is not None, reason=out.reason if out else "")

    async def _end(self, robot: str, stored: StoredGoal, who: str, action: str) -> None:
        """Delete the robot's mission, and end it; hold the lock. Raises `StoreError`."""
        with self._uncertain_write():
            await self._store.delete(robot, stored.goal.goal_id, Audit(self._clock.stamp(), who, action))
        self._cancel(robot)
        if action != VISIT_ENDED:
            self.overruled(robot)
        _log.info("goal_cancelled", robot=robot, goal=stored.goal.goal_id, who=who)

    def _cancel(self, robot: str) -> None:
        self.goals.pop(robot, None)  # it may have been reached while its end was being stored
        self._change_core(partial(self._core.cancel, robot))

    def _begin(self, robot: str, stored: StoredGoal) -> None:
        self.goals[robot] = stored
        if not stored.visit and not stored.goal.idle:
            self.overruled(robot)
        priority = stored.tour.priority if stored.tour is not None else 0
        heading = stored.any_heading
        self._change_core(partial(self._core.set_goal, robot, stored.goal, any_heading=heading, priority=priority))
