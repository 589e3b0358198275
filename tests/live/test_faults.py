"""What a running robot does when parts of the system die, lie or vanish: one stack, one fault after the other.

The tests of this module share a robot that drives up and down the middle corridor; each leaves it able to drive.
"""

from __future__ import annotations

import asyncio
import json
import logging
import math
import os
import random
import signal
import time
from typing import TYPE_CHECKING

import aiomqtt
import pytest
import pytest_asyncio
from driver import START, Floor

from fog_contracts.geometry import contains_point
from fog_contracts.messages import Pose, SimCommand
from fog_supervisor import net
from fognav.stack import AGENT, AGGREGATOR, BROKER, MAP_SERVICE, PLANNER, REDIS, ROUTER
from fognav_sim.scenario import person_at

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

_log = logging.getLogger("live")
"""Tells measured figures (`pytest --log-cli-level=info`)."""

pytestmark = [pytest.mark.live, pytest.mark.reaction, pytest.mark.asyncio(loop_scope="module"), pytest.mark.timeout(90)]

STOPPED_WITHIN_S = 0.3
LATE_S, LOST_S = 1.0, 3.0
"""Age of the map from which on the robot is slow, and from which on it stands."""
PLAN_LATE_S = 1.5
RAMP_S = 0.5
MARGIN_S = 0.3
"""Beats of the heartbeat (0.1 s), of the control loop (0.2 s) and of the stream (0.05 s)."""
SLOW_M_S = 0.15
EAST = (58.0, 28.4)
WEST = (15.0, 28.4)
NODE_X, NODE_Y = 40.0, 29.85
Z1 = [(38.0, 26.9), (42.0, 26.9), (42.0, 29.9), (38.0, 29.9)]


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def floor(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Floor]:
    async with Floor(tmp_path_factory.mktemp("live")) as made:
        yield made


async def test_the_robot_crosses_a_watched_area_without_blocking_it_by_itself(floor: Floor) -> None:
    floor.readings.clear()
    told: set[str] = set()
    await floor.drive_to(*EAST)
    while floor.truth.x < Z1[1][0] + 0.3:
        told.add(floor.hazard("z1"))
        await floor.until(lambda before=floor.truth.x: floor.truth.x > before + 0.05, 20, "it gets on")
    assert told == {"clear"}
    # The node itself saw it, and for longer than the five readings that make a hazard.
    assert sum(reading.state == "blocked" for reading in floor.readings) > 10
    assert floor.truth.contacts == 0


async def test_a_person_in_the_beam_beside_the_robot_does_block_the_area(floor: Floor) -> None:
    await floor.drive_to(*WEST)
    await floor.until(lambda: abs(floor.truth.x - NODE_X) < 0.15, 60, "it is in the beam")
    assert floor.hazard("z1") == "clear"
    seen = time.monotonic()
    await floor.simulate(SimCommand(place=[person_at(NODE_X, NODE_Y - 0.40)]))
    await floor.until(lambda: floor.hazard("z1") == "blocked", 3, "the area is blocked")
    await floor.until(lambda: floor.state.mode == "PROTECTIVE_STOP", 1, "it stops in the blocked area")
    _log.info("person_to_stop_s: %s", round(time.monotonic() - seen, 3))
    assert contains_point(Z1, floor.truth.x, floor.truth.y)
    await floor.until(lambda: floor.log_lines(time.monotonic() - 0.2)[-1].stands, 1, "it stands")
    # With the robot in the beam nobody can tell whether the person has left: somebody carries it away.
    away = Pose(x=START[0], y=START[1], theta=math.pi)
    await floor.simulate(SimCommand(remove=["person"], kidnap=away))
    reply = await floor.operator.command("initial_pose", away)
    assert reply is not None
    assert reply.accepted, reply.reason
    await floor.until(lambda: floor.hazard("z1") == "clear", 20, "the area is clear again")
    await floor.goes_on()
    assert floor.off < 0.3
    assert floor.truth.contacts == 0


async def test_a_killed_agent_stands_at_once_and_waits_for_an_operator_where_it_is(floor: Floor) -> None:
    await floor.drive_to(*EAST)
    await floor.leave()
    starts = floor.starts()
    killed = time.monotonic()
    floor.stack.supervisor.kill(AGENT)
    await floor.agent_is_back(starts[AGENT])
    await floor.until(lambda: floor.state.mode == "INIT", 10, "it is in INIT")
    await floor.until(
        lambda: "waiting for an operator to enable" in floor.state.reasons and len(floor.state.reasons) == 1,
        30,
        "only the operator is missing",
    )
    ready = time.monotonic() - killed
    await asyncio.sleep(1.0)  # long enough to see it drive, if it did
    stood = floor.stood_after(killed)
    _log.info("wheels_zero_ms: %s", round(1000 * stood))
    _log.info("ready_s: %s", round(ready, 1))
    _log.info("off_m: %s", round(floor.off, 3))
    assert stood < STOPPED_WITHIN_S
    assert floor.off < 0.3
    assert not floor.state.enabled
    floor.attend()
    await floor.drives()
    await floor.goes_on()
    others = {name: count for name, count in floor.starts().items() if name != AGENT}
    assert others == {name: starts[name] for name in others}


async def test_a_killed_guardian_leaves_no_wheel_turning(floor: Floor) -> None:
    await floor.drive_to(*EAST)
    starts, guardian = floor.starts(), floor.guardian
    assert guardian is not None
    killed = time.monotonic()
    os.kill(guardian, signal.SIGKILL)
    await floor.until(lambda: floor.state.mode == "PROTECTIVE_STOP", 3, "the robot notices")
    await floor.until(lambda: floor.guardian not in {None, guardian}, 5, "there is another guardian")
    stood = next(line.at for line in floor.log_lines(killed) if line.stands) - killed
    _log.info("wheels_zero_ms: %s", round(1000 * stood))
    assert stood < STOPPED_WITHIN_S
    await floor.drives()
    resumed = next(line.at for line in floor.log_lines(killed + STOPPED_WITHIN_S) if not line.stands)
    _log.info("drives_again_s: %s", round(resumed - killed, 1))
    assert resumed - killed > 2.0, "it must be healthy for 2 s first"
    await floor.goes_on()
    assert floor.starts() == starts


MISSED_BY = {
    BROKER: [(AGGREGATOR, "mqtt (not connected to the broker)"), (MAP_SERVICE, "mqtt (not connected to the broker)")],
    REDIS: [(AGGREGATOR, "store (Redis"), (MAP_SERVICE, "store (Redis"), (PLANNER, "store (Redis")],
    ROUTER: [(PLANNER, "zenoh")],
}
"""Which service says on `/readyz` that it misses which part."""


@pytest.mark.parametrize(
    ("name", "seconds"), [(BROKER, 5), (REDIS, 4), (ROUTER, 5), (AGGREGATOR, 4), (MAP_SERVICE, 5), (PLANNER, 5)]
)
async def test_a_part_that_vanishes_for_a_while_is_missed_by_name_and_harms_nobody(
    floor: Floor, name: str, seconds: float
) -> None:
    east = floor.truth.x < 50
    await floor.drive_to(*(EAST if east else WEST))
    supervisor, starts = floor.stack.supervisor, floor.starts()
    begun = time.monotonic()
    supervisor.kill(name)
    await supervisor.stop(name)
    await asyncio.sleep(seconds)  # it stays away
    away = floor.log_lines(begun)
    mode, reasons, areas = floor.state.mode, floor.state.reasons, floor.hazard("z1")
    for service, part in MISSED_BY.get(name, ()):
        missed = await net.readiness(floor.stack.port_file(service))
        assert missed is not None, f"{service} says that it misses nothing"
        assert part in missed
    supervisor.start(name)
    await supervisor.wait_ready([name], 30)
    if name in {ROUTER, MAP_SERVICE}:
        # Nobody confirms the map any more.
        late = [line.speed for line in away if line.at > begun + LATE_S + MARGIN_S]
        assert max(late) <= SLOW_M_S + 0.001
        assert all(line.stands for line in away if line.at > begun + LOST_S + RAMP_S + MARGIN_S)
    if name in {BROKER, AGGREGATOR}:
        assert areas == "unknown", "nobody can tell any more that the area is clear"
    if name == PLANNER:
        assert max(line.speed for line in away if line.at > begun + PLAN_LATE_S + MARGIN_S) <= SLOW_M_S + 0.001
    await floor.goes_on()
    _log.info("away: %s", f"{mode} {reasons} {areas}")
    _log.info("gets_on_s: %s", round(time.monotonic() - begun, 1))
    assert floor.starts() == {**starts, name: starts[name] + 1}
    assert floor.truth.contacts == 0


async def test_rubbish_from_sensors_and_on_the_line_ends_nothing(floor: Floor) -> None:
    await floor.drive_to(*(EAST if floor.truth.x < 50 else WEST))
    starts = floor.starts()
    generator = random.Random(1)
    topic = "fog/v1/estig/nodes/n1/reading"
    rubbish: list[bytes] = [
        b"", b"{", b"null", b"[1,2]", b"\xff\xfe\x00", json.dumps({"seq": "one"}).encode(), generator.randbytes(900),
        b"[" * 1000, b"x" * 200_000,
    ]  # fmt: skip
    port = floor.stack.mqtt_port
    async with aiomqtt.Client("127.0.0.1", port) as listener:
        await listener.subscribe(topic)
        async with aiomqtt.Client("127.0.0.1", port) as sender:
            for payload in rubbish:
                await sender.publish(topic, payload, qos=1)
        # What is larger than any message costs its sender the connection.
        with pytest.raises(aiomqtt.MqttError):
            async with aiomqtt.Client("127.0.0.1", port, timeout=3) as sender:
                await sender.publish(topic, b"x" * 10_000_000, qos=1)
        async with aiomqtt.Client("127.0.0.1", port) as sender:
            await sender.publish(topic, b"the last", qos=1)
        largest = 0
        async with asyncio.timeout(10):
            async for message in listener.messages:
                assert isinstance(message.payload, bytes)
                largest = max(largest, len(message.payload))
                if message.payload == b"the last":
                    break
    assert largest == 200_000, "the broker keeps what is far too large from everybody"
    lidar = floor.stack.folder / "sim" / "lidar"
    with lidar.open("wb", buffering=0) as line:
        line.write(generator.randbytes(2000))
        line.write(bytes((0xA5, 0x25)))  # and, as bad luck will have it, the command to stop
    await floor.goes_on()
    assert floor.hazard("z1") == "clear"
    assert floor.starts() == starts


async def test_a_goal_in_a_wall_is_refused_with_reason_remedy_and_field(floor: Floor) -> None:
    answer = await floor.goal(40.0, 29.97)
    assert (answer.status, answer.body["name"]) == (422, "GOAL_OCCUPIED")
    assert "the goal (40.00, 29.97)" in answer.reason
    assert "the nearest reachable point is" in answer.reason
    assert [error["field"] for error in answer.body["errors"]] == ["body.pose"]
    again = await floor.goal(*answer.body["nearest"])
    assert again.status == 200, "the remedy that it names helps"


async def test_a_zone_with_two_points_is_refused_with_remedy_and_field(floor: Floor) -> None:
    answer = await floor.zone({"kind": "BLOCKED", "shape": {"type": "polygon", "points": [[30, 28], [31, 28]]}})
    assert answer.status == 422
    assert [error["field"] for error in answer.body["errors"]] == ["body.shape.points"]
    assert "a polygon needs at least three corners: add one" in answer.reason
