"""A robot of another maker for the demo, that knows of Fognav only what VDA 5050 3.0 says.

`python -m fognav_sim.guest_vda5050`. It has the maker's own map of the floor, and the zone sets of a fleet control at
an MQTT broker, read and told of as the norm has it (6.4, 6.10); it plans and drives as the guest by ROS 2 does.
"""

from __future__ import annotations

import asyncio
import json
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from fog_runtime.configuration.maps import load_map
from fog_runtime.transports.mqtt_connection import Broker
from fognav_sim.guest import STEP_S, Grid, Guest

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

MAKER: Final = "kit"
SERIAL: Final = "0001"
_BASE: Final = f"vda5050/v3/{MAKER}/{SERIAL}"
_LETHAL: Final = 100
_STATE_S: Final = 1.0


def inside(vertices: Sequence[Mapping[str, float]], floor: Grid) -> NDArray[np.bool_]:
    """Return which cells (height, width) of a floor have their middle in a polygon, by the even-odd rule."""
    height, width = floor.cells.shape
    x = floor.x + (np.arange(width) + 0.5) * floor.resolution
    y = (floor.y + (np.arange(height) + 0.5) * floor.resolution)[:, None]
    found = np.zeros((height, width), np.bool_)
    for a, b in zip(vertices, [*vertices[1:], vertices[0]], strict=True):
        if a["y"] == b["y"]:
            continue
        crosses = (a["y"] > y) != (b["y"] > y)
        found ^= crosses & (x < a["x"] + (y - a["y"]) * (b["x"] - a["x"]) / (b["y"] - a["y"]))
    return found


class ZoneSets:
    """The zone sets that the robot has; at most one is enabled."""

    def __init__(self, guest: Guest, map_id: str) -> None:
        self._guest, self._map_id = guest, map_id
        self._sets: dict[str, list[dict[str, Any]]] = {}
        self._enabled = ""
        self._actions: list[dict[str, str]] = []

    def on_zone_set(self, told: dict[str, Any]) -> None:
        """Keep a set of this map, disabled."""
        found = told["zoneSet"]
        if found["mapId"] == self._map_id:
            self._sets.setdefault(found["zoneSetId"], found["zones"])

    def on_actions(self, told: dict[str, Any]) -> None:
        """Enable or delete a set."""
        for action in told["actions"]:
            name = next(each["value"] for each in action["actionParameters"] if each["key"] == "zoneSetId")
            kind, known = action["actionType"], name in self._sets
            if known and kind == "enableZoneSet":
                self._enabled = name
                self._use(self._sets[name])
            elif known and kind == "deleteZoneSet" and name != self._enabled:
                del self._sets[name]
            done = {
                "actionId": action["actionId"],
                "actionType": kind,
                "actionStatus": "FINISHED" if known else "FAILED",
            }
            self._actions = [*self._actions, done][-20:]

    def _use(self, zones: Sequence[Mapping[str, Any]]) -> None:
        floor = self._guest.floor
        assert floor is not None
        keepout, speed = (np.zeros(floor.cells.shape, np.int8) for _ in range(2))
        for zone in zones:
            if zone["zoneType"] == "BLOCKED":
                keepout[inside(zone["vertices"], floor)] = _LETHAL
            elif zone["zoneType"] == "SPEED_LIMIT":
                speed[inside(zone["vertices"], floor)] = round(100.0 * zone["maximumSpeed"])
        self._guest.speed = floor._replace(cells=speed)
        self._guest.on_keepout(floor._replace(cells=keepout))

    def state(self) -> dict[str, Any]:
        """Return what the robot's state says of zone sets and their actions."""
        status = {name: "ENABLED" if name == self._enabled else "DISABLED" for name in self._sets}
        sets = [{"zoneSetId": name, "mapId": self._map_id, "zoneSetStatus": each} for name, each in status.items()]
        return {"zoneSets": sets, "instantActionStates": self._actions}


async def drive(guest: Guest, sets: ZoneSets, broker: Broker, host: str, speed: float) -> None:
    """Drive until the goal is reached or this is cancelled; `host` is the topic of Fognav's robot's visualization."""
    number = 0

    def message(**content: object) -> str:
        nonlocal number
        number += 1
        now = time.strftime("%Y-%m-%dT%H:%M:%S.000Z", time.gmtime())
        head = {"headerId": number, "timestamp": now, "version": "3.0.0", "manufacturer": MAKER, "serialNumber": SERIAL}
        return json.dumps(head | content)

    async with broker.client(SERIAL, None) as client:

        async def hear() -> None:
            async for told in client.messages:
                name, content = str(told.topic), json.loads(bytes(told.payload or b""))
                if name == host:
                    at = content.get("mobileRobotPosition")
                    guest.host = guest.host if at is None else (at["x"], at["y"])
                    continue
                (sets.on_zone_set if name.endswith("/zoneSet") else sets.on_actions)(content)
                await client.publish(f"{_BASE}/state", message(**sets.state()))

        for topic in (host, f"{_BASE}/zoneSet", f"{_BASE}/instantActions"):
            await client.subscribe(topic)
        await client.publish(f"{_BASE}/connection", message(connectionState="ONLINE"), qos=1, retain=True)
        hearing, told_at = asyncio.create_task(hear()), 0.0
        try:
            while not guest.has_arrived:
                if hearing.done():
                    hearing.result()
                if time.monotonic() - told_at >= _STATE_S:
                    told_at = time.monotonic()
                    await client.publish(f"{_BASE}/state", message(**sets.state()))
                await asyncio.sleep(STEP_S)
                guest.step(STEP_S * speed, time.monotonic() * speed)
        finally:
            hearing.cancel()


async def _main() -> None:
    """Drive as the command line says: BROKER MAP MAP_ID HOST_TOPIC START_X START_Y GOAL_X GOAL_Y SPEED."""
    url, file, map_id, host = sys.argv[1:5]
    x, y, goal_x, goal_y, speed = map(float, sys.argv[5:10])
    guest, static = Guest((x, y), (goal_x, goal_y)), load_map(Path(file))
    at = static.geometry
    guest.floor = Grid((static.cells != 0).astype(np.int8), at.resolution, at.origin_x, at.origin_y)
    driving = asyncio.create_task(drive(guest, ZoneSets(guest, map_id), Broker.of(url), host, speed))
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, driving.cancel)
    with suppress(asyncio.CancelledError):
        await driving
    sys.stdout.write(json.dumps(guest.report()) + "\n")


if __name__ == "__main__":
    asyncio.run(_main())
