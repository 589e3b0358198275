"""Runs the rides: calls lifts, sends robots into them, hands them over, and takes those that come."""

from __future__ import annotations

import asyncio
import secrets
from collections import defaultdict
from typing import TYPE_CHECKING, Final, Protocol

from msgspec import structs

from fog_contracts import channels as ch
from fog_contracts.messages import Berth, HandOver, LiftState, OutOfService, Pose, Refusal, Stop
from fog_runtime import logs
from fog_runtime.clock import ticker
from fog_runtime.http import ProblemError
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import Attempt, IdempotencyError
from planner.lifts.persistence import OUT, OnOtherFloorError, carries, on_behalf
from planner.lifts.rides import Facts, cabins_at, cannot_leave, inside_of, lift_to, next_act, request, session
from planner.problems import PlannerProblem
from planner.robot_operator import CommandError
from planner.stops import Order, Ride
from planner.store import NO_MISSION, MissionConflictError, OutOfServiceError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fog_contracts.messages import Place, RobotPose, RobotState
    from fog_contracts.site import Site
    from fog_runtime.clock import Clock
    from fog_runtime.transports.zenoh_edge import ZenohEdge
    from planner.lifts.persistence import RidePersistence
    from planner.robot_operator import RobotOperator
    from planner.store import StoredGoal

STEP_S: Final = 0.5
_SEEN_S: Final = 4 * STEP_S
"""A mission that has not asked for a place for so long does not wait for it any more."""
SILENT_S: Final = 60.0
"""A robot that was not heard for so long holds no lift any more: a restart takes less."""
STOPPED_S: Final = 120.0
"""A robot that comes so soon after anybody has stopped robots here is stopped, too: the stop may have missed it."""
PLACES_S: Final = 60.0
"""A mission waits so long for the site's places, as the map-service has them; then those of site.toml count."""

_log = logs.get("planner")


class Robots(Protocol):
    """What rides need of the planner's service."""

    operator: RobotOperator
    poses: dict[str, RobotPose]

    @property
    def missions(self) -> RidePersistence:
        """The missions."""

    @property
    def places(self) -> Mapping[str, Place] | None:
        """All places by id; None until the map-service has told them."""

    @property
    def leads(self) -> bool:
        """Whether this process acts; else another planner does."""

    async def send(self, order: Order) -> StoredGoal | Refusal:
        """Give a robot a mission."""


class Riding:
    """The rides of a running planner."""

    def __init__(self, service: Robots, site: Site, zenoh: ZenohEdge, clock: Clock) -> None:
        self._service = service
        self._site = site
        self._zenoh = zenoh
        self._clock = clock
        self._lifts: dict[str, tuple[LiftState, float]] = {}
        self._heard: dict[str, float] = {}
        self._created = clock.now()
        self._waits: dict[str, tuple[str, float, float]] = {}
        """By robot: for which place it waits until the site's places are known, since when, and until when at least."""
        self._giving: defaultdict[str, asyncio.Lock] = defaultdict(asyncio.Lock)
        """By robot: held while it is given its goal, or its mission is cancelled."""
        service.missions.site = site.id
        service.missions.leg_to = self.leg_to

    def subscribe(self) -> None:
        """Follow the lifts of the site, if it has any."""
        if self._site.lifts:
            self._zenoh.subscribe(ch.LIFT_STATE, LiftState, self._on_lift)

    def _on_lift(self, ids: Mapping[str, str], state: LiftState) -> None:
        self._lifts[ids["lift"]] = state, self._clock.now()

    def on_state(self, robot: str, state: RobotState) -> None:
        """Note on which floor a robot is by its own record; one without a record knows this floor only."""
        self._heard[robot] = self._clock.now()
        self._service.missions.said[robot] = state.berth or Berth(floor=self._site.id)

    def leg_to(self, robot: str, stop: Stop, who: str) -> tuple[Stop, Ride | None] | str | None:
        """Return where a robot goes for a stop: there, or to the nearest lift to its floor; or why it can't.

        None: that is not known yet.
        """
        if stop.floor in (None, self._site.id):
            found = self._resolved(robot, stop)
            return (found, None) if isinstance(found, Stop) else found
        lift = lift_to(self._site.lifts, stop.floor, self._service.poses.get(robot))
        if lift is None:
            known = sorted({floor for each in self._site.lifts for floor in each.floors} - {self._site.id})
            return f"no lift of {self._site.id} leads to {stop.floor}; lifts lead to: {', '.join(known) or 'no floor'}"
        goal = stop.goal if stop.place is not None or stop.pose is not None else None
        return Stop(pose=lift.wait), Ride(lift=lift.id, floor=stop.floor, goal=goal, who=who)

    @property
    def floor(self) -> str:
        """This floor, by its site's id."""
        return self._site.id

    def first_leg(self, robot: str, stop: Stop, who: str, field: str) -> tuple[Stop, Ride | None]:
        """Return where a robot goes for an ordered stop, which has its pose if it is here; `field`: where it stands.

        Raises a `ProblemError` if no lift leads to its floor.
        """
        found = self.leg_to(robot, stop, who)
        if isinstance(found, str):
            raise ProblemError(PlannerProblem.NO_LIFT, found, field=f"{field}.floor")
        assert found is not None  # who orders a stop here gives its pose
        return found

    def check(self, robot: str, stop: Stop, field: str, *, mission: bool) -> None:
        """Raise a `ProblemError` for an ordered stop on a floor to which the robot can't be handed over.

        `mission`: with one. Raises `CommandError` if the robot is not heard.
        """
        if stop.floor is None:
            return
        state = self._service.operator.fresh_state(robot)
        if (found := cannot_leave(robot, state, stop.floor, mission=mission)) is not None:
            raise ProblemError(found[0], found[1], field=f"{field}.floor")

    def waits(self, robot: str) -> str:
        """Return why a robot's mission does not go on here yet; empty if it does, or if it has none."""
        name, _, until = self._waits.get(robot, ("", 0.0, 0.0))
        if self._clock.now() <= until:
            return f"it goes to {name} once the map-service has told this floor's places, {PLACES_S:.0f} s at most"
        known = self._service.missions.berths.get(robot)
        given = None if known is None or known.floor != self._site.id else known.came_by
        if given is None or not carries(given) or session(robot, given.epoch) in self._service.missions.begun:
            return ""
        return f"it comes with a mission from {given.origin}, and goes on once the lift {given.lift} is open here"

    def _resolved(self, robot: str, stop: Stop) -> Stop | str | None:
        """Return a stop of this floor with a pose; None for a place while the places are not known; or why it has none.

        None is returned for a while only.
        """
        if stop.pose is not None:
            return stop
        known, name, now = self._service.places, stop.place or "", self._clock.now()
        if known is None:
            before, since, until = self._waits.get(robot, (name, now, now))
            if before != name or now > until + PLACES_S:  # else the same wait, however seldom it is asked for
                since = now
            if now - since < PLACES_S:
                self._waits[robot] = name, since, now + _SEEN_S
                return None
        self._waits.pop(robot, None)
        place = (self._site.places if known is None else known).get(name)
        if place is None:
            unknown = f", and the map-service has told no others for {PLACES_S:.0f} s" if known is None else ""
            return f"there is no place {name}{unknown}"
        pose = Pose(x=place.x, y=place.y, theta=place.theta or 0.0)
        return structs.replace(stop, pose=pose, any_heading=place.theta is None)

    async def cancel(self, robot: str, who: str, expected: str | None = None) -> bool:
        """End a robot's mission, also one that it takes along to another floor; False when it has none.

        Of that no stop is left: the robot finishes its ride, and drives out of the lift. Raises `OnOtherFloorError`
        for one that goes on, since only the other floor can cancel it, `MissionConflictError` and `StoreError`.
        """
        missions, operator = self._service.missions, self._service.operator
        async with self._giving[robot]:  # what is being given to it is in force then
            if await missions.cancel(robot, who, expected):
                return True
            known = missions.berths.get(robot)
            left = known is not None and known.floor != self._site.id
            away = operator.heard(robot) is None and (left or (known is None and robot not in missions.said))
            if expected is None and (away or missions.standing(robot) == "arrives"):
                coming = self._coming(robot, known, who)
                if coming is not None:
                    await missions.cancel_coming(robot, who, coming)
                    return True
            changed = missions.without_mission(robot, who, expected)
            if known is None or changed is None:
                return False
            if left:
                await self._leave_without(robot, changed, away=away)
            await missions.cancel_carried(robot, known, changed)
            return True

    async def _leave_without(self, robot: str, changed: HandOver, *, away: bool) -> None:
        """Let a robot leave without its mission; raises `OnOtherFloorError` unless it accepts that.

        It may have accepted the hand-over with its mission before: this floor's record is changed afterwards only.
        """
        reason = f"it has left for {changed.floor}, and its mission with it: cancel it there"
        if not away:
            try:
                reply = await self._service.operator.hand_over(robot, changed)
                if reply.accepted:
                    return
                why = reply.reason
            except CommandError as error:
                why = str(error)
            reason += f", or try again here, where it did not accept that: {why}"
        raise OnOtherFloorError(robot, OutOfService(id="floor", reason=reason, by=changed.who, since=0.0))

    def _coming(self, robot: str, known: Berth | None, who: str) -> HandOver | None:
        """Return the hand-over by which a robot is on its way here, as far as a lift shows that; None if none does.

        Raises `OnOtherFloorError` while it may as well be this floor's own, which called the lift to go away.
        """
        for lift in self._site.lifts:
            state = self._lift(lift.id)
            name, _, number = ("" if state is None else state.session_id).rpartition("/")
            if state is None or state.destination_floor != self._site.id or name != robot or not number.isdecimal():
                continue
            if robot not in self._service.missions.said and known is None and state.current_floor == self._site.id:
                reason = f"the lift {lift.id} is here for it, and nothing was heard of it yet: try again once it is"
                raise OnOtherFloorError(robot, OutOfService(id="lift", reason=reason, by=who, since=0.0))
            if (epoch := int(number)) > (0 if known is None else known.epoch):
                others = (floor for floor in lift.floors if floor != self._site.id)
                origin = next(others) if known is None else known.floor
                return HandOver(
                    origin=origin, floor=self._site.id, epoch=epoch, lift=lift.id, goal=OUT, who=who,
                    id=secrets.token_hex(8),
                )  # fmt: skip
        return None

    async def run(self) -> None:
        """Let rides go on, twice a second."""
        async for _ in ticker(self._clock, STEP_S):
            if self._service.leads:
                await self.step()

    async def step(self) -> None:
        """Do what is due for each robot, then ask the lifts."""
        missions = self._service.missions
        robots = {*missions.said, *missions.berths, *missions.goals}
        for robot in robots:
            try:
                await self._step(robot)
            except (StoreError, CommandError) as error:
                _log.warning("ride_delayed", robot=robot, reason=str(error))
        # What is only on its way here keeps its lift until it has been taken in: its stay here is not known before.
        here = {robot for robot in missions.said if missions.standing(robot) == "here"}
        here |= {*missions.berths, *missions.goals}
        for lift in self._site.lifts:
            for robot in here:
                state = self._lift(lift.id)
                if (asked := request(lift.id, robot, self._facts(robot), state, self._site.id)) is not None:
                    self._zenoh.publish(ch.LIFT_REQUEST, asked, lift=lift.id)

    def _lift(self, name: str | None) -> LiftState | None:
        state, at = self._lifts.get(name or "", (None, 0.0))
        return state if self._clock.now() - at <= ch.LIFT_STATE.max_age_s else None

    def _facts(self, robot: str) -> Facts:
        missions = self._service.missions
        berth = missions.berths.get(robot) or Berth(floor=self._site.id)
        stored, pose = missions.goals.get(robot), self._service.poses.get(robot)
        at_goal = stored is not None and missions.at_goal.get(robot) == stored.goal.goal_id
        ride = None if stored is None else stored.ride
        silent = self._clock.now() - self._heard.get(robot, self._created) > SILENT_S
        cabins = cabins_at(self._site.lifts, berth, pose)
        return Facts(berth, ride, at_goal, cabins, inside_of(self._site.lifts, pose), silent)

    async def _step(self, robot: str) -> None:
        missions = self._service.missions
        known, said = missions.berths.get(robot), missions.said.get(robot)
        match missions.standing(robot):
            case "arrives" if said is not None:
                if self._clock.now() - self._service.operator.stopped_at < STOPPED_S:
                    await self._service.operator.send("disable", robot, "stop before it came")
                self._service.poses.pop(robot, None)  # of its last stay here
                await missions.arrive(robot, said)
            case "leaves" if known is not None and known.came_by is not None:
                if self._service.operator.heard(robot) is None:
                    return  # it has gone, or nobody can reach it
                await self._service.operator.hand_over(robot, known.came_by)
            case "here" if known is not None and known.came_by is not None:
                await self._take(robot, known.came_by)
            case "here" if (stored := missions.goals.get(robot)) is not None and stored.ride is not None:
                await self._ride(robot, stored, stored.ride)

    async def _ride(self, robot: str, stored: StoredGoal, ride: Ride) -> None:
        """Send a robot into its lift, or hand it over in there, unless it can't be handed over: then its mission ends.

        It could be when it was ordered there, but may have been started with other software or settings since.
        """
        missions, state = self._service.missions, self._service.operator.heard(robot)
        act = next_act(robot, self._facts(robot), self._lift(ride.lift), self._site.id)
        if act == "wait" or state is None:
            return
        if (found := cannot_leave(robot, state, ride.floor, mission=stored.tour is not None)) is not None:
            await missions.give_up(robot, stored, "cut", found[1])
        elif act == "leave":
            await missions.leave(robot, stored)
        else:
            cabin = next(lift.cabin for lift in self._site.lifts if lift.id == ride.lift)
            await missions.board(robot, stored, cabin)

    async def _take(self, robot: str, given: HandOver) -> None:
        """Give a robot that has come its goal once its lift is here and open; settle once it has left the cabin."""
        name, begun = session(robot, given.epoch), self._service.missions.begun
        pose = self._service.poses.get(robot)
        is_out = pose is not None and pose.localized and given.lift not in self._facts(robot).cabins
        if given.lift is not None and is_out:
            if name not in begun:  # such as one that came long ago, on a floor whose store was restored
                _log.warning("ride_over", robot=robot, epoch=given.epoch, reason="it is not in the cabin: no goal")
        elif name not in begun:
            lift = self._lift(given.lift)
            if given.lift is not None and (lift is None or not lift.serves(name, self._site.id)):
                return
            async with self._giving[robot]:
                await self._give(robot, name, given)
        if given.lift is None or is_out:
            await self._service.missions.settle(robot)
            begun.discard(name)

    async def _give(self, robot: str, name: str, given: HandOver) -> None:
        """Give a robot what it goes on with here, unless it was cancelled meanwhile. Raises `StoreError`."""
        known, goal = self._service.missions.berths.get(robot), given.goal
        if known is None or known.came_by != given:
            return
        stop: Stop | str | None = None
        if goal == OUT:
            waits = (lift.wait for lift in self._site.lifts if lift.id == given.lift)
            stop = next((Stop(pose=pose, any_heading=True) for pose in waits), "its lift is not this floor's")
        elif goal is not None:
            stop = self._resolved(robot, Stop(place=goal.place, pose=goal.pose, any_heading=goal.any_heading))
            if stop is None:
                return  # it is tried again
        begun = self._service.missions.begun
        begun.add(name)
        if isinstance(stop, str):
            _log.warning("ride_without_goal", robot=robot, reason=stop)
        elif stop is not None:
            try:
                await self._send(robot, given, stop)
            except StoreError:
                begun.discard(name)
                raise

    async def _send(self, robot: str, given: HandOver, stop: Stop) -> None:
        assert stop.pose is not None  # it is resolved
        attempt = Attempt.of("floors", given.id or session(robot, given.epoch), "arrival", given)
        order = Order(
            robot,
            stop.pose,
            on_behalf(robot, given),
            place=stop.place,
            any_heading=stop.any_heading,
            attempt=attempt,
            expected=NO_MISSION,
            tour=given.mission,
        )
        try:
            sent = await self._service.send(order)
        except (MissionConflictError, OutOfServiceError) as error:
            _log.info("ride_overruled", robot=robot, reason=str(error))  # an operator was faster
            return
        except IdempotencyError:  # a robot of before, whose record or this floor's was restored
            reason = f"another ride of it had the number {given.epoch} within a day: send it by hand"
            _log.warning("ride_without_goal", robot=robot, reason=reason)
            return
        if isinstance(sent, Refusal):
            _log.warning("ride_without_goal", robot=robot, reason=sent.reason)
