"""One demonstration from start to verdict, and the report of it."""

import asyncio
import contextlib
import math
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from fog_contracts.messages import SimCommand, SimObstacle
from fog_contracts.site import AreaSite
from fog_runtime.clock import SystemClock
from fog_runtime.site import LoadedSite
from fog_runtime.zenoh_edge import ZenohEdge
from fog_supervisor.supervisor import Event
from fognav.demo import usage
from fognav.demo.danger import Danger, NoDangerError, along, choose, may_appear
from fognav.demo.judge import Judge, Verdict, hazard_to_path_ms, stages_ms
from fognav.demo.operator import Operator
from fognav.demo.scene import Scene
from fognav.output import WrongUseError
from fognav.recording import recording
from fognav.stack import WATCHDOG, Stack, StackConfig
from fognav_sim.scenario import barrier_across
from robot_agent.config import SafetyConfig
from robot_agent.safety.gate import STOP_AT_ONCE

READY_S: Final = 90.0
"""Real seconds for everything to start."""
LOCALIZED_S: Final = 60.0
AREAS_S: Final = 30.0
ENABLED_S: Final = 60.0
_HEALTHY_S: Final = SafetyConfig().relax_after + 0.5
"""A robot that lacked something within this time would begin its drive in a stop; the margin is its states' period."""
_SETTLE_S: Final = 10.0
"""After so long (s of the clock) a robot that is not quite well is enabled too: it says itself why it refuses."""
GOAL_S: Final = 60.0
_TICK_S: Final = 0.1
_USAGE_S: Final = 1.0
_SLOWEST_MPS: Final = 0.08
"""Mean speed (way, standing and detours together) below which a drive is given up."""
_DETOUR: Final = 3.0
_TIMEOUT_BASE_S: Final = 180.0

_SPEED_CHECK_S: Final = 2.0
_SPEED_STRIKES: Final = 2
_SPEED_SHARE: Final = 0.93
"""Share of the asked speed that the simulator must keep."""
_LATE_PER_S: Final = 3.0
"""Late beats per second of the agent's loops (25 are due) from which on it can't keep up."""
_SLOWER: Final = 0.7


@dataclass(frozen=True, kw_only=True)
class Options:
    """What `fognav demo` was asked for."""

    seed: int = 1
    speed: float = 1.0
    hazard: bool = True
    keep_running: bool = False
    record: Path | None = None


class _TooFastError(Exception):
    def __init__(self, sustained: float, why: str) -> None:
        super().__init__(why)
        self.sustained = sustained


@contextlib.asynccontextmanager
async def _background(*works: Coroutine[Any, Any, None]) -> AsyncIterator[list[asyncio.Task[None]]]:
    """Run the works beside the body, and end them with it."""
    tasks = [asyncio.create_task(work) for work in works]
    try:
        yield tasks
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


class Demo:
    """A demonstration; `scene` always shows the attempt that runs."""

    def __init__(self, site: LoadedSite, options: Options, on_event: Callable[[str], None] | None = None) -> None:
        self.site = site
        self.options = options
        self.stack: Stack | None = None
        """The stack of the attempt that runs: tests kill its processes."""
        self._on_event = on_event
        demo = site.site.demo
        if demo is None:
            raise WrongUseError(f"{site.directory}/site.toml has no [demo]: name a start, a goal and areas there")
        if not site.site.robots:
            raise WrongUseError(f"{site.directory}/site.toml has no [[robots]]: say where the robot starts")
        self._hazard = options.hazard and bool(demo.areas)
        self._place = demo.goal
        self._goal = site.site.places[demo.goal]
        self.robot = site.site.robots[0].id
        self.page_url = ""
        self.scene = self._new_scene(options.speed)
        self._given_up: list[dict[str, object]] = []
        self._reset()

    def _new_scene(self, speed: float) -> Scene:
        scene = Scene(self.site, self.robot, self.options.seed, speed, page_url=self.page_url)
        scene.on_event = self._on_event
        return scene

    def _reset(self) -> None:
        self._judge: Judge | None = None
        self._usage = usage.Usage()
        self._danger: Danger | None = None
        self._blocked_at: float | None = None
        self._ended_at: float | None = None
        self._restarts: dict[str, int] = {}
        self._strikes = 0
        self._late_beats = 0
        self._stops_seen = 0
        self._speeds: list[float] = []

    # --- attempts ---------------------------------------------------------------------------------------------------

    async def run(self, stop: asyncio.Event) -> dict[str, object]:
        """Run until the verdict, or until `stop` is set; return the report. Everything is ended on return.

        Raises `NotReadyError` when a process does not start, and `WrongUseError` when the site can't be used so.
        """
        speed = self.options.speed
        self._given_up.clear()
        while True:
            self._reset()
            self.scene = self._new_scene(speed)
            try:
                await self._until_stop(stop, speed)
            except _TooFastError as slow:
                slower = max(1.0, round(min(speed * _SLOWER, slow.sustained), 1))
                self._given_up.append({"speed": speed, "why": str(slow), "modes": self._modes()})
                self.scene.say(f"speed {speed:g} is too much for this machine ({slow}): once more at {slower:g}")
                speed = slower
                continue
            return self.report()

    async def _until_stop(self, stop: asyncio.Event, speed: float) -> None:
        attempt = asyncio.create_task(self._attempt(speed, stop))
        stopped = asyncio.create_task(stop.wait())
        try:
            await asyncio.wait({attempt, stopped}, return_when=asyncio.FIRST_COMPLETED)
            # An attempt that keeps running sees the stop itself.
            if not attempt.done() and self.scene.verdict is None:
                self._end(Verdict("stopped", "interrupted; all processes are being ended"))
                attempt.cancel()
            await asyncio.wait({attempt})
            if not attempt.cancelled():
                attempt.result()
        finally:
            stopped.cancel()
            attempt.cancel()
            await asyncio.gather(attempt, stopped, return_exceptions=True)

    async def _attempt(self, speed: float, stop: asyncio.Event) -> None:
        clock = SystemClock(speed)
        config = StackConfig(site_dir=self.site.directory, robot=self.robot, seed=self.options.seed, speed=speed)
        async with Stack(config, self._on_process) as stack, self._keeping_logs(stack):
            self.stack = stack
            if self.options.hazard and not self._hazard:
                self.scene.say("the site's [demo] lists no areas: nothing will be blocked")
            self.scene.say(f"starting {len(stack.supervisor.names)} processes, logs in {stack.folder / 'logs'}")
            await stack.start_servers(READY_S)
            async with contextlib.AsyncExitStack() as ends:
                if self.options.record is not None:
                    # From before the first word of any service: a file that lacks the map's first versions is no
                    # input for a replay. A session of its own, since what is recorded is what any listener hears.
                    ears = await ends.enter_async_context(self._open(stack, clock, "record"))
                    numbers = [area.number for area in self.site.site.areas if area.number is not None]
                    await ends.enter_async_context(
                        recording(
                            self.options.record, mqtt_url=stack.mqtt_url, zenoh=ears, clock=clock, numbers=numbers
                        )
                    )
                await stack.start_system(READY_S)
                edge = await ends.enter_async_context(self._open(stack, clock, "demo"))
                operator = Operator(edge, stack, self.scene, clock)
                async with _background(operator.keep_enabled(), self._sample(stack)) as tasks:
                    await self._drive(operator, clock, tasks)
                    if self.options.keep_running:
                        self.scene.say("still running: Ctrl-C ends everything")
                        await stop.wait()

    @contextlib.asynccontextmanager
    async def _keeping_logs(self, stack: Stack) -> AsyncIterator[None]:
        """Keep the logs of an attempt that went wrong by itself."""
        try:
            yield
        except (asyncio.CancelledError, _TooFastError, WrongUseError):
            raise
        except Exception:
            stack.keep_files = True
            raise
        else:
            stack.keep_files = not self.success()
        finally:
            if stack.keep_files:
                self.scene.say(f"its logs are kept in {stack.folder / 'logs'}")

    def _open(self, stack: Stack, clock: SystemClock, name: str) -> contextlib.AbstractAsyncContextManager[ZenohEdge]:
        site = self.site.site.id
        return ZenohEdge.open(connect=[stack.zenoh_endpoint], clock=clock, role="console", id=name, site=site)

    def _on_process(self, event: Event) -> None:
        if event.what == "died":
            self._restarts[event.program] = self._restarts.get(event.program, 0) + 1
            self.scene.say(f"{event.program} died ({event.detail})")
        elif event.what == "started" and event.program in self._restarts:
            self.scene.say(f"{event.program} was started again")

    async def _sample(self, stack: Stack) -> None:
        while True:
            pids = stack.pids()
            if watchdog := pids.get(WATCHDOG):
                for child in usage.children(watchdog)[:1]:
                    pids["robot-guardian"] = child
            self._usage.sample(pids)
            self.scene.usage = self._usage.recent()
            await asyncio.sleep(_USAGE_S)

    # --- one drive --------------------------------------------------------------------------------------------------

    async def _drive(self, operator: Operator, clock: SystemClock, tasks: list[asyncio.Task[None]]) -> None:
        scene = self.scene
        operator.held_back = True
        scene.phase = "localizing"
        await self._until(lambda: scene.truth is not None, READY_S, "the simulator said what is so", tasks)
        localized = "the robot knew its place"
        await self._until(lambda: scene.pose is not None and scene.pose.localized, LOCALIZED_S, localized, tasks)
        scene.say("robot: it knows where it is")
        # An area whose node was not heard yet is unknown, and the planner avoids it.
        scene.phase = "waiting for the nodes"
        await self._until(self._all_clear, AREAS_S, "every watched area was known to be clear", tasks)
        scene.say(f"nodes: all {len(self._watched())} watched areas are clear")
        scene.phase = "enabling"
        settled = clock.now() + _SETTLE_S
        well = "the robot was well"
        await self._until(lambda: operator.ready_s >= _HEALTHY_S or clock.now() > settled, ENABLED_S, well, tasks)
        operator.held_back = False
        await self._until(self._is_enabled, ENABLED_S, "it was enabled", tasks)
        scene.phase = "sending the goal"
        if not await self._send_goal(operator, tasks):
            return
        goal = scene.goal
        assert goal is not None
        self._judge = operator.judge = Judge(
            goal=(self._goal.x, self._goal.y),
            goal_id=goal.goal_id,
            areas=self.site.site.areas,
            begun=clock.now(),
            timeout_s=_TIMEOUT_BASE_S + _DETOUR * self._span() / _SLOWEST_MPS,
        )
        scene.phase = "driving"
        self._usage.restart()
        await self._watch(operator, clock, self._judge, tasks)

    def _watched(self) -> set[str]:
        return {node.area for node in self.site.site.nodes}

    def _all_clear(self) -> bool:
        states = {area: hazard.hazard.state for area, hazard in self.scene.hazards.items()}
        return all(states.get(area) == "clear" for area in self._watched())

    def _is_enabled(self) -> bool:
        state = self.scene.state
        return state is not None and state.enabled and state.mode not in STOP_AT_ONCE

    def _span(self) -> float:
        """Rough length (m) of the way: right angles from where the robot is."""
        truth = self.scene.truth
        assert truth is not None
        return abs(truth.x - self._goal.x) + abs(truth.y - self._goal.y)

    async def _send_goal(self, operator: Operator, tasks: list[asyncio.Task[None]]) -> bool:
        """Give the goal to the planner, patiently while it can't answer; False when it refuses."""
        deadline = time.monotonic() + GOAL_S
        while True:
            try:
                answer = await operator.put_goal(self._place)
                problem = f"HTTP {answer.status}: {answer.reason}"
                if answer.status < 300:
                    break
                if answer.status < 500:
                    self._end(Verdict("refused", f"the planner does not take the goal: {problem}"))
                    return False
            except OSError as error:
                problem = str(error)
            if time.monotonic() > deadline:
                self._end(Verdict("stopped", f"the planner took no goal for {GOAL_S:.0f} s: {problem}"))
                return False
            await asyncio.sleep(_TICK_S)
        self.scene.say(f"operator: drive to {self._goal.label or self._place}")
        scene = self.scene
        sent = "the planner published the goal"
        await self._until(lambda: scene.goal is not None and scene.goal.pose is not None, GOAL_S, sent, tasks)
        return True

    async def _watch(
        self, operator: Operator, clock: SystemClock, judge: Judge, tasks: list[asyncio.Task[None]]
    ) -> None:
        checked = clock.now()
        while True:
            self._check(tasks)
            verdict = judge.verdict(clock.now())
            if verdict is not None:
                self._judge_speed(verdict, clock)
                self._end(verdict)
                self._ended_at = clock.now()
                return
            if self._hazard and self._blocked_at is None:
                await self._maybe_block(operator, judge, clock)
            if clock.now() - checked >= _SPEED_CHECK_S * clock.speed:
                self._check_speed(clock.now() - checked, clock)
                checked = clock.now()
            await asyncio.sleep(max(0.02, clock.real(_TICK_S)))
            area = self._danger.area.id if self._danger is not None else ""
            since = self._blocked_at
            self.scene.trace = self.scene.traces.of(area, since) if since is not None else None

    async def _maybe_block(self, operator: Operator, judge: Judge, clock: SystemClock) -> None:
        path, truth = self.scene.path, self.scene.truth
        if path is None or truth is None or path.goal_id != judge.goal_id or not path.points:
            return
        if self._danger is None:
            self._danger = self._choose(path.points)
            area = self._danger.area
            where = area.label or area.id
            self.scene.say(f"after {self._danger.trigger_m:.1f} m something will block {where}, unseen from here")
        if judge.distance_m < self._danger.trigger_m:
            return
        ahead = along(path.points, self._danger.area.polygon)
        if ahead is None or not may_appear(self._danger, (truth.x, truth.y)):
            # The way has changed meanwhile (an obstacle, a service that was away): another area, from here on.
            self._danger = self._choose(path.points)
            if judge.distance_m < self._danger.trigger_m or not may_appear(self._danger, (truth.x, truth.y)):
                return
        stamp = clock.stamp()
        reply = await operator.simulate(SimCommand(place=[self._danger.barrier]))
        if reply is None or not reply.accepted:
            self.scene.say(f"the barrier could not be placed: {reply.reason if reply else 'no answer'}")
            return
        self._blocked_at = stamp
        judge.block(self._danger.area)
        self.scene.phase = "driving, the way is blocked"
        self.scene.say(f"a barrier stands in {self._danger.area.label or self._danger.area.id} now")

    def _choose(self, points: list[tuple[float, float]]) -> Danger:
        def barrier_in(area: AreaSite) -> SimObstacle:
            return barrier_across(area, self.site.site, self.site.map, self.options.seed)

        try:
            return choose(self.site.site, points, self.options.seed, barrier_in)
        except NoDangerError as error:
            raise WrongUseError(str(error)) from error

    def _check_speed(self, elapsed: float, clock: SystemClock) -> None:
        """Raise `_TooFastError` when the processes have been late for a while, or late and the robot stopped for it.

        At speed 1 there is nothing to lower.
        """
        truth, state, judge = self.scene.truth, self.scene.state, self._judge
        if truth is None or state is None or judge is None:
            return
        self._speeds.append(truth.sustained_speed)
        fresh = max(0, state.loop.late - self._late_beats)
        self._late_beats = state.loop.late
        slow = truth.sustained_speed < _SPEED_SHARE * clock.speed
        late = fresh / elapsed > _LATE_PER_S
        self._strikes = self._strikes + 1 if slow or late else 0
        stops = self._unexplained_stops()
        new_stops, self._stops_seen = stops[self._stops_seen :], len(stops)
        stopped = bool(new_stops) and (slow or fresh > 0)
        if clock.speed > 1.0 and not judge.entered_blocked and (stopped or self._strikes >= _SPEED_STRIKES):
            why = f"{truth.sustained_speed:.2f} sustained, {fresh} of the agent's beats late in {elapsed:.0f} s"
            raise _TooFastError(truth.sustained_speed, "; ".join([why, *(new_stops if stopped else [])]))

    def _unexplained_stops(self) -> list[str]:
        """Return the stops of this drive that nothing in its scene asks for.

        The barrier stands where no robot is, and who touches something has failed anyway; but after a process died, a
        stop is what should follow.
        """
        return [] if self._judge is None or self._restarts else self._judge.stops

    def _judge_speed(self, verdict: Verdict, clock: SystemClock) -> None:
        """Blame the haste, not the robot, for a run that failed while something was late.

        And count no speed as kept at which the robot arrived, but stopped on its way although nothing in its scene asks
        for a stop. A touch or a blocked area entered is never excused: what stops the robot must work at any
        speed. Nor is a stop by itself an excuse for a run that failed.
        """
        entered = self._judge is not None and self._judge.entered_blocked
        if clock.speed <= 1.0 or entered or verdict.outcome == "contact":
            return
        sustained = self.scene.truth.sustained_speed if self.scene.truth else 1.0
        if verdict.outcome == "reached":
            stops = self._unexplained_stops()
            if stops and (self._blocked_at is not None or not self._hazard):
                raise _TooFastError(sustained, f"it arrived, but stopped on its way: {'; '.join(stops)}")
        elif self._strikes:
            raise _TooFastError(sustained, f"{verdict.outcome}: {verdict.reason}")

    # --- helpers ----------------------------------------------------------------------------------------------------

    def _end(self, verdict: Verdict) -> None:
        self.scene.verdict = verdict
        self.scene.phase = verdict.outcome
        self.scene.say(f"{verdict.outcome}: {verdict.reason}")

    async def _until(
        self, condition: Callable[[], bool], timeout_s: float, what: str, tasks: list[asyncio.Task[None]]
    ) -> None:
        """Wait until the condition holds; raises `TimeoutError` after `timeout_s` real seconds."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            self._check(tasks)
            if time.monotonic() > deadline:
                state = self.scene.state
                heard = f"the robot says {state.mode}: {'; '.join(state.reasons)}" if state else "no word of the robot"
                areas = ", ".join(f"{area} {hazard.hazard.state}" for area, hazard in self.scene.hazards.items())
                heard += f"; areas: {areas or 'none heard of'}"
                raise TimeoutError(f"{timeout_s:.0f} s passed before {what}; {heard}")
            await asyncio.sleep(_TICK_S / 2)

    @staticmethod
    def _check(tasks: list[asyncio.Task[None]]) -> None:
        for task in tasks:
            if task.done():
                task.result()

    def success(self) -> bool:
        """Whether all that was asked for came true."""
        judge, verdict = self._judge, self.scene.verdict
        if judge is None or verdict is None or not judge.success(verdict.outcome):
            return False
        return not self._hazard or self._blocked_at is not None

    def _modes(self) -> dict[str, int]:
        """How often the robot entered each mode on its drive."""
        return dict(self._judge.modes) if self._judge else {}

    def report(self) -> dict[str, object]:
        """Return the report (`fognav demo --report`)."""
        judge, verdict = self._judge, self.scene.verdict
        area = self._danger.area.id if self._danger is not None else None
        trace = self.scene.traces.of(area, self._blocked_at) if area and self._blocked_at is not None else None
        begun, ended = (judge.begun if judge else 0.0), self._ended_at
        return {
            "outcome": verdict.outcome if verdict else "stopped",
            "success": self.success(),
            "reason": verdict.reason if verdict else "it ended before there was a verdict",
            "site": self.site.site.id,
            "seed": self.options.seed,
            "distance_m": round(judge.distance_m, 2) if judge else 0.0,
            "time_s": round(ended - begun, 2) if judge and ended else None,
            "min_clearance_m": _finite(judge.min_clearance_m) if judge else None,
            "hazard": self._hazard,
            "area": area,
            "area_entered": judge.entered_blocked if judge else False,
            "area_clearance_m": _finite(judge.blocked_clearance_m) if judge else None,
            "route_areas": judge.route_areas if judge else [],
            "plans": judge.paths if judge else 0,
            "stages_ms": stages_ms(trace),
            "hazard_to_path_ms": hazard_to_path_ms(trace),
            "processes": self._usage.report(),
            "restarts": self._restarts,
            "modes": self._modes(),
            "given_up": self._given_up,
            "speed": self.scene.speed,
            "asked_speed": self.options.speed,
            "sustained_speed": round(sum(self._speeds) / len(self._speeds), 2) if self._speeds else None,
            "events": [f"{at:.1f} {text}" for at, text in self.scene.events],
        }


def _finite(value: float) -> float | None:
    return round(value, 3) if math.isfinite(value) else None
