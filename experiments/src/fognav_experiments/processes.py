"""The cores as their processes run them, on a bus instead of brokers, wired from their tables of handlers.

Each class represents one process and adds to its core what no channel carries: a store without delay, the connection
to the broker, fetching snapshots, distance fields. Lockstep and replays share them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Final

from fog_contracts import channels as ch
from fog_contracts.codec import encode
from fog_contracts.messages import MapSnapshot, Message, PlanReply, RobotGoal, RobotState
from fognav_experiments.computers import ComputerClock, Link
from planner.dock_missions import DockGoals
from robot_agent.motion.local_planner import decide

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from fog_contracts.bus import Bus
    from fog_contracts.handlers import Handler, Ids, Moment, Publication, QueryHandler
    from fog_contracts.messages import EgressRequest, Pose, ProfileName, Zone
    from hazard_aggregator.core import Aggregator
    from map_service.core import MapCore
    from planner.core import PlannerCore
    from robot_agent.agent.core import AgentCore
    from robot_agent.guardian.link import WheelCommand

Measure = Callable[[str], AbstractContextManager[object]]
"""Returns what is entered around the work of a component, by its name: it measures what that costs."""

USED: Final[Mapping[ProfileName, frozenset[ch.Channel]]] = {
    "default": frozenset({ch.ROBOT_GOAL}),
    "full": frozenset({ch.ROBOT_GOAL, ch.HAZARD, ch.ZONES, ch.MAP_HEARTBEAT}),
    "fog": frozenset({
        ch.ROBOT_GOAL, ch.HAZARD, ch.ZONES, ch.MAP_HEARTBEAT, ch.MAP_DELTA, ch.ROBOT_PATH, ch.ROBOT_RELEASE,
    }),
}  # fmt: skip
"""What a robot receives from the fog that its profile uses."""


QUERY_TIMEOUT_S: Final = 3.0
"""How long a robot waits for the reply to a query."""


def unmeasured(_component: str) -> AbstractContextManager[object]:
    """Measure nothing."""
    return _NOTHING


_NOTHING: Final = nullcontext()


class FogProcess:
    """A process of the fog, which may die; another one takes its place on the bus then.

    All times that it is given are true: its core is given what its computer's clock shows.
    """

    def __init__(self, bus: Bus, clock: ComputerClock | None = None) -> None:
        self._bus = bus
        self._clock = clock or ComputerClock()
        self._connected: list[Handler | QueryHandler] = []
        self.alive = True

    def stop(self) -> None:
        """Die: nothing is received, answered or published any more."""
        self.alive = False
        self._bus.disconnect(self._connected)

    def _subscribe(self, handlers: Mapping[ch.Channel, Handler]) -> None:
        own = {channel: self._clock.heard(handler) for channel, handler in handlers.items()}
        self._bus.subscribe(own)
        self._connected += own.values()

    def _serve(self, query_handlers: Mapping[ch.Channel, QueryHandler]) -> None:
        own = {channel: self._clock.asked(handler) for channel, handler in query_handlers.items()}
        self._bus.serve(own)
        self._connected += own.values()


class AggregatorProcess(FogProcess):
    """The hazard-aggregator, with a store without delay."""

    def __init__(
        self, core: Aggregator, bus: Bus, measure: Measure = unmeasured, clock: ComputerClock | None = None
    ) -> None:
        super().__init__(bus, clock)
        self.core = core
        self._measure = measure
        self._subscribe({channel: self._with_store(handler) for channel, handler in core.handlers().items()})
        self._serve(core.query_handlers())

    def connect(self) -> None:
        """Publish everything again, as after each connection to the broker."""
        self._bus.publish(self.core.republish_all())

    def tick(self, at: Moment) -> None:
        """Tick the core; call it ten times a second."""
        with self._measure("aggregator"):
            self._bus.publish(self._store(self.core.tick(self._clock(at))))

    def _with_store(self, handler: Handler) -> Handler:
        def handle(ids: Ids, message: Message | str, at: Moment) -> Sequence[Publication]:
            with self._measure("aggregator"):
                return self._store(handler(ids, message, at))

        return handle

    def _store(self, publications: Sequence[Publication]) -> Sequence[Publication]:
        """Return these publications, and those that were withheld until stored."""
        return [*publications, *self.core.mark_stored(self.core.to_store())]


class MapProcess(FogProcess):
    """The map-service; `load_zones` and `put_zone` replace its store and REST API."""

    def __init__(
        self, core: MapCore, bus: Bus, measure: Measure = unmeasured, clock: ComputerClock | None = None
    ) -> None:
        super().__init__(bus, clock)
        self.core = core
        self._measure = measure
        self._serving = False
        self._subscribe({channel: self._measured(handler) for channel, handler in core.handlers().items()})

    def load_zones(self, zones: Iterable[Zone], at: Moment) -> None:
        """Load the stored zones; the map is not served before."""
        self._bus.publish(self.core.load_zones(zones, self._clock(at)))

    def put_zone(self, zone: Zone, at: Moment) -> None:
        """Add or replace an operator's zone."""
        self._bus.publish(self.core.put_zone(zone, self._clock(at)))

    def tick(self, at: Moment) -> None:
        """Tick the core, and serve queries once the map is complete; call it ten times a second."""
        with self._measure("map-service"):
            self._bus.publish(self.core.tick(self._clock(at)))
        if self.core.serving and not self._serving:
            self._serving = True
            self._serve(self.core.query_handlers())

    def _measured(self, handler: Handler) -> Handler:
        def handle(ids: Ids, message: Message | str, at: Moment) -> Sequence[Publication]:
            with self._measure("map-service"):
                return handler(ids, message, at)

        return handle


class PlannerProcess(FogProcess):
    """The planner: messages wait for its next tick; urgent ones trigger it at once."""

    def __init__(
        self,
        core: PlannerCore,
        bus: Bus,
        staging: Mapping[str, Pose] | None = None,
        measure: Measure = unmeasured,
        clock: ComputerClock | None = None,
    ) -> None:
        """`staging`: by robot, the pose in front of its dock."""
        super().__init__(bus, clock)
        self.core = core
        self._measure = measure
        self._docks = DockGoals(staging or {})
        self.due = False
        """Whether `tick` is due before its regular time."""
        self._subscribe({c: self._with_wake_up(c, handler) for c, handler in core.handlers().items()})
        self._serve(core.query_handlers())

    def set_goal(self, robot: str, goal: RobotGoal, *, any_heading: bool = False) -> None:
        """Give a robot a goal, as an operator does."""
        self.core.set_goal(robot, goal, any_heading=any_heading)
        self.due = True

    def tick(self, at: Moment) -> None:
        """Tick the core, then run the jobs and fetch the snapshot that it requests.

        Call it ten times a second, and when it is `due`.
        """
        self.due = False
        shown = self._clock(at)
        with self._measure("planner"):
            self._bus.publish(self.core.tick(shown))
            self.core.missions.pop_reached()
            for job in self.core.jobs(shown):
                job.run()
                self.due = self.core.add(job, shown.now) or self.due
        if self.core.wants_snapshot(shown.now):
            snapshot = self._bus.query(ch.MAP_SNAPSHOT, None, MapSnapshot, at)
            if snapshot is not None:
                self.core.load(snapshot, shown.now)
                self.due = True

    def deliver(self, at: Moment) -> None:
        """Deliver all messages on the bus, and tick as long as a tick is due."""
        self._bus.deliver(at)
        while self.due:
            self.tick(at)
            self._bus.deliver(at)

    def _send_to_dock(self, robot: str, state: RobotState, at: Moment) -> None:
        pose = self._docks.due(robot, state, self.core.missions.goal(robot), at.now)
        if pose is not None:
            self.set_goal(robot, RobotGoal(goal_id=f"dock-{at.now:.2f}", pose=pose, stamp=at.stamp))

    def _with_wake_up(self, channel: ch.Channel, handler: Handler) -> Handler:
        def handle(ids: Ids, message: Message, at: Moment) -> Sequence[Publication]:
            self.due = self.due or channel in self.core.URGENT
            if isinstance(message, RobotState):
                self._send_to_dock(ids["robot"], message, at)
            with self._measure("planner"):
                return handler(ids, message, at)

        return handle


class AgentProcess:
    """A robot's agent; its caller passes the data of base and lidar to the core. Times as for the fog's processes."""

    def __init__(
        self,
        core: AgentCore,
        robot: str,
        bus: Bus,
        measure: Measure = unmeasured,
        clock: ComputerClock | None = None,
    ) -> None:
        self.core = core
        self._clock = clock or ComputerClock()
        self._bus = bus
        self._measure = measure
        self.link = Link()
        """The robot's Wi-Fi: all messages go through it."""
        self.observe: Callable[[Sequence[Publication], Moment], None] = lambda _publications, _at: None
        """Is given what the robot publishes, whether it arrives or not."""
        self.received_bytes = 0
        """Bytes of the messages that were received and are of use in the robot's profile."""
        self._map_due = 0.0
        self._way_out: tuple[EgressRequest, float] | None = None
        """The newest request for a way out without a reply, and when its query times out."""
        handlers = {channel: self._measured(channel, handler) for channel, handler in core.handlers().items()}
        queries = {channel: self._clock.asked(handler) for channel, handler in core.query_handlers().items()}
        bus.subscribe(handlers, only={"robot": robot})
        bus.serve(queries, only={"robot": robot})
        self._connected: list[Handler | QueryHandler] = [*handlers.values(), *queries.values()]

    def stop(self) -> None:
        """Die: nothing is received or answered any more."""
        self._bus.disconnect(self._connected)

    def _measured(self, channel: ch.Channel, handler: Handler) -> Handler:
        component = "layers" if channel is ch.MAP_DELTA else "messages"

        def receive(ids: Ids, message: Message, at: Moment) -> Sequence[Publication]:
            if channel in USED[self.core.profile.name]:
                self.received_bytes += len(encode(channel, message))
            with self._measure(component):
                return handler(ids, message, self._clock(at))

        def handle(ids: Ids, message: Message, at: Moment) -> Sequence[Publication]:
            return self.link.down(lambda when: receive(ids, message, when), at)

        return handle

    def deliver(self, at: Moment) -> None:
        """Deliver what a slow link has held back long enough; call it every 10 ms."""
        self._bus.publish(self.link.due(at))

    def fetch_map(self, at: Moment) -> None:
        """Ask for a snapshot if the core wants one and none is under way; call it 20 times a second."""
        if self.link.whole and self.core.wants_snapshot(self._clock(at).now) and at.now >= self._map_due:
            until = self._map_due = at.now + QUERY_TIMEOUT_S
            self.link.ask(
                lambda when: self._bus.query(ch.MAP_SNAPSHOT, None, MapSnapshot, when),
                lambda snapshot, when: self._load(until, snapshot, when),
                at,
            )

    def _load(self, until: float, snapshot: MapSnapshot | None, at: Moment) -> None:
        """Load the reply to the query that times out at `until`; one that comes later is nobody's."""
        if until != self._map_due or at.now >= until:
            return
        self._map_due = at.now
        if snapshot is not None:
            self.received_bytes += len(snapshot.cost) + len(snapshot.speed) + len(snapshot.static)
            with self._measure("layers"):
                self.core.load(snapshot, self._clock(at).now)

    def control(self, at: Moment) -> None:
        """Run the robot's own global planner, if its profile has one, and its local planner, as often as this says."""
        at = self._clock(at)
        with self._measure("layers"):
            search = self.core.search(at.now)
        if search is not None:
            with self._measure("global planning"):
                self.core.on_found(search.run(), at)
        with self._measure("local planning"):
            job = self.core.control_job(at.now)
            if job is not None:
                self.core.accept(decide(job))

    def stream(self, at: Moment) -> WheelCommand:
        """Return the wheel command for the guardian; call it 20 times a second."""
        shown = self._clock(at)
        with self._measure("safety and wheels"):
            return self.core.stream(shown.now, shown.stamp)

    def tick(self, at: Moment) -> None:
        """Tick the core; call it ten times a second."""
        with self._measure("messages"):
            publications = self.core.tick(self._clock(at))
        self.observe(publications, at)
        self._bus.publish(self.link.up(publications, at))
        self._ask_for_way_out(at)

    def _ask_for_way_out(self, at: Moment) -> None:
        if self._way_out is not None and at.now >= self._way_out[1]:
            self._on_way_out(self._way_out, None, at)
        if (request := self.core.egress_request(self._clock(at).now)) is not None:
            asked = self._way_out = (request, at.now + QUERY_TIMEOUT_S if self.link.whole else at.now)
            self.link.ask(
                lambda when: self._bus.query(ch.PLANNER_EGRESS, request, PlanReply, when),
                lambda reply, when: self._on_way_out(asked, reply, when),
                at,
            )

    def _on_way_out(self, asked: tuple[EgressRequest, float], reply: PlanReply | None, at: Moment) -> None:
        """Pass on the reply to the newest query; one that comes after its time is nobody's."""
        if asked is self._way_out:
            self._way_out = None
            self.core.on_egress_reply(asked[0], reply, self._clock(at).now)


class Fog:
    """Aggregator, map-service and planner together."""

    def __init__(
        self,
        aggregator: Aggregator,
        map_: MapCore,
        planner: PlannerCore,
        bus: Bus,
        *,
        staging: Mapping[str, Pose] | None = None,
        measure: Measure = unmeasured,
    ) -> None:
        """`staging`: by robot, the pose in front of its dock. `measure`: of the services' work."""
        self.clock = ComputerClock()
        self.aggregator = AggregatorProcess(aggregator, bus, measure, self.clock)
        self.map = MapProcess(map_, bus, measure, self.clock)
        self.planner = PlannerProcess(planner, bus, staging, measure, self.clock)

    def start(self, at: Moment) -> None:
        """Connect everything, with no zones stored."""
        self.map.load_zones([], at)
        self.aggregator.connect()
        self.deliver(at)

    def deliver(self, at: Moment) -> None:
        """Deliver all messages on the bus, including those that result from them."""
        self.planner.deliver(at)

    def tick(self, at: Moment) -> None:
        """Tick all three; call it ten times a second."""
        for process in (self.aggregator, self.map, self.planner):
            if process.alive:
                process.tick(at)
            self.deliver(at)
