"""One attempt of a demonstration at one speed: start the whole system, drive once, place the barrier, end all.

Meanwhile other commands know it by its entry in the register, and people by what it tells them to operate it.
"""

import asyncio
import contextlib
import os
import shlex
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Final

from fog_contracts.messages import SimCommand, Trace
from fog_runtime.clock import Clock, SystemClock
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor import net
from fog_supervisor.supervisor import Event
from fognav import checkout
from fognav.demo.guest import GuestDrive
from fognav.demo.machine import SpeedWatch, TooFastError, Usage, children
from fognav.demo.operator import Operator
from fognav.demo.options import DrivePlan
from fognav.demo.preparation import Background, Preparation
from fognav.demo.scene import Scene
from fognav.operate.systems import Registration, System, registered
from fognav.output import FailedError, WrongUseError
from fognav.programs import AGENT, BROKER, CONSOLE, ROBOT, ROUTER, SERVICES, WATCHDOG
from fognav.recording import recording
from fognav.stack import Stack, StackConfig, users_of
from fognav_sim.barrier import BarrierError
from fognav_sim.drive.drive import Drive, DriveOutcome, DriveSummary
from fognav_sim.drive.hazard import HazardSchedule, PlannedHazard

PAGE: Final = "page"
_SLOW_ZONE: Final = (1.0, 0.1)
"""Radius (m) and speed limit (m/s) of the proposed zone: it is seen to work, and fails no drive."""


class Presence(Registration):
    """The entry of one attempt's system, from `update` to the end of the context."""

    def __init__(self, plan: DrivePlan, scene: Scene, stack: Stack) -> None:
        super().__init__(self.system)
        self._plan = plan
        self._scene = scene
        self._stack = stack
        self._usable = True

    def system(self) -> System:
        """Return the system as it is now: a restarted process has another port and process id."""
        stack = self._stack
        ports = {name: stack.port(name) for name in (*SERVICES, AGENT)}
        urls = {name: f"http://{net.LOOPBACK}:{port}" for name, port in ports.items() if port is not None}
        urls |= {BROKER: stack.mqtt_url, ROUTER: stack.zenoh_endpoint}
        if self._scene.page_url:
            urls[PAGE] = self._scene.page_url
        credentials = stack.security.file("console")
        return System(
            name=f"demo-{os.getpid()}",
            kind="demo",
            site=self._plan.site.site.id,
            urls=urls,
            pids={"demo": os.getpid(), **stack.pids()},
            token_file=str(stack.token_file),
            credentials_file=None if credentials is None else str(credentials),
            robots=[self._plan.robot],
            speed=self._scene.speed,
        )

    def update(self) -> None:
        """Keep the entry current; without a usable register, the demo runs on without one."""
        if not self._usable:
            return
        try:
            super().update()
        except FailedError as error:
            self._usable = False
            self._scene.log_event(f"other commands can't find this demo: {error}")

    def announce(self) -> None:
        """Tell people the addresses and a command to draw a zone, which works as it is printed."""
        if not self._usable:
            return
        system = self.system()
        name = _command()
        choice = f" --fog {system.name}" if len(registered()) > 1 else ""
        goal = self._plan.goal
        radius, speed = _SLOW_ZONE
        zone = f"--circle {goal.x:g},{goal.y:g},{radius:g} --kind speed-limit --speed {speed:g} --reason 'slowly here'"
        rest = ", ".join(f"{service} {system.urls[service]}" for service in SERVICES if service in system.urls)
        self._scene.log_event(f"REST: {rest}; token in {system.token_file}")
        self._scene.log_event(f"see the system: {name} status{choice}")
        self._scene.log_event(f"draw a zone: {name} zone add {zone}{choice}")
        self._scene.hint = f"operate it from another terminal: {name} status{choice}"


def _command() -> str:
    """Return how this command is started in the current folder."""
    try:
        root = checkout.root()
    except WrongUseError:
        return "fognav"  # installed without a checkout, on the PATH
    return "./fognav" if Path.cwd() == root else shlex.quote(str(root / "fognav"))


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


READY_S: Final = 90.0
"""Real seconds for everything to start."""
_TICK_S: Final = 0.1
_SAMPLE_S: Final = 1.0
_SPEED_CHECK_S: Final = 2.0


class Attempt:
    """One attempt; its results are available while it runs and afterwards."""

    def __init__(self, plan: DrivePlan, scene: Scene) -> None:
        self.plan = plan
        self.scene = scene
        self.drive: Drive | None = None
        self.placement: HazardPlacement | None = None
        self.speed_watch = SpeedWatch(scene.speed)
        self.usage = Usage()
        self.restarts: dict[str, int] = {}
        """How often each process died and was restarted."""
        self.guest: dict[str, object] | None = None
        """The drive of a robot of others, where one was asked for."""
        self.taken_over = False
        """Somebody sent the robot elsewhere: the system is theirs from then on."""
        self._stack: Stack | None = None

    # --- the system ---

    async def run(self, stop: asyncio.Event) -> None:
        """Start everything, drive, and end everything.

        With `keep_running`, or once somebody sent the robot elsewhere, wait for `stop` before the end.
        Raises `NotReadyError` or `TimeoutError` if the system or the robot does not become ready, `TooFastError` if
        the machine can't sustain the speed, and `WrongUseError` if the site is not suitable.
        """
        options = self.plan.options
        clock = SystemClock(self.scene.speed)
        site_dir = self.plan.site.directory
        config = StackConfig(
            site_dir=site_dir,
            robot=self.plan.robot,
            base=options.base,
            lidar=options.lidar,
            robot_file=options.robot_file,
            seed=options.seed,
            speed=self.scene.speed,
            extra={**options.settings, "DEMO_URL": self.scene.page_url.rpartition("/")[0]},
            users=users_of(self.plan.site.site),
            embedded=options.embedded,
        )
        async with Stack(config, self._on_process) as stack, self._keeping_logs(stack):
            self._stack = stack
            if options.hazard and not self.plan.hazard:
                self.scene.log_event("scenario: no barrier, because [demo] of site.toml lists no areas")
            self.scene.log_event(f"starting {len(stack.supervisor.names)} processes, logs in {stack.folder / 'logs'}")
            await stack.start_servers(READY_S)
            async with contextlib.AsyncExitStack() as ends:
                # Recording begins before the first service publishes: a replay needs the map's first versions.
                await ends.enter_async_context(self._recording(stack, clock))
                await stack.start_system(READY_S)
                edge = await ends.enter_async_context(self._open(stack, clock, "demo"))
                operator = Operator(edge, stack, self.scene, clock)
                presence = ends.enter_context(Presence(self.plan, self.scene, stack))
                presence.update()
                presence.announce()
                async with Background(operator.keep_enabled(), self._sample(stack, presence)) as background:
                    guest = None
                    if options.guest:
                        guest = await ends.enter_async_context(GuestDrive(stack, self.plan, options.guest))
                        self.scene.log_event(
                            f"scenario: a robot of others sets out 2 m behind, by {options.guest} alone"
                        )
                    await self.run_drive(operator, clock, background)
                    if guest is not None and not self.taken_over:
                        self.scene.log_event("scenario: waiting until the robot of others is there, too")
                        self.guest = await guest.finish(self._barrier())
                    if self.taken_over:
                        self.scene.log_event("the system keeps running for whom sent the robot: end it with Ctrl-C")
                    elif options.keep_running:
                        self.scene.log_event("the system keeps running: end it with Ctrl-C")
                    if self.taken_over or options.keep_running:
                        await stop.wait()

    def _barrier(self) -> list[tuple[float, float]] | None:
        """Return the outline of the barrier that was placed; None without one."""
        hazard = None if self.drive is None or not self.drive.hazard_met else self.drive.hazard
        return None if hazard is None or hazard.planned is None else list(hazard.planned.barrier.polygon)

    @contextlib.asynccontextmanager
    async def _recording(self, stack: Stack, clock: SystemClock) -> AsyncIterator[None]:
        """Record every channel if requested, by a zenoh session of its own."""
        path = self.plan.options.record
        if path is None:
            yield
            return
        numbers = [area.number for area in self.plan.site.site.areas if area.number is not None]
        async with (
            self._open(stack, clock, "record", user="recorder") as edge,
            recording(
                path,
                mqtt_url=stack.mqtt_url,
                zenoh=edge,
                clock=clock,
                numbers=numbers,
                credentials=stack.security.credentials("recorder"),
            ),
        ):
            yield

    @contextlib.asynccontextmanager
    async def _keeping_logs(self, stack: Stack) -> AsyncIterator[None]:
        """Keep the logs of an attempt that failed, unless it was interrupted or is repeated more slowly."""
        try:
            yield
        except (asyncio.CancelledError, TooFastError, WrongUseError):
            raise
        except Exception:
            stack.keep_files = True
            raise
        else:
            stack.keep_files = not self.success()
        finally:
            if stack.keep_files:
                self.scene.log_event(f"logs kept in {stack.folder / 'logs'}")

    def _open(
        self, stack: Stack, clock: SystemClock, name: str, user: str = "console"
    ) -> contextlib.AbstractAsyncContextManager[ZenohEdge]:
        return ZenohEdge.open(
            connect=[stack.zenoh_endpoint],
            clock=clock,
            role="console",
            id=name,
            site=self.plan.site.site.id,
            credentials=stack.security.credentials(user),
        )

    def _on_process(self, event: Event) -> None:
        self._tell_of_robot(event)
        if event.kind == "exited":
            self.restarts[event.program] = self.restarts.get(event.program, 0) + 1
            what = "ended" if event.detail.startswith("exit code 0") else "died"
            self.scene.log_event(f"{event.program} {what} ({event.detail})")
        elif event.kind == "started" and event.program in self.restarts:
            self.scene.log_event(f"{event.program} was restarted")

    def _tell_of_robot(self, event: Event) -> None:
        tell = self.plan.options.on_robot_start
        if tell is None or self._stack is None or event.kind != "started" or event.program not in ROBOT:
            return
        if (pid := self._stack.supervisor.pid(event.program)) is not None:
            tell(pid)

    async def _sample(self, stack: Stack, presence: Presence) -> None:
        """Keep the processes' usage and the register's entry current."""
        while True:
            presence.update()
            pids = stack.pids()
            if watchdog := pids.get(WATCHDOG):
                for child in children(watchdog)[:1]:
                    pids["robot-guardian"] = child
            self.usage.sample(pids)
            self.scene.usage = self.usage.recent()
            await asyncio.sleep(_SAMPLE_S)

    def console_login(self) -> str | None:
        """Return the address that opens the console, logged in by the part that no server sees; None before it runs."""
        stack = self._stack
        port = stack.port(CONSOLE) if stack is not None else None
        if stack is None or port is None:
            return None
        return f"http://{net.LOOPBACK}:{port}/#login={stack.token}&scenario"

    # --- the drive ---

    async def run_drive(self, operator: Operator, clock: SystemClock, background: Background) -> None:
        """Prepare the robot, send it to its goal, and watch it until the drive has an outcome."""
        preparation = Preparation(self.plan, self.scene, operator, clock, background)
        await preparation.make_ready()
        if (failed := await preparation.send_goal()) is not None:
            self.end(failed)
            return
        placement = self.begin_drive(operator, clock)
        self.usage.restart()
        await self._watch(placement, clock, background)

    def begin_drive(self, operator: Operator, clock: Clock) -> HazardPlacement:
        """Evaluate the drive to the goal from now on, by what the operator receives."""
        scene, plan = self.scene, self.plan
        assert scene.goal is not None
        assert scene.truth is not None
        self.drive = operator.drive = Drive(
            goal=(plan.goal.x, plan.goal.y),
            goal_id=scene.goal.goal_id,
            areas=plan.site.site.areas,
            truth=scene.truth,
            now=clock.now(),
            hazard=HazardSchedule.of(plan.site, plan.options.seed, plan.options.request) if plan.hazard else None,
        )
        if scene.path is not None:
            self.drive.on_path(scene.path, clock.now())
        self.placement = HazardPlacement(self.drive, scene, operator, clock)
        scene.phase = "driving"
        return self.placement

    async def _watch(self, placement: HazardPlacement, clock: SystemClock, background: Background) -> None:
        drive = self.drive
        assert drive is not None
        checked = clock.now()
        while (outcome := drive.outcome(clock.now())) is None:
            background.check()
            if (taken := self._taken_over(drive)) is not None:
                self.taken_over = True
                self.end(taken)
                return
            await placement.place_if_due()
            if clock.now() - checked >= _SPEED_CHECK_S * clock.speed:
                self._check_speed(clock.now() - checked, drive)
                checked = clock.now()
            await asyncio.sleep(max(0.02, clock.real(_TICK_S)))
            self.scene.trace = placement.trace()
        self.speed_watch.check_outcome(
            outcome,
            self.scene.truth,
            self.unexplained_stops(),
            entered_blocked=drive.evaluation.entered_blocked,
            hazard_placed=drive.hazard_met,
        )
        self.end(outcome)

    def _taken_over(self, drive: Drive) -> DriveOutcome | None:
        """Return the outcome of a drive whose robot somebody has sent elsewhere: it is theirs from then on."""
        goal = self.scene.goal
        if goal is None or goal.pose is None or goal.goal_id == drive.evaluation.goal_id:
            return None
        return DriveOutcome("stopped", f"somebody sent the robot elsewhere ({goal.place or 'a position'})")

    def _check_speed(self, elapsed_s: float, drive: Drive) -> None:
        truth, state = self.scene.truth, self.scene.state
        if truth is not None and state is not None:
            entered, stops = drive.evaluation.entered_blocked, self.unexplained_stops()
            self.speed_watch.check(elapsed_s, truth, state, stops, entered_blocked=entered)

    def unexplained_stops(self) -> list[str]:
        """Return the stops of this drive without a cause in its scenario.

        The barrier is never placed near the robot, and a drive with contact has failed anyway. After a process died a
        stop is expected.
        """
        return [] if self.drive is None or self.restarts else self.drive.evaluation.stops

    def end(self, outcome: DriveOutcome) -> None:
        """Record and show the outcome."""
        self.scene.outcome = outcome
        self.scene.phase = outcome.kind
        self.scene.log_event(f"{outcome.kind}: {outcome.reason}{self._of_its_barrier(outcome)}")

    def _of_its_barrier(self, outcome: DriveOutcome) -> str:
        """Return what else must be said of a drive that reached its goal, "" if nothing."""
        if outcome.kind != "reached" or self.drive is None:
            return ""
        if not self.drive.hazard_met:
            return "; but this is no success: no barrier was placed on the way ahead of it"
        if self.drive.evaluation.entered_blocked:
            return "; but this is no success: it drove into the blocked area"
        if self.plan.options.hazard and not self.plan.hazard:
            return f"; but nothing was in its way: [demo] of {self.plan.site.directory}/site.toml lists no areas"
        return ""

    def summary(self) -> DriveSummary:
        """Summarize the drive, as far as it came."""
        outcome = self.scene.outcome or DriveOutcome("stopped", "the demo ended before the drive had an outcome")
        return (
            self.drive.summary(outcome)
            if self.drive is not None
            else DriveSummary(outcome=outcome.kind, reason=outcome.reason)
        )

    def success(self) -> bool:
        """Whether the drive succeeded and, if a hazard was requested, met one."""
        guest = self.guest
        led = guest is None or (guest["reached"] is True and guest["touched_barrier"] is False)
        return self.summary().success and led
