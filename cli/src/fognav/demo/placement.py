"""Places the barrier of a drive in the simulated world when it is due."""

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
        def make_barrier(area: AreaSite) -> SimObstacle:
            return barrier_across(area, site.site, site.map, seed)

        self._scene = scene
        self._schedule = HazardSchedule(site.site, seed, make_barrier)
        self.placed_at: float | None = None
        """Stamp of the moment just before the barrier was placed."""

    @property
    def area(self) -> str | None:
        """Id of the area that is or will be blocked; None before it is chosen."""
        planned = self._schedule.planned
        return planned.area.id if planned is not None else None

    def trace(self) -> Trace | None:
        """Return the trace of the placed hazard through its stages, as far as it is known."""
        if self.area is None or self.placed_at is None:
            return None
        return self._scene.traces.earliest(self.area, self.placed_at)

    async def place_if_due(self, operator: Operator, evaluation: DriveEvaluation, clock: Clock) -> None:
        """Place the barrier if it is due; raises `WrongUseError` if no area on the robot's path qualifies."""
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
        area = planned.area.label or planned.area.id
        self._scene.log_event(
            f"scenario: a barrier will block {area} after {planned.trigger_m:.1f} m, out of the robot's sight"
        )

    async def _place(
        self, planned: PlannedHazard, operator: Operator, evaluation: DriveEvaluation, clock: Clock
    ) -> None:
        stamp = clock.stamp()
        reply = await operator.simulate(SimCommand(place=[planned.barrier]))
        if reply is None or not reply.accepted:
            self._scene.log_event(
                f"scenario: the barrier could not be placed: {reply.reason if reply else 'no reply from the simulator'}"
            )
            return
        self.placed_at = stamp
        evaluation.block(planned.area)
        self._scene.phase = "driving around the barrier"
        self._scene.log_event(f"scenario: a barrier now blocks {planned.area.label or planned.area.id}")
