"""Connects robots of Fognav to a fleet control's broker, and robots of others to Fognav's zones.

Each robot of Fognav has a connection of its own, whose last will tells that it is gone.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final
from uuid import uuid4

import aiomqtt
import msgspec

from fog_bridges.floor import ORDERS, Request
from fog_bridges.vda5050 import telling
from fog_bridges.vda5050.connection import SYSTEM, Connection, Sender, Setup
from fog_bridges.vda5050.incoming import (
    MESSAGE_MAX,
    InstantActions,
    MessageError,
    Order,
    ReportedConnection,
    ReportedState,
    decoded,
)
from fog_bridges.vda5050.orders import Leg, Where, corners_of, goal_of, goals_of, is_repeated, rejection
from fog_bridges.vda5050.robot import FleetRobot
from fog_bridges.vda5050.uncertain import NOBODYS
from fog_bridges.vda5050.zones import ZoneSets, ZoneUser
from fog_runtime import logs
from fog_runtime.clock import ticker

if TYPE_CHECKING:
    from fog_bridges.floor import Floor
    from fog_bridges.vda5050.incoming import Node
    from fog_bridges.vda5050.outgoing import State
    from fog_runtime.clock import Clock

TICK_S: Final = 0.1
LOOK_S: Final = 2.0
"""How often the planner is asked for the path beyond the next node, while there is more of an order."""
ORDERS_AT_ONCE: Final = 10
LEGS: Final = 5
"""How many nodes beyond the next one the planned path reaches."""
LOOKED_FOR: Final = 20
"""Nodes of an order that are looked for on the map before it is taken over; further ones when they are next."""
_log = logs.get(SYSTEM)


class RobotLink(Connection):
    """A robot of Fognav at a fleet's broker."""

    def __init__(self, setup: Setup, robot: str, floor: Floor, clock: Clock) -> None:
        self.core = FleetRobot(robot, setup.map_id)
        self._setup = setup
        self._floor = floor
        self._sender = Sender(setup, setup.version, setup.manufacturer, robot)
        self._order_came = asyncio.Event()
        self.map_changes = 0
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
        for node, goal in goals_of(order, core.places)[:LOOKED_FOR]:
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

    async def look_loop(self) -> None:
        """Keep the path beyond the next node as the planner would have it: only 3.0 tells of paths."""
        async for _ in ticker(self.clock, LOOK_S):
            changes = self.map_changes
            legs = await self._beyond() if self._setup.version == "3.0" else []
            if changes == self.map_changes:
                self.core.orders.beyond = legs

    def on_floor(self, name: str, now: float, *, fresh: bool = False) -> None:
        """Take in that the floor begins anew, is known, or has other areas or zones."""
        if name == "ready":
            self.core.on_known(now)
        elif name == "hello" and fresh:
            self.core.forget()
        elif name != "hello":
            self.map_changes += 1
            self.core.orders.beyond = []  # the path beyond the next node may be another one by now

    async def _beyond(self) -> list[Leg]:
        ahead = [(node, goal_of(node, self.core.places)) for node in self.core.orders.nodes if node.released]
        legs: list[Leg] = []
        for (start, a), (end, b) in pairwise(ahead[: LEGS + 1]):
            if a is None or b is None:
                break
            poses = {name: {"x": at.x, "y": at.y, "theta": 0.0} for name, at in (("start", a), ("goal", b))}
            answer = await self._floor.ask(Request("POST", "/api/v1/plan", poses))
            if answer.refusal or answer.body.get("refusal") is not None or not answer.body.get("points"):
                break
            legs.append(Leg(start, end, corners_of([(x, y) for x, y in answer.body["points"]])))
        return legs

    async def drive_loop(self) -> None:
        """Keep the robot's mission what the order needs."""
        async for now in ticker(self.clock, TICK_S):
            self.core.advance(now)
            while self.core.is_known and (request := self.core.step(self.clock.now())) is not None:
                answer = await self._floor.ask(request)
                if answer.refusal and (request.headers or {}).get("If-Match") != NOBODYS:
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
                tasks.create_task(link.look_loop(), name=f"{robot}-look")
            if self._setup.zones:
                self._zones = ZoneLink(self._setup, clock)
                tasks.create_task(self._zones.run(), name="zones")

    def on_event(self, name: str, data: dict[str, Any]) -> None:
        """Take in an event of the floor."""
        if self._zones is not None:
            self._zones.sets.on_event(name, data)
        now = 0.0 if self._clock is None else self._clock.now()
        if name == "place":
            if (value := data["value"]) is None:
                self._places.pop(data["id"], None)
            else:
                self._places[data["id"]] = Where(value["x"], value["y"], value.get("theta"))
        elif name in ("hello", "ready", "area", "zone"):
            if data.get("fresh"):
                self._places.clear()
            for link in self._links.values():
                link.on_floor(name, now, fresh=bool(data.get("fresh")))
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
