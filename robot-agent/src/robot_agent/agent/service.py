"""The agent's edge: connects, runs the core at its rates, and passes messages between core and network."""

from __future__ import annotations

import asyncio
import math
import os
import secrets
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Final

from msgspec import structs, to_builtins
from prometheus_client import REGISTRY, Counter, Gauge

from fog_contracts import channels as ch
from fog_contracts.codec import ContractError
from fog_contracts.handlers import Publication
from fog_contracts.messages import CommandReply, LoopHealth, PlanReply, RobotCommand, RobotState
from fog_runtime import logs, metrics
from fog_runtime.clock import Phase, Ticker
from fog_runtime.configuration.robot_file import describe_robot
from fog_runtime.health import Health, reachable_address, serve_health
from fog_runtime.machine import ServiceManager, SuspensionMonitor, run_in_real_time
from fog_runtime.process import AgainError, limit_the_end, release_startup_memory
from fog_runtime.transports.edges import Edges
from fog_runtime.transports.zenoh_edge import ZenohEdge, use_one_thread
from fog_runtime.version import VERSION
from robot_agent import registry
from robot_agent.agent.edges.camera_edge import CameraEdge
from robot_agent.agent.edges.exporter import Observed, RobotCollector, name_thread, parent
from robot_agent.agent.edges.local_tools import LocalTools
from robot_agent.agent.edges.map_loader import MapLoader, Store
from robot_agent.agent.local_link import Equipment, socket_beside
from robot_agent.agent.recording.input_log import LOG_KEY, BaseReceived, Published, ScanReceived, Started
from robot_agent.agent.recording.input_writer import open_core
from robot_agent.agent.settings import remarks
from robot_agent.config import agent_config
from robot_agent.hardware import DockingDriver
from robot_agent.motion.local_planner import decide

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Sequence
    from concurrent.futures import Future

    from fog_contracts.handlers import Ids, Later, Moment, QueryHandler
    from fog_contracts.messages import EgressRequest, Message
    from fog_contracts.robot import LidarSettings
    from fog_runtime.clock import Clock, SystemClock
    from fog_runtime.configuration.robot_file import RobotFile
    from robot_agent.agent.berths import Berths
    from robot_agent.agent.core import AgentCore
    from robot_agent.agent.edges.guardian_client import GuardianClient
    from robot_agent.agent.edges.lidar_edge import Devices, LidarEdge
    from robot_agent.agent.settings import Given, Settings
    from robot_agent.guardian.link import BaseFeedback
    from robot_agent.hardware import LaserScan
    from robot_agent.localization.pose import SavedPose
    from robot_agent.motion.local_planner import Decision

STREAM_S: Final = 0.05
IDLE_STREAM_S: Final = 0.1
"""A robot that stands and has nothing to do needs every other tick only, and of these every other one looks at its
inputs while it stands by (`AgentCore.standing_by`)."""
CONTROL_AFTER_S: Final = 0.02
"""Decisions begin this long after a tick of the stream: at the same moment, their thread and the loop's would take the
interpreter from one another some hundred times a second. They end before the next tick, which sends their speeds."""
PUBLISH_S: Final = 0.1
POLLED: Final = (ch.MAP_HEARTBEAT, ch.ROBOT_RELEASE)
"""What comes steadily is read with the stream, which uses it: ages of a second and more are not judged by 0.1 s."""
HOUSEKEEPING_S: Final = 1.0
EGRESS_TIMEOUT_S: Final = 3.0
"""Timeout of a query for the way out of a blocked area."""

SCANS = Counter("fognav_lidar_scans_total", "Whole scans of the lidar")
LATENESS = Gauge("fognav_loop_lateness_p99_seconds", "99th percentile of a loop's lateness", ["loop"])
ENCODER_FAULTS = Counter("fognav_encoder_faults_total", "Readings of the wheel encoders that no motion explains")
SUSPENSIONS = Counter("fognav_suspensions_total", "Times that the robot's computer was suspended and resumed")

_log = logs.get("agent")


class Service:
    """The running agent; its loops are tasks of the process. The core is used on the loop's thread only."""

    def __init__(
        self,
        core: AgentCore,
        zenoh: ZenohEdge,
        store: Store,
        clock: Clock,
        health: Health,
        metrics_address: Callable[[], str] = str,
    ) -> None:
        """Prepare; `metrics_address` returns where the fog node reaches this process's metrics, and may block."""
        self._core = core
        self._zenoh = zenoh
        self._edges = Edges(clock, zenoh=zenoh)
        self._tasks: set[asyncio.Task[None]] = set()
        self._store = store
        self._storing = False
        self._unstored: SavedPose | None = None
        """The pose that could not be stored."""
        self._clock = clock
        self._health = health
        self._robot = core.robot
        self.phase = Phase()
        """The common phase of all loops: the process sleeps between their ticks."""
        self._stream = self._ticker(STREAM_S)
        self._control = self._ticker(core.profile.control_period, CONTROL_AFTER_S)
        self._wanted = asyncio.Event()
        """Whether there may be something to decide."""
        self._decision: Future[Decision] | None = None
        """The decision that is under way, until the stream collects it."""
        self._look: Callable[[float], object] = lambda _now: None
        self.collector = RobotCollector()
        self._state: RobotState | None = None
        self._corrupted: dict[str, int] = {}
        self._mode = ""
        self._searching = False
        self._encoder_faults = 0
        self._last_feedback_at = -math.inf
        self._last_scan_at = -math.inf
        self._base_reason = "the guardian is not connected yet"
        self._manager = ServiceManager()
        self._find_metrics_address = metrics_address
        self._metrics_address = ""
        self._was_connected = False
        self.berths: Berths | None = None
        """The floors that the robot knows, and its record of the one that it is on."""
        self.tools: LocalTools | None = None
        """Tools on this computer, which watch what the robot measures."""

    def _ticker(self, period: float, offset: float = 0.0) -> Ticker:
        return Ticker(self._clock, period, self.phase, offset)

    # --- Housekeeping -----------------------------------------------------------------------------------------------

    async def housekeeping_loop(self, lidar: LidarEdge, guardian: GuardianClient) -> None:
        """Once a second: store the pose if it changed, and report the health; more often until the robot is ready.

        While the robot drives, its pose is stored by `publish_loop`.
        """
        due = -math.inf
        self._manager.ready()
        ticker = self._ticker(STREAM_S)
        async for now in ticker:
            if now >= due:
                due = now + HOUSEKEEPING_S - STREAM_S / 2
                self._core.on_loop_health(self._loop_health())
                await self._store_pose(now)
                await self._change_floor()
                await self._announce_metrics()
                self._report_health(self._clock.now(), lidar)
                self._observe(self._clock.now(), lidar, guardian)
            else:
                self._report_health(now, lidar)
            ticker.period = HOUSEKEEPING_S if self._health.ready else STREAM_S

    async def _store_pose(self, now: float) -> None:
        # A robot that stands tells its pose once: what a full disk has refused is tried again.
        if not self._storing and (pose := self._core.pose_to_store(now) or self._unstored) is not None:
            await self._put_pose(pose)

    async def _put_pose(self, pose: SavedPose) -> None:
        self._storing = True
        try:
            await asyncio.to_thread(self._store.put_pose, pose)
            self._unstored = None
        except OSError as error:
            if self._unstored is None:
                _log.error("pose_not_stored", reason=str(error), remedy="it is tried again")
            self._unstored = pose
        finally:
            self._storing = False

    async def _change_floor(self) -> None:
        """Once the robot was handed over: store where, and end, to be started again on that floor."""
        berth = self._core.berth_to_store
        if berth is None or self.berths is None:
            return
        goes_on = self._core.goes_on
        try:
            await asyncio.to_thread(self.berths.store, berth, enabled=goes_on)
            if goes_on and not self._core.goes_on:  # stopped while that was written
                await asyncio.to_thread(self.berths.store, berth, enabled=False)
        except OSError as error:
            _log.error("floor_not_stored", floor=berth.floor, reason=str(error), remedy="it is tried again")
            return
        self._core.leave()
        limit_the_end()
        raise AgainError(f"the robot is on {berth.floor} now")

    async def _announce_metrics(self) -> None:
        """Look up this computer's address after each connection: a network gives it another one now and then."""
        if self._zenoh.connected and not self._was_connected:
            self._metrics_address = await asyncio.to_thread(self._find_metrics_address)
        self._was_connected = self._zenoh.connected

    def _report_health(self, now: float, lidar: LidarEdge) -> None:
        core, health = self._core, self._health
        loaded = core.replica.version is not None
        health.set("map", loaded, "" if loaded else "no snapshot of the map has been received yet")
        status = core.localizer.status
        health.set("pose", status in {"good", "weak"}, f"{status}: {core.localizer.detail}".rstrip(": "))
        resting = not core.lidar_on
        scans = now - self._last_scan_at < HOUSEKEEPING_S
        health.set("lidar", resting or scans, "at rest" if resting else lidar.problem)
        base_ok = now - self._last_feedback_at < HOUSEKEEPING_S
        health.set("base", base_ok, "" if base_ok else self._base_reason)
        ENCODER_FAULTS.inc(core.encoder_faults - self._encoder_faults)
        self._encoder_faults = core.encoder_faults
        if core.localizer.searching and not self._searching:
            _log.info("global_search_started", reason=core.localizer.detail)
        self._searching = core.localizer.searching

    def _observe(self, now: float, lidar: LidarEdge, guardian: GuardianClient) -> None:
        """Leave what the metrics tell where the thread that serves them finds it."""
        watchdog = guardian.pid and parent(guardian.pid)
        pids = {"agent": os.getpid(), "guardian": guardian.pid, "watchdog": watchdog}
        self.collector.pids = {name: pid for name, pid in pids.items() if pid}
        if (vitals := self.collector.vitals(self._clock.real(now), self._clock.stamp())) is not None:
            self._edges.publish(Publication(ch.ROBOT_VITALS, vitals, {"robot": self._robot}))
        if self._state is None:
            return
        core, localizer = self._core, self._core.localizer
        self.collector.observed = Observed(
            state=self._state,
            map_age=core.map_age(now),
            particles=localizer.particles,
            uncertainty=None if localizer.pose(now) is None else localizer.uncertainty,
            corrupted={**self._corrupted, "lidar": lidar.corrupted},
        )

    def equipment(self, lidar: LidarEdge, mounted: LidarSettings) -> Equipment:
        """Return what tools on this computer are told beside what the robot measures."""
        return Equipment(
            version=VERSION, processes=dict(self.collector.pids), lidar=str(lidar.problem), masks=mounted.masks,
            base="" if self._clock.now() - self._last_feedback_at < HOUSEKEEPING_S else self._base_reason,
            damaged={**self._corrupted, "lidar": lidar.corrupted}, mirrored=mounted.mirrored,
        )  # fmt: skip

    # --- Base and lidar ---------------------------------------------------------------------------------------------

    def on_feedback(self, feedback: BaseFeedback, now: float) -> None:
        """Pass the guardian's feedback to the core."""
        self._last_feedback_at = now
        self._corrupted["base"] = feedback.corrupted
        self._core.on_base(feedback, now)
        if self.tools is not None and self.tools.watched:
            self.tools.publish(BaseReceived(feedback=feedback, now=now))

    def on_base_lost(self, now: float, reason: str) -> None:
        """Pass the loss of the guardian, or of its base, to the core."""
        self._base_reason = reason
        self._core.on_base_lost(now, reason)

    def on_scan(self, scan: LaserScan, now: float) -> None:
        """Pass a whole scan of the lidar to the core."""
        self._last_scan_at = now
        SCANS.inc()
        self._core.on_scan(scan, now)
        if self.tools is not None and self.tools.watched:
            self.tools.publish(ScanReceived.of(scan, now))

    async def stream_loop(self, guardian: GuardianClient, lidar: LidarEdge) -> None:
        """Stream wheel commands at 20 Hz, at rest at 10 Hz, each on the newest of base and lidar unless it repeats."""
        suspension = SuspensionMonitor()

        def look(now: float) -> Sequence[LaserScan]:
            if seconds := suspension.suspended():
                SUSPENSIONS.inc()
                _log.warning("computer_was_suspended", seconds=round(seconds, 1))
                self._core.on_suspension(seconds)
            guardian.receive()
            self._zenoh.poll()
            return lidar.poll(now, on=self._core.lidar_on)

        def localize(scans: Sequence[LaserScan], now: float) -> None:
            for scan in scans:
                self.on_scan(scan, now)

        def stream(now: float) -> None:
            self._collect()
            if self._core.repeats(now):
                # The guardian wants a command. All else waits where it is for the next tick, but for the lidar's bytes.
                lidar.fetch()
                guardian.send(self._core.stream(now, self._clock.stamp()))
                return
            scans = look(now)
            if self._core.standing_by:
                # Its last command is a tick ago. Scans are as rare as its looks: these must know of the newest one.
                localize(scans, now)
                scans = ()
            guardian.send(self._core.stream(now, self._clock.stamp()))
            # After the command, which localization must not delay.
            localize(scans, now)
            # Here, because the housekeeping waits for the storage, which may hang while the robot drives well.
            missing = self._health.missing
            self._manager.alive(f"waiting for {', '.join(missing)}" if missing else "ready")
            self._stream.period = IDLE_STREAM_S if self._core.idle else STREAM_S
            if not self._core.standing_by:
                self._wanted.set()

        self._look = lambda now: localize(look(now), now)
        await self._stream.call(stream)

    async def control_loop(self) -> None:
        """Plan and decide, 5 times a second in the profile `fog`, on a thread: what hangs can't block the stream."""
        loop = asyncio.get_running_loop()
        thread = ThreadPoolExecutor(1, thread_name_prefix="decide", initializer=name_thread, initargs=("decide",))
        try:
            async for tick in self._control:
                now = tick
                self._control.period = self._core.profile.control_period
                if self._decision is not None:
                    # Slower than its period: the next one must not begin beside it.
                    await asyncio.wrap_future(self._decision)
                    self._collect()
                    now = self._clock.now()
                    self._control.held_up(now - tick)
                if (search := self._core.search(now)) is not None:
                    found = await loop.run_in_executor(thread, search.run)
                    self._core.on_found(found, self._edges.now())
                job = self._core.control_job(now)
                if job is not None:
                    # The stream collects it: a future of asyncio would wake the loop, whose next tick is soon enough.
                    self._decision = thread.submit(decide, job)
                elif self._core.standing_by:
                    # Not woken to find that there is nothing to decide: the stream tells when there may be again.
                    # What was late before must not be reported for as long as the robot stands.
                    self._control.rejoin()
                    self._wanted.clear()
                    await self._wanted.wait()
        finally:
            self._decision = None
            thread.shutdown(wait=False, cancel_futures=True)

    def _collect(self) -> None:
        """Drive by the decision that is under way, once it is made."""
        if self._decision is not None and self._decision.done():
            decision, self._decision = self._decision.result(), None
            self._core.accept(decision)

    # --- Subscriptions ----------------------------------------------------------------------------------------------

    def subscribe(self) -> None:
        """Register subscriptions and queries."""
        self._edges.subscribe(self._core.handlers(), self._publish, only={"robot": self._robot}, polled=POLLED)
        queries = {channel: partial(self._answer, handler) for channel, handler in self._core.query_handlers().items()}
        self._edges.serve(queries, only={"robot": self._robot}, on_reply=self._log_command)

    def _answer(self, handler: QueryHandler, ids: Ids, request: Message | None, at: Moment) -> Message | Later[Message]:
        """Answer by the newest of base and lidar: a robot that stands by looks at them seldom."""
        if self._core.standing_by:
            self._look(at.now)
        return handler(ids, request, at)

    def _log_command(self, _channel: ch.Channel, request: Message | None, reply: Message) -> None:
        if isinstance(request, RobotCommand) and isinstance(reply, CommandReply):
            _log.info(
                "command",
                kind=request.kind,
                operator=request.operator,
                accepted=reply.accepted,
                refusal=reply.code,
                causes=reply.causes,
                reason=reply.reason,
            )

    # --- Publications -----------------------------------------------------------------------------------------------

    async def publish_loop(self) -> None:
        """Tick the core at 10 Hz, publish what it returns, store a driving robot's pose, and observe traces."""
        await self._ticker(PUBLISH_S).call(self._tick)

    def _tick(self, _now: float) -> None:
        at = self._edges.now()
        self._publish(self._core.tick(at))
        if (request := self._core.egress_request(at.now)) is not None:
            self._begin(self._fetch_way_out(request), "egress")
        if not (self._core.idle or self._storing) and (pose := self._core.pose_to_store(at.now)) is not None:
            # Within a second a robot turns round: one whose computer dies then would begin with the wrong heading.
            self._storing = True
            self._begin(self._put_pose(pose), "pose")
        for trace in self._core.finished_traces():
            metrics.observe_trace(trace, ["deliver", "command", "total"])

    def _begin(self, work: Coroutine[None, None, None], name: str) -> None:
        task = asyncio.get_running_loop().create_task(work, name=name)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _fetch_way_out(self, request: EgressRequest) -> None:
        try:
            reply = await self._zenoh.query(ch.PLANNER_EGRESS, request, PlanReply, EGRESS_TIMEOUT_S)
        except ContractError as error:
            _log.warning("egress_refused", reason=str(error))
            reply = None
        self._core.on_egress_reply(request, reply, self._clock.now())

    def _publish(self, publications: Sequence[Publication]) -> None:
        for publication in publications:
            if isinstance(state := publication.message, RobotState):
                state = structs.replace(state, metrics=self._metrics_address)
                publication = replace(publication, message=state)  # noqa: PLW2901  # the same one, completed
                self._state = state
                self._report_mode(state)
                if self.tools is not None and self.tools.watched:
                    channel, ids = publication.channel.name, dict(publication.ids)
                    self.tools.publish(Published(channel=channel, ids=ids, message=state))
            self._edges.publish(publication)

    def _loop_health(self) -> LoopHealth:
        control, stream = self._control.p99_s, self._stream.p99_s
        LATENESS.labels("control").set(control)
        LATENESS.labels("stream").set(stream)
        return LoopHealth(control_p99_s=control, stream_p99_s=stream, late=self._control.late + self._stream.late)

    def _report_mode(self, state: RobotState) -> None:
        if state.mode == self._mode:
            return
        _log.info("mode_changed", mode=state.mode, before=self._mode, codes=state.codes, reasons=state.reasons)
        self._mode = state.mode


async def run(settings: Settings, robot: RobotFile, given: Given, clock: SystemClock, devices: Devices) -> None:
    """Localize, follow paths and gate the wheels until cancelled."""
    site, body, guardian, lidar = given.site, given.body, devices.guardian, devices.lidar
    _log.info("robot_settings", **describe_robot(robot, *registry.options(robot)))
    config = agent_config(
        settings.robot,
        given.operator_key,
        given.base.drive_train,
        lidar.traits,
        body,
        boot=secrets.token_hex(8),
        obstacle_ttl=settings.obstacle_memory_s,
        footprint=given.footprint,
        settings=robot.settings,
        finds_dock=isinstance(given.base, DockingDriver),
        markers=given.markers,
    )
    if given.berths is not None:
        floors, resumes = tuple(given.berths.floors), await asyncio.to_thread(given.berths.take_enabled)
        config = replace(config, berth=given.berths.berth, floors=floors, resumes=resumes)
    source = "radius of site.toml" if given.footprint is None else "footprint of robot.toml"
    inscribed = round(config.footprint.inscribed_radius, 3)
    sizes = {"radius": config.radius, "inscribed_radius": inscribed}
    _log.info("robot_body", source=source, **sizes, site=site, entry=to_builtins(body))
    for remark in remarks(robot, lidar.traits, config.footprint):
        _log.warning("robot_remark", remark=remark)
    use_one_thread()
    health = Health("map", "pose", "lidar", "base")
    async with ZenohEdge.open(
        connect=settings.zenoh_endpoints if settings.fog else (), clock=clock, role="robot-agent", id=settings.robot,
        site=site, credentials=given.credentials,
    ) as zenoh:  # fmt: skip
        with (
            open_core(config, settings.seed, settings.input_log) as core,
            serve_health(health, settings.http_host, settings.http_port, settings.port_file) as server,
        ):
            store = Store(settings.data_dir)
            address = partial(reachable_address, settings.http_host, server.port, settings.zenoh_endpoints)
            agent = Service(core, zenoh, store, clock, health, address)
            agent.berths = given.berths
            map_loader = MapLoader(core, zenoh, store, clock, site=site, phase=agent.phase)
            map_loader.begin()
            guardian.begin(agent.on_feedback, agent.on_base_lost)
            lidar.on_samples = core.on_lidar_samples
            started = Started(config=replace(config, operator_key=LOG_KEY), seed=settings.seed)
            equipment = partial(agent.equipment, lidar, robot.settings.lidar)
            agent.tools = LocalTools(socket_beside(settings.guardian_socket), started, equipment, core, clock)
            agent.subscribe()
            REGISTRY.register(agent.collector)
            zenoh.declare_liveliness("robot-agent", settings.robot)
            # What the start has made stays: no later collection of garbage looks at it, and delays a wheel command.
            release_startup_memory()
            # After the start, which takes all the time that it gets.
            priority = settings.agent_realtime_priority if settings.speed == 1.0 else 0
            _log.info("started", priority=run_in_real_time(priority))
            async with asyncio.TaskGroup() as tasks:
                for task in devices.tasks:
                    tasks.create_task(_ended(task))
                tasks.create_task(agent.stream_loop(guardian, lidar), name="stream")
                tasks.create_task(agent.control_loop(), name="control")
                tasks.create_task(map_loader.run(body), name="map")
                tasks.create_task(agent.publish_loop(), name="publish")
                tasks.create_task(agent.tools.run(), name="local tools")
                if robot.settings.camera.source:
                    camera = CameraEdge(robot.settings.camera, given.markers, clock, core.on_sighting)
                    tasks.create_task(camera.run(), name="camera")
                tasks.create_task(agent.housekeeping_loop(lidar, guardian), name="housekeeping")


async def _ended(task: asyncio.Task[None]) -> None:
    """Wait for a task: its error ends the others, and is cancelled with them."""
    await task
