"""Missions with several stops in Redis: one record for each robot, whose next leg replaces the one before."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING

from fog_contracts.messages import RobotGoal
from fog_runtime import logs
from fog_runtime.stores.redis_store import Audit
from planner.stops import CutTimes, Stop, act_on_cut, leg_aside, next_leg
from planner.store import MissionConflictError, MissionPersistence, StoredGoal

if TYPE_CHECKING:
    from collections.abc import Callable

    from fog_contracts.messages import Berth, RobotPath
    from fog_runtime.clock import Clock
    from fog_runtime.health import Health
    from planner.core import PlannerCore
    from planner.stops import Order, Tour
    from planner.store import Store

WHO = "planner"
"""Who ends missions by their own rules, in the audit trail."""

_log = logs.get("planner")


class TourPersistence(MissionPersistence):
    """The missions, which go on to their next stop.

    `path` returns a robot's last path or refusal; `synchronized` tells whether the time of day is right.
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
        super().__init__(core, store, clock, health, change_core, synchronized)
        self._path = path
        self._cut: defaultdict[str, CutTimes] = defaultdict(CutTimes)
        """By robot, since when no way leads on."""
        self.said: dict[str, Berth] = {}
        """By robot, where it is by its own latest word."""
        self.at_goal: dict[str, str] = {}
        self.begun: set[str] = set()
        """Rides, by their lift's session, whose robots have come and were given their goal, or had none."""
        """By robot that rides to another floor, the last goal of that mission that it has reached."""

    async def send(self, order: Order) -> StoredGoal:
        """Give a robot a mission, and count its time from now on; raises as the base class does."""
        stored = await super().send(order)
        if stored.tour is not None and stored.tour.deadline is not None:
            self._ends.count(stored.tour.id, stored.tour.deadline)
        return stored

    def end(self, robot: str, goal_id: str) -> None:
        """Mark a reached goal for its end; one of a mission that goes on is its mission's until the next is stored."""
        stored = self.goals.get(robot)
        if stored is None or stored.goal.goal_id != goal_id or stored.tour is None or not stored.tour.goes_on:
            super().end(robot, goal_id)
            return
        self._reached[robot] = goal_id
        _log.info("stop_reached", robot=robot, goal=goal_id, ahead=len(stored.tour.ahead))

    async def _end_reached(self) -> None:
        """Go on to the next stops, and delete the other missions that are reached; then apply the missions' rules."""
        for robot, goal_id in list(self._reached.items()):
            stored = self.goals.get(robot)
            if stored is not None and stored.goal.goal_id == goal_id and stored.tour is not None:
                await self._replace(robot, stored, *next_leg(stored.tour, _stop(stored)), who=robot, action="stop")
                if self._reached.get(robot) == goal_id:  # else a newer mission is reached meanwhile
                    del self._reached[robot]
        await super()._end_reached()
        if self._leading:
            tours = {stored.tour.id for stored in self.goals.values() if stored.tour is not None}
            self._ends.keep({*tours, *(out.id for out in self._out.values())})
            for robot, stored in list(self.goals.items()):
                if stored.tour is not None:
                    await self._apply(robot, stored, stored.tour)

    async def _replace(self, robot: str, stored: StoredGoal, stop: Stop, tour: Tour, *, who: str, action: str) -> None:
        """Store the next leg of a mission if the robot still has the one before, then begin it. Raises `StoreError`."""
        stamp = self._clock.stamp()
        goal = RobotGoal(goal_id=tour.goal_id, pose=stop.pose, place=stop.place, stamp=stamp)
        leg = StoredGoal(goal=goal, any_heading=stop.any_heading, tour=tour)
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
            await self._give_up(robot, stored, "deadline", "its deadline has passed")
            return
        path = self._path(robot)
        if path is None or path.goal_id != stored.goal.goal_id:
            return  # nothing is planned yet
        kind, nearest, reason = None, None, ""
        if path.refusal is not None:
            kind, nearest, reason = path.refusal.kind, path.refusal.nearest, path.refusal.reason
        act = act_on_cut(tour, nearest, *self._cut[robot].see(tour, kind, self._clock.now()))
        if act == "cancel":
            await self._give_up(robot, stored, "cut", reason or "no way has led to its stop for too long")
        elif act == "on":
            await self._replace(robot, stored, *next_leg(tour, _stop(stored)), who=WHO, action="stop")
        elif act == "nearest" and nearest is not None:
            await self._replace(robot, stored, *leg_aside(tour, _stop(stored), nearest), who=WHO, action="aside")

    async def _give_up(self, robot: str, stored: StoredGoal, action: str, why: str) -> None:
        try:
            await self.cancel(robot, WHO, stored.goal.goal_id, action=action)
        except MissionConflictError:
            return  # an operator was faster
        _log.warning("mission_given_up", robot=robot, goal=stored.goal.goal_id, action=action, reason=why)


def _stop(stored: StoredGoal) -> Stop:
    """Return a leg's goal as a stop."""
    goal = stored.goal
    assert goal.pose is not None  # what is stored has a pose
    return Stop(pose=goal.pose, place=goal.place, any_heading=stored.any_heading)
