"""The preparation of a drive: the robot localizes, every area becomes clear, the robot is enabled and gets its goal."""

import asyncio
import time
from collections.abc import Callable, Coroutine
from types import TracebackType
from typing import Any, Final, Self

from fog_contracts.commands import PROFILE_OF
from fog_contracts.messages import ProfileName
from fog_runtime.clock import Clock
from fognav.demo.operator import Operator
from fognav.demo.options import DrivePlan
from fognav.demo.scene import Scene
from fognav_sim.drive.drive import DriveOutcome
from robot_agent.config import SafetyConfig
from robot_agent.safety.gate import IMMEDIATE_STOP_MODES

_PERIOD_S: Final = 0.05


class Background:
    """Runs coroutines as tasks beside the body of its context, and cancels them at its end."""

    def __init__(self, *coroutines: Coroutine[Any, Any, None]) -> None:
        self._coroutines = coroutines
        self._tasks: list[asyncio.Task[None]] = []

    async def __aenter__(self) -> Self:
        self._tasks = [asyncio.create_task(coroutine) for coroutine in self._coroutines]
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def check(self) -> None:
        """Raise the exception of a task that has failed."""
        for task in self._tasks:
            if task.done():
                task.result()

    async def until(
        self, condition: Callable[[], bool], timeout_s: float, description: str, situation: Callable[[], str]
    ) -> None:
        """Wait until the condition holds; raises `TimeoutError` with the situation after `timeout_s` real seconds."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            self.check()
            if time.monotonic() > deadline:
                raise TimeoutError(f"timeout after {timeout_s:.0f} s, waiting until {description}; {situation()}")
            await asyncio.sleep(_PERIOD_S)


TRUTH_S: Final = 90.0
"""Real seconds until the simulator publishes."""
LOCALIZED_S: Final = 60.0
AREAS_S: Final = 30.0
ENABLED_S: Final = 60.0
GOAL_S: Final = 60.0
PROFILE_S: Final = 30.0
_READY_FOR_S: Final = SafetyConfig().relax_after + 0.5
"""How long the robot must be ready before it is enabled, or its drive would begin in a protective stop; the margin is
the period of its states."""
_READY_TIMEOUT_S: Final = 10.0
"""After this time (s of the clock) a robot that is not ready is enabled too: its refusal gives the reason."""
_RETRY_S: Final = 0.1


class Preparation:
    """The phases before a drive. Those that wait raise `TimeoutError` with the situation."""

    def __init__(self, plan: DrivePlan, scene: Scene, operator: Operator, clock: Clock, background: Background) -> None:
        self._plan = plan
        self._scene = scene
        self._operator = operator
        self._clock = clock
        self._background = background

    async def make_ready(self) -> None:
        """Wait until the robot is localized, every watched area clear, and the robot enabled."""
        scene, clock, operator = self._scene, self._clock, self._operator
        operator.enabling_paused = True
        scene.phase = "localizing"
        await self._until(lambda: scene.truth is not None, TRUTH_S, "the ground truth is received")
        await self._until(
            lambda: scene.pose is not None and scene.pose.localized, LOCALIZED_S, "the robot is localized"
        )
        scene.log_event("robot: localized")
        # An area is unknown until its node has published, and the planner avoids it.
        scene.phase = "waiting for the sensor nodes"
        await self._until(self._all_clear, AREAS_S, "all watched areas are clear")
        scene.log_event(f"nodes: all {len(self._plan.watched_areas)} watched areas are clear")
        if self._plan.options.profile != "fog":
            await self._choose(self._plan.options.profile)
        scene.phase = "enabling"
        deadline = clock.now() + _READY_TIMEOUT_S
        await self._until(
            lambda: operator.ready_s >= _READY_FOR_S or clock.now() > deadline,
            ENABLED_S,
            "the robot is ready to be enabled",
        )
        operator.enabling_paused = False
        await self._until(self._is_enabled, ENABLED_S, "the robot is enabled")

    async def _choose(self, profile: ProfileName) -> None:
        """Let the robot navigate by another profile, which it accepts while it is disabled; raises `TimeoutError`."""
        kind = next(command for command, name in PROFILE_OF.items() if name == profile)
        deadline, problem = time.monotonic() + PROFILE_S, "no reply from the robot"
        while (reply := await self._operator.command(kind)) is None or not reply.accepted:
            problem = problem if reply is None else reply.reason
            if time.monotonic() > deadline:
                raise TimeoutError(f"the robot does not change to the profile {profile}: {problem}")
            await asyncio.sleep(_RETRY_S)
        self._scene.log_event(f"operator: profile {profile}")

    async def send_goal(self) -> DriveOutcome | None:
        """Send the goal to the planner, again while it is unavailable; return the outcome if it is not accepted."""
        self._scene.phase = "sending the goal"
        deadline = time.monotonic() + GOAL_S
        while True:
            try:
                answer = await self._operator.put_goal(self._plan.place)
                problem = f"HTTP {answer.status}: {answer.reason}"
                if answer.status < 300:
                    break
                if answer.status < 500:
                    return DriveOutcome("refused", f"the planner refused the goal: {problem}")
            except OSError as error:
                problem = str(error)
            if time.monotonic() > deadline:
                return DriveOutcome("stopped", f"the planner was unavailable for {GOAL_S:.0f} s: {problem}")
            await asyncio.sleep(_RETRY_S)
        scene = self._scene
        scene.log_event(f"operator: drive to {self._plan.goal.label or self._plan.place}")
        await self._until(
            lambda: scene.goal is not None and scene.goal.pose is not None, GOAL_S, "the planner publishes the goal"
        )
        return None

    async def _until(self, condition: Callable[[], bool], timeout_s: float, description: str) -> None:
        await self._background.until(condition, timeout_s, description, self._scene.situation)

    def _all_clear(self) -> bool:
        states = {area: hazard.hazard.state for area, hazard in self._scene.hazards.items()}
        return all(states.get(area) == "clear" for area in self._plan.watched_areas)

    def _is_enabled(self) -> bool:
        state = self._scene.state
        return state is not None and state.enabled and state.mode not in IMMEDIATE_STOP_MODES
