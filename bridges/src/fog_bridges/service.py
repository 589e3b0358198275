"""Connects Home Assistant's core to the broker and to the floor."""

from __future__ import annotations

import asyncio
import time
from collections import Counter as Counts
from typing import TYPE_CHECKING, Any, Final

from fog_bridges.floor import ORDERS
from fog_bridges.home_assistant import CANCEL, STOP
from fog_bridges.picture import Picture
from fog_contracts import channels as ch
from fog_runtime import logs
from fog_runtime.clock import ticker

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from fog_bridges.floor import Floor
    from fog_bridges.home_assistant import HomeAssistant
    from fog_contracts.handlers import Publication
    from fog_runtime.clock import Clock
    from fog_runtime.transports.mqtt_edge import MqttEdge

TICK_S: Final = 1.0
"""How often it is looked who has fallen silent."""
PICTURE_S: Final = 2.0
"""How often the map is drawn at most."""
ORDERS_AT_ONCE: Final = 100
STOPS_AT_ONCE: Final = 20
"""Of one robot: a person presses no button more often while the floor is asked, and each has gone to the floor."""
ORDER_MAX_AGE_S: Final = 10.0
"""An order that has waited for longer is refused: who sent it may have forgotten it."""
_log = logs.get("bridge")


class HomeAssistantBridge:
    """The adapter for Home Assistant, at its broker or Fognav's."""

    name: Final = "home-assistant"

    def __init__(self, core: HomeAssistant, mqtt: MqttEdge, clock: Clock) -> None:
        self._core = core
        self._mqtt = mqtt
        self._clock = clock
        self._picture = Picture()
        self._orders: asyncio.Queue[tuple[str, str, int, float]] = asyncio.Queue(ORDERS_AT_ONCE)
        """Robot, order, how often the robot was stopped before it, and when it came (s, monotonic)."""
        self._stops: Counts[str] = Counts()
        self._stopping: Counts[str] = Counts()
        """How many stops of a robot wait for the floor's answer."""
        self._tasks: asyncio.TaskGroup | None = None
        self._floor: Floor | None = None
        self._is_known = False
        self._limited = logs.RateLimited(_log)
        """A broker may send the same order at any rate."""
        mqtt.on(ch.ROBOT_ORDER, self._on_order)
        mqtt.on(ch.ROBOT_REPORT, lambda ids, _: core.on_kept(ids["robot"]))
        mqtt.on_connect(self._tell_everything)

    @property
    def problem(self) -> str:
        """Why Home Assistant is told nothing; empty while it is."""
        return "" if self._mqtt.connected else "its broker is not connected"

    async def run(self, floor: Floor, clock: Clock) -> None:
        """Connect, and do all until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            self._tasks, self._floor = tasks, floor
            tasks.create_task(self._mqtt.run(), name="mqtt")
            tasks.create_task(self._order_loop(floor), name="orders")
            tasks.create_task(self._picture_loop(clock), name="picture")
            async for now in ticker(clock, TICK_S):
                self._publish(self._core.tick(now))

    def on_event(self, name: str, data: dict[str, Any]) -> None:
        """Pass on an event of the floor."""
        self._picture.on_event(name, data)
        self._publish(self._core.on_event(name, data, self._clock.now()))
        if name == "ready":
            self._tell_availability(known=True)

    def on_lost(self) -> None:
        """Say that nobody knows the floor's state."""
        self._core.on_lost()
        self._tell_availability(known=False)

    async def _order_loop(self, floor: Floor) -> None:
        """Carry out orders, one after the other; what a robot refuses is told where the order came from."""
        while True:
            robot, text, stops, came = await self._orders.get()
            now = self._clock.now()
            request = self._core.on_command(robot, text, now)
            if self._stops.get(robot, 0) != stops:
                request = f"{text!r} was not carried out: robot {robot} was stopped meanwhile"
            elif now - came > ORDER_MAX_AGE_S:
                request = f"{text[:40]!r} has waited for {now - came:.0f} s: send it again"
            await self._tell(robot, text, request if isinstance(request, str) else await floor.send(request))

    async def _stop(self, floor: Floor, robot: str) -> None:
        """Stop a robot, and end its mission: else it would go on with that once somebody enables it."""
        stop, cancel = (self._core.on_command(robot, text, self._clock.now()) for text in (STOP, CANCEL))
        refusal = stop if isinstance(stop, str) else await floor.send(stop)
        if not isinstance(cancel, str):
            await floor.send(cancel)  # that there is no mission is no reason to complain
        self._stopping[robot] -= 1
        await self._tell(robot, STOP, refusal)

    async def _tell(self, robot: str, order: str, refusal: str) -> None:
        ORDERS.labels(self.name, "refused" if refusal else "accepted").inc()
        fields = {"robot": robot, "order": order, "refusal": refusal}
        self._limited.info("order", f"{robot} {order} {refusal}", time.monotonic(), **fields)
        if self._core.knows(robot):  # the broker would keep what is told of any name
            await self._mqtt.publish(ch.ROBOT_REFUSAL, refusal[:250], robot=robot)

    async def _picture_loop(self, clock: Clock) -> None:
        """Draw the map when it or a robot on it has changed."""
        async for _ in ticker(clock, PICTURE_S):
            if self._picture.changed and (drawn := await asyncio.to_thread(self._picture.draw)) is not None:
                for channel, text in zip((ch.MAP_PICTURE, ch.MAP_PICTURE_PLACE), drawn, strict=True):
                    await self._mqtt.publish(channel, text)

    def _on_order(self, ids: Mapping[str, str], text: str) -> None:
        robot = ids["robot"]
        if text == STOP and self._core.knows(robot) and self._tasks is not None and self._floor is not None:
            # It waits for no other order: each may wait for a robot that does not answer.
            self._stops[robot] += 1
            if self._stopping[robot] < STOPS_AT_ONCE:
                self._stopping[robot] += 1
                self._tasks.create_task(self._stop(self._floor, robot), name="stop")
            else:
                self._drop(robot, text, f"{STOPS_AT_ONCE} stops of it are on their way already")
            return
        try:
            self._orders.put_nowait((robot, text, self._stops.get(robot, 0), self._clock.now()))
        except asyncio.QueueFull:
            self._drop(robot, text, f"{ORDERS_AT_ONCE} wait already")

    def _drop(self, robot: str, order: str, reason: str) -> None:
        ORDERS.labels(self.name, "dropped").inc()
        self._limited.warning("order_dropped", reason, time.monotonic(), robot=robot, order=order, reason=reason)

    async def _tell_everything(self) -> None:
        self._publish(self._core.everything())
        self._tell_availability(known=self._is_known)

    def _tell_availability(self, *, known: bool) -> None:
        self._is_known = known
        self._mqtt.publish_nowait(ch.BRIDGE_AVAILABILITY, ch.ONLINE if known else ch.OFFLINE)

    def _publish(self, publications: Sequence[Publication]) -> None:
        for channel, message, ids in ((each.channel, each.message, each.ids) for each in publications):
            self._mqtt.publish_nowait(channel, message, **ids)
