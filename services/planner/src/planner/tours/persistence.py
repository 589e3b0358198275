"""Missions in force and in Redis: each robot has one record, whose next leg replaces the one before."""

from __future__ import annotations

import asyncio
import secrets
from collections import defaultdict
from contextlib import contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Final

from fog_contracts.messages import RobotGoal
from fog_runtime import logs
from fog_runtime.stores.redis_connection import StoreError, StoreLostError, StoreRefusedError
from fog_runtime.stores.redis_store import ANY, Audit, RecoveryError
from planner.stops import CutTimes, Ends, act_on_cut, leg_aside, next_leg
from planner.store import NO_MISSION, VISIT_ENDED, MissionConflictError, OutOfServiceError, StoredGoal
from planner.waits.persistence import LearnedPersistence

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import Literal

    from fog_contracts.messages import Berth, OutOfService, RobotPath, Stop, Tour
    from fog_runtime.clock import Clock
    from fog_runtime.health import Health
    from fog_runtime.stores.redis_store import Attempt, StoreStatus
    from planner.core import PlannerCore
    from planner.stops import Order, Ride, ScheduledMission
    from planner.store import Store

STORE_PERIOD_S = 0.5
_ATTEMPTS: Final = 2
"""How often a conditional write is tried: what is stored may differ from what this process knows, once."""
WHO = "planner"
"""Who ends missions by their own rules, in the audit trail."""

_log = logs.get("planner")


class MissionPersistence:
    """Keeps the missions of store and core equal, and lets those with several stops go on to their next one.

    `change_core` passes a change to the core's thread.
    """

    def __init__(  # noqa: PLR0913  # the process's parts
        self,
        core: PlannerCore,
        store: Store,
        clock: Clock,
        health: Health,
        change_core: Callable[[Callable[[], object]], None],
        path: Callable[[str], RobotPath | None],
        synchronized: Callable[[], bool] = lambda: True,
    ) -> None:
        """Load nothing yet. `path`: a robot's last path or refusal; `synchronized`: if the time of day is right."""
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
        self._undecided: dict[str, str] = {}  # reached goals of missions of which it is not known yet where they go on
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
        self._path = path
        self._cut: defaultdict[str, CutTimes] = defaultdict(CutTimes)
        """By robot, since when no way leads on."""
        self.said: dict[str, Berth] = {}
        """By robot, where it is by its own latest word."""
        self.at_goal: dict[str, str] = {}
        """By robot that rides to another floor, the last goal of that mission that it has reached."""
        self.begun: set[str] = set()
        """Rides, by their lift's session, whose robots have come and were given their goal, or had none."""

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
            await self._refresh()  # the robot may be out of service although the request for it failed
            self.require_in_service(order.robot)
            stamp, place, pose = self._clock.stamp(), order.place, order.pose
            goal_id = secrets.token_hex(8) if order.tour is None else order.tour.goal_id
            goal = RobotGoal(goal_id=goal_id, pose=pose, place=place, stamp=stamp, idle=order.idle)
            stored = StoredGoal(
                goal=goal, any_heading=order.any_heading, visit=order.visit, tour=order.tour, ride=order.ride
            )
            await self._store_mission(order, stored, Audit(stamp, order.who, order.action, order.attempt))
            self._begin(order.robot, stored)
        if (tour := stored.tour) and tour.deadline is not None and not tour.leg:  # else by another floor's clock
            self._ends.count(tour.id, tour.deadline)
        _log.info("goal_accepted", robot=order.robot, goal=goal.goal_id, x=pose.x, y=pose.y, place=place, who=order.who)
        return stored

    async def cancel(self, robot: str, who: str, expected: str | None = None, *, action: str = "cancel") -> bool:
        """End a robot's mission; False when it has none. With `expected`, only the mission of that id.

        Raises `MissionConflictError` and `StoreError`.
        """
        async with self._lock:
            await self._refresh()  # it may have one that was stored although its request failed
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
            await self._refresh()
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
        """Mark a reached goal for its end, unless the robot has another one by now.

        One of a mission that goes on is its mission's until the next is stored.
        """
        stored = self.goals.get(robot)
        if stored is None or stored.goal.goal_id != goal_id:
            return
        self._reached[robot] = goal_id
        if stored.tour is not None and stored.tour.goes_on:
            _log.info("stop_reached", robot=robot, goal=goal_id, ahead=len(stored.tour.ahead))
            return
        del self.goals[robot]
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
        """Go on to the next stops, and delete the other missions that are reached; then apply the missions' rules.

        Raises `StoreError`.
        """
        for robot, goal_id in list(self._reached.items()):
            stored = self.goals.get(robot)
            if stored is None or stored.goal.goal_id != goal_id:
                async with self._lock:  # whoever loads the missions meanwhile would begin it again
                    await self._store.delete(robot, goal_id, Audit(self._clock.stamp(), robot, "reached"))
            elif stored.tour is not None:
                await self._replace(robot, stored, *next_leg(stored.tour, stored.stop), who=robot, action="stop")
            if self._reached.get(robot) == goal_id:  # else a newer mission is reached meanwhile
                del self._reached[robot]
        if self._leading:
            tours = {stored.tour.id for stored in self.goals.values() if stored.tour is not None}
            self._ends.keep({*tours, *(out.id for out in self._out.values())})
            for robot, stored in list(self.goals.items()):
                if stored.tour is not None:
                    await self._apply(robot, stored, stored.tour)

    async def _replace(  # noqa: PLR0913  # the parts of a leg, and who stores it
        self, robot: str, stored: StoredGoal, stop: Stop, tour: Tour, *, who: str, action: str, ride: Ride | None = None
    ) -> None:
        """Store the next leg of a mission if the robot still has the one before, then begin it. Raises `StoreError`."""
        stamp = self._clock.stamp()
        goal = RobotGoal(goal_id=tour.goal_id, pose=stop.pose, place=stop.place, stamp=stamp)
        leg = StoredGoal(goal=goal, any_heading=stop.any_heading, tour=tour, ride=ride)
        async with self._lock:
            if self.goals.get(robot) is not stored:
                return
            with self._uncertain_write():
                outcome = await self._store.put(robot, leg, Audit(stamp, who, action), expected=stored.goal.goal_id)
            if outcome == "ok":
                self._begin(robot, leg)
            else:
                self._reload = True

    async def _apply(self, robot: str, stored: StoredGoal, tour: Tour) -> None:
        """End a mission whose deadline has passed, and do what it says about a way that is cut."""
        if self._ends.passed(tour.id, tour.deadline):
            await self.give_up(robot, stored, "deadline", "its deadline has passed")
            return
        path = self._path(robot)
        if path is None or path.goal_id != stored.goal.goal_id:
            return  # nothing is planned yet
        kind, nearest, reason = None, None, ""
        if path.refusal is not None:
            kind, nearest, reason = path.refusal.kind, path.refusal.nearest, path.refusal.reason
        act = act_on_cut(tour, nearest, *self._cut[robot].see(tour, kind, self._clock.now()))
        if act == "cancel":
            await self.give_up(robot, stored, "cut", reason or "no way has led to its stop for too long")
        elif act == "on":
            await self._replace(robot, stored, *next_leg(tour, stored.stop), who=WHO, action="stop")
        elif act == "nearest" and nearest is not None and stored.ride is None:  # a lift is no stop
            await self._replace(robot, stored, *leg_aside(tour, stored.stop, nearest), who=WHO, action="aside")

    async def give_up(self, robot: str, stored: StoredGoal, action: str, why: str) -> None:
        """End a mission that can't go on, unless an operator was faster; `why` is logged. Raises `StoreError`."""
        with suppress(MissionConflictError):
            await self.cancel(robot, WHO, stored.goal.goal_id, action=action)
            _log.warning("mission_given_up", robot=robot, goal=stored.goal.goal_id, action=action, reason=why)

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

    async def _refresh(self) -> None:
        """Load what is stored again after a write that may have failed; hold the lock. Raises `StoreError`."""
        with self._uncertain_write():
            if self._reload:
                await self._load()

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
        await self._refresh()
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
