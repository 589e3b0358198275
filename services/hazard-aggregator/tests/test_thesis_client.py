"""A node and a robot as the thesis describes them (Mendes 2022, sections 3.3 to 3.5), with nothing of Fognav's own."""

import asyncio
import contextlib

import aiomqtt
import pytest

from fog_runtime.transports.mqtt_connection import Broker

pytestmark = pytest.mark.live
PERIOD_S = 0.1
"""Two sonars and a pause of 50 ms."""


class ThesisNode:
    """Publishes `blocked` or `clear` on its area's topic after each pair of readings, without an id or a counter."""

    def __init__(self, client: aiomqtt.Client, number: int) -> None:
        self.client = client
        self.topic = f"area {number}"
        self.obstacle = False

    async def run(self) -> None:
        while True:
            await self.client.publish(self.topic, "blocked" if self.obstacle else "clear")
            await asyncio.sleep(PERIOD_S)


class ThesisRobot:
    """Keeps the places that are dangerous: a line is an area's number and coordinates, -999 for a place that is not."""

    def __init__(self) -> None:
        self.dangers: dict[int, tuple[float, float]] = {}
        self.lines: list[str] = []

    def on_line(self, line: str) -> None:
        self.lines.append(line)
        number, x, y = line.split(",")
        if (float(x), float(y)) == (-999, -999):
            self.dangers.pop(int(number), None)
        else:
            self.dangers[int(number)] = float(x), float(y)


async def test_thesis_node_and_robot_work_with_the_aggregator(fog, until):
    file = fog.site / "site.toml"
    file.write_text(file.read_text().split("[[nodes]]")[0])
    fog.start("hazard_aggregator")
    await fog.ready("hazard_aggregator")
    broker = Broker.of(fog.mosquitto.url, fog.test_credentials)
    robot = ThesisRobot()
    async with broker.client("thesis", None) as client, asyncio.TaskGroup() as tasks:
        await client.subscribe("WSN", qos=1)

        async def listen() -> None:
            async for message in client.messages:
                robot.on_line(message.payload.decode())

        node = ThesisNode(client, 7)
        running = [tasks.create_task(listen()), tasks.create_task(node.run())]
        await until(lambda: "7,-999,-999" in robot.lines, "the area is clear", lambda: fog.log("hazard_aggregator"))
        assert robot.dangers == {}
        node.obstacle = True
        await until(lambda: 7 in robot.dangers, "the robot knows the danger")
        # Without a node's position it is the middle of the area.
        assert robot.dangers[7] == (3.5, 3.0)
        count = len(robot.lines)
        node.obstacle = False
        await until(lambda: 7 not in robot.dangers, "the danger is gone")
        assert robot.lines[count:] == ["7,-999,-999"], "a line comes with each change, and only then"
        for task in running:
            task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.gather(*running)
