"""How a driving robot reacts when parts of the system die, vanish or send garbage: one stack, one fault after another.

The tests of this module share a robot that drives back and forth in the middle corridor; each leaves it able to drive.
"""

from __future__ import annotations

import asyncio
import itertools
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
from driver import ROBOT, START, LiveSystem

from fog_contracts.geometry import contains_point
from fog_contracts.messages import Pose, SimCommand, SimObstacle
from fog_runtime.transports.mqtt_connection import Broker
from fog_supervisor import net
from fognav.programs import AGENT, AGGREGATOR, BROKER, MAP_SERVICE, PLANNER, REDIS, ROUTER

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

_log = logging.getLogger("live")
"""Logs measured times and distances (`pytest --log-cli-level=info`)."""

pytestmark = [
    pytest.mark.live,
    pytest.mark.reaction,
    pytest.mark.asyncio(loop_scope="module"),
    pytest.mark.timeout(180),
]

WAIT_S = 60.0
STOPPED_WITHIN_S = 0.3
LATE_S, LOST_S = 1.0, 3.0
"""Age of the map above which the robot slows down, and above which it stops."""
PLAN_LATE_S = 1.5
RAMP_S = 0.5
MARGIN_S = 0.3
"""Periods of the heartbeat (0.1 s), of the control loop (0.2 s) and of the command stream (0.05 s)."""
SLOW_M_S = 0.15
EAST = (58.0, 28.4)
WEST = (15.0, 28.4)
NODE_X, NODE_Y = 40.0, 29.85
Z1 = [(38.0, 26.9), (42.0, 26.9), (42.0, 29.9), (38.0, 29.9)]


def person_at(x: float, y: float) -> SimObstacle:
    """Return a person standing at (x, y) in metres: an octagonal prism, 0.44 m wide and 1.7 m high."""
    corners = [(k + 0.5) * math.tau / 8 for k in range(8)]
    return SimObstacle(
        id="person", polygon=[(x + 0.22 * math.cos(a), y + 0.22 * math.sin(a)) for a in corners], height=1.7
    )


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def system(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[LiveSystem]:
    async with LiveSystem(tmp_path_factory.mktemp("live")) as running:
        yield running


@pytest_asyncio.fixture(autouse=True, loop_scope="module")
async def able_to_drive(system: LiveSystem) -> None:
    """Do what an operator would for a robot that a failed test left: enable it, and say where it is if it doubts."""
    system.start_operator()
    if system.state.mode == "INIT" and any(reason.startswith("the pose is") for reason in system.state.reasons):
        pose = {"x": system.truth.x, "y": system.truth.y, "theta": system.truth.theta}
        body = {"kind": "initial_pose", "pose": pose}
        answer = await system.request(PLANNER, "POST", f"/api/v1/robots/{ROBOT}/commands", body)
        assert answer.status == 200, answer


async def test_robot_in_a_watched_area_does_not_block_it(system: LiveSystem) -> None:
    system.readings.clear()
    states: set[str] = set()
    await system.drive_to(*EAST)
    while system.truth.x < Z1[1][0] + 0.3:
        states.add(system.hazard("z1"))
        await system.until(lambda before=system.truth.x: system.truth.x > before + 0.05, WAIT_S, "the robot drives on")
    # While the robot is in the beam the node confirms nothing: if a busy machine keeps it there, the area gets unknown.
    assert states <= {"clear", "unknown"}
    # The node itself saw the robot, and for longer than the five readings that confirm a hazard.
    assert sum(reading.state == "blocked" for reading in system.readings) > 10
    assert system.truth.contacts == 0


async def test_person_in_the_beam_beside_the_robot_blocks_the_area(system: LiveSystem) -> None:
    await system.drive_to(*(WEST if system.truth.x > NODE_X else EAST))
    await system.until(lambda: abs(system.truth.x - NODE_X) < 0.15, WAIT_S, "the robot is in the beam")
    assert system.hazard("z1") == "clear"
    placed = time.monotonic()
    await system.simulate(SimCommand(place=[person_at(NODE_X, NODE_Y - 0.40)]))
    await system.until(lambda: system.hazard("z1") == "blocked", WAIT_S, "the area is blocked")
    await system.until(lambda: system.state.mode == "PROTECTIVE_STOP", WAIT_S, "the robot stops in it")
    _log.info("person_to_stop_s: %s", round(time.monotonic() - placed, 3))
    assert contains_point(Z1, system.truth.x, system.truth.y)
    await system.until(lambda: system.log_lines(time.monotonic() - 0.2)[-1].stopped, WAIT_S, "the wheels are stopped")
    # While the robot is in the beam the node can't tell whether the person has left: it is carried away.
    away = Pose(x=START[0], y=START[1], theta=math.pi)
    await system.simulate(SimCommand(remove=["person"], kidnap=away))
    reply = await system.operator.command("initial_pose", away)
    assert reply is not None
    assert reply.accepted, reply.reason
    await system.until(lambda: system.hazard("z1") == "clear", WAIT_S, "the area is clear again")
    await system.wait_progress()
    # Scans from before it was carried away may have been on their way when the pose was given.
    await system.until(lambda: system.localization_error < 0.3, WAIT_S, "the robot knows where it is")
    assert system.truth.contacts == 0


async def test_robot_stops_when_its_agent_is_killed_and_waits_for_an_operator(system: LiveSystem) -> None:
    await system.drive_to(*EAST)
    await system.stop_operator()
    starts = system.starts()
    killed, late = time.monotonic(), system.lateness()
    system.stack.supervisor.kill(AGENT)
    await system.wait_agent_restarted(starts[AGENT])
    await system.until(lambda: system.state.mode == "INIT", WAIT_S, "the robot is in INIT")
    await system.until(
        lambda: "waiting for an operator to enable" in system.state.reasons and len(system.state.reasons) == 1,
        WAIT_S,
        "the robot waits only for the operator",
    )
    ready = time.monotonic() - killed
    await asyncio.sleep(1.0)  # long enough to see it drive, if it did
    stopping_time = system.stopping_time(killed)
    _log.info("wheels_zero_ms: %s", round(1000 * stopping_time))
    _log.info("ready_s: %s", round(ready, 1))
    _log.info("localization_error_m: %s", round(system.localization_error, 3))
    assert stopping_time < STOPPED_WITHIN_S + late.seconds()
    assert system.localization_error < 0.3
    assert not system.state.enabled
    system.start_operator()
    await system.wait_driving()
    await system.wait_progress()
    others = {name: count for name, count in system.starts().items() if name != AGENT}
    assert others == {name: starts[name] for name in others}


async def test_wheels_stop_when_the_guardian_is_killed(system: LiveSystem) -> None:
    await system.drive_to(*EAST)
    starts, guardian = system.starts(), system.guardian
    assert guardian is not None
    killed, late = time.monotonic(), system.lateness()
    os.kill(guardian, signal.SIGKILL)
    await system.until(lambda: system.state.mode == "PROTECTIVE_STOP", WAIT_S, "the robot stops")
    limit = STOPPED_WITHIN_S + late.seconds()
    await system.until(lambda: system.guardian not in {None, guardian}, WAIT_S, "a new guardian runs")
    stopping_time = next(line.at for line in system.log_lines(killed) if line.stopped) - killed
    _log.info("wheels_zero_ms: %s", round(1000 * stopping_time))
    assert stopping_time < limit
    await system.wait_driving()
    resumed = next(line.at for line in system.log_lines(killed + STOPPED_WITHIN_S) if not line.stopped)
    _log.info("resumed_s: %s", round(resumed - killed, 1))
    assert resumed - killed > 2.0, "it must be healthy for 2 s first"
    await system.wait_progress()
    assert system.starts() == starts


DEPENDENTS = {
    BROKER: [(AGGREGATOR, "mqtt (not connected to the broker)"), (MAP_SERVICE, "mqtt (not connected to the broker)")],
    REDIS: [(AGGREGATOR, "store (Redis"), (MAP_SERVICE, "store (Redis"), (PLANNER, "store (Redis")],
    ROUTER: [(PLANNER, "zenoh")],
}
"""The services that report on `/readyz` that a part is missing, each with the expected text."""


@pytest.mark.parametrize(
    ("name", "seconds"), [(BROKER, 5), (REDIS, 4), (ROUTER, 5), (AGGREGATOR, 4), (MAP_SERVICE, 5), (PLANNER, 5)]
)
async def test_outage_of_a_process_is_reported_by_its_dependents_and_causes_no_contact(
    system: LiveSystem, name: str, seconds: float
) -> None:
    east = system.truth.x < 50
    await system.drive_to(*(EAST if east else WEST))
    supervisor, starts = system.stack.supervisor, system.starts()
    started = time.monotonic()
    supervisor.kill(name)
    await supervisor.stop(name)
    await asyncio.sleep(seconds)  # the outage
    outage = system.log_lines(started)
    mode, reasons, areas = system.state.mode, system.state.reasons, system.hazard("z1")
    for service, expected in DEPENDENTS.get(name, ()):
        async with asyncio.timeout(WAIT_S):
            while expected not in (await net.readiness(system.stack.port_file(service)) or ""):  # noqa: ASYNC110  # another process changes it
                await asyncio.sleep(0.05)
    if name in {BROKER, AGGREGATOR}:
        # An area without readings must not stay clear.
        await system.until(lambda: system.hazard("z1") == "unknown", WAIT_S, "the area is unknown")
    supervisor.start(name)
    await supervisor.wait_ready([name], WAIT_S)
    if name in {ROUTER, MAP_SERVICE}:
        # The map's heartbeat has stopped.
        late = [line.speed for line in outage if line.at > started + LATE_S + MARGIN_S]
        assert max(late) <= SLOW_M_S + 0.001
        assert all(line.stopped for line in outage if line.at > started + LOST_S + RAMP_S + MARGIN_S)
    if name == PLANNER:
        assert max(line.speed for line in outage if line.at > started + PLAN_LATE_S + MARGIN_S) <= SLOW_M_S + 0.001
    await system.wait_progress()
    _log.info("outage: %s", f"{mode} {reasons} {areas}")
    _log.info("resumed_s: %s", round(time.monotonic() - started, 1))
    assert system.starts() == {**starts, name: starts[name] + 1}
    assert system.truth.contacts == 0


async def test_garbage_on_mqtt_and_on_the_serial_line_stops_no_process(system: LiveSystem) -> None:
    await system.drive_to(*(EAST if system.truth.x < 50 else WEST))
    starts = system.starts()
    generator = random.Random(1)
    topic = "fog/v1/estig/nodes/n1/reading"
    garbage: list[bytes] = [
        b"", b"{", b"null", b"[1,2]", b"\xff\xfe\x00", json.dumps({"seq": "one"}).encode(), generator.randbytes(900),
        b"[" * 1000, b"x" * 200_000,
    ]  # fmt: skip
    ids = itertools.count()

    def client(user: str) -> aiomqtt.Client:
        broker = Broker.of(system.stack.mqtt_url, system.stack.security.credentials(user))
        return broker.client(f"test-{next(ids)}", None)

    async with client("console") as listener:
        await listener.subscribe(topic)
        async with client("n1") as sender:
            for payload in garbage:
                await sender.publish(topic, payload, qos=1)
        # The broker disconnects a client that sends more than the largest message.
        with pytest.raises(aiomqtt.MqttError):
            async with client("n1") as sender:
                await sender.publish(topic, b"x" * 10_000_000, qos=1)
        async with client("n1") as sender:
            await sender.publish(topic, b"the last", qos=1)
        largest = 0
        async with asyncio.timeout(60):
            async for message in listener.messages:
                assert isinstance(message.payload, bytes)
                largest = max(largest, len(message.payload))
                if message.payload == b"the last":
                    break
    assert largest == 200_000, "the broker does not forward messages that are far too large"
    lidar = system.stack.folder / "sim" / "lidar"
    with lidar.open("wb", buffering=0) as line:
        line.write(generator.randbytes(2000))
        line.write(bytes((0xA5, 0x25)))  # the worst case: the command to stop scanning
    await system.wait_progress()
    assert system.hazard("z1") == "clear"
    assert system.starts() == starts
