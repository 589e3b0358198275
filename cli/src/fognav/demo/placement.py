"""Puts the barrier of a drive into the simulated world when its moment has come."""

from fog_contracts.messages import SimCommand, SimObstacle, Trace
from fog_contracts.site import AreaSite
from fog_runtime.clock import Clock
from fog_runtime.site import LoadedSite
from fognav.demo.operator import Operator
from fognav.demo.scene import Scene
from fognav.output import WrongUseError
from fognav_sim.drive.evaluation import DriveEvaluation
from fognav_sim.drive.hazard import HazardSchedule, PlannedHazard
from fognav_sim.scenario import ScenarioError, barrier_across


class HazardPlacement:
    """The hazard of one drive: planned, then placed once."""

    def __init__(self, site: LoadedSite, seed: int, scene: Scene) -> None:
        def barrier_in(area: AreaSite) -> SimObstacle:
            return barrier_across(area, site.site, site.map, seed)

        self._scene = scene
        self._schedule = HazardSchedule(site.site, seed, barrier_in)
        self.placed_at: float | None = None
        """Stamp of the moment just before the barrier was placed."""

    @property
    def area(self) -> str | None:
        """Id of the area that is or will be blocked; None before it is drawn."""
        planned = self._schedule.planned
        return planned.area.id if planned is not None else None

    def trace(self) -> Trace | None:
        """Return the way of the placed hazard through the stages, as far as it is known."""
        if self.area is None or self.placed_at is None:
            return None
        return self._scene.traces.earliest(self.area, self.placed_at)

    async def place_if_due(self, operator: Operator, evaluation: DriveEvaluation, clock: Clock) -> None:
        """Place the barrier if its moment has come; raises `WrongUseError` when no area fits the robot's way."""
        path, truth = self._scene.path, self._scene.truth
        if self.placed_at is not None or path is None or truth is None:
            return
        if path.goal_id != evaluation.goal_id or not path.points:
            return
        try:
            if self._schedule.planned is None:
                self._announce(self._schedule.draw(path.points))
            due = self._schedule.due(path.points, evaluation.distance_m, (truth.x, truth.y))
        except ScenarioError as error:
            raise WrongUseError(str(error)) from error
        if due is not None:
            await self._place(due, operator, evaluation, clock)

    def _announce(self, planned: PlannedHazard) -> None:
        where = planned.area.label or planned.area.id
        self._scene.say(f"after {planned.trigger_m:.1f} m something will block {where}, unseen from here")

    async def _place(
        self, planned: PlannedHazard, operator: Operator, evaluation: DriveEvaluation, clock: Clock
    ) -> None:
        stamp = clock.stamp()
        reply = await operator.simulate(SimCommand(place=[planned.barrier]))
        if reply is None or not reply.accepted:
            self._scene.say(f"the barrier could not be placed: {reply.reason if reply else 'no answer'}")
            return
        self.placed_at = stamp
        evaluation.block(planned.area)
        self._scene.phase = "driving, the way is blocked"
        self._scene.say(f"a barrier stands in {planned.area.label or planned.area.id} now")
