from __future__ import annotations

import asyncio
import json
import os
import signal
import time
from pathlib import Path

import msgspec
import pytest
from agent_rig import ROBOT, SITE, AgentProcess, Robot, is_by_delay, until
from guardian_rig import DEADLINE_S, STOP_S
from secured_servers import secured_router

from fog_contracts import channels as ch
from fog_contracts.grid import Window
from fog_contracts.messages import PlanReply, Pose, RobotGoal
from fog_runtime.machine import TERMINAL_STOPS
from robot_agent.agent.recording.replay import replay
from robot_agent.localization.pose import SavedPose

pytestmark = [pytest.mark.live, pytest.mark.reaction, pytest.mark.timeout(150)]


@pytest.fixture(scope="module")
def router(tmp_path_factory):
    with secured_router(tmp_path_factory.mktemp("router"), SITE, robots=[ROBOT]) as running:
        yield running


@pytest.fixture
async def robot(tmp_path, router):
    async with Robot(tmp_path, router) as running:
        yield running


def threads_of(pid: int) -> list[int]:
    return [int(thread.name) for thread in Path(f"/proc/{pid}/task").iterdir()]


async def enabled(robot) -> None:
    await robot.localized()
    reply = await robot.fog.command("enable")
    assert reply.accepted, reply
    await until(lambda: robot.fog.state.mode == "NORMAL", "the robot is in NORMAL")


@pytest.mark.smoke
async def test_agent_localizes_refuses_a_wrong_key_and_drives_a_path(robot):
    await robot.localized()
    assert robot.fog.state.mode == "INIT"
    assert robot.error() < 0.15
    wrong = await robot.fog.command("enable", key=b"x" * 32)
    assert not wrong.accepted
    assert "signature" in wrong.reason
    assert robot.fog.state.mode == "INIT"
    await enabled(robot)
    robot.fog.send_robot_to_the_corner()
    await until(lambda: robot.body.moving, "it drives")
    await until(lambda: robot.body.pose[0] > 2.6, "it follows the path")
    assert abs(robot.body.pose[1] - 2.0) < 0.3
    assert robot.error() < 0.2
    state = robot.fog.state
    assert (state.goal_id, state.plan_id, state.map_epoch, state.mode) == ("g1", 1, 7, "NORMAL")
    await until(lambda: robot.fog.state.metrics, "it says where its metrics are")
    assert robot.fog.state.metrics == f"127.0.0.1:{robot.agent.port}"
    status, text = robot.agent.get("/metrics")
    assert status == 200
    assert "fognav_lidar_scans_total" in text
    assert 'fognav_robot_mode{mode="NORMAL"} 1.0' in text
    for process in ("agent", "guardian", "watchdog"):
        assert f'fognav_thread_cpu_seconds_total{{process="{process}",thread="python"}}' in text
    for thread in ("decide", "map"):
        assert f'fognav_thread_cpu_seconds_total{{process="agent",thread="{thread}"}}' in text
        assert f'fognav_process_resident_bytes{{process="{process}"}}' in text
    for name in ("robot_map_age_seconds", "particles", "pose_sigma_meters", "battery_volts", "serial_errors_total"):
        assert f"\nfognav_{name}" in text
    status, text = robot.agent.get("/readyz")
    assert (status, json.loads(text)["missing"]) == (200, [])
    priority = next(event["priority"] for event in robot.agent.events if event["event"] == "started")
    threads = threads_of(robot.agent.process.pid)
    if priority == "SCHED_RR 5":
        assert {os.sched_getscheduler(thread) for thread in threads} == {os.SCHED_RR}
        assert {os.sched_getparam(thread).sched_priority for thread in threads} == {5}
    else:
        assert priority == "refused: grant CAP_SYS_NICE or an rtprio limit"


async def test_wheels_stop_when_the_agent_is_killed_and_the_next_one_asks_for_an_enable(robot):
    await enabled(robot)
    robot.fog.send_robot_to_the_corner()
    await until(lambda: robot.body.pose[0] > 2.4, "it is on its way")
    await until(lambda: robot.body.moving, "it drives")
    robot.agent.process.kill()
    assert robot.body.stopped_within(time.monotonic()) < STOP_S
    robot.agent.process.wait()
    stopped_at = robot.body.pose
    assert robot.agent.data.joinpath("pose.json").exists()
    robot.fog.states.clear()
    robot.agent.start()
    await robot.localized()
    assert robot.fog.state.mode == "INIT"
    assert robot.error() < 0.15
    assert robot.body.pose == stopped_at
    replayed = await robot.fog.repeat_command()
    assert not replayed.accepted
    assert "restarted" in replayed.reason
    await enabled(robot)
    await until(lambda: robot.body.pose[0] > stopped_at[0] + 0.3, "it drives on")


async def test_stop_signals_of_a_terminal_do_not_freeze_a_driving_agent_and_a_hang_up_ends_it_in_order(robot):
    await enabled(robot)
    robot.fog.send_robot_to_the_corner()
    await until(lambda: robot.body.moving, "it drives")
    for number in TERMINAL_STOPS:
        robot.agent.process.send_signal(number)
    reached = robot.body.pose[0]
    await until(lambda: robot.body.pose[0] > reached + 0.2, "it drives on")
    robot.agent.process.send_signal(signal.SIGHUP)
    assert robot.body.stopped_within(time.monotonic()) < STOP_S
    assert robot.agent.process.wait(60.0) == 0
    await until(lambda: not robot.body.scanner.scanning, "the lidar stands")


async def test_wheels_stop_when_the_agent_hangs_or_the_lidar_is_silent_and_continue_afterwards(robot):
    await enabled(robot)
    robot.fog.send_robot_to_the_corner()
    await until(lambda: robot.body.moving, "it drives")
    robot.agent.process.send_signal(signal.SIGSTOP)
    begun = time.monotonic()
    assert robot.body.stopped_within(begun) < STOP_S
    robot.fog.states.clear()
    await until(lambda: time.monotonic() - begun > 1.0, "the hang lasts")
    robot.agent.process.send_signal(signal.SIGCONT)
    await until(lambda: any(s.mode == "PROTECTIVE_STOP" for s in robot.fog.states), "the stop is reported")
    await until(lambda: robot.body.moving, "it drives on after two healthy seconds")
    robot.body.scanner.stalled = True
    assert robot.body.stopped_within(time.monotonic()) < 0.3 + STOP_S
    await until(lambda: any(e["event"] == "lidar_problem" for e in robot.agent.events), "the silence is logged")
    robot.body.scanner.stalled = False
    await until(lambda: robot.body.moving, "it drives on")


async def test_robot_that_its_computer_stops_again_and_again_drives_on_without_a_fault(robot):
    await enabled(robot)
    robot.fog.send_robot_to_the_corner()
    for number in range(1, 4):
        await until(lambda: robot.body.moving and robot.fog.state.mode == "NORMAL", "it drives")
        robot.agent.process.send_signal(signal.SIGSTOP)
        begun = time.monotonic()
        assert robot.body.stopped_within(begun) < STOP_S
        await until(lambda begun=begun: time.monotonic() - begun > 0.6, "the delay lasts")
        robot.agent.process.send_signal(signal.SIGCONT)
        await until(lambda count=number: robot.fog.state.loop.late_stops == count, "the stop is counted")
    await until(lambda: robot.body.moving, "it drives on")
    assert "FAULT" not in {state.mode for state in robot.fog.states}
    assert any("this computer was" in reason for state in robot.fog.states for reason in state.reasons)


async def test_a_bumper_needs_an_authenticated_reset_that_reaches_the_guardian(robot):
    await enabled(robot)
    robot.fog.send_robot_to_the_corner()
    await until(lambda: robot.body.moving, "it drives")
    robot.body.robot.world.bump_right = True
    assert robot.body.stopped_within(time.monotonic()) < STOP_S
    await until(lambda: robot.fog.state.mode == "FAULT", "the fault is reported")
    refused = await robot.fog.command("enable")
    assert not refused.accepted
    refused = await robot.fog.command("reset")
    assert "the cause is still there" in refused.reason
    robot.body.robot.world.bump_right = False
    end = time.monotonic() + DEADLINE_S
    while not (reply := await robot.fog.command("reset")).accepted:  # until it has received that the bumper is free
        assert "the cause is still there" in reply.reason
        assert time.monotonic() < end, f"the bumper is free, but no reset is accepted: {reply}"
    await until(lambda: robot.watchdog.count("fault_reset") == 1, "the guardian is reset")
    assert not robot.body.moving
    await enabled(robot)
    await until(lambda: robot.body.moving, "it drives again")


async def test_changes_of_the_map_are_applied_and_lost_ones_are_fetched(robot):
    await robot.localized()
    master, before = robot.fog.master, robot.fog.snapshots
    cells = master.layers["cost"][30:34, 60:70].copy()
    cells[:] = 200
    master.write([("cost", Window(60, 30, 10, 4), cells)], [], [])  # not published
    await until(lambda: robot.fog.state.map_seq == 1, "the lost change is fetched")
    assert robot.fog.snapshots == before + 1


async def test_robot_without_a_fog_starts_from_its_files_and_holds(robot):
    await robot.localized()
    await until(lambda: robot.agent.data.joinpath("snapshot.msgpack").exists(), "the map is kept")
    await until(lambda: robot.agent.data.joinpath("pose.json").exists(), "the pose is kept")
    kept = msgspec.json.decode(robot.agent.data.joinpath("pose.json").read_bytes(), type=SavedPose)
    assert (kept.site, kept.x) == ("lab", pytest.approx(2.0, abs=0.15))
    os.kill(robot.agent.process.pid, signal.SIGTERM)
    assert robot.agent.process.wait(60.0) == 0
    robot.fog.serves, requested = False, robot.fog.snapshots
    robot.fog.states.clear()
    robot.agent.start()
    await until(lambda: robot.fog.state and robot.fog.state.map_epoch == 7, "the map from disk is in use")
    await until(lambda: robot.agent.get("/readyz")[0] == 200, "it is localized")
    assert robot.fog.snapshots == requested
    reply = await robot.fog.command("enable")
    assert reply.accepted, reply
    robot.fog.send_robot_to_the_corner()
    await until(lambda: robot.fog.state.mode == "HOLD", "an old map holds the robot")
    assert not robot.body.moving


async def test_log_of_a_live_agent_replays_to_the_same_commands_and_publications(robot):
    await enabled(robot)
    robot.fog.send_robot_to_the_corner()
    await until(lambda: robot.body.pose[0] > 2.6, "it follows the path")
    reply = await robot.fog.command("disable")
    assert reply.accepted, reply
    await until(lambda: robot.fog.state.mode == "INIT", "the robot is disabled")
    robot.agent.process.send_signal(signal.SIGTERM)
    assert robot.agent.process.wait(60.0) == 0
    result = await asyncio.to_thread(replay, robot.agent.input_log)
    assert result.differences == []
    assert {"SnapshotLoaded", "PoseRestored", "LoopHealthReceived"} <= set(result.inputs)
    assert result.outputs["Answered"] == 2
    assert result.outputs["WheelsCommanded"] > 20
    assert result.inputs["DecisionMade"] > 5
    assert "NORMAL" in result.modes
    assert result.modes[-1] == "INIT"


async def test_robot_leaves_a_blocked_area_by_the_planners_way_on_a_signed_single_use_command(robot):
    def way_out(_ids, _request):
        return PlanReply(points=[(2.0, 2.0), (2.7, 2.0)], length=0.7)

    robot.fog.edge.serve(ch.PLANNER_EGRESS, way_out)
    await enabled(robot)
    robot.fog.block(1.5, 1.0, 2.4, 3.0)
    await until(lambda: robot.fog.state.mode == "PROTECTIVE_STOP", "it stops in the blocked area")
    wrong = await robot.fog.command("egress", key=b"x" * 32)
    assert "signature" in wrong.reason
    reply = await robot.fog.command("egress")
    assert reply.accepted, reply
    again = await robot.fog.repeat_command()
    assert "already carried out" in again.reason
    ended = "the egress ended: the robot is out"
    await until(lambda: robot.fog.state.mode == "EGRESS" or ended in robot.fog.state.reasons, "it begins")
    await until(lambda: robot.fog.state.mode != "EGRESS", "it ends")
    end = time.monotonic() + DEADLINE_S
    while ended not in robot.fog.state.reasons:
        # Whatever stops a robot ends an egress, a late scan on a busy machine too: then it is commanded again.
        assert time.monotonic() < end, f"it is still in the blocked area: {robot.fog.state}; its last answer: {reply}"
        reply = await robot.fog.command("egress")
        await until(lambda: robot.fog.state.mode != "EGRESS", "it ends")
    assert robot.fog.state.mode == "INIT"
    assert 2.6 < robot.body.pose[0] < 2.8


async def leave_dock(robot) -> None:
    """Undock the robot, again after each end that its computer's delay explains and no other."""
    fog, begun, why = robot.fog, time.monotonic(), "the undocking ended: "
    while robot.body.pose[0] >= 2.45:
        assert time.monotonic() - begun < DEADLINE_S, f"it is still on its way off the dock: {fog.state}"
        before = len(fog.states)
        reply = await fog.command("undock")
        assert reply.accepted, reply
        await until(lambda before=before: any(state.mode == "DOCK" for state in fog.states[before:]), "it begins")
        await until(lambda: robot.body.pose[0] < 2.45 or fog.state.mode != "DOCK", "it leaves its dock, or stops")
        if robot.body.pose[0] < 2.45:
            return
        await until(lambda: not fog.state.docked or why in "".join(fog.state.reasons), "it says why")
        if not fog.state.docked:
            return  # late between the charger and the end of its way: it is off its dock
        ended = [reason for reason in fog.state.reasons if reason.startswith(why)]
        assert len(ended) == 1, fog.state
        assert is_by_delay(ended[0]), ended


async def test_robot_goes_to_its_dock_and_leaves_it_on_signed_commands(tmp_path, router):
    running = Robot(tmp_path, router)
    running.body.dock = (2.7, 2.0, 0.0)  # 0.7 m before the robot
    running.agent = AgentProcess(tmp_path, router, running.watchdog, running.body)
    async with running as robot:
        await enabled(robot)
        base, fog = robot.body.robot, robot.fog
        reply = await fog.command("dock")
        assert reply.accepted, reply
        await until(lambda: fog.state.wants_dock, "it wants to its dock")
        fog.goal = RobotGoal(goal_id="front", pose=Pose(x=2.0, y=2.0, theta=0.0), planner_epoch=3)
        fog.points = [(1.9, 2.0), (2.0, 2.0)]
        fog.plan()
        await until(lambda: base.seeking_dock and robot.body.moving, "the base seeks its dock")
        await until(lambda: fog.state.docked and fog.state.mode == "HOLD", "it is on its dock")
        assert fog.state.enabled
        await leave_dock(robot)
