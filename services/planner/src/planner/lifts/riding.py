"""Runs the rides: calls lifts, sends robots into them, hands them over, and takes those that come."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Protocol

from msgspec import structs

from fog_contracts import channels as ch
from fog_contracts.messages import Berth, LiftState, Pose, Refusal, Stop
from fog_runtime import logs
from fog_runtime.clock import ticker
from fog_runtime.http import ProblemError
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import Attempt, IdempotencyError
from planner.lifts.persistence import on_behalf
from planner.lifts.rides import Facts, cabins_at, cannot_leave, inside_of, lift_to, next_act, request, session
from planner.problems import PlannerProblem
from planner.robot_operator import CommandError
from planner.stops import Order, Ride
from planner.store import NO_MISSION, MissionConflictError, OutOfServiceError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fog_contracts.messages import FloorGoal, HandOver, Place, RobotPose, RobotState
    from fog_contracts.site import Site
    from fog_runtime.clock import Clock
    from fog_runtime.transports.zenoh_edge import ZenohEdge
    from planner.lifts.persistence import RidePersistence
    from planner.robot_operator import RobotOperator
    from planner.store import StoredGoal

STEP_S: Final = 0.5
SILENT_S: Final = 60.0
"""A robot that was not heard for so long holds no lift any more: a restart takes less."""
STOPPED_S: Final = 120.0
"""A robot that comes so soon after anybody has stopped robots here is stopped, too: the stop may have missed it."""

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

    def leg_to(self, robot: str, stop: Stop, who: str) -> tuple[Stop, Ride | None] | str:
        """Return where a robot goes for a stop: there, or to the nearest lift to its floor; or why it can't."""
        if stop.floor in (None, self._site.id):
            found = self._resolved(stop)
            return found if isinstance(found, str) else (found, None)
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

    def _resolved(self, stop: Stop) -> Stop | str:
        """Return a stop of this floor with a pose; or, for a place that does not exist, that there is none."""
        if stop.pose is not None:
            return stop
        known = self._site.places if self._service.places is None else self._service.places
        place = known.get(stop.place or "")
        if place is None:
            return f"there is no place {stop.place}"
        pose = Pose(x=place.x, y=place.y, theta=place.theta or 0.0)
        return structs.replace(stop, pose=pose, any_heading=place.theta is None)

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
            begun.add(name)
            if given.goal is not None:
                try:
                    await self._send(robot, given, given.goal)
                except StoreError:
                    begun.discard(name)
                    raise
        if given.lift is None or is_out:
            await self._service.missions.settle(robot)
            begun.discard(name)

    async def _send(self, robot: str, given: HandOver, goal: FloorGoal) -> None:
        stop = self._resolved(Stop(place=goal.place, pose=goal.pose, any_heading=goal.any_heading))
        if isinstance(stop, str):
            _log.warning("ride_without_goal", robot=robot, reason=stop)
            return
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
