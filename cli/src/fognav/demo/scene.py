"""The latest state of the system, collected from all channels for the terminal, the page and the report."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

from fog_contracts.messages import (
    HazardArea,
    RobotGoal,
    RobotObstacles,
    RobotPath,
    RobotPose,
    RobotState,
    SimTruth,
    Trace,
)
from fog_contracts.stages import Traces, durations_ms, hazard_to_path_ms
from fog_runtime.configuration.site import LoadedSite
from fognav_sim.drive.drive import DriveOutcome

_EVENTS: Final = 200
_TRAIL: Final = 20_000
_TRAIL_STEP_M: Final = 0.1


@dataclass
class Scene:
    """The latest message of each channel and the log of events; used on the event loop's thread only."""

    site: LoadedSite
    robot: str
    seed: int
    speed: float
    phase: str = "starting"
    page_url: str = ""
    hint: str = ""
    """How to operate the system, once it runs."""
    pose: RobotPose | None = None
    truth: SimTruth | None = None
    state: RobotState | None = None
    path: RobotPath | None = None
    goal: RobotGoal | None = None
    obstacles: RobotObstacles | None = None
    hazards: dict[str, HazardArea] = field(default_factory=dict)
    traces: Traces = field(default_factory=Traces)
    trace: Trace | None = None
    usage: dict[str, tuple[float, float]] = field(default_factory=dict)
    outcome: DriveOutcome | None = None
    events: deque[tuple[float, str]] = field(default_factory=lambda: deque(maxlen=_EVENTS))
    trail: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=_TRAIL))
    on_event: Callable[[str], None] | None = None
    started_at: float = field(default_factory=time.monotonic)

    def log_event(self, text: str) -> None:
        """Append a line to the log of events."""
        self.events.append((time.monotonic() - self.started_at, text))
        if self.on_event is not None:
            self.on_event(text)

    def on_truth(self, truth: SimTruth) -> None:
        """Record the ground truth, and extend the trail."""
        self.truth = truth
        last = self.trail[-1] if self.trail else None
        if last is None or abs(last[0] - truth.x) + abs(last[1] - truth.y) >= _TRAIL_STEP_M:
            self.trail.append((round(truth.x, 2), round(truth.y, 2)))

    def situation(self) -> str:
        """Return the last states of robot and areas, for error messages."""
        robot = (
            f"the robot is in {self.state.mode}: {'; '.join(self.state.reasons)}"
            if self.state
            else "no state received from the robot"
        )
        areas = ", ".join(f"{area} {hazard.hazard.state}" for area, hazard in self.hazards.items())
        return f"{robot}; areas: {areas or 'no state received'}"

    def scenario_view(self, trail_from: int = 0) -> dict[str, Any]:
        """Return what the console's page does not know by itself as JSON values; the trail begins at a point's number.

        A number beyond the trail's end is another attempt's: then all of it is sent.
        """
        truth, first = self.truth, trail_from if 0 <= trail_from <= len(self.trail) else 0
        return {
            "phase": self.phase,
            "speed": self.speed,
            "seed": self.seed,
            "distance": truth and round(truth.distance, 1),
            "clearance": truth and round(truth.clearance, 2),
            "barriers": [o.polygon for o in truth.obstacles] if truth else [],
            "stages": durations_ms(self.trace),
            "hazard_to_path": hazard_to_path_ms(self.trace),
            "processes": {name: [round(cpu, 1), round(rss, 1)] for name, (cpu, rss) in self.usage.items()},
            "outcome": self.outcome and [self.outcome.kind, self.outcome.reason],
            "events": [[round(at, 1), text] for at, text in list(self.events)[-30:]],
            "trail_from": first,
            "trail": list(self.trail)[first:],
        }
