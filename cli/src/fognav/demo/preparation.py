"""What happens before a drive: the robot localizes, every area becomes clear, it is enabled, and gets its goal."""

import asyncio
import time
from collections.abc import Callable
from typing import Final

from fog_runtime.clock import Clock
from fognav.demo.background import Background
from fognav.demo.operator import Operator
from fognav.demo.options import DrivePlan
from fognav.demo.scene import Scene
from fognav_sim.drive.evaluation import DriveOutcome
from robot_agent.config import SafetyConfig
from robot_agent.safety.gate import IMMEDIATE_STOP_MODES

TRUTH_S: Final = 90.0
"""Real seconds until the simulator speaks."""
LOCALIZED_S: Final = 60.0
AREAS_S: Final = 30.0
ENABLED_S: Final = 60.0
GOAL_S: Final = 60.0
_HEALTHY_S: Final = SafetyConfig().relax_after + 0.5
"""A robot that lacked something within this time would begin its drive in a stop; the margin is its states' period."""
_SETTLE_S: Final = 10.0
"""After so long (s of the clock) a robot that is not quite well is enabled too: it says itself why it refuses."""
_RETRY_S: Final = 0.1


class Preparation:
    """The phases before a drive. Those that wait raise `TimeoutError` with what was going on."""

    def __init__(self, plan: DrivePlan, scene: Scene, operator: Operator, clock: Clock, background: Background) -> None:
        self._plan = plan
        self._scene = scene
        self._operator = operator
        self._clock = clock
        self._background = background

    async def make_ready(self) -> None:
        """Wait until the robot is localized, every watched area clear, and the robot enabled."""
        scene, clock, operator = self._scene, self._clock, self._operator
        operator.held_back = True
        scene.phase = "localizing"
        await self._until(lambda: scene.truth is not None, TRUTH_S, "the simulator published the truth")
        await self._until(
            lambda: scene.pose is not None and scene.pose.localized, LOCALIZED_S, "the robot was localized"
        )
        scene.say("robot: it knows where it is")
        # An area whose node was not heard yet is unknown, and the planner avoids it.
        scene.phase = "waiting for the nodes"
        await self._until(self._all_clear, AREAS_S, "every watched area was known to be clear")
        scene.say(f"nodes: all {len(self._plan.watched_areas)} watched areas are clear")
        scene.phase = "enabling"
        settled = clock.now() + _SETTLE_S
        await self._until(
            lambda: operator.ready_s >= _HEALTHY_S or clock.now() > settled, ENABLED_S, "the robot was well"
        )
        operator.held_back = False
        await self._until(self._is_enabled, ENABLED_S, "it was enabled")

    async def send_goal(self) -> DriveOutcome | None:
        """Give the goal to the planner, patiently while it can't answer; return how it ended if it does not take it."""
        self._scene.phase = "sending the goal"
        deadline = time.monotonic() + GOAL_S
        while True:
            try:
                answer = await self._operator.put_goal(self._plan.place)
                problem = f"HTTP {answer.status}: {answer.reason}"
                if answer.status < 300:
                    break
                if answer.status < 500:
                    return DriveOutcome("refused", f"the planner does not take the goal: {problem}")
            except OSError as error:
                problem = str(error)
            if time.monotonic() > deadline:
                return DriveOutcome("stopped", f"the planner took no goal for {GOAL_S:.0f} s: {problem}")
            await asyncio.sleep(_RETRY_S)
        scene = self._scene
        scene.say(f"operator: drive to {self._plan.goal.label or self._plan.place}")
        await self._until(
            lambda: scene.goal is not None and scene.goal.pose is not None, GOAL_S, "the planner published the goal"
        )
        return None

    async def _until(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        await self._background.until(condition, timeout_s, what, self._scene.situation)

    def _all_clear(self) -> bool:
        states = {area: hazard.hazard.state for area, hazard in self._scene.hazards.items()}
        return all(states.get(area) == "clear" for area in self._plan.watched_areas)

    def _is_enabled(self) -> bool:
        state = self._scene.state
        return state is not None and state.enabled and state.mode not in IMMEDIATE_STOP_MODES
