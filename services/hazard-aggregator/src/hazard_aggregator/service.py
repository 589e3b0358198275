"""Between the core and the world: takes what MQTT and zenoh bring, announces what the core decides, stores it."""

from __future__ import annotations

import asyncio
import zlib
from typing import TYPE_CHECKING

import msgspec
from prometheus_client import Gauge

from fog_contracts import channels as ch
from fog_contracts.messages import AreaDefinition, AreaHazard, NodeConfig, NodeReading, RobotPose
from fog_runtime import logs, metrics
from fog_runtime.clock import ticker
from hazard_aggregator.core import Aggregator, wsn_line
from hazard_aggregator.outbox import Outbox
from hazard_aggregator.store import StoreError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from fog_contracts.site import NodeSite, Site
    from fog_runtime.clock import Clock
    from fog_runtime.health import Health
    from fog_runtime.mqtt_edge import MqttEdge
    from fog_runtime.zenoh_edge import ZenohEdge
    from hazard_aggregator.store import Store

TICK_S = 0.1
RETRY_S = 0.5

HAZARDS = Gauge("fognav_hazards", "Whether an area is announced in this state (1) or not (0)", ["area", "state"])
WITHHELD = Gauge("fognav_hazards_withheld", "Areas whose relief waits for the store")

_log = logs.get("aggregator")


class Service:
    """The running aggregator; its loops are tasks of the process."""

    def __init__(self, core: Aggregator, site: Site, store: Store, clock: Clock, health: Health) -> None:
        self.core = core
        self.outbox = Outbox()
        self._site = site
        self.nodes: dict[str, NodeSite] = {node.id: node for node in site.nodes}
        self._store = store
        self._clock = clock
        self._health = health
        self._mqtt: MqttEdge | None = None
        self._to_send: dict[str, AreaHazard] = {}
        self._send = asyncio.Event()
        self._write = asyncio.Event()
        self._store_read = asyncio.Event()

    # --- What comes in ----------------------------------------------------------------------------------------------

    def listen(self, mqtt: MqttEdge, zenoh: ZenohEdge) -> None:
        """Say what to be called for."""
        self._mqtt = mqtt
        mqtt.on(ch.NODE_READING, self._on_reading, NodeReading)
        mqtt.on(ch.NODE_AVAILABILITY, self._on_availability)
        numbers = sorted({d.number for d in self.core.definitions() if d.number is not None})
        mqtt.on(ch.THESIS_AREA, self._on_thesis_state, numbers=numbers)
        # Its own last words: they outlive a restart without Redis.
        mqtt.on(ch.AREA_HAZARD, self._on_own_hazard, AreaHazard)
        mqtt.on_connect(self._say_everything)
        zenoh.subscribe(ch.ROBOT_POSE, RobotPose, self._on_pose)

    def _on_reading(self, ids: dict[str, str], reading: NodeReading) -> None:
        self._take(self.core.on_reading(ids["node"], reading, self._clock.now(), self._clock.stamp()))

    def _on_availability(self, ids: dict[str, str], text: str) -> None:
        if text not in ("online", "offline"):
            metrics.REFUSED.labels(ch.NODE_AVAILABILITY.name).inc()
            return
        now, stamp = self._clock.now(), self._clock.stamp()
        self._take(self.core.on_availability(ids["node"], text == "online", now, stamp))

    def _on_thesis_state(self, ids: dict[str, str], text: str) -> None:
        now, stamp = self._clock.now(), self._clock.stamp()
        self._take(self.core.on_thesis_state(int(ids["number"]), text.strip(), now, stamp))

    def _on_own_hazard(self, _ids: dict[str, str], hazard: AreaHazard) -> None:
        if hazard.epoch < self.core.epoch:
            self._take(self.core.recall([hazard], self._clock.stamp()))

    def _on_pose(self, ids: dict[str, str], pose: RobotPose) -> None:
        self._take(self.core.on_pose(ids["robot"], pose, self._clock.now()))

    async def put_area(self, definition: AreaDefinition, audit: dict[str, str]) -> None:
        """Store an area, then let it count; raises `StoreError` and changes nothing when it can't be stored."""
        await self._store.save_area(definition, audit)
        self._take(self.core.put_area(definition, self._clock.stamp()))
        if definition.removed:
            self.outbox.forget(definition.id)
            self._to_send.pop(definition.id, None)
        if self._mqtt is not None and definition.number is not None and not definition.removed:
            await self._mqtt.add_number(ch.THESIS_AREA, definition.number)
        await self._publish(ch.AREA_DEFINITION, definition, area=definition.id)

    # --- What goes out ----------------------------------------------------------------------------------------------

    def _take(self, changed: Iterable[AreaHazard]) -> None:
        changed = list(changed)
        if not changed:
            return
        for hazard in changed:
            if hazard.trace is not None:
                metrics.observe_trace(hazard.trace, ["debounce"])
            _log.info("hazard", area=hazard.area, state=hazard.state, penalty=hazard.penalty, cause=hazard.cause)
        self._announce(self.outbox.offer(changed))
        self._write.set()

    def _announce(self, hazards: Iterable[AreaHazard]) -> None:
        for hazard in hazards:
            self._to_send[hazard.area] = hazard
            for state in ("blocked", "clear", "unknown"):
                HAZARDS.labels(hazard.area, state).set(hazard.state == state)
        WITHHELD.set(len(self.outbox.withheld()))
        self._send.set()

    async def send_loop(self) -> None:
        """Publish what is announced, per area the newest."""
        while True:
            await self._send.wait()
            self._send.clear()
            while self._to_send:
                _, hazard = self._to_send.popitem()
                await self._say(hazard)

    async def write_loop(self) -> None:
        """Store hazards, again and again until Redis took them; what was withheld for it is then announced."""
        await self._store_read.wait()
        if weakness := await self._store.weakness():
            _log.warning("store_is_weak", remedy=weakness)
        while True:
            await self._write.wait()
            self._write.clear()
            while waiting := self.outbox.unstored():
                try:
                    await self._store.save_hazards(waiting)
                except StoreError as error:
                    self._health.set("store", ok=False, detail=str(error))
                    await asyncio.sleep(RETRY_S)
                    continue
                self._health.set("store", ok=True)
                self._announce(self.outbox.stored(waiting))

    def store_was_read(self) -> None:
        """Say that the start found the store: writing may begin."""
        self._store_read.set()
        self._health.set("store", ok=True)

    async def store_loop(self) -> None:
        """Watch Redis; after a start without it, read it as soon as it answers, before anything is written over."""
        while True:
            await asyncio.sleep(RETRY_S)
            try:
                if self._store_read.is_set():
                    await self._store.ping()
                    self._health.set("store", ok=True)
                    continue
                stored = await self._store.load(self.core.epoch)
            except StoreError as error:
                self._health.set("store", ok=False, detail=str(error))
                continue
            stamp = self._clock.stamp()
            for definition in stored.definitions:
                self._take(self.core.put_area(definition, stamp))
                if self._mqtt is not None and definition.number is not None:
                    await self._mqtt.add_number(ch.THESIS_AREA, definition.number)
            self._take(self.core.recall(stored.hazards, stamp))
            self.store_was_read()
            await self._say_everything()

    async def tick_loop(self) -> None:
        """Let the core notice silence, and tell health about the connection."""
        async for now in ticker(self._clock, TICK_S):
            self._take(self.core.tick(now, self._clock.stamp()))
            if self._mqtt is not None:
                self._health.set("mqtt", ok=self._mqtt.connected, detail="" if self._mqtt.connected else "no broker")

    async def _say_everything(self) -> None:
        """After every (re)connect: retained messages are a convenience of the broker's, never the record."""
        for definition in self.core.definitions():
            await self._publish(ch.AREA_DEFINITION, definition, area=definition.id)
        for hazard in self.outbox.announced():
            await self._say(hazard)
        for node in self.nodes.values():
            await self._publish(ch.NODE_CONFIG, node_config(node), node=node.id)

    async def _say(self, hazard: AreaHazard) -> None:
        await self._publish(ch.AREA_HAZARD, hazard, area=hazard.area)
        definition = next((d for d in self.core.definitions() if d.id == hazard.area), None)
        if definition is not None:
            node = self.nodes.get(definition.nodes[0]) if definition.nodes else None
            if line := wsn_line(definition, hazard, node):
                await self._publish(ch.THESIS_WSN, line)

    async def _publish(
        self, channel: ch.Channel, message: AreaDefinition | AreaHazard | NodeConfig | str, **ids: str
    ) -> None:
        if self._mqtt is not None:
            await self._mqtt.publish(channel, message, wait=False, **ids)


def node_config(node: NodeSite) -> NodeConfig:
    """Return what a node is told about its place; the version tells one content from another."""
    config = NodeConfig(
        version=0,
        range_limit_m=[sonar.range_limit for sonar in node.sonars],
        no_echo_is_clear=[sonar.no_echo_is_clear for sonar in node.sonars],
    )
    return msgspec.structs.replace(config, version=zlib.crc32(msgspec.json.encode(config)))
