"""The services' own `Service` classes with all their loops in one process: edges over a bus, a clock moved by tests.

Everything between a service's loops and its core is the real code; there are no brokers, databases, threads or ports.
"""

from __future__ import annotations

import asyncio
import inspect
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Final

from fog_contracts.bus import Bus, roundtrip
from fog_contracts.handlers import Moment, Publication
from fog_runtime.health import Health
from fognav_experiments.rigs import STAMP
from hazard_aggregator.core import Aggregator
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.registry import find_rule
from hazard_aggregator.service import Service as AggregatorService
from hazard_aggregator.store import Stored
from map_service.core import MapCore
from map_service.registry import make_layers
from map_service.service import Service as MapService
from planner.core import PlannerCore
from planner.service import Service as PlannerService
from planner.waits.persistence import Learned
from robot_agent.agent.core import AgentCore
from robot_agent.agent.edges.map_loader import MapLoader
from robot_agent.agent.service import Service as AgentService
from robot_agent.registry import profile

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine, Iterable, Sequence

    from fog_contracts.channels import Channel, Role
    from fog_contracts.messages import Message
    from fog_runtime.configuration.site import LoadedSite
    from fog_runtime.transports.mqtt_connection import ForeignHandler
    from robot_agent.config import AgentConfig
    from robot_agent.guardian.link import WheelCommand

AGENT_LOOPS: Final = ("agent map", "agent control", "agent stream")
TICKS: Final = ("aggregator tick", "map tick", "planner tick", "agent publish")
OTHERS: Final = ("aggregator alerts", "planner map", "agent housekeeping")
_EARLY_S: Final = 1e-6
"""Sums of periods are not exact multiples of a step: a task that is due within this time is due now."""


class InlineExecutor(ThreadPoolExecutor):
    """Runs each call immediately, on the submitting thread."""

    def submit(self, fn, /, *args, **kwargs):  # type: ignore[override]  # a test double without the type parameters
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except BaseException as error:  # noqa: BLE001  # the future's waiter raises it
            future.set_exception(error)
        return future


class SteppedClock:
    """A clock that stands still while tasks run, and wakes sleeping tasks one by one, in the order of their names."""

    speed = 1.0
    id = 0

    def __init__(self, order: Sequence[str]) -> None:
        self.time = 0.0
        self._order = order
        self._sleepers: list[tuple[float, str, asyncio.Future[None]]] = []

    def now(self) -> float:
        return self.time

    def stamp(self) -> float:
        return STAMP + self.time

    def real(self, seconds: float) -> float:
        return seconds

    async def sleep(self, seconds: float) -> None:
        task = asyncio.current_task()
        assert task is not None
        woken: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._sleepers.append((self.time + seconds, task.get_name(), woken))
        await woken

    async def wake(self, run_until_idle: Callable[[], Awaitable[None]]) -> None:
        """Wake all tasks that are due, in order; all work of one is completed before the next is woken."""
        due = [sleeper for sleeper in self._sleepers if sleeper[0] <= self.time + _EARLY_S]
        self._sleepers = [sleeper for sleeper in self._sleepers if sleeper not in due]
        for _, _, woken in sorted(due, key=lambda sleeper: self._order.index(sleeper[1])):
            woken.set_result(None)
            await run_until_idle()


class BusEdge:
    """The interfaces of `MqttEdge` and `ZenohEdge` over a bus; it enforces the roles of the channel table."""

    connected = True
    pending = 0

    def __init__(self, live: LiveServices, role: Role) -> None:
        self._live = live
        self._role = role

    def on(self, channel: Channel, handler: Any, kind: Any = None, *, numbers: Sequence[Any] = ()) -> None:
        assert channel.transport == "mqtt"
        assert channel.message is kind
        wanted = {str(number) for number in numbers}

        def only_numbers(ids: dict[str, str], message: Any) -> None:
            if "number" not in ids or ids["number"] in wanted:
                handler(ids, message)

        self._subscribe(channel, only_numbers, {})

    def subscribe(self, channel: Channel, kind: type[Message], handler: Any, **ids: str) -> None:
        assert channel.transport == "zenoh"
        assert channel.message is kind
        self._subscribe(channel, handler, ids)

    subscribe_polled = subscribe  # the bus delivers at once

    def poll(self) -> None:
        """Do nothing: nothing waits."""

    def _subscribe(self, channel: Channel, handler: Any, ids: dict[str, str]) -> None:
        assert self._role in channel.subscribers, channel.name
        self._live.subscribed.add((self._role, channel))

        def handle(ids: Any, message: Any, _at: Moment) -> Sequence[Publication]:
            handler(dict(ids), message)
            return ()

        self._live.bus.subscribe({channel: handle}, only=ids)

    def publish(self, channel: Channel, message: Message | str, **ids: str) -> None:
        assert self._role in channel.publishers, channel.name
        self._live.published.add((self._role, channel))
        self._live.bus.publish([Publication(channel, message, ids)])

    publish_nowait = publish

    def serve(self, channel: Channel, handler: Any, **ids: str) -> None:
        assert self._role in channel.publishers, channel.name
        self._live.served.add((self._role, channel))
        self._live.query_handlers[channel.key(site=self._live.site, **ids)] = handler, ids

    async def query(self, channel: Channel, request: Any, kind: type[Message], _timeout_s: float, **ids: str) -> Any:
        assert self._role in channel.subscribers, channel.name
        self._live.queried.add((self._role, channel))
        return await self._live.query(channel, request, kind, **ids)

    def refuse(self, _channel: Channel, key: str, reason: str) -> None:
        self._live.bus.refused.append(f"{key}: {reason}")

    async def add_number(self, channel: Channel, number: str | int) -> None: ...

    async def listen_to_foreign(
        self, topics: Iterable[str], handler: ForeignHandler, again: Iterable[str] = ()
    ) -> None: ...

    def on_connect(self, callback: Callable[[], Awaitable[None]]) -> None:
        """The broker never connects again."""

    def on_connection_lost(self, callback: Callable[[], object]) -> None:
        """The connection is never lost."""


class MemoryStore:
    """A store without delay that is empty at the start."""

    recoveries = 0

    def __init__(self) -> None:
        self.writes: list[tuple[Any, ...]] = []

    async def check(self) -> None: ...

    async def earlier_result(self, _attempt: Any) -> None:
        return None

    async def berths(self) -> dict[str, Any]:
        """No robot was ever handed over."""
        return {}

    async def out_of_service(self) -> dict[str, Any]:
        return {}

    async def schedules(self) -> dict[str, Any]:
        return {}

    async def learned(self) -> Learned:
        return Learned({}, {})

    async def put_learned(self, _learned: object) -> None: ...

    async def durability_warning(self) -> str:
        return ""

    async def zones(self) -> tuple[list[Any], dict[str, str]]:
        return [], {}

    async def read(self, _table: Any, _kind: Any) -> dict[str, Any]:
        return {}

    async def zone_times(self) -> dict[str, Any]:
        return {}

    async def load(self) -> Stored:
        return Stored([], [], [], {}, {})

    async def goals(self) -> dict[str, Any]:
        return {}

    async def alerts(self) -> list[Any]:
        return []

    async def save_alerts(self, alerts: list[Any]) -> None:
        self.writes.append(tuple(alerts))

    async def record_alert(self, *args: Any) -> None:
        self.writes.append(args)

    async def save_hazards(self, hazards: Any) -> None:
        self.writes.append(tuple(hazards))

    async def put(self, *args: Any, **_: Any) -> str:
        self.writes.append(args)
        return "ok"

    async def create(self, zone: Any, _audit: Any) -> tuple[str, Any]:
        self.writes.append((zone,))
        return "ok", zone

    async def delete(self, *args: Any, **_: Any) -> str:
        self.writes.append(args)
        return "ok"

    async def record_command(self, *args: Any) -> None:
        self.writes.append(args)

    # The agent's store is a folder.
    def snapshot(self, _site: str) -> None:
        return None

    def pose(self, _site: str) -> None:
        return None

    def put_snapshot(self, snapshot: Any) -> None:
        self.writes.append((snapshot,))

    def put_pose(self, pose: Any) -> None:
        self.writes.append((pose,))


class Link:
    """A stand-in for the guardian and for the lidar's port."""

    problem = ""
    pid = 0
    corrupted = 0

    def __init__(self) -> None:
        self.sent: list[WheelCommand] = []

    def send(self, command: WheelCommand) -> None:
        self.sent.append(command)

    def receive(self) -> None:
        """The guardian is silent."""

    def fetch(self) -> None:
        """The lidar is silent."""

    def poll(self, now: float, *, on: bool) -> tuple[()]:
        """The lidar is silent."""
        del now, on
        return ()


class LiveServices:
    """Aggregator, map-service, planner and one robot's agent, assembled as in their `__main__`."""

    def __init__(self, loaded: LoadedSite, config: AgentConfig, seed: int, bus: Bus) -> None:
        self.bus = bus
        self.site = loaded.site.id
        self.clock = SteppedClock((*AGENT_LOOPS, *TICKS, *OTHERS))
        self.query_handlers: dict[str, tuple[Any, dict[str, str]]] = {}
        self.subscribed: set[tuple[Role, Channel]] = set()
        self.published: set[tuple[Role, Channel]] = set()
        self.served: set[tuple[Role, Channel]] = set()
        self.queried: set[tuple[Role, Channel]] = set()
        self.link = Link()
        self._tasks: list[asyncio.Task[None]] = []
        definitions, clock = loaded.site.definitions(), self.clock
        self._loaded, self._robot = loaded, config.robot
        self.edges = edges = {
            role: BusEdge(self, role) for role in ("hazard-aggregator", "map-service", "planner", "robot-agent")
        }
        self.aggregator = AggregatorService(
            Aggregator(AreaFusion(definitions, loaded.site.nodes, 1, registry=find_rule)),
            MemoryStore(), edges["hazard-aggregator"], edges["hazard-aggregator"], clock, Health(),
            site=self.site,
        )  # fmt: skip
        self.map = MapService(
            MapCore(
                self.site, loaded.map, 1,
                layers=make_layers(loaded.map, loaded.site.layers), definitions=definitions,
            ),
            MemoryStore(), edges["map-service"], edges["map-service"], clock, Health(),
        )  # fmt: skip
        self.planner_core = PlannerCore(1)
        self.planner = PlannerService(
            self.planner_core, MemoryStore(), edges["planner"], clock, Health(), site=loaded.site
        )
        self.agent_core = AgentCore(config, seed, find_profile=profile)
        store = MemoryStore()
        self.agent = AgentService(self.agent_core, edges["robot-agent"], store, clock, Health())
        self.agent_map = MapLoader(
            self.agent_core, edges["robot-agent"], store, clock, site=self.site, phase=self.agent.phase
        )

    async def start(self) -> None:
        """Subscribe, load the stores and lead, connected, at time 0; periodic loops do not run yet."""
        body = next(robot for robot in self._loaded.site.robots if robot.id == self._robot)
        await self.agent_map.restore(body)
        for service in (self.aggregator, self.map, self.planner, self.agent):
            service.subscribe()
        self.aggregator.records.mark_loaded()
        for name, loop in (
            ("aggregator write", self.aggregator.write_loop()),
            ("map store", self.map.store_loop()),
            ("planner plan", self.planner.plan_loop()),
        ):
            await self._begin(name, loop)
        await self.aggregator.lead(1, confirmed=True)
        await self.map.lead(1, confirmed=True)
        await self.planner.lead(1, confirmed=True)
        await self.run_until_idle()

    async def begin_loops(self) -> None:
        """Start all periodic loops; each ticks at once."""
        loops = {
            "agent map": self.agent_map.snapshot_loop(),
            "agent control": self.agent.control_loop(),
            "agent stream": self.agent.stream_loop(self.link, self.link),
            "aggregator tick": self.aggregator.tick_loop(),
            "aggregator alerts": self.aggregator.alerts.run(),
            "map tick": self.map.tick_loop(),
            "planner tick": self.planner.tick_loop(),
            "agent publish": self.agent.publish_loop(),
            "planner map": self.planner.snapshots.snapshot_loop(),
            "agent housekeeping": self.agent.housekeeping_loop(self.link, self.link),
        }
        for name, loop in loops.items():
            await self._begin(name, loop)

    async def stop(self) -> None:
        """End everything; fails if a loop has died of an exception."""
        for task in self._tasks:
            task.cancel()
        ends = await asyncio.gather(*self._tasks, return_exceptions=True)
        self.planner.close()
        for end in ends:
            assert isinstance(end, asyncio.CancelledError), end

    async def run_until_idle(self) -> None:
        """Run until every task waits for the clock, and no message is undelivered."""
        loop: Any = asyncio.get_running_loop()
        while True:
            await asyncio.sleep(0)
            while loop._ready:  # noqa: ASYNC110  # asyncio has no event for an idle loop
                await asyncio.sleep(0)
            if not self.bus.deliver(Moment(self.clock.now(), self.clock.stamp())):
                return

    async def query(self, channel: Channel, request: Any, kind: type[Message], **ids: str) -> Any:
        """Send a query as a client of any role; return the reply, or None when no service replies it."""
        handler, served = self.query_handlers.get(channel.key(site=self.site, **ids), (None, {}))
        if handler is None:
            return None
        reply = handler(served, None if request is None else roundtrip(channel, request))
        reply = await reply if inspect.isawaitable(reply) else reply
        assert isinstance(reply, kind)
        return roundtrip(channel, reply, reply=channel.kind == "query")

    async def run(self, work: Coroutine[Any, Any, Any]) -> Any:
        """Run a coroutine to its end; return its result."""
        task = asyncio.create_task(work)
        await self.run_until_idle()
        return task.result()

    async def _begin(self, name: str, loop: Coroutine[Any, Any, None]) -> None:
        self._tasks.append(asyncio.create_task(loop, name=name))
        await self.run_until_idle()
