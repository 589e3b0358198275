"""Runs the visits: tells them what robots do, gives the missions that they ask for, ends those of nobody."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final, Protocol

from fog_contracts.messages import Pose, Refusal
from fog_runtime import logs
from fog_runtime.clock import ticker
from fog_runtime.stores.redis_connection import StoreError
from planner.planning_map import USUAL_SPEED
from planner.stops import Order
from planner.store import NO_MISSION, VISIT_ENDED, MissionConflictError, OutOfServiceError
from planner.visits import DRIVING, READY_S, Act, Facts, Visit, VisitEnd, Visits, is_free

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fog_contracts.messages import Place, RobotPath, RobotPose, RobotState
    from fog_contracts.site import Site
    from fog_runtime.clock import Clock
    from planner.robot_operator import RobotOperator
    from planner.store import StoredGoal
    from planner.tours.persistence import MissionPersistence

STEP_S: Final = 0.5

_log = logs.get("planner")


class Robots(Protocol):
    """What visits need of the planner's service."""

    operator: RobotOperator
    states: dict[str, RobotState]
    poses: dict[str, RobotPose]

    @property
    def missions(self) -> MissionPersistence:
        """The missions."""

    @property
    def places(self) -> Mapping[str, Place] | None:
        """All places by id; None until the map-service has told them."""

    def path(self, robot: str) -> RobotPath | None:
        """Return a robot's last path or refusal."""

    async def send(self, order: Order) -> StoredGoal | Refusal:
        """Give a robot a mission."""


class Visiting:
    """The visits of a running planner."""

    def __init__(self, service: Robots, site: Site, clock: Clock) -> None:
        """`site` names the robots that serve visitors, and the places until the map-service has told all."""
        self._service = service
        self._places = site.places
        self._clock = clock
        self._tasks: set[asyncio.Task[None]] = set()
        self.visits = Visits(site.visitors.robots)
        service.operator.overruled = service.missions.overruled = self.overruled

    @property
    def places(self) -> dict[str, Place]:
        """The public places by id, as operators have them now."""
        known = self._places if self._service.places is None else self._service.places
        return {name: place for name, place in known.items() if place.public}

    def now(self) -> float:
        """Return the time of visits (s, monotonic)."""
        return self._clock.now()

    def overruled(self, robot: str) -> None:
        """Somebody has commanded the robot, or changed its mission: end its visit, and the visit's mission."""
        self.visits.commanded(robot, self.now())
        self.step()

    def on_state(self, robot: str, state: RobotState) -> None:
        """Use a robot's state, which has just arrived."""
        self.visits.on_state(robot, state, self.now())

    async def run(self) -> None:
        """Let visits go on, twice a second."""
        async for _ in ticker(self._clock, STEP_S):
            self.step()

    def step(self) -> None:
        """Begin what is to be done now."""
        for act in self.visits.step(self.now(), self._fleet(), self.places):
            task = asyncio.get_running_loop().create_task(self._do(act), name="visit")
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    def _fleet(self) -> dict[str, Facts]:
        service, found = self._service, {}
        for robot in {*service.states, *service.missions.goals}:
            stored, path, pose = service.missions.goals.get(robot), service.path(robot), service.poses.get(robot)
            state = service.operator.heard(robot)
            found[robot] = Facts(
                mission=None if stored is None or stored.goal.idle else stored.goal.goal_id,
                of_visit=stored is not None and stored.visit,
                refused=path is not None and path.refusal is not None,
                heard=state is not None and not service.operator.is_doubled(robot),
                free=state is not None
                and pose is not None
                and pose.localized
                and is_free(state)
                and service.missions.out_of_service(robot) is None,
                x=0.0 if pose is None else pose.x,
                y=0.0 if pose is None else pose.y,
            )
        return found

    async def _do(self, act: Act) -> None:
        outcome: str | VisitEnd = VisitEnd.FAILED
        try:
            if act.visit is None:
                await self._service.missions.cancel(act.robot, act.who or act.robot, act.mission, action=VISIT_ENDED)
            else:
                outcome = await self._send(act, act.visit)
        except (MissionConflictError, OutOfServiceError):
            outcome = VisitEnd.OPERATOR
        except StoreError as error:
            _log.error("visit_not_stored", robot=act.robot, reason=str(error))
        finally:
            self.visits.done(act, outcome, self.now())
        if act.visit is not None:
            _log.info("visit_ordered", visit=act.visit.id, robot=act.robot, place=act.place, outcome=outcome)
            self.step()  # ended meanwhile: the robot must not drive for it

    async def _send(self, act: Act, visit: Visit) -> str | VisitEnd:
        place = self.places.get(act.place)
        if place is None:
            return VisitEnd.PLACE
        who, pose = f"visitor {visit.name}", Pose(x=place.x, y=place.y, theta=place.theta or 0.0)
        order = Order(
            act.robot, pose, who, place=act.place, any_heading=place.theta is None, expected=NO_MISSION,
            action="visit", visit=True,
        )  # fmt: skip
        sent = await self._service.send(order)
        return VisitEnd.NO_WAY if isinstance(sent, Refusal) else sent.goal.goal_id

    def rest(self, visit: Visit) -> tuple[float | None, float | None]:
        """Return how far the robot still has to drive (m), and how long that takes, or how long it waits (s)."""
        if visit.state == "ready":
            return None, max(0.0, READY_S - (self.now() - visit.since))
        state = self._service.states.get(visit.robot or "")
        if visit.state not in DRIVING or state is None or state.goal_id != visit.mission or state.goal_distance is None:
            return None, None
        return state.goal_distance, state.goal_distance / USUAL_SPEED
