import asyncio
import resource
from pathlib import Path

import pytest

from fog_contracts import channels as ch
from fog_contracts.messages import AreaHazard, RobotPose
from fog_runtime.clock import SystemClock
from fog_runtime.credentials import NOBODY
from fog_runtime.transports.mqtt_edge import MqttEdge
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fognav import recording
from fognav.output import FailedError, WrongUseError
from fognav.programs import BROKER, ROUTER
from fognav.stack import Stack, StackConfig

pytestmark = pytest.mark.live
TIMEOUT_S = 60.0

HAZARD = AreaHazard(area="z1", state="clear", severity=0, penalty=0, since=1.0, seq=1, epoch=1, cause="test")
POSE = RobotPose(x=1.0, y=2.0, theta=0.5, covariance=[0.0] * 9, v=0.1, w=0.0, radius=0.17, height=0.35, stamp=1.0)


async def record_some(file: Path, mqtt: MqttEdge, zenoh: ZenohEdge, mqtt_url: str) -> dict[str, int]:
    """Record until both messages are in the file: subscriptions reach the router with a delay."""
    while True:
        async with recording.recording(file, mqtt_url=mqtt_url, zenoh=zenoh, clock=SystemClock()):
            for _ in range(10):
                await mqtt.publish(ch.AREA_HAZARD, HAZARD, area="z1")
                zenoh.publish(ch.ROBOT_POSE, POSE, robot="r1")
                await asyncio.sleep(0.05)
        counts = recording.summary(file)["messages"]
        assert isinstance(counts, dict)
        if set(counts) == {"area_hazard", "robot_pose"}:
            return counts


async def test_messages_of_both_transports_are_recorded_and_replayed(tmp_path: Path) -> None:
    file = tmp_path / "run.mcap"
    clock = SystemClock()
    async with Stack(StackConfig(site_dir=tmp_path, robot="r1")) as stack, asyncio.timeout(2 * TIMEOUT_S):
        for name in (BROKER, ROUTER):
            stack.supervisor.start(name)
        await stack.supervisor.wait_ready([BROKER, ROUTER], TIMEOUT_S)
        received: asyncio.Queue[object] = asyncio.Queue()
        mqtt = MqttEdge(stack.mqtt_url, "test", clock, site="here")
        mqtt.on(ch.AREA_HAZARD, lambda _, hazard: received.put_nowait(hazard), AreaHazard)
        opened = ZenohEdge.open(connect=[stack.zenoh_endpoint], clock=clock, role="console", id="test", site="here")
        async with opened as zenoh:
            task = asyncio.create_task(mqtt.run())
            await mqtt.wait_connected()
            counts = await record_some(file, mqtt, zenoh, stack.mqtt_url)
            while not received.empty():
                received.get_nowait()
            zenoh.subscribe(ch.ROBOT_POSE, RobotPose, lambda _, pose: received.put_nowait(pose))
            played = await recording.play(
                file, mqtt_url=stack.mqtt_url, zenoh_endpoint=stack.zenoh_endpoint, site="here", speed=2.0
            )
            assert played["sent"] == sum(counts.values())
            kinds = set()
            while len(kinds) < 2:
                kinds.add(type(await received.get()))
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
    assert kinds == {AreaHazard, RobotPose}


async def test_full_disk_ends_a_recording_with_what_to_do_and_what_was_written_can_be_read(tmp_path: Path) -> None:
    file = tmp_path / "run.mcap"
    async with Stack(StackConfig(site_dir=tmp_path, robot="r1")) as stack, asyncio.timeout(2 * TIMEOUT_S):
        for name in (BROKER, ROUTER):
            stack.supervisor.start(name)
        await stack.supervisor.wait_ready([BROKER, ROUTER], TIMEOUT_S)
        opened = ZenohEdge.open(
            connect=[stack.zenoh_endpoint], clock=SystemClock(), role="console", id="test", site="here"
        )
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, before[1]))
        try:
            recorded = recording.record(
                file, mqtt_url=stack.mqtt_url, zenoh_endpoint=stack.zenoh_endpoint, site="here", seconds=0.0,
                credentials=NOBODY,
            )  # fmt: skip
            async with opened as zenoh:
                task = asyncio.create_task(recorded)
                while not task.done():
                    zenoh.publish(ch.ROBOT_POSE, POSE, robot="r1")
                    await asyncio.sleep(0.001)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
    with pytest.raises(
        FailedError, match=r"run\.mcap: File too large\. What was recorded until then can be read: make"
    ):
        await task
    assert "robot_pose" in str(recording.summary(file)["messages"])


def test_file_that_is_not_a_recording_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "notes.mcap"
    file.write_text("not a recording, but long enough to be one")
    with pytest.raises(WrongUseError, match=r"notes\.mcap"):
        recording.summary(file)
