"""A robot without fog, site and map is driven by hand through its agent's socket, by its real processes on ptys."""

from __future__ import annotations

import asyncio
import os
import pty
import select
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import programs
import pytest
from agent_rig import ROBOT, SITE, Body, Robot, until
from guardian_rig import Process, Watchdog, lateness, wait_for
from secured_servers import secured_router

from fog_runtime.clock import SystemClock
from robot_agent.agent.edges.local_tools import LocalTools
from robot_agent.agent.local_link import Missed
from robot_agent.agent.recording.input_log import BaseReceived, Published, ScanReceived, Started
from robot_agent.local_client import LocalRobot, LocalRobotError

pytestmark = [pytest.mark.live, pytest.mark.reaction, pytest.mark.timeout(120)]

NOBODY = 65534
STOP_S = 0.3
"""Within this time of a released key or a lost link the wheels stand."""

DRIVER = """
import sys, time
from pathlib import Path
from robot_agent.local_client import LocalRobot
with LocalRobot(Path(sys.argv[1])) as robot:
    while not robot.take_over().accepted:
        time.sleep(0.1)
    while True:
        robot.steer(0.15, 0.0)
        time.sleep(0.05)
"""


class Agent(Process):
    def __init__(self, folder, watchdog, body) -> None:
        self.log_file = folder / "agent.log"
        self.socket = watchdog.socket.with_name("agent.sock")
        settings = folder / "robot.toml"
        settings.write_text(
            '[base]\ndriver = "roomba600"\n[lidar]\ndriver = "rplidar-a1"\n[body]\nradius_m = 0.17\n', "utf-8"
        )
        self.environment = {
            **os.environ,
            "FOGNAV_FOG": "false",
            "FOGNAV_ROBOT": "r1",
            "FOGNAV_ROBOT_FILE": str(settings),
            "FOGNAV_DATA_DIR": str(folder / "data"),
            "FOGNAV_LIDAR_PORT": str(body.lidar_link),
            "FOGNAV_GUARDIAN_SOCKET": str(watchdog.socket),
        }

    def start(self) -> None:
        self.process = programs.start("robot_agent", self.environment, self.log_file)


class Watcher:
    """Reads what the agent tells, on a thread, and steers meanwhile if told to."""

    def __init__(self, path) -> None:
        self.robot = LocalRobot(path)
        self.seen: dict[type, list] = {}
        self.motion: tuple[float, float] | None = None
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._ends.set()
        self._thread.join()
        self.robot.close()

    def _run(self) -> None:
        while not self._ends.is_set():
            if self.motion is not None:
                self.robot.steer(*self.motion)
            for entry in self.robot.entries(0.04):
                self.seen.setdefault(type(entry), []).append(entry)
                if self.motion is not None:
                    break

    @property
    def state(self) -> dict | None:
        states = self.seen.get(Published)
        return states[-1].message if states else None


async def test_tool_that_leaves_at_once_is_forgotten_without_an_error(tmp_path):
    core = SimpleNamespace(on_hand=lambda *_: None)
    tools = LocalTools(tmp_path / "agent.sock", Missed(count=1), lambda: Missed(count=2), core, SystemClock())
    problems = []
    asyncio.get_running_loop().set_exception_handler(lambda _loop, problem: problems.append(problem))
    serving = asyncio.create_task(tools.run())
    await asyncio.sleep(0)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as tool:
        tool.connect(str(tmp_path / "agent.sock"))
    await asyncio.sleep(0.1)
    serving.cancel()
    await asyncio.gather(serving, return_exceptions=True)
    assert problems == []
    assert not tools.watched


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    folder = tmp_path_factory.mktemp("by-hand")
    with Body(folder) as body, Watchdog(folder, body.link) as watchdog, Agent(folder, watchdog, body) as agent:
        wait_for(agent.socket.exists, "the agent serves its socket")
        with Watcher(agent.socket) as watcher:
            wait_for(lambda: watcher.seen.get(ScanReceived), "a scan")
        yield body, agent


def taken_over(path) -> LocalRobot:
    """Return a link by which the robot may be driven; it must be healthy first."""
    robot = LocalRobot(path)
    refusals = []

    def agrees() -> bool:
        refusals.append(reply := robot.take_over())
        return reply.accepted

    wait_for(agrees, f"it may be driven by hand: {refusals}")
    return robot


def test_a_tool_sees_scans_counters_and_why_nobody_can_enable_a_robot_without_a_fog(rig):
    _, agent = rig
    with Watcher(agent.socket) as watcher:
        wait_for(lambda: {Started, BaseReceived, ScanReceived, Published} <= set(watcher.seen), "all kinds")
        assert watcher.seen[Started][0].config.radius == pytest.approx(0.17, rel=0.01)
        assert len(watcher.seen[ScanReceived][-1].scan().ranges_m) > 200
        assert watcher.state["mode"] == "INIT"
        assert {"map_missing", "pose_unknown", "not_enabled"} <= set(watcher.state["codes"])


def test_it_drives_as_long_as_somebody_steers_and_not_faster_than_the_cap(rig):
    body, agent = rig
    before = body.pose
    robot = taken_over(agent.socket)
    with robot:
        end = time.monotonic() + 1.5
        fastest = 0.0
        while time.monotonic() < end:
            robot.steer(1.0, 0.0)
            time.sleep(0.05)
            fastest = max(fastest, *body.speeds)
        assert 0.10 < fastest <= 0.152
        assert body.pose[0] > before[0] + 0.1
        begun, late = time.monotonic(), lateness()
        assert body.stopped_within(begun) < STOP_S + late.seconds(), "nobody steers any more"


def test_a_second_hand_is_refused_and_what_it_steers_is_not_heeded(rig):
    body, agent = rig
    with taken_over(agent.socket), LocalRobot(agent.socket) as other:
        reply = other.take_over()
        assert (reply.accepted, reply.code) == (False, "hand_taken")
        for _ in range(10):
            other.steer(0.15, 0.0)
            time.sleep(0.02)
        assert body.speeds == (0.0, 0.0)
        assert other.hand_back().code == "not_by_hand"


@pytest.mark.parametrize("way", [signal.SIGKILL, signal.SIGSTOP])
def test_a_driver_that_dies_or_hangs_stops_the_robot(rig, way):
    body, agent = rig
    driver = subprocess.Popen([sys.executable, "-c", DRIVER, str(agent.socket)])
    try:
        wait_for(lambda: max(body.speeds) > 0.1, "it drives")
        begun = time.monotonic()
        driver.send_signal(way)
        assert body.stopped_within(begun) < STOP_S
        taken_over(agent.socket).close()  # whoever hangs for long drives no more, so that another may
    finally:
        driver.kill()
        driver.wait()


def test_a_bump_is_a_fault_that_is_reset_at_the_robot(rig):
    body, agent = rig
    with taken_over(agent.socket) as robot:
        body.robot.world.bump_left = True
        refusals = []

        def is_refused() -> bool:
            refusals.append(robot.take_over())
            return refusals[-1].code == "fault_latched"

        wait_for(is_refused, "the bump is a fault")
        assert robot.reset().code == "cause_remains"
        body.robot.world.bump_left = False
        wait_for(lambda: robot.reset().accepted, "it is reset once the cause is gone")
        wait_for(lambda: robot.take_over().accepted, "it is driven by hand again")


def test_a_reader_that_reads_nothing_is_told_what_it_missed_and_delays_nobody(rig):
    body, agent = rig
    with LocalRobot(agent.socket) as slow, Watcher(agent.socket) as watcher:
        wait_for(lambda: len(watcher.seen.get(ScanReceived, ())) > 60, "the other one gets more than a socket holds")
        assert Missed not in watcher.seen
        assert slow.hand_back().code == "not_by_hand", "a reply is never missed"
        kinds = []
        for entry in slow.entries(1.0):
            kinds.append(type(entry))
            if isinstance(entry, Missed):
                break
        assert kinds[0] is Started
        assert kinds[-1] is Missed
    assert body.speeds == (0.0, 0.0)


def test_a_socket_without_an_agent_says_what_to_do(tmp_path):
    with pytest.raises(LocalRobotError, match="no robot's agent runs here: start it"):
        LocalRobot(tmp_path / "agent.sock")


def test_a_socket_of_another_user_is_refused_with_the_group_to_join(rig):
    _, agent = rig
    assert stat.S_IMODE(agent.socket.stat().st_mode) == 0o660, "its group may open it, others may not"
    own = os.geteuid()
    os.seteuid(NOBODY) if own == 0 else agent.socket.chmod(0)
    try:
        with pytest.raises(LocalRobotError, match=r"you may not open it: .* join its group \(usermod -aG fognav YOU\)"):
            LocalRobot(agent.socket)
    finally:
        os.seteuid(own)
        agent.socket.chmod(0o660)


def test_a_bump_ends_a_robot_that_calibrates_itself_and_its_tool_says_so(rig, tmp_path):
    body, agent = rig
    command = [sys.executable, "-m", "fognav", "calibrate", "--by-itself", "--yes", "--socket", str(agent.socket)]
    tool = subprocess.Popen([*command, "--out", str(tmp_path / "drive.mcap")], stderr=subprocess.PIPE)
    try:
        wait_for(lambda: max(body.speeds) > 0.1, "it drives by itself")
        body.robot.world.bump_left = True
        assert tool.wait(30.0) == 1
        assert b"the robot has stopped: " in (error := tool.stderr.read())
        assert b"bumper" in error
        assert body.speeds == (0.0, 0.0)
    finally:
        body.robot.world.bump_left = False
        tool.kill()
        tool.wait()
        tool.stderr.close()
    with LocalRobot(agent.socket) as robot:
        wait_for(lambda: robot.reset().accepted, "it is reset once the cause is gone")


async def test_a_robot_on_a_mission_that_was_driven_by_hand_waits_with_its_mission_for_an_enable(tmp_path):
    with secured_router(tmp_path, SITE, robots=[ROBOT]) as router:
        async with Robot(tmp_path, router) as robot:
            await robot.localized()
            fog, path = robot.fog, robot.watchdog.socket.with_name("agent.sock")
            fog.send_robot_to_the_corner()
            assert (await fog.command("enable")).accepted
            await until(lambda: fog.state.mode == "NORMAL" and max(robot.body.speeds) > 0.1, "it is on its way")
            link = await asyncio.to_thread(taken_over, path)
            with link:
                await until(lambda: fog.state.mode == "TELEOP", "its fog is told")
                assert (await asyncio.to_thread(link.hand_back)).accepted
            await until(lambda: fog.state.mode == "INIT" and not robot.body.moving, "it stands")
            # It is healthy for longer than any other stop would need to be left, and its mission is there.
            before, stood_at = len(fog.states), fog.state.clock
            await until(lambda: fog.state.clock - stood_at > 2.5, "time passes")
            assert {state.mode for state in fog.states[before:]} == {"INIT"}
            assert fog.state.goal_id == "g1"
            assert "not_enabled" in fog.state.codes
            assert not robot.body.moving
            assert (await fog.command("enable")).accepted
            await until(lambda: fog.state.mode == "NORMAL" and max(robot.body.speeds) > 0.1, "it goes on")


def test_teleop_begun_while_a_fault_is_latched_says_so_and_drives_after_its_reset(rig):
    body, agent = rig
    with LocalRobot(agent.socket) as robot:
        body.robot.world.bump_left = True
        wait_for(lambda: robot.reset().code == "cause_remains", "the bump is a fault")
        body.robot.world.bump_left = False
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "fognav", "teleop", "--socket", str(agent.socket)]
    tool = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs)
    os.close(theirs)
    said = b""
    try:
        while b"r resets a fault whose cause is gone" not in b" ".join(said.split()):  # its lines are wrapped
            assert select.select([ours], [], [], 30.0)[0], said
            said += os.read(ours, 4096)
        os.write(ours, b"r")

        def turns() -> bool:
            os.write(ours, b"j")
            return body.speeds[1] > 0.01

        wait_for(turns, "it is driven by hand")
    finally:
        tool.send_signal(signal.SIGINT)
        tool.wait(10.0)
        os.close(ours)
