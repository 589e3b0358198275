"""Connects robots of Fognav to a fleet control's broker, and robots of others to Fognav's zones.

Each robot of Fognav has a connection of its own, whose last will tells that it is gone. A message that is retained is
never an order: nobody knows how old it is.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Sequence  # msgspec resolves annotations at run time
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final
from uuid import uuid4

import aiomqtt
import msgspec

from fog_bridges.floor import Request
from fog_bridges.metrics import ORDERS, REFUSED
from fog_bridges.vda5050 import telling
from fog_bridges.vda5050.incoming import (
    MESSAGE_MAX,
    RELEASES,
    InstantActions,
    MessageError,
    Order,
    ReportedConnection,
    ReportedState,
    Version,
    decoded,
)
from fog_bridges.vda5050.orders import Where, is_repeated, rejection
from fog_bridges.vda5050.outgoing import of_version, timestamp
from fog_bridges.vda5050.robot import FleetRobot
from fog_bridges.vda5050.zones import ZoneSets, ZoneUser
from fog_runtime import logs
from fog_runtime.clock import ticker
from fog_runtime.concurrency import raise_if_cancelled
from fog_runtime.transports.mqtt_connection import Broker, Inbox

if TYPE_CHECKING:
    from fog_bridges.floor import Floor
    from fog_bridges.vda5050.incoming import Node
    from fog_bridges.vda5050.outgoing import State
    from fog_runtime.clock import Clock

SYSTEM: Final = "vda5050"
TICK_S: Final = 0.1
RETRY_S: Final = 1.0
ORDERS_AT_ONCE: Final = 10
LOOKED_FOR: Final = 20
"""Nodes of an order that are looked for on the map before it is taken over; further ones when they are next."""
_log = logs.get(SYSTEM)


class Setup(msgspec.Struct, frozen=True, kw_only=True):
    """Where messages go, and in whose name."""

    site: str
    broker: Broker
    version: Version
    interface: str
    manufacturer: str
    map_id: str
    robots: Sequence[str]
    """Of Fognav, under the fleet's control."""
    zones: Sequence[tuple[str, str]]
    """Manufacturer and serial number of robots of others that are told of zones."""


class Sender:
    """Numbers and writes the messages on one robot's topics."""

    def __init__(self, setup: Setup, version: Version, manufacturer: str, serial: str) -> None:
        self._version: Version = version
        self._names = {"manufacturer": manufacturer, "serialNumber": serial}
        self._base = f"{setup.interface}/v{version.partition('.')[0]}/{manufacturer}/{serial}/"
        self.numbers: Counter[str] = Counter()
        """How many messages each topic has had."""

    def topic(self, name: str) -> str:
        """Return the whole topic."""
        return self._base + name

    def message(self, name: str, content: msgspec.Struct | dict[str, Any], stamp: float) -> bytes:
        """Return a message; `content` is what it has beside its header, in the words of 3.0."""
        header = {"headerId": self.numbers[name], "timestamp": timestamp(stamp), "version": RELEASES[self._version]}
        self.numbers[name] += 1
        return msgspec.json.encode({**header, **self._names, **of_version(name, content, self._version)})


class Connection:
    """A connection to the fleet's broker that is made again and again."""

    def __init__(self, broker: Broker, name: str, topics: Sequence[str], clock: Clock) -> None:
        self._broker = broker
        self._name = name
        self._topics = topics
        self.clock = clock
        self.limited = logs.RateLimited(_log)
        self.problem = "not connected yet"
        """Why nothing is told; empty while it is."""

    def will(self) -> aiomqtt.Will | None:
        """Return what the broker tells when this connection is lost."""
        return None

    def on_message(self, topic: str, payload: bytes) -> None:
        """Take in a message that is not retained."""

    async def serve(self, client: aiomqtt.Client) -> None:
        """Tell what is to be told, until cancelled."""
        raise NotImplementedError

    async def run(self) -> None:
        """Connect and stay connected until cancelled."""
        while True:
            inbox = Inbox(self._on_message)
            try:
                async with self._broker.client(self._name, self.will(), inbox) as client:
                    await client.subscribe([(topic, 0) for topic in self._topics])
                    inbox.open()
                    self.problem = ""
                    await self.serve(client)
            except aiomqtt.MqttError as error:
                raise_if_cancelled()
                self.problem = f"the broker {self._broker} is not connected: {error}"
                self.limited.warning("broker_disconnected", self._name, self.clock.now(), reason=self.problem)
            await asyncio.sleep(RETRY_S)

    def _on_message(self, message: aiomqtt.Message) -> None:
        topic, payload = message.topic.value, message.payload
        if message.retain and not topic.endswith("/connection"):
            self.refuse("retained", topic, "it is retained, so nobody knows how old it is: delete it from the broker")
        elif isinstance(payload, bytes | bytearray):
            self.on_message(topic, bytes(payload))

    def refuse(self, reason: str, topic: str, words: str) -> None:
        """Count and log a message that is of no use."""
        REFUSED.labels(SYSTEM, reason).inc()
        self.limited.warning("message_refused", topic, self.clock.now(), topic=topic, reason=words[:300])


class RobotLink(Connection):
    """A robot of Fognav at a fleet's broker."""

    def __init__(self, setup: Setup, robot: str, floor: Floor, clock: Clock) -> None:
        self.core = FleetRobot(robot, setup.map_id)
        self._setup = setup
        self._floor = floor
        self._sender = Sender(setup, setup.version, setup.manufacturer, robot)
        self._order_came = asyncio.Event()
        self._is_asked = False
        self._wants_factsheet = True
        topics = [self._sender.topic(name) for name in ("order", "instantActions")]
        super().__init__(setup.broker, f"fognav-{setup.site}-{robot}", topics, clock)

    # --- What the fleet sends -----------------------------------------------------------------------------------------

    def on_message(self, topic: str, payload: bytes) -> None:
        """Take in an order or instant actions."""
        name, core = topic.rpartition("/")[2], self.core
        try:
            message = decoded(name, payload, self._setup.version, core.robot)
        except MessageError as error:
            self.refuse("malformed", topic, str(error))
            core.on_malformed(name, error)
            return
        if isinstance(message, InstantActions):
            self._on_instant(message)
        elif any(is_repeated(message, each) for each in (core.pending, *core.waiting) if each is not None):
            self._tell_order(message, "repeated", "")
        elif len(core.waiting) >= ORDERS_AT_ONCE:
            self.refuse("too_many", topic, f"{ORDERS_AT_ONCE} orders wait already")
        else:
            core.waiting.append(message)
            self._order_came.set()

    def _on_instant(self, message: InstantActions) -> None:
        core, now = self.core, self.clock.now()
        waited = core.waiting
        wishes = core.on_instant(message, now)
        self._is_asked |= "state" in wishes
        self._wants_factsheet |= "factsheet" in wishes
        for action in message.actions:
            kind = action.action_type
            key = f"action {kind if kind in dict(telling.ACTIONS) else 'unknown'}"  # a fleet can't make ever new keys
            self.limited.info("instant_action", key, now, robot=core.robot, action=kind, id=action.action_id)
        for order in waited:
            if order not in core.waiting:
                self._tell_order(order, "dropped", "it was cancelled first")

    def _tell_order(self, order: Order, result: str, words: str) -> None:
        ORDERS.labels(SYSTEM, result).inc()
        self.limited.info(
            "order", f"order {result}", self.clock.now(), robot=self.core.robot, order=order.order_id,
            update=order.order_update_id, result=result, refusal=words,
        )  # fmt: skip

    async def order_loop(self) -> None:
        """Take over or reject orders, one after the other."""
        while True:
            await self._order_came.wait()
            self._order_came.clear()
            while self.core.waiting:
                order = self.core.waiting.pop(0)
                result, words = await self._taken(order)
                self._is_asked |= result == "accepted"
                self._tell_order(order, result, words)

    async def _taken(self, order: Order) -> tuple[str, str]:
        core = self.core
        if core.orders.is_known(order):
            return "repeated", ""
        if (error := core.checked(order, self.clock.now())) is not None:
            return "refused", error.error_description
        core.pending = order
        for node, goal in core.goals(order)[:LOOKED_FOR]:
            refusal = await self._route(node, goal)
            if core.pending is not order:
                error = core.checked(order, self.clock.now())
                return "dropped", "it was cancelled first" if error is None else error.error_description
            if refusal:
                core.pending = None
                words = f"node {node.node_id}: {refusal}"
                core.reject(rejection(order, "NO_ROUTE_TO_TARGET", words, nodeId=node.node_id))
                return "refused", refusal
        core.pending = None
        if (error := core.checked(order, self.clock.now())) is not None:
            return "refused", error.error_description
        core.accept(order)
        return "accepted", ""

    async def _route(self, node: Node, goal: Where) -> str:
        """Return why a node can't be reached; empty if it can, or if nobody knows."""
        path = f"/api/v1/robots/{self.core.robot}/goal/dry-run"
        answer = await self._floor.ask(Request("POST", path, {"pose": {"x": goal.x, "y": goal.y}}))
        if answer.refusal:
            now, words = self.clock.now(), answer.refusal
            self.limited.warning("route_unknown", f"route {answer.problem}", now, node=node.node_id, reason=words)
            return answer.refusal if answer.problem == "request_invalid" else ""
        refusal = (answer.body.get("path") or {}).get("refusal")
        return "" if refusal is None else str(refusal.get("reason", "there is no path"))

    async def drive_loop(self) -> None:
        """Keep the robot's mission what the order needs."""
        async for now in ticker(self.clock, TICK_S):
            self.core.advance(now)
            while self.core.is_known and (request := self.core.step(self.clock.now())) is not None:
                answer = await self._floor.ask(request)
                if answer.refusal:
                    words = f"{request.method} {request.path}: {answer.refusal}"
                    self.limited.warning("mission_refused", answer.problem, self.clock.now(), reason=words)
                self.core.on_answer(answer, self.clock.now())

    # --- What the fleet is told ---------------------------------------------------------------------------------------

    def _connection(self, word: str) -> bytes:
        return self._sender.message("connection", {"connectionState": word}, self.clock.stamp())

    def will(self) -> aiomqtt.Will:
        """Return that the robot is gone."""
        payload = self._connection("CONNECTION_BROKEN")
        return aiomqtt.Will(self._sender.topic("connection"), payload, qos=1, retain=True)

    async def serve(self, client: aiomqtt.Client) -> None:
        """Tell whether the robot is there, and all about it while it is."""
        try:
            await self._tell(client)
        except asyncio.CancelledError:
            with suppress(aiomqtt.MqttError):
                await client.publish(self._sender.topic("connection"), self._connection("OFFLINE"), qos=1, retain=True)
            raise

    async def _tell(self, client: aiomqtt.Client) -> None:
        said, told, path, told_at, drawn_at = "", None, -1, 0.0, 0.0
        self._wants_factsheet = True
        async for now in ticker(self.clock, TICK_S):
            word = "ONLINE" if self.core.is_known and self.core.is_there(now) else "CONNECTION_BROKEN"
            if word != said:
                await client.publish(self._sender.topic("connection"), self._connection(word), qos=1, retain=True)
                said, told = word, None
            if word != "ONLINE":
                continue
            if self._wants_factsheet:
                self._wants_factsheet = False
                await self._publish(client, "factsheet", telling.factsheet(self.core, self._setup.version))
            state = telling.state(self.core, now, self.clock.stamp())
            lasting = telling.lasting(state)
            is_news = lasting != told or path != self.core.path_changes or self._is_asked
            if (is_news and now - told_at >= telling.CHANGED_S) or now - told_at >= telling.STATE_S:
                told, path, told_at, self._is_asked = lasting, self.core.path_changes, now, False
                await self._publish(client, "state", state)
            if now - drawn_at >= telling.VISUALIZATION_S and self.core.pose is not None:
                drawn_at = now
                number = max(0, self._sender.numbers["state"] - 1)
                drawn = telling.visualization(self.core, number, self.clock.stamp())
                await self._publish(client, "visualization", drawn)

    async def _publish(self, client: aiomqtt.Client, name: str, content: State | Any) -> None:  # noqa: ANN401  # any message
        payload = self._sender.message(name, content, self.clock.stamp())
        # The factsheet is retained, so that a fleet control that starts later has it without asking.
        await client.publish(self._sender.topic(name), payload, qos=0, retain=name == "factsheet")


class ZoneLink(Connection):
    """Fognav as fleet control of zones: only 3.0 has them."""

    def __init__(self, setup: Setup, clock: Clock) -> None:
        self.sets = ZoneSets(setup.site, setup.map_id)
        self._users = {key: ZoneUser(self.sets.prefix, setup.map_id) for key in setup.zones}
        self._senders = {key: Sender(setup, "3.0", *key) for key in setup.zones}
        self._logged: dict[tuple[str, str], tuple[str, str]] = {}
        self._of_topic = {
            sender.topic(name): (key, name) for key, sender in self._senders.items() for name in ("state", "connection")
        }
        super().__init__(setup.broker, f"fognav-{setup.site}-zones", list(self._of_topic), clock)

    def on_message(self, topic: str, payload: bytes) -> None:
        """Take in which zone sets a robot has, and whether it is there."""
        key, name = self._of_topic[topic]
        user = self._users[key]
        try:
            if len(payload) > MESSAGE_MAX:
                raise msgspec.DecodeError(f"{len(payload)} bytes are over the limit of {MESSAGE_MAX}")
            if name == "state":
                user.on_state(msgspec.json.decode(payload, type=ReportedState).zone_sets)
            elif payload:
                said = msgspec.json.decode(payload, type=ReportedConnection).connection_state
                user.is_online = said == "ONLINE"
        except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
            self.refuse("malformed", topic, str(error))

    async def serve(self, client: aiomqtt.Client) -> None:
        """Have each robot use the floor's current zone set."""
        async for now in ticker(self.clock, TICK_S):
            self.sets.update(now)
            current = self.sets.current
            if current is None:
                continue
            for key, user in self._users.items():
                for kind, name in user.steps(current.zone_set_id, now):
                    if self._logged.get(key) != (kind, name):  # else it is sent again
                        self._logged[key] = kind, name
                        _log.info("zone_set", robot="/".join(key), step=kind, zone_set=name)
                    if kind == "zoneSet":
                        await self._send(client, key, "zoneSet", {"zoneSet": current})
                    else:
                        action = {
                            "actionType": kind, "actionId": uuid4().hex, "blockingType": "NONE",
                            "actionParameters": [{"key": "zoneSetId", "value": name}],
                        }  # fmt: skip
                        await self._send(client, key, "instantActions", {"actions": [action]})

    async def _send(self, client: aiomqtt.Client, key: tuple[str, str], name: str, content: dict[str, Any]) -> None:
        sender = self._senders[key]
        await client.publish(sender.topic(name), sender.message(name, content, self.clock.stamp()), qos=0)

    @property
    def words(self) -> str:
        """Why not all robots use the current zone set; empty if they do."""
        behind = [f"{'/'.join(key)}: {user.problem}" for key, user in self._users.items() if user.problem]
        return self.problem or "; ".join(behind)


class Vda5050Bridge:
    """The adapter for VDA 5050."""

    name: Final = SYSTEM

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._links: dict[str, RobotLink] = {}
        self._zones: ZoneLink | None = None
        self._places: dict[str, Where] = {}
        self._clock: Clock | None = None

    @property
    def problem(self) -> str:
        """Why the fleet is told nothing, or robots of others do not use the zones; empty if all is well."""
        if self._clock is None:
            return "not started yet"
        found = [link.problem for link in self._links.values()]
        found += [f"no robot {robot} is heard of" for robot, link in self._links.items() if not link.core.state]
        return next((each for each in found if each), "" if self._zones is None else self._zones.words)

    async def run(self, floor: Floor, clock: Clock) -> None:
        """Connect, and do all until cancelled."""
        self._clock = clock
        self._links = {robot: RobotLink(self._setup, robot, floor, clock) for robot in self._setup.robots}
        for link in self._links.values():
            link.core.places = self._places
        async with asyncio.TaskGroup() as tasks:
            for robot, link in self._links.items():
                tasks.create_task(link.run(), name=robot)
                tasks.create_task(link.order_loop(), name=f"{robot}-orders")
                tasks.create_task(link.drive_loop(), name=f"{robot}-drive")
            if self._setup.zones:
                self._zones = ZoneLink(self._setup, clock)
                tasks.create_task(self._zones.run(), name="zones")

    def on_event(self, name: str, data: dict[str, Any]) -> None:
        """Take in an event of the floor."""
        if self._zones is not None:
            self._zones.sets.on_event(name, data)
        now = 0.0 if self._clock is None else self._clock.now()
        if name == "hello" and data["fresh"]:
            self._places.clear()
            for link in self._links.values():
                link.core.forget()
        elif name == "ready":
            for link in self._links.values():
                link.core.on_known(now)
        elif name == "place":
            if (value := data["value"]) is None:
                self._places.pop(data["id"], None)
            else:
                self._places[data["id"]] = Where(value["x"], value["y"], value.get("theta"))
        elif (link_of := self._links.get(data.get("id", ""))) is not None:
            self._on_robots_event(link_of.core, name, data, now)

    @staticmethod
    def _on_robots_event(core: FleetRobot, name: str, data: dict[str, Any], now: float) -> None:
        value = data.get("value")
        if name == "robot" and value is not None:
            core.on_robot(value, now)
        elif name == "pose" and value is not None:
            core.on_pose(value, now)
        elif name == "path":
            core.on_path([] if value is None else [(x, y) for x, y in value["points"]])
        elif name == "record" and data["kind"] == "mission":
            before, after = (((data[each] or {}).get("goal") or {}).get("goal_id") for each in ("before", "after"))
            if before and before != after:
                core.on_end(before, now, reached=data["action"] == "reached")

    def on_lost(self) -> None:
        """Take in that nobody knows the floor's state."""
        for link in self._links.values():
            link.core.is_known = False
        if self._zones is not None:
            self._zones.sets.on_lost()
