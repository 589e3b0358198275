"""Which robots are on this floor, in Redis: written before a robot hears that it leaves, and before it is served."""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING, Final

from msgspec import structs

from fog_contracts.handover import id_after, id_before, next_berth, standing
from fog_contracts.messages import Berth, FloorGoal, HandOver, OutOfService, Reason, RobotGoal
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

OUT: Final = FloorGoal()
"""The goal upstairs of a robot whose mission was cancelled on its way: out of the lift, and no further."""
_CHANGED: Final = "another request has changed this robot's floor meanwhile: look, then repeat it"

_log = logs.get("planner")


def on_behalf(robot: str, given: HandOver | None) -> str:
    """Return who acts, for the audit trail: the robot, which says for whom."""
    return f"robot {robot}, for {given.who}"[:100] if given is not None and given.who else f"robot {robot}"


def carries(given: HandOver | None, expected: str | None = None) -> bool:
    """Whether a robot takes a mission along; with `expected`, the one of which that is a leg (`Tour.goal_id`)."""
    if given is None or (given.mission is None and given.goal in {None, OUT}):
        return False
    return expected is None or (given.mission is not None and expected.rpartition("-")[0] == given.mission.id)


class OnOtherFloorError(OutOfServiceError):
    """A robot gets no goal: this floor does not have it; the message says why."""

    def __init__(self, robot: str, out: OutOfService) -> None:
        Exception.__init__(self, f"robot {robot} is not this floor's: {out.reason}")


class RidePersistence(MissionPersistence):
    """The missions, and the robots' floors as this one knows them (`fog_contracts.handover`)."""

    site = "none"
    """This floor."""
    leg_to: Callable[[str, Stop, str], tuple[Stop, Ride | None] | str | None] = staticmethod(
        lambda _robot, stop, _who: (stop, None)
    )
    """Returns where a robot goes for a stop, for whom: there, or to the lift to its floor; or why it can't.

    None: that is not known yet.
    """

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
        self._undecided.clear()

    def end(self, robot: str, goal_id: str) -> None:
        """Mark a reached goal for its end; a ride goes on from there."""
        stored = self.goals.get(robot)
        if stored is None or stored.goal.goal_id != goal_id or stored.ride is None:
            super().end(robot, goal_id)
            return
        self.at_goal[robot] = goal_id

    def standing(self, robot: str) -> Standing | None:
        """Return what a robot is to this floor by its own latest word; None before one."""
        said, announced = self.said.get(robot), self._announced(robot)
        if said is not None and announced is not None and (said.floor, said.epoch) == (self.site, announced.epoch):
            return "arrives"
        return None if said is None else standing(self.berths.get(robot), said, self.site)

    def _announced(self, robot: str) -> HandOver | None:
        """Return by what a robot is to come that is not here yet, and whose mission was cancelled here."""
        given = known.came_by if (known := self.berths.get(robot)) is not None else None
        return given if known is not None and given is not None and given.floor != known.floor else None

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
            reason = "it is in a lift whose door is not open here yet, or waits for the site's places"
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
        if found is None:
            self._undecided[robot] = stored.goal.goal_id
            return
        if isinstance(found, str):
            await self.give_up(robot, stored, "cut", found)
            return
        stop, ride = found
        await super()._replace(robot, stored, stop, tour, who=who, action=action, ride=ride)

    async def _end_reached(self) -> None:
        await super()._end_reached()
        self._reached = {**self._undecided, **self._reached}
        self._undecided.clear()

    async def leave(self, robot: str, stored: StoredGoal) -> None:
        """Record that a robot has left this floor, and end its mission here, which it takes along.

        Raises `StoreError`: then it has left, or not.
        """
        ride, known = stored.ride, self.berths.get(robot)
        assert ride is not None
        before, said = known or Berth(floor=self.site), self.said.get(robot)
        came_by = None if said is None else said.came_by
        given = HandOver(
            origin=self.site, floor=ride.floor, epoch=before.epoch + 1, lift=ride.lift, goal=ride.goal, who=ride.who,
            id=id_after("" if came_by is None else came_by.id, secrets.token_hex(8)),
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
            if (given := self._announced(robot)) is not None and given.epoch == said.epoch:
                said = structs.replace(said, came_by=given)
            audit = Audit(self._clock.stamp(), who, "arrive")
            with self._uncertain_write():
                if (old := (await self._store.goals()).get(robot)) is not None:
                    await self._store.delete(robot, old.goal.goal_id, audit)
            if robot in self.goals:
                self._cancel(robot)
            await self._put(robot, said, audit)
        _log.info("robot_arrived", robot=robot, epoch=said.epoch, who=who)

    def without_mission(self, robot: str, who: str, expected: str | None = None) -> HandOver | None:
        """Return a robot's hand-over without the mission that it takes along.

        None if there is none, or if this floor has given it already.
        """
        given = known.came_by if (known := self.berths.get(robot)) is not None else None
        if given is None or not carries(given, expected) or f"{robot}/{given.epoch}" in self.begun:
            return None
        new = id_after(id_before(given), secrets.token_hex(8))
        return structs.replace(given, goal=OUT, mission=None, who=who, id=new)

    async def cancel_carried(self, robot: str, known: Berth, changed: HandOver) -> None:
        """Cancel the mission that a robot takes along: `changed` is its hand-over without. Raises `StoreError`."""
        async with self._lock:
            if self.berths.get(robot) != known:
                raise StoreError(_CHANGED)
            await self._note(robot, structs.replace(known, came_by=changed), changed.who)

    async def cancel_coming(self, robot: str, who: str, given: HandOver) -> None:
        """Cancel the mission of a robot that is on its way here, whatever it takes along. Raises `StoreError`.

        `given`: what this floor takes it to have come by, once it comes; until then its record names the other floor.
        """
        async with self._lock:
            await self._note(robot, Berth(floor=given.origin, epoch=given.epoch, came_by=given), who)

    async def _note(self, robot: str, berth: Berth, who: str) -> None:
        if not await self._put(robot, berth, Audit(self._clock.stamp(), who, "cancel")):
            raise StoreError(_CHANGED)
        _log.info("ride_cancelled", robot=robot, who=who)

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
                    raise StoreError(_CHANGED)
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
