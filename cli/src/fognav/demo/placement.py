"""Places the barrier of a drive in the simulated world when it is due."""

from fog_contracts.messages import SimCommand, Trace
from fog_runtime.clock import Clock
from fognav.demo.operator import Operator
from fognav.demo.scene import Scene
from fognav.output import WrongUseError
from fognav_sim.barrier import BarrierError
from fognav_sim.drive.drive import Drive
from fognav_sim.drive.hazard import PlannedHazard


class HazardPlacement:
    """Places the barrier of one drive, once."""

    def __init__(self, drive: Drive, scene: Scene, operator: Operator, clock: Clock) -> None:
        self._drive = drive
        self._scene = scene
        self._operator = operator
        self._clock = clock
        self._announced_area = ""
        self._placed: tuple[str, float] | None = None
        """Id of the blocked area, and stamp of the moment just before its barrier was placed."""

    def trace(self) -> Trace | None:
        """Return the trace of the placed hazard through its stages, as far as it is known."""
        return self._scene.traces.earliest(*self._placed) if self._placed is not None else None

    async def place_if_due(self) -> None:
        """Place the barrier if it is due; raises `WrongUseError` if no area on the robot's path qualifies."""
        try:
            due = self._drive.hazard_due()
        except BarrierError as error:
            raise WrongUseError(str(error)) from error
        planned = self._drive.hazard.planned if self._drive.hazard is not None else None
        if planned is not None and planned.area.id != self._announced_area:
            self._announced_area = planned.area.id
            self._scene.log_event(
                f"scenario: a barrier will block {_label(planned)} after {planned.trigger_m:.1f} m, out of the robot's "
                "sight"
            )
        if due is not None:
            await self._place(due)

    async def _place(self, planned: PlannedHazard) -> None:
        stamp = self._clock.stamp()
        reply = await self._operator.simulate(SimCommand(place=[planned.barrier]))
        if reply is None or not reply.accepted:
            self._scene.log_event(
                f"scenario: the barrier could not be placed: {reply.reason if reply else 'no reply from the simulator'}"
            )
            return
        self._placed = planned.area.id, stamp
        self._drive.on_barrier_placed(planned)
        self._scene.phase = "driving around the barrier"
        self._scene.log_event(f"scenario: a barrier now blocks {_label(planned)}")


def _label(planned: PlannedHazard) -> str:
    return planned.area.label or planned.area.id
