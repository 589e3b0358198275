"""The recorded messages of a demo, fed to fresh cores, give what the live processes published.

A real demo (real brokers, all processes, emulated hardware) is recorded from before its first service starts, so that
every input of aggregator, map-service and planner is in the file; floor plan, nodes and areas come from the site. Two
replays in processes of their own, with different hash seeds, must give the same bytes.

A replay can't reproduce in which order a live process handled inputs of different transports, nor the phase of its
0.1 s ticks: MQTT and zenoh are two streams, and the recorder is a third subscriber. So the tests compare those live
outputs that do not depend on this:

- per area the sequence of states, with the reading that decided each (its cause names it), and the last hazard;
- the final map, cell by cell through its hash, after obstacles have faded (a robot that moved 3 cm between a pose and
  an obstacle omits another cell beside it); the versions before it must be those of the recorded deltas;
- each plan, computed again on its map version and from its first point, point by point;
- whether the replayed planner's paths cross the blocked area.

The robot-agent is replayed from a log of its own, because the data of its base and lidar cross no channel
(robot-agent/tests/test_replay.py).
"""

from __future__ import annotations

import asyncio
import itertools
import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader

from fog_contracts import channels as ch
from fog_contracts.geometry import lengths_along
from fog_contracts.messages import (
    AreaHazard,
    CommandReply,
    MapDelta,
    MapHeartbeat,
    MapSnapshot,
    NodeReading,
    RobotObstacles,
    RobotPath,
    SimCommand,
    SimObstacle,
)
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.site import load_site
from fog_runtime.record import RecordError, read
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor import net
from fognav.demo.attempt import Attempt
from fognav.demo.machine import SpeedWatch
from fognav.demo.operator import Operator
from fognav.demo.options import DrivePlan, Options
from fognav.demo.preparation import Background
from fognav.demo.scene import Scene
from fognav.output import WrongUseError
from fognav.programs import AGENT, MAP_SERVICE, SERVERS, SERVICES, SIMULATOR, WATCHDOG
from fognav.recording import recording, summary
from fognav.stack import Stack, StackConfig, users_of
from fognav_sim.drive.hazard import entry_distance
from robot_agent.agent.recording.replay import replay

if TYPE_CHECKING:
    from collections.abc import Callable

pytestmark = [pytest.mark.live, pytest.mark.timeout(300), pytest.mark.usefixtures("forked_programs")]

HERE = Path(__file__).parent
SITE = HERE.parents[1] / "sites" / "estig"
SPEED = 1.0
READY_TIMEOUT_S = 60.0
DRIVE_TIMEOUT_S = 120.0
BOX = SimObstacle(id="box", polygon=[(4.8, 23.4), (5.2, 23.4), (5.2, 23.8), (4.8, 23.8)])
"""Behind the robot at its start: the lidar sees it, and no path leads over it."""
AFTER_M = 1.5
"""Distance (m) that the robot drives on its new path."""
FADE_MARGIN_S = 3.0
"""Time (s of the clock) between the last obstacle's end and the final snapshot."""
ZONES: tuple[dict[str, Any], ...] = (
    {"id": "wet", "kind": "BLOCKED", "shape": {"type": "circle", "centre": [48.5, 15.0], "radius": 1.0}},
    {"id": "slow", "kind": "SPEED_LIMIT", "speed": 0.2,
     "shape": {"type": "rectangle", "corner": [8.0, 41.0], "opposite": [10.0, 43.0]}},
)  # fmt: skip


class NoSpeedWatch(SpeedWatch):
    """Accepts a machine that is too slow for the speed: the quality of the drive does not matter here."""

    def check(self, *_, **__):
        pass

    def check_outcome(self, *_, **__):
        pass


@dataclass(frozen=True)
class Recording:
    """A recorded demo; `last` is the live map-service's snapshot at the end."""

    path: Path
    last: MapSnapshot
    blocked: str
    messages: list[tuple[int, ch.Channel, dict[str, str], Any]]

    def of(self, channel: ch.Channel) -> list[Any]:
        return [message for _, recorded_channel, _, message in self.messages if recorded_channel is channel]


async def until(condition: Callable[[], bool], description: str, timeout_s: float) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f"timeout after {timeout_s:.0f} s, waiting until {description}"
        await asyncio.sleep(0.05)


async def request_map_service(stack: Stack, method: str, path: str, body: dict[str, Any] | None = None) -> None:
    port = stack.port(MAP_SERVICE)
    assert port is not None
    response = await asyncio.to_thread(net.request, method, port, path, body=body, token=stack.token)
    assert response.status < 300, response.reason


async def drive(attempt: Attempt, stack: Stack, edge: ZenohEdge, clock: SystemClock) -> None:
    """Drive until the robot follows a path around the barrier."""
    scene = attempt.scene
    operator = Operator(edge, stack, scene, clock)

    async with Background(operator.keep_enabled()) as background:
        driving = asyncio.create_task(attempt.run_drive(operator, clock, background))

        def has_driven(distance: float) -> bool:
            assert not driving.done(), (scene.outcome, list(scene.events))
            return attempt.drive is not None and attempt.drive.evaluation.distance_m >= distance

        def has_new_path() -> bool:
            drive = attempt.drive
            return has_driven(0.0) and drive.blocked_at_m is not None and drive.evaluation.plans >= 2

        try:
            await until(has_new_path, f"the planner has replanned: {list(scene.events)}", DRIVE_TIMEOUT_S)
            assert attempt.drive is not None
            distance_m = attempt.drive.evaluation.distance_m + AFTER_M
            await until(lambda: has_driven(distance_m), "the robot has followed its new path", DRIVE_TIMEOUT_S)
        finally:
            driving.cancel()
            await asyncio.gather(driving, return_exceptions=True)


def input_log(recording: Path) -> Path:
    """Return the input log of the agent of a recorded demo."""
    return recording.with_name("agent.mcap")


async def record(path: Path) -> tuple[MapSnapshot, str]:
    """Record a demo; return the last map and the area that was blocked."""
    site = load_site(SITE)
    clock = SystemClock(SPEED)
    plan = DrivePlan.of(site, Options(seed=1, speed=SPEED))
    attempt = Attempt(plan, Scene(site, plan.robot, 1, SPEED))
    attempt.speed_watch = NoSpeedWatch(SPEED)
    faded_at = 0.0

    def on_obstacles(_: dict[str, str], seen: RobotObstacles) -> None:
        nonlocal faded_at
        faded_at = clock.now() + seen.ttl + FADE_MARGIN_S

    # The default memory for obstacles would make the recording too long.
    extra = {"OBSTACLE_MEMORY_S": "10", "INPUT_LOG": str(input_log(path))}
    users = users_of(site.site, unrestricted=("test",))
    config = StackConfig(site_dir=SITE, robot=plan.robot, seed=1, speed=SPEED, extra=extra, users=users)
    async with Stack(config) as stack:
        supervisor, own = stack.supervisor, stack.security.credentials("test")
        for name in SERVERS:
            supervisor.start(name)
        await supervisor.wait_ready(SERVERS, READY_TIMEOUT_S)
        opened = ZenohEdge.open(
            connect=[stack.zenoh_endpoint], clock=clock, role="console", id="replay", site=site.site.id,
            credentials=own,
        )  # fmt: skip
        async with opened as edge, recording(path, mqtt_url=stack.mqtt_url, zenoh=edge, clock=clock, credentials=own):
            # The services must be ready before nodes and robots publish.
            for names in (SERVICES, [SIMULATOR], [WATCHDOG, AGENT]):
                for name in names:
                    supervisor.start(name)
                await supervisor.wait_ready([name for name in names if name != AGENT], READY_TIMEOUT_S)
            edge.subscribe(ch.ROBOT_OBSTACLES, RobotObstacles, on_obstacles)
            reply = await edge.query(ch.SIM_COMMAND, SimCommand(place=[BOX]), CommandReply, 10.0, robot=plan.robot)
            assert reply is not None
            assert reply.accepted, reply.reason
            for zone in ZONES:
                await request_map_service(stack, "POST", "/api/v1/zones", zone)
            await drive(attempt, stack, edge, clock)
            for name in (AGENT, WATCHDOG):
                await supervisor.stop(name)
            await request_map_service(stack, "DELETE", "/api/v1/zones/wet")
            await until(lambda: clock.now() > faded_at, "all obstacles have faded", READY_TIMEOUT_S)
            last = await edge.query(ch.MAP_SNAPSHOT, None, MapSnapshot, 10.0)
            assert last is not None
    area = attempt.summary().area
    assert area is not None
    return last, area


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("recording") / "demo.mcap"
    last, blocked = asyncio.run(record(path))
    return Recording(path, last, blocked, list(read(path)))


def run_cores(recording: Path, out: Path, hash_seed: int) -> Path:
    out.mkdir()
    command = [sys.executable, str(HERE / "cores.py"), str(recording), str(SITE), str(out)]
    environment = {**os.environ, "PYTHONHASHSEED": str(hash_seed)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return out


@pytest.fixture(scope="module")
def replayed(recorded: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_cores(recorded.path, tmp_path_factory.mktemp("replay") / "first", 1)


def read_output(replayed: Path, name: str, kind: Any) -> list[Any]:
    return [msgspec.json.decode(line, type=kind) for line in (replayed / f"{name}.jsonl").read_bytes().splitlines()]


def by_area(hazards: list[AreaHazard]) -> dict[str, list[AreaHazard]]:
    found: dict[str, list[AreaHazard]] = {}
    for hazard in hazards:
        found.setdefault(hazard.area, []).append(hazard)
    return found


def transitions(hazards: list[AreaHazard]) -> list[tuple[str, int, str]]:
    """Return the sequence of states, each with its cost and cause."""
    grouped = itertools.groupby(hazards, key=lambda hazard: (hazard.state, hazard.penalty))
    return [(state, penalty, next(group).cause) for (state, penalty), group in grouped]


# --- The replays ---


def test_recording_contains_all_kinds_of_inputs(recorded):
    assert {"blocked", "clear", "unknown"} == {hazard.state for hazard in recorded.of(ch.AREA_HAZARD)}
    assert len(recorded.of(ch.NODE_READING)) > 100
    assert len({path.plan_id for path in recorded.of(ch.ROBOT_PATH)}) >= 2
    assert any(zones.zones for zones in recorded.of(ch.ZONES))
    assert any(seen.points for seen in recorded.of(ch.ROBOT_OBSTACLES))


def test_two_replays_give_the_same_bytes(recorded, replayed, tmp_path):
    second = run_cores(recorded.path, tmp_path / "second", 2)
    names = sorted(path.name for path in replayed.iterdir())
    assert names == ["deltas.jsonl", "hazards.jsonl", "paths.jsonl", "plans.jsonl", "snapshot.jsonl", "versions.jsonl"]
    for name in names:
        first = (replayed / name).read_bytes()
        assert first, name
        assert first == (second / name).read_bytes(), name


def test_replayed_readings_give_the_recorded_states_of_every_area(recorded, replayed):
    live, replay = by_area(recorded.of(ch.AREA_HAZARD)), by_area(read_output(replayed, "hazards", AreaHazard))
    assert live.keys() == replay.keys()
    for area, hazards in live.items():
        assert transitions(hazards) == transitions(replay[area]), area
        assert hazards[-1].nodes == replay[area][-1].nodes


def test_recorded_deltas_bring_a_replica_to_the_last_live_map(recorded, replayed):
    reached = read_output(replayed, "versions", MapHeartbeat)[-1]
    heartbeat = recorded.of(ch.MAP_HEARTBEAT)[-1]
    for version in (heartbeat, recorded.last):
        assert (reached.epoch, reached.seq, reached.hash) == (version.epoch, version.seq, version.hash)


def test_replayed_inputs_give_the_last_live_map(recorded, replayed):
    (snapshot,) = read_output(replayed, "snapshot", MapSnapshot)
    assert snapshot.hash == recorded.last.hash
    last = recorded.last
    assert (snapshot.cost, snapshot.speed, snapshot.static) == (last.cost, last.speed, last.static)


def test_replayed_inputs_block_the_area_with_the_recorded_deltas(recorded, replayed):
    def blocking(deltas: list[MapDelta]) -> list[tuple[int, int, int, int]]:
        return [
            (delta.x, delta.y, delta.w, delta.h)
            for delta in deltas
            if any(cause.id == recorded.blocked and cause.state == "blocked" for cause in delta.causes)
            and delta.layer == "cost"
        ]

    live = blocking(recorded.of(ch.MAP_DELTA))
    assert live
    assert live == blocking(read_output(replayed, "deltas", MapDelta))


def test_every_recorded_plan_is_recomputed(recorded, replayed):
    """Of ways that cost the same another may be found: what guides a search is computed beside it, sooner or later."""
    plans = {path.plan_id: path for path in reversed(recorded.of(ch.ROBOT_PATH)) if path.points}
    recomputed = read_output(replayed, "plans", RobotPath)
    assert [path.plan_id for path in recomputed] == sorted(plans)
    for path in recomputed:
        live = plans[path.plan_id]
        assert (path.map_epoch, path.map_seq, path.refusal) == (live.map_epoch, live.map_seq, None)
        lengths = [lengths_along(np.array(points))[-1] for points in (path.points, live.points)]
        assert lengths[0] == pytest.approx(lengths[1], rel=0.01), path.plan_id
        assert np.allclose((path.points[0], path.points[-1]), (live.points[0], live.points[-1])), path.plan_id


def test_replayed_planner_replans_around_the_blocked_area_for_the_recorded_hazard(recorded, replayed):
    area = next(area for area in load_site(SITE).site.areas if area.id == recorded.blocked)

    def crosses(path: RobotPath) -> bool:
        return entry_distance(path.points, area.polygon) is not None

    live = recorded.of(ch.ROBOT_PATH)
    replay_paths = [
        msgspec.convert(path, RobotPath) for path in read_output(replayed, "paths", dict) if "plan_id" in path
    ]
    for paths in (live, replay_paths):
        assert crosses(paths[0])
        assert not crosses(paths[-1])
        detour = next(path for path in paths if not crosses(path))
        assert [trace.area for trace in detour.traces] == [area.id]
        assert all(path.refusal is None for path in paths)
    assert replay_paths[-1].points[-1] == live[-1].points[-1]


def test_agent_replayed_from_its_input_log_decides_exactly_the_same(recorded):
    result = replay(input_log(recorded.path))
    assert result.differences == []
    paths = {path.plan_id for path in recorded.of(ch.ROBOT_PATH)}
    assert result.inputs["MessageReceived"] > len(paths) >= 2
    assert result.inputs["ScanReceived"] > 100
    assert result.inputs["DecisionMade"] > 50
    assert "NORMAL" in result.modes


# --- The file ---


def test_recording_has_a_schema_for_every_channel_and_matching_json(recorded):
    with recorded.path.open("rb") as file:
        reader = make_reader(file)
        found = reader.get_summary()
        assert found is not None
        assert len({channel.topic for channel in found.channels.values()}) == len(found.channels) > 30
        for channel in found.channels.values():
            schema = found.schemas[channel.schema_id]
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            described = json.loads(schema.data)
            assert described["type"] == "object"
            assert described["properties"]
        count = 0
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            assert set(json.loads(message.data)) <= set(json.loads(schema.data)["properties"]), channel.topic
            count += 1
    assert count == len(recorded.messages)
    kinds = {type(message) for *_, message in recorded.messages}
    assert {NodeReading, AreaHazard, MapDelta, RobotPath} <= kinds


def test_damaged_recording_is_refused_with_its_name(recorded, tmp_path):
    data = bytearray(recorded.path.read_bytes())
    with recorded.path.open("rb") as file:
        found = make_reader(file).get_summary()
    assert found is not None
    chunk = found.chunk_indexes[len(found.chunk_indexes) // 2]
    middle = chunk.chunk_start_offset + chunk.chunk_length // 2
    data[middle : middle + 64] = bytes(64)
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data)
    with pytest.raises(RecordError, match=r"damaged\.mcap"):
        list(read(damaged))
    with pytest.raises(WrongUseError, match=r"damaged\.mcap"):
        summary(damaged)


def test_recording_without_its_beginning_is_refused_with_its_name(recorded, tmp_path):
    headless = tmp_path / "headless.mcap"
    headless.write_bytes(recorded.path.read_bytes()[4096:])
    with pytest.raises(RecordError, match=r"headless\.mcap"):
        list(read(headless))


def test_recording_without_its_end_gives_all_complete_messages(recorded, tmp_path):
    data = recorded.path.read_bytes()
    short = tmp_path / "short.mcap"
    short.write_bytes(data[: len(data) * 2 // 3])
    got = list(read(short))
    assert len(recorded.messages) // 3 < len(got) < len(recorded.messages)
    assert got == recorded.messages[: len(got)]
