"""An agent's input log is enough to repeat all of its decisions, to the last bit."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from functools import partial

import msgspec
import numpy as np
import pytest
from little_world import AGENT, KEY, L_PATH, LittleWorld, trace

from fog_contracts import channels as ch
from fog_contracts.commands import sign
from fog_contracts.messages import AreaHazard, HazardArea, PolygonShape, RobotCommand, Zone, ZoneSet
from fog_contracts.replica import MapError
from fog_contracts.site import MarkerSite
from fog_runtime.record import Recorder, read_entries
from robot_agent.agent.core import AgentCore
from robot_agent.agent.hand_driving import HandBack, Steer, TakeOver
from robot_agent.agent.recording import input_log as log
from robot_agent.agent.recording.replay import ReplayError, main, replay
from robot_agent.localization.markers import Sighting
from robot_agent.localization.pose import AbsoluteObservation, Pose2
from robot_agent.registry import profile

MARKER = MarkerSite(id=7, x=3.5, y=4.4, theta=-math.pi / 2)
SEEING = replace(AGENT, localization=replace(AGENT.localization, markers=(MARKER,)))


def write(path, entries):
    with Recorder(path) as recorder:
        for number, entry in enumerate(entries):
            recorder.write_entry(log.TOPIC_OF_ENTRY[type(entry)], entry, number)


def entries_of(path):
    return [msgspec.json.decode(data, type=log.ENTRY_OF_TOPIC[topic]) for _, topic, data in read_entries(path)]


def drive_through_most_situations(world):
    """Drive the robot through most of the situations that its core distinguishes."""
    with pytest.raises(MapError):
        world.agent.load(msgspec.structs.replace(world.master.snapshot(), hash=1), world.now)
    world.ready()
    world.drive_to(L_PATH)
    world.run(4.0)
    forged = RobotCommand(kind="enable", robot="r1", operator="eve", nonce="n" * 16, **world.run_and_clock)
    assert not world.ask(forged).accepted
    assert not world.ask(sign(forged, log.LOG_KEY)).accepted
    world.block(world.x + 1.5, 1.0, world.x + 2.0, 3.0, solid=True)
    world.run(1.0)
    assert world.state().mode == "HOLD"
    area = AreaHazard(
        area="z4", state="unknown", severity=1, penalty=200, since=0.0, seq=1, epoch=1, cause="t", nodes={}
    )
    corners = [(0.0, 0.0), (3.4, 0.0), (3.4, 3.0), (0.0, 3.0)]
    world.send(ch.HAZARD, HazardArea(hazard=area, polygon=corners, label="Z4", epoch=7))
    shape = PolygonShape(points=[(9.0, 1.0), (10.0, 1.0), (10.0, 2.0)])
    wet = Zone(id="wet", kind="BLOCKED", shape=shape, reason="mopped")
    world.send(ch.ZONES, ZoneSet(epoch=7, seq=1, zones=[wet], active=["wet"]))
    world.drive_to([(world.x, world.y), (3.5, 2.0), (3.5, 3.8)], plan_id=2, traces=[trace()])
    world.run(6.0)
    world.agent.on_suspension(2.0)
    observation = AbsoluteObservation(Pose2(world.x, world.y, world.theta), np.diag([0.01, 0.01, 0.01]), world.now)
    assert world.agent.on_absolute_observation(observation)
    seen = Pose2(MARKER.x, MARKER.y, MARKER.theta).relative_to(Pose2(world.x, world.y, world.theta))
    world.agent.on_sighting(Sighting(MARKER.id, seen, np.diag([1e-4, 1e-4, 1e-4]), world.now), world.now)
    world.run(1.0)
    assert world.agent.pose_to_store(world.now) is not None
    world.heartbeats_on = False
    world.run(3.5)
    world.heartbeats_on = True
    world.bumper = True
    world.run(0.3)
    world.bumper = False
    world.run(0.1)
    assert world.command("reset").accepted
    world.agent.on_base_lost(world.now, "the guardian closed the link")
    world.run(0.3)
    assert world.command("enable").accepted
    world.run(3.0)
    assert world.command("cancel").accepted
    world.run(1.0)
    left, bottom = (math.floor(value / 0.05) * 0.05 for value in (world.x - 0.2, world.y - 0.2))
    world.block(left, bottom, left + 0.4, bottom + 0.4)
    world.run(0.2)
    assert world.command("egress").accepted
    world.way_out = [(world.x, world.y), (world.x, world.y - 1.0)]
    world.run(2.0)
    assert world.state().mode == "EGRESS"


def plan_on_the_robot(world):
    """Let the robot search a path itself."""
    assert world.command("disable").accepted
    world.run(1.0)
    assert world.command("profile_default").accepted
    world.drive_to([(world.x, world.y), (world.x, world.y - 1.0)], goal_id="g3", plan_id=3)
    world.run(0.5)


def drive_by_hand(world: LittleWorld) -> None:
    """Let an operator at the robot turn it, and hand it back."""
    assert world.agent.on_hand(TakeOver(), world.now).accepted
    for _ in range(10):
        world.agent.on_hand(Steer(v=0.0, w=0.5), world.now)
        world.run(0.1)
    assert world.agent.on_hand(HandBack(), world.now).accepted
    world.run(0.5)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A logged drive: where its log is, and the world at its end."""
    path = tmp_path_factory.mktemp("log") / "drive.mcap"
    entries = []
    world = LittleWorld(
        seed=4, config=SEEING, start_agent=lambda config, seed: log.LoggedAgent(config, seed, entries.append, profile)
    )
    drive_through_most_situations(world)
    plan_on_the_robot(world)
    drive_by_hand(world)
    write(path, entries)
    return path, world


def test_a_replay_repeats_every_command_mode_publication_and_answer(drive):
    path, world = drive
    result = replay(path)
    assert result.differences == []
    assert result.outputs["WheelsCommanded"] == len(world.commands)
    assert result.outputs["Published"] == len(world.published)
    assert result.outputs["Answered"] == result.inputs["QueryReceived"] + 2 == 12
    assert result.inputs["DecisionMade"] > 50
    assert {"INIT", "NORMAL", "HOLD", "FAULT", "TELEOP"} <= set(result.modes)
    assert set(result.inputs) == {kind.__name__ for kind in log.TOPIC_OF_ENTRY if issubclass(kind, log.Input)} - {
        "Started",
        "PoseRestored",
        "LoopHealthReceived",
    }


@pytest.mark.drive
def test_replays_in_other_processes_with_other_hash_seeds_give_the_same_outputs(drive):
    path, _ = drive

    def run(hash_seed):
        command = [sys.executable, "-m", "robot_agent.agent.recording.replay", str(path)]
        environment = {**os.environ, "PYTHONHASHSEED": str(hash_seed)}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, done.stderr + done.stdout
        return json.loads(done.stdout)

    first, second = run(1), run(2)
    assert first["different"] == second["different"] == 0
    assert first["digest"] == second["digest"] == replay(path).digest


def test_logging_changes_no_decision(drive):
    plain = LittleWorld(config=SEEING, seed=4, start_agent=partial(AgentCore, find_profile=profile))
    drive_through_most_situations(plain)
    plan_on_the_robot(plain)
    drive_by_hand(plain)
    assert plain.commands == drive[1].commands
    assert plain.published == drive[1].published


def test_a_restarted_agent_is_replayed_from_its_restored_pose(tmp_path):
    entries = []
    world = LittleWorld(seed=4).ready()
    world.start_agent = lambda config, seed: log.LoggedAgent(config, seed, entries.append)
    assert world.restart() is not None
    world.agent.load(world.master.snapshot(), world.now)
    world.run(2.0)
    assert world.agent.localizer.status == "good"
    write(tmp_path / "log.mcap", entries)
    result = replay(tmp_path / "log.mcap")
    assert result.differences == []
    assert result.inputs["PoseRestored"] == 1


def test_an_agent_that_decides_differently_is_detected(drive, tmp_path, capsys):
    path, _ = drive
    started, *rest = entries_of(path)
    other = tmp_path / "other.mcap"
    safety = replace(started.config.safety, speed_normal=0.2)
    slower = msgspec.structs.replace(started, config=replace(started.config, safety=safety))
    assert slower != started
    write(other, [slower, *rest])
    result = replay(other)
    assert result.different > 50
    assert any('"seq"' in difference.recorded for difference in result.differences)
    assert main([str(other)]) == 1
    assert json.loads(capsys.readouterr().out)["different"] == result.different


def test_a_missing_and_an_additional_output_are_detected(drive, tmp_path):
    path, _ = drive
    entries = entries_of(path)
    # A publication that is the only output of its input: a change moves no other output.
    alone = [
        index
        for index, entry in enumerate(entries[:-1])
        if isinstance(entry, log.Published)
        and isinstance(entries[index - 1], log.Input)
        and isinstance(entries[index + 1], log.Input)
    ]
    one = alone[len(alone) // 2]
    for changed in ([*entries[:one], *entries[one + 1 :]], [*entries[: one + 1], *entries[one:]]):
        write(tmp_path / "changed.mcap", changed)
        assert replay(tmp_path / "changed.mcap").different == 1


def test_a_log_holds_no_operators_key_and_none_of_its_signatures(drive):
    path, _ = drive
    assert AGENT.operator_key == KEY
    commands = [entry for entry in entries_of(path) if isinstance(entry, log.QueryReceived)]
    kinds = [entry.request["kind"] for entry in commands]
    assert kinds == [
        *("initial_pose", "enable", "enable", "enable", "reset", "enable", "cancel", "egress"),
        *("disable", "profile_default"),
    ]
    for entry in commands:
        command = msgspec.convert(entry.request, RobotCommand)
        assert command.signature in {b"", sign(command, log.LOG_KEY).signature}
        assert command.signature != sign(command, KEY).signature
    for _, _, data in read_entries(path):
        assert msgspec.json.encode(KEY).strip(b'"') not in data


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda entries: entries[1:], "no start"),
        (lambda _: [], "no start"),
        (lambda entries: [*entries[:50], log.EntriesLost(count=7), *entries[50:]], "7 entries are missing"),
        (lambda entries: [*entries[:50], entries[0]], "can't continue with Started"),
    ],
)
def test_log_that_can_not_be_replayed_is_refused_with_the_reason(drive, tmp_path, change, word, capsys):
    path = tmp_path / "bad.mcap"
    write(path, change(entries_of(drive[0])))
    with pytest.raises(ReplayError, match=word):
        replay(path)
    assert main([str(path)]) == 2
    assert word in capsys.readouterr().err


def test_truncated_log_is_replayed_up_to_its_end(drive, tmp_path):
    data = drive[0].read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) // 2])
    result = replay(cut)
    assert result.differences == []
    assert 0 < result.inputs.total() < replay(drive[0]).inputs.total()
