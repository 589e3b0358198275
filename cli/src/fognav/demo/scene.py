"""The latest state of the system, collected from all channels for the terminal, the page and the report."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from fog_contracts.costs import ROBOT_RADIUS, UNKNOWN
from fog_contracts.grid import StaticMap
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
    event_count: int = 0
    """Number of all events so far."""
    on_event: Callable[[str], None] | None = None
    started_at: float = field(default_factory=time.monotonic)

    def log_event(self, text: str) -> None:
        """Append a line to the log of events."""
        self.events.append((time.monotonic() - self.started_at, text))
        self.event_count += 1
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

    def static_view(self) -> dict[str, Any]:
        """Return the static part of the scene (map, areas, nodes, places) as JSON values for the page."""
        geometry = self.site.map.geometry
        site = self.site.site
        return {
            "site": site.name or site.id,
            "robot": self.robot,
            "radius": next((r.radius for r in site.robots if r.id == self.robot), ROBOT_RADIUS),
            "seed": self.seed,
            "map": {
                "width": geometry.width,
                "height": geometry.height,
                "resolution": geometry.resolution,
                "x": geometry.origin_x,
                "y": geometry.origin_y,
            },
            "extent": _extent(self.site.map),
            "areas": [{"id": a.id, "label": a.label or a.id, "polygon": a.polygon} for a in site.areas],
            "nodes": [
                {"id": n.id, "x": n.x, "y": n.y, "beams": [[n.theta + s.angle, s.range_limit] for s in n.sonars]}
                for n in site.nodes
            ],
            "places": [{"id": i, "label": p.label or i, "x": p.x, "y": p.y} for i, p in site.places.items()],
        }

    def live_view(self) -> dict[str, Any]:
        """Return the changing part of the scene as JSON values for the page."""
        pose, truth, state, path = self.pose, self.truth, self.state, self.path
        return {
            "phase": self.phase,
            "speed": self.speed,
            "pose": pose and [round(pose.x, 3), round(pose.y, 3), round(pose.theta, 3), round(pose.v, 3)],
            "localized": bool(pose and pose.localized),
            "truth": truth and [round(truth.x, 3), round(truth.y, 3), round(truth.theta, 3)],
            "distance": truth and round(truth.distance, 1),
            "clearance": truth and round(truth.clearance, 2),
            "barriers": [o.polygon for o in truth.obstacles] if truth else [],
            "mode": state.mode if state else "",
            "reasons": list(state.reasons[:4]) if state else [],
            "battery": state.battery if state else None,
            "goal": self.goal and self.goal.pose and [self.goal.pose.x, self.goal.pose.y],
            "goal_distance": state and state.goal_distance,
            "path": [[round(x, 2), round(y, 2)] for x, y in path.points] if path else [],
            "released": path.released_length if path else 0.0,
            "refusal": path.refusal.reason if path and path.refusal else "",
            "hazards": {area: hazard.hazard.state for area, hazard in self.hazards.items()},
            "unconfirmed": [area for area, hazard in self.hazards.items() if not hazard.confirmed],
            "obstacles": [[round(x, 2), round(y, 2)] for x, y in self.obstacles.points] if self.obstacles else [],
            "stages": durations_ms(self.trace),
            "hazard_to_path": hazard_to_path_ms(self.trace),
            "processes": {name: [round(cpu, 1), round(rss, 1)] for name, (cpu, rss) in self.usage.items()},
            "outcome": self.outcome and [self.outcome.kind, self.outcome.reason],
            "event_count": self.event_count,
            "events": [[round(at, 1), text] for at, text in list(self.events)[-30:]],
        }


def _extent(static: StaticMap) -> list[float]:
    """Return left, bottom, right and top (m) of the known part of the map: some maps have wide unknown margins."""
    known = static.cells != UNKNOWN
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    g = static.geometry
    if rows.size == 0:
        return list(g.bounds)
    x = [g.origin_x + edge * g.resolution for edge in (int(columns[0]), int(columns[-1]) + 1)]
    y = [g.origin_y + edge * g.resolution for edge in (int(rows[0]), int(rows[-1]) + 1)]
    return [x[0], y[0], x[1], y[1]]
