from __future__ import annotations

import math
import os
import random
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import guardian_rig as rigs
import numpy as np
import pytest
from guardian_rig import STOP_S, wait_for

from fog_runtime.machine import ENDING, TERMINAL_STOPS
from robot_agent.bases.diffdrive.emulator import DiffDriveEmulator
from robot_agent.bases.roomba600.emulator import PASSIVE, SAFE, Quirks, RoombaEmulator
from robot_agent.lidars.rplidar_a1.emulator import RplidarEmulator

pytestmark = [pytest.mark.live, pytest.mark.reaction, pytest.mark.timeout(120)]


@pytest.fixture
def rig(tmp_path):
    with rigs.Rig(tmp_path) as running:
        yield running


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.smoke
def test_wheels_stop_each_time_the_guardian_is_killed_and_drive_again(rig):
    for _ in range(3):
        rig.drive()
        dead = rig.watchdog.guardian()
        begun = rig.end_guardian(signal.SIGKILL)
        assert rig.base.stopped_within(begun) < STOP_S
        wait_for(lambda dead=dead: rig.watchdog.guardian() not in {None, dead}, "another guardian runs")


def test_diffdrive_base_is_guarded_like_the_roomba(tmp_path):
    board = DiffDriveEmulator()
    board.timeout_s = 1e9  # the board itself must not stop here
    with rigs.Rig(tmp_path, "diffdrive", board) as rig:
        rig.drive()
        begun = rig.end_guardian(signal.SIGKILL)
        assert rig.base.stopped_within(begun) < STOP_S
        rig.drive()
        rig.agent.wheels = None
        assert rig.base.stopped_within(time.monotonic()) < STOP_S
        rig.drive()
        board.bump_left = True
        assert rig.base.stopped_within(time.monotonic()) < STOP_S
        wait_for(lambda: "bumper" in (rig.agent.feedback.fault or ""), "the fault is reported")


@pytest.mark.parametrize(("docked", "mode"), [(True, PASSIVE), (False, SAFE)])
def test_base_is_left_charging_on_its_dock_and_without_its_buttons_off_it_when_all_has_ended(tmp_path, docked, mode):
    roomba = RoombaEmulator(quirks=Quirks(stays_safe_on_dock=True))
    if docked:
        roomba.set_dock(0.0, 0.0, 0.0)
    with rigs.Rig(tmp_path, robot=roomba) as rig:
        wait_for(lambda: rig.agent.feedback and roomba.mode == mode, "the base is ready")
        rig.watchdog.process.terminate()
        assert rig.watchdog.process.wait(rigs.DEADLINE_S) == 0
        wait_for(rig.base.has_obeyed, "it hears the last word")
        assert roomba.mode == mode
        stopped = subprocess.run(
            [sys.executable, "-m", "robot_agent.guardian.stop_base"], env=rig.watchdog.environment, check=False
        )
        assert stopped.returncode == 0
        wait_for(rig.base.has_obeyed, "it hears the last word")
        assert roomba.mode == mode
        assert (roomba.battery.current_ma > 0) == docked


def test_wheels_stop_when_the_guardian_hangs_and_drive_again(rig):
    rig.drive()
    hung = rig.watchdog.guardian()
    begun = rig.end_guardian(signal.SIGSTOP)
    assert rig.base.stopped_within(begun) < STOP_S
    wait_for(lambda: not alive(hung), "the hung guardian is gone")
    rig.drive()
    assert any("hung" in line.get("reason", "") for line in rig.watchdog.events)


def test_wheels_stop_when_the_agent_falls_silent(rig):
    rig.drive()
    rig.agent.wheels = None
    assert rig.base.stopped_within(time.monotonic()) < STOP_S
    wait_for(lambda: rig.agent.feedback.stopped == "no fresh command from the agent", "the agent is informed")
    rig.drive()


def test_base_that_falls_silent_before_it_has_moved_is_waited_for_and_afterwards_its_silence_is_latched(rig):
    speaks = rig.base.robot.outgoing

    def fall_silent():
        rig.base.robot.outgoing = lambda now: speaks(now)[:0]
        wait_for(lambda: "no valid frame" in (rig.agent.feedback.fault or ""), "the silence is a fault")

    wait_for(lambda: rig.agent.feedback and rig.agent.feedback.stopped is None, "the base is ready")
    fall_silent()
    rig.base.robot.outgoing = speaks
    wait_for(lambda: rig.agent.feedback.fault is None and rig.agent.feedback.stopped is None, "the base is ready again")
    assert rig.watchdog.count("fault_latched") == 0
    rig.drive()
    fall_silent()
    assert rig.base.stopped_within(time.monotonic()) < STOP_S
    before = rig.agent.feedback.seq
    rig.base.robot.outgoing = speaks
    wait_for(lambda: rig.agent.feedback.seq > before + 20, "the base sends frames again")
    assert "no valid frame" in rig.agent.feedback.fault
    assert rig.watchdog.count("fault_latched") == 1


def wakeups(pid: int) -> int:
    """How often a process has waited and was woken: its voluntary context switches."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("voluntary_ctxt_switches:")[1].split()[0])


def wakeups_per_feedback(rig, messages: int) -> float:
    """Wake-ups of the guardian for each message that the agent receives: a busy machine delays both.

    One that the machine delays too much, the watchdog replaces: it is another process then, and counted anew.
    """
    for _ in range(5):
        guardian, first = rig.watchdog.guardian(), rig.agent.feedback.seq
        before = wakeups(guardian)

        def enough(guardian=guardian, first=first) -> bool:
            return rig.watchdog.guardian() != guardian or rig.agent.feedback.seq >= first + messages

        wait_for(enough, "the guardian reports")
        if rig.watchdog.guardian() == guardian:
            return (wakeups(guardian) - before) / (rig.agent.feedback.seq - first)
        wait_for(lambda: rig.watchdog.guardian() and rig.base.speeds == rig.agent.wheels, "another guardian commands")
    raise AssertionError("no guardian lasts for a second")


def test_guardian_is_woken_for_whole_frames_while_driving_and_by_the_agent_alone_at_rest(rig):
    rig.base.send_in_pieces = True
    rig.drive()
    # Two looks for the four frames of a message, and more where a busy machine sends the frames late. Woken by each
    # piece of a frame it would be more than 50.
    assert wakeups_per_feedback(rig, 30) < 25.0
    rig.agent.wheels = (0.0, 0.0)
    wait_for(lambda: not rig.base.moving, "the wheels stop")
    assert wakeups_per_feedback(rig, 10) < 4.0, "two commands of the agent a message"
    rig.drive()
    rig.base.robot.world.bump_left = True
    assert rig.base.stopped_within(time.monotonic()) < STOP_S


def test_watchdog_tells_the_service_manager_that_it_lives(tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager, rigs.Base(tmp_path / "base") as base:
        manager.bind(str(tmp_path / "manager"))
        manager.settimeout(rigs.DEADLINE_S)
        watchdog = rigs.Watchdog(tmp_path, base.link)
        watchdog.environment["NOTIFY_SOCKET"] = str(tmp_path / "manager")
        with watchdog:
            assert manager.recv(4096) == b"READY=1"
            wait_for(watchdog.guardian, "the guardian runs")
            for _ in range(3):
                assert manager.recv(4096).startswith(b"WATCHDOG=1\n")
            started = next(line for line in watchdog.events if line["event"] == "started" and "priority" in line)
            assert re.match(r"SCHED_RR 15$|niceness -15,|refused: ", started["priority"])


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


AGENT = """
import socket, sys, time
from robot_agent.guardian.link import WheelCommand, encode
with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link:
    link.connect(sys.argv[1])
    for seq in range(10_000):
        link.send(encode(WheelCommand(seq=seq, left=0.2, right=0.2)))
        time.sleep(0.05)
"""
PATIENT_AGENT = f"""
import pathlib, sys, time
while not pathlib.Path(sys.argv[1]).exists():
    time.sleep(0.01)
{AGENT}
"""


FLOODING_AGENT = AGENT.replace("range(10_000)", "range(2**31)").replace("time.sleep(0.05)", "pass")


def test_agent_that_floods_the_guardian_delays_no_stop(rig):
    rig.drive()
    guardian = rig.watchdog.guardian()
    rig.agent.__exit__()
    flooding = subprocess.Popen([sys.executable, "-c", FLOODING_AGENT, str(rig.watchdog.socket)])
    try:
        wait_for(lambda: rig.base.speeds == (0.2, 0.2), "the flooding agent drives")
        rig.base.robot.world.bump_left = True
        assert rig.base.stopped_within(time.monotonic()) < STOP_S
        wait_for(lambda: rig.watchdog.count("fault_latched") == 1, "the fault is logged")
        assert rig.watchdog.guardian() == guardian, "its heartbeats came in time"
    finally:
        flooding.kill()
        flooding.wait()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_wheels_stop_when_the_agent_is_killed_or_hangs(rig, number):
    rig.drive()
    rig.agent.__exit__()
    other = subprocess.Popen([sys.executable, "-c", AGENT, str(rig.watchdog.socket)])
    try:
        wait_for(lambda: rig.base.speeds == (0.2, 0.2), "the other agent drives")
        other.send_signal(number)
        assert rig.base.stopped_within(time.monotonic()) < STOP_S
    finally:
        other.kill()
        other.wait()


def test_wheels_stop_and_the_guardian_ends_when_the_watchdog_is_killed(rig):
    rig.drive()
    guardian = rig.watchdog.guardian()
    rig.watchdog.process.kill()
    assert rig.base.stopped_within(time.monotonic()) < STOP_S
    wait_for(lambda: not alive(guardian), "the guardian is gone")
    rig.watchdog.process.wait()
    rig.watchdog.start()
    rig.drive()


@pytest.mark.parametrize("number", ENDING)
def test_a_signal_ends_both_processes_cleanly_with_the_wheels_at_rest(rig, number):
    rig.drive()
    guardian = rig.watchdog.guardian()
    rig.watchdog.process.send_signal(number)
    assert rig.base.stopped_within(time.monotonic()) < STOP_S
    assert rig.watchdog.process.wait(60.0) == 0
    assert not alive(guardian)
    assert rig.watchdog.events[-1]["event"] == "ended"


@pytest.mark.parametrize("number", ENDING)
def test_a_signal_ends_the_guardian_with_stop_bytes_and_the_watchdog_starts_another(rig, number):
    rig.drive()
    begun = rig.end_guardian(number)
    assert rig.base.stopped_within(begun) < STOP_S
    wait_for(lambda: rig.watchdog.count("guardian_lost"), "its end is logged")
    assert rig.watchdog.events[-1]["exit_code"] == 0
    rig.drive()


def test_stop_signals_of_a_terminal_leave_watchdog_and_guardian_in_control(rig):
    rig.drive()
    guardian = rig.watchdog.guardian()
    for pid in (guardian, rig.watchdog.process.pid):
        for number in TERMINAL_STOPS:
            os.kill(pid, number)
    rig.agent.wheels = None
    assert rig.base.stopped_within(time.monotonic()) < STOP_S
    rig.drive()
    assert rig.watchdog.guardian() == guardian
    rig.end_guardian(signal.SIGKILL)
    assert rig.base.stopped_within(time.monotonic()) < STOP_S


def test_wheels_stop_whatever_signal_the_group_of_a_login_shell_receives(rig):
    """As the manual starts them: watchdog and agent from one script, whose terminal goes away or stops it."""
    script = '"$0" -m robot_agent.guardian.watchdog & exec "$0" -c "$1" "$2"'
    rig.agent.__exit__()
    rig.watchdog.__exit__()
    for number in (*ENDING, *TERMINAL_STOPS):
        rig.watchdog.socket.unlink(missing_ok=True)
        with rig.watchdog.log_file.open("ab") as log, subprocess.Popen(
            ["/bin/sh", "-c", script, sys.executable, PATIENT_AGENT, str(rig.watchdog.socket)],
            env=rig.watchdog.environment, stderr=log, stdout=log, process_group=0,
        ) as shell:  # fmt: skip
            watchdog = wait_for(lambda pid=shell.pid: children(pid), "the watchdog runs")[0]
            try:
                wait_for(lambda: rig.base.speeds == (0.2, 0.2), "the base drives")
                os.killpg(shell.pid, number)
                assert rig.base.stopped_within(time.monotonic()) < STOP_S, number.name
            finally:
                shell.kill()
                os.kill(watchdog, signal.SIGTERM)
                wait_for(lambda pid=watchdog: not alive(pid), "the watchdog ends")
    rig.watchdog.start()


def test_lost_port_is_reopened(rig):
    rig.drive()
    rig.base.unplug()
    wait_for(lambda: rig.watchdog.count("port_lost"), "the loss is logged")
    # The cable was unplugged while the robot was driving: it rolls on until the port is open again.
    assert rig.base.moving
    rig.base.plug_in()
    rig.agent.wheels = (0.0, 0.0)
    assert rig.base.stopped_within(time.monotonic()) < 5.0
    rig.drive()


def test_garbage_on_the_line_neither_moves_the_base_nor_ends_the_guardian(rig):
    rig.drive()
    rig.agent.wheels = (0.0, 0.0)
    wait_for(lambda: not rig.base.moving, "the base stands")
    guardian, rng = rig.watchdog.guardian(), random.Random(5)
    for _ in range(50):
        rig.base.send(rng.randbytes(300))
        time.sleep(0.005)
        assert not rig.base.moving
    assert rig.watchdog.guardian() == guardian
    travel = rig.base.robot.encoders[0] * math.pi * 0.072 / 508.8
    wait_for(lambda: abs(rig.agent.feedback.odometry.left_m - travel) < 1e-9, "frames are parsed again")
    rig.agent.reset = True
    rig.drive()


def test_bumper_fault_survives_a_new_agent_until_a_reset(rig):
    rig.drive()
    rig.base.robot.world.bump_left = True
    assert rig.base.stopped_within(time.monotonic()) < STOP_S
    rig.base.robot.world.bump_left = False
    rig.agent.__exit__()
    rig.agent = rigs.Agent(rig.watchdog.socket)
    with rig.agent:
        rig.agent.wheels = (0.3, 0.3)
        wait_for(lambda: rig.agent.feedback and "bumper" in (rig.agent.feedback.fault or ""), "the fault is reported")
        assert not rig.base.moving
        rig.agent.reset = True
        wait_for(lambda: rig.base.moving, "the reset lets it drive")


def test_roomba_that_its_button_starts_under_a_latched_fault_is_stopped_and_kept_from_it(rig):
    robot = rig.base.robot
    rig.drive()
    robot.world.wheel_drop_left = True
    wait_for(lambda: "a wheel has dropped" in (rig.agent.feedback.fault or ""), "the fault is latched")
    robot.world.wheel_drop_left = False
    robot.clean()
    wait_for(lambda: not robot.cleaning and robot.mode == SAFE, "the guardian has it under control again")
    robot.press_clean()
    assert not robot.cleaning, "its buttons are without effect in Safe mode"
    assert "a wheel has dropped" in rig.agent.feedback.fault


def test_second_agent_is_refused_while_the_first_lives_and_takes_over_when_it_hangs(rig):
    rig.drive()
    with rigs.Agent(rig.watchdog.socket) as second:
        second.wheels = (0.2, 0.2)
        refusal = wait_for(lambda: second.refused, "the second agent is told")
        assert "another agent is connected" in refusal
        for _ in range(50):
            time.sleep(0.01)
            assert rig.base.speeds != (0.2, 0.2)
        wait_for(lambda: rig.base.speeds == (0.3, 0.3), "the first agent drives on")
        assert not any("another agent connected" in line.get("reason", "") for line in rig.watchdog.events)
        rig.agent.wheels = None
        wait_for(lambda: rig.base.speeds == (0.2, 0.2), "the second agent drives")
        rig.agent.refused, rig.agent.wheels = None, (0.3, 0.3)
        wait_for(lambda: rig.agent.refused, "the first agent is told")
        assert rig.base.speeds != (0.3, 0.3)


def test_agent_that_sends_nothing_gives_way_and_bad_packets_are_refused(rig):
    rig.drive()
    rig.agent.__exit__()
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as old:
        old.connect(str(rig.watchdog.socket))
        rig.agent = rigs.Agent(rig.watchdog.socket)
        with rig.agent:
            rig.drive()
            old.settimeout(5.0)
            while old.recv(4096):
                pass
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as bad_client:
        bad_client.connect(str(rig.watchdog.socket))
        for packet in (b"\xff", os.urandom(4000), b"\x80", b"\x00" * 5000):
            bad_client.send(packet)
        assert bad_client.recv(4096)
    wait_for(lambda: rig.watchdog.count("command_refused"), "the refusal is logged")
    assert rig.watchdog.count("guardian_lost") == 0


def test_robot_file_names_base_and_port_and_limits_the_speed(tmp_path):
    file = tmp_path / "robot.toml"
    file.write_text(
        f'[base]\ndriver = "diffdrive"\nport = "{tmp_path / "base"}"\n[lidar]\ndriver = "ld19"\n'
        "[motion]\nspeed_m_s = 0.2\ndegraded_speed_m_s = 0.1\n"
    )
    with rigs.Base(tmp_path / "base", DiffDriveEmulator()) as base:
        watchdog = rigs.Watchdog(tmp_path, base.link)
        del watchdog.environment["FOGNAV_BASE_PORT"]
        watchdog.environment["FOGNAV_ROBOT_FILE"] = str(file)
        with watchdog, rigs.Agent(watchdog.socket) as agent:
            agent.wheels = (0.3, 0.3)
            wait_for(lambda: base.speeds == pytest.approx((0.21, 0.21), abs=0.001), "the base drives at its own limit")


class LidarOnBasePort(RplidarEmulator):
    """An RPLidar that scans, on the base's port."""

    wheel_speeds_m_s = (0.0, 0.0)

    def __init__(self):
        super().__init__(lambda angles, _now: 2.0 + np.cos(3.0 * angles))
        self.receive(b"\xa5\x20", time.monotonic())

    def tick(self, now, dt):
        pass

    def add_wheel_travel(self, left_m, right_m):
        pass


def test_lidar_on_the_port_of_the_base_is_named_to_the_agent_and_left_alone(tmp_path):
    lidar = LidarOnBasePort()
    with rigs.Rig(tmp_path, robot=lidar) as rig:
        reason = wait_for(lambda: rig.agent.refused, "the agent is told")
        assert "a rplidar-a1 speaks on this port, not a roomba600" in reason
        assert rig.agent.feedback is None
        assert lidar.scanning
        wait_for(lambda: rig.watchdog.count("port_open") > 1, "the port is tried again")
        # The cables are swapped back: nobody has to restart anything.
        with rig.base.lock:
            rig.base.robot = RoombaEmulator()
        rig.drive()


def test_second_watchdog_does_not_open_a_port_in_use(rig, tmp_path):
    rig.drive()
    folder = tmp_path / "second"
    folder.mkdir()
    with rigs.Watchdog(folder, rig.base.link) as second:
        wait_for(lambda: second.count("port_lost"), "the second one is refused")
        (reason,) = {line["reason"] for line in second.events if line["event"] == "port_lost"}
        assert "locked" in reason
        assert rig.base.speeds == (0.3, 0.3)


@pytest.mark.parametrize(
    ("setting", "value", "reason"),
    [
        ("BASE_PORT", "", "the base's serial port is not set"),
        ("BASE_PORT", "/dev/ttyUSB0", "/dev/ttyUSB0 is no name to rely on"),
        ("ROBOT_FILE", "/none/robot.toml", "/none/robot.toml"),
        ("FOOTPRINT", "round", "FOGNAV_FOOTPRINT: "),
        ("SPEED", "fast", "positive number"),
        ("BASE", "tank", "no 'tank' (known: "),
        ("BASE_OPTIONS", '{"axle_m": 3.0}', "FOGNAV_BASE_OPTIONS.axle_m"),
        ("GUARDIAN_SOCKET", "", "FOGNAV_GUARDIAN_SOCKET"),
        ("GUARDIAN_SOCKET", "/tmp/nowhere/guardian.sock", "No such file or directory. Name a path"),
        ("LOG_LEVEL", "loud", "FOGNAV_LOG_LEVEL"),
    ],
)
def test_wrong_settings_end_the_watchdog_with_the_reason(tmp_path, setting, value, reason):
    with rigs.Base(tmp_path / "roomba") as base, rigs.Watchdog(tmp_path, base.link) as watchdog:
        watchdog.__exit__()
        watchdog.log_file.unlink()
        watchdog.environment[f"FOGNAV_{setting}"] = value
        watchdog.start()
        assert watchdog.process.wait(60.0) == 78
        assert any(line["event"] == "bad_settings" and reason in line["reason"] for line in watchdog.events)
