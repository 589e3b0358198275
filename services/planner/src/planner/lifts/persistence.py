"""Which robots are on this floor, in Redis: written before a robot hears that it leaves, and before it is served."""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING

from msgspec import structs

from fog_contracts.handover import next_berth, standing
from fog_contracts.messages import Berth, HandOver, OutOfService, Reason, RobotGoal
from fog_runtime import logs
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import Audit
from planner.stops import carried
from planner.store import OutOfServiceError, StoredGoal
from planner.tours.persistence import WHO, MissionPersistence

if TYPE_CHECKING:
    from collections.abc import Callable

    from fog_contracts.handover import Standing
    from fog_contracts.messages import Pose, Stop, Tour
    from planner.stops import Ride

_log = logs.get("planner")


def on_behalf(robot: str, given: HandOver | None) -> str:
    """Return who acts, for the audit trail: the robot, which says for whom."""
    return f"robot {robot}, for {given.who}"[:100] if given is not None and given.who else f"robot {robot}"


class OnOtherFloorError(OutOfServiceError):
    """A robot gets no goal: this floor does not have it; the message says why."""

    def __init__(self, robot: str, out: OutOfService) -> None:
        Exception.__init__(self, f"robot {robot} is not this floor's: {out.reason}")


class RidePersistence(MissionPersistence):
    """The missions, and the robots' floors as this one knows them (`fog_contracts.handover`)."""

    site = "none"
    """This floor."""
    leg_to: Callable[[str, Stop, str], tuple[Stop, Ride | None] | str] = staticmethod(
        lambda _robot, stop, _who: (stop, None)
    )
    """Returns where a robot goes for a stop, for whom: there, or to the lift to its floor; or why it can't."""

    async def _load(self) -> None:
        self.berths = await self._store.berths()
        await super()._load()
        left = {robot for robot, berth in self.berths.items() if berth.floor != self.site}
        for robot, stored in (await self._store.goals()).items() if left else ():
            if robot in left:  # it took its mission along, which could not be deleted any more
                with self._uncertain_write():
                    await self._store.delete(robot, stored.goal.goal_id, Audit(self._clock.stamp(), WHO, "left"))

    def stand_by(self) -> None:
        """Forget it: another planner changes it until this one leads again."""
        super().stand_by()
        self.berths.clear()
        self.at_goal.clear()

    def end(self, robot: str, goal_id: str) -> None:
        """Mark a reached goal for its end; a ride goes on from there."""
        stored = self.goals.get(robot)
        if stored is None or stored.goal.goal_id != goal_id or stored.ride is None:
            super().end(robot, goal_id)
            return
        self.at_goal[robot] = goal_id

    def standing(self, robot: str) -> Standing | None:
        """Return what a robot is to this floor by its own latest word; None before one."""
        said = self.said.get(robot)
        return None if said is None else standing(self.berths.get(robot), said, self.site)

    def is_here(self, robot: str) -> bool:
        """Whether this floor sends the robot anywhere: both say so, or it was never handed over."""
        return self.standing(robot) == "here" or (robot not in self.berths and robot not in self.said)

    def out_of_service(self, robot: str) -> OutOfService | None:
        """Return why the robot gets no goal; None when it is in service, and on this floor."""
        return self._elsewhere(robot) or super().out_of_service(robot)

    def require_in_service(self, robot: str) -> None:
        """Raise `OutOfServiceError` for a robot that is out of service, or on another floor."""
        if (out := self._elsewhere(robot)) is not None:
            raise OnOtherFloorError(robot, out)
        berth = self.berths.get(robot)
        given = None if berth is None else berth.came_by
        if given is not None and given.lift is not None and f"{robot}/{given.epoch}" not in self.begun:
            reason = "it is in a lift whose door is not open here yet"
            raise OnOtherFloorError(robot, OutOfService(id="lift", reason=reason, by=WHO, since=0.0))
        super().require_in_service(robot)

    def _elsewhere(self, robot: str) -> OutOfService | None:
        berth = self.berths.get(robot)
        if berth is None:
            return None
        if berth.floor != self.site:
            reason = f"it has left for {berth.floor}"
        elif self.standing(robot) == "stale":
            reason = "its record of its floor is older than this floor's"
        else:
            return None
        by = berth.came_by.who if berth.came_by is not None else WHO
        return OutOfService(id=f"floor-{berth.epoch}", reason=reason, by=by, since=0.0)

    async def board(self, robot: str, stored: StoredGoal, cabin: Pose) -> None:
        """Send a robot that waits for its lift into the cabin. Raises `StoreError`."""
        assert stored.ride is not None
        stamp = self._clock.stamp()
        tour = None if stored.tour is None else structs.replace(stored.tour, leg=stored.tour.leg + 1)
        goal_id = secrets.token_hex(8) if tour is None else tour.goal_id
        goal = RobotGoal(goal_id=goal_id, pose=cabin, stamp=stamp)
        leg = StoredGoal(goal=goal, tour=tour, ride=structs.replace(stored.ride, boards=True))
        async with self._lock:
            if self.goals.get(robot) is not stored:
                return
            with self._uncertain_write():
                outcome = await self._store.put(robot, leg, Audit(stamp, WHO, "stop"), expected=stored.goal.goal_id)
            if outcome == "ok":
                self._begin(robot, leg)
            else:
                self._reload = True

    async def _replace(  # noqa: PLR0913  # as the base class
        self, robot: str, stored: StoredGoal, stop: Stop, tour: Tour, *, who: str, action: str, ride: Ride | None = None
    ) -> None:
        found = self.leg_to(robot, stop, tour.who)
        if isinstance(found, str):
            await self.give_up(robot, stored, "cut", found)
            return
        stop, ride = found
        await super()._replace(robot, stored, stop, tour, who=who, action=action, ride=ride)

    async def leave(self, robot: str, stored: StoredGoal) -> None:
        """Record that a robot has left this floor, and end its mission here, which it takes along.

        Raises `StoreError`: then it has left, or not.
        """
        ride, known = stored.ride, self.berths.get(robot)
        assert ride is not None
        before = known or Berth(floor=self.site)
        given = HandOver(
            origin=self.site, floor=ride.floor, epoch=before.epoch + 1, lift=ride.lift, goal=ride.goal, who=ride.who,
            id=secrets.token_hex(8),
            mission=None if stored.tour is None else carried(stored.tour, self.site, ride.floor),
        )  # fmt: skip
        after = next_berth(before, given)
        async with self._lock:
            if self.goals.get(robot) is not stored or isinstance(after, Reason):
                return
            with self._uncertain_write():
                outcome = await self._store.put_berth(
                    robot, after, known, Audit(self._clock.stamp(), ride.who, "leave")
                )
            if outcome != "ok":
                self._reload = True
                return
            self.berths[robot] = after
            await self._end(robot, stored, ride.who, "left")
        _log.info("robot_left", robot=robot, floor=ride.floor, epoch=after.epoch, who=ride.who)

    async def arrive(self, robot: str, said: Berth) -> None:
        """Record that a robot has come; what was stored for it before ends. Raises `StoreError`."""
        who = on_behalf(robot, said.came_by)
        async with self._lock:
            audit = Audit(self._clock.stamp(), who, "arrive")
            with self._uncertain_write():
                if (old := (await self._store.goals()).get(robot)) is not None:
                    await self._store.delete(robot, old.goal.goal_id, audit)
            if robot in self.goals:
                self._cancel(robot)
            await self._put(robot, said, audit)
        _log.info("robot_arrived", robot=robot, epoch=said.epoch, who=who)

    async def settle(self, robot: str) -> None:
        """Record that a robot that has come is out of its lift. Raises `StoreError`."""
        async with self._lock:
            if (known := self.berths.get(robot)) is not None and known.floor == self.site:
                audit = Audit(self._clock.stamp(), robot, "settle")
                await self._put(robot, structs.replace(known, came_by=None), audit)

    async def put_back(self, robot: str, who: str, **conditions: str) -> bool:
        """Put a robot back into service, also one whose record of its floor is older than this floor's.

        By that the operator says that it is here, such as after a restored backup. Raises `OnOtherFloorError` for one
        that has left; as the base class otherwise.
        """
        if who != WHO and robot not in self._out and (out := self._elsewhere(robot)) is not None:
            if self.standing(robot) != "stale":
                raise OnOtherFloorError(robot, out)
            async with self._lock:
                found = structs.replace(self.said[robot], came_by=None)
                if not await self._put(robot, found, Audit(self._clock.stamp(), who, "in")):
                    raise StoreError("another request has changed this robot's floor meanwhile: look, then repeat it")
            return True
        return await super().put_back(robot, who, **conditions)

    async def _put(self, robot: str, berth: Berth, audit: Audit) -> bool:
        with self._uncertain_write():
            outcome = await self._store.put_berth(robot, berth, self.berths.get(robot), audit)
        if outcome == "ok":
            self.berths[robot] = berth
        else:
            self._reload = True
        return outcome == "ok"
