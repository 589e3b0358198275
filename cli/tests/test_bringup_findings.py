"""What `fognav robot bringup` makes of what it sees: of the robot's parts, its computer, and its lidar's mounting."""

import asyncio
import math
import os
import socket
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from msgspec import structs

from fog_contracts.messages import Power
from fog_contracts.robot import LidarSettings
from fog_runtime.configuration.settings import SettingsError
from fognav.robot_page import calibrating, computer, findings, server, settings_file
from fognav.robot_page.bringup import Mount, Place
from fognav.robot_page.mounting import OwnReturns, changes, masked_sectors, missing_by_sector
from fognav.robot_page.view import RobotView
from robot_agent.agent import local_link
from robot_agent.agent.hand_driving import HandReply
from robot_agent.calibrated import Changed
from robot_agent.footprint import Footprint
from robot_agent.guardian.link import BaseFeedback
from robot_agent.hardware import BaseStatus, LaserScan, WheelOdometry

LINK = "Connected to 02:00:00:00:00:01 (on wlan0)\n\tSSID: floor\n\tfreq: 5180\n\tsignal: {} dBm\n"
HEARD = "BSS 02:00:00:00:00:01(on wlan0)\n\tsignal: {}.00 dBm\n\tSSID: floor\n"
FEEDBACK = BaseFeedback(
    seq=1, status=BaseStatus(), odometry=WheelOdometry(left_m=0.0, right_m=0.0), fault=None, stopped=None
)


async def test_an_error_in_what_a_page_shows_is_raised_for_the_log(tmp_path):
    class Broken(RobotView):
        def as_json(self):
            raise ZeroDivisionError

    path, page = tmp_path / "agent.sock", SimpleNamespace(receive_text=asyncio.Event().wait, send_json=None)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as agent:
        agent.bind(str(path))
        agent.listen()
        session = asyncio.create_task(server._Session(page, path, Broken()).run())
        link, _ = await asyncio.to_thread(agent.accept)
        with link:
            link.sendall(local_link.encode(HandReply(accepted=True, reason="")))
            with pytest.raises(ZeroDivisionError):
                await session


def test_each_finding_about_the_computer_tells_well_from_ill_and_both_from_unknown():
    judged = {
        "power save is off": (computer.wifi_power_save("wlan0", "Power save: off\n"), "ok"),
        "power save is on": (computer.wifi_power_save("wlan0", "Power save: on\n"), "bad"),
        "no iw": (computer.wifi_power_save("wlan0", None), "unknown"),
        "no Wi-Fi": (computer.wifi_power_save(None, None), "unknown"),
        "a near access point": (computer.wifi_roaming("wlan0", LINK.format(-50), HEARD.format(-50)), "ok"),
        "a far one": (computer.wifi_roaming("wlan0", LINK.format(-80), HEARD.format(-80)), "warn"),
        "stays with the far one": (
            computer.wifi_roaming("wlan0", LINK.format(-66), HEARD.format(-66) + HEARD.format(-45)), "warn",
        ),
        "what else there is is not known": (computer.wifi_roaming("wlan0", LINK.format(-50), None), "unknown"),
        "not connected": (computer.wifi_roaming("wlan0", "Not connected.\n", ""), "warn"),
        "chrony": (computer.clock("System time     : 0.000123 seconds slow\nLeap status     : Normal\n", None), "ok"),
        "chrony, alone": (computer.clock("Leap status     : Not synchronised\n", None), "warn"),
        "timesyncd": (computer.clock(None, "NTP=yes\nNTPSynchronized=yes\n"), "ok"),
        "timesyncd, alone": (computer.clock(None, "NTP=yes\nNTPSynchronized=no\n"), "warn"),
        "nobody tells the time": (computer.clock(None, None), "unknown"),
        "cool": (computer.temperature({"cpu": 45.0}), "ok"),
        "hot": (computer.temperature({"cpu": 45.0, "gpu": 74.0}), "warn"),
        "too hot": (computer.temperature({"cpu": 83.0}), "bad"),
        "no thermometer": (computer.temperature({}), "unknown"),
        "a steady supply": (computer.supply({"under_voltage": False, "throttled": False}), "ok"),
        "a weak supply": (computer.supply({"under_voltage": True, "throttled": False}), "bad"),
        "slowed down": (computer.supply({"under_voltage": False, "throttled": True}), "warn"),
        "no Raspberry Pi": (computer.supply({}), "unknown"),
        "memory": (computer.memory("MemTotal: 4000000 kB\nMemAvailable: 3000000 kB\n"), "ok"),
        "little memory": (computer.memory("MemAvailable: 100000 kB\n"), "bad"),
        "no meminfo": (computer.memory(""), "unknown"),
        "room": (computer.disk(5_000_000_000, Path("/var")), "ok"),
        "little room": (computer.disk(600_000_000, Path("/var")), "warn"),
        "a full card": (computer.disk(1_000_000, Path("/var")), "bad"),
        "real time": (computer.real_time({"agent": os.SCHED_RR, "guardian": os.SCHED_FIFO}), "ok"),
        "no real time": (computer.real_time({"agent": os.SCHED_OTHER, "guardian": os.SCHED_RR}), "warn"),
        "no processes": (computer.real_time({}), "unknown"),
        "a program that writes to ports": (computer.port_programs(["brltty"]), "bad"),
    }  # fmt: skip
    assert {name: finding.state for name, (finding, _) in judged.items()} == {
        name: state for name, (_, state) in judged.items()
    }
    ill = [finding for finding, _ in judged.values() if finding.state in {"warn", "bad"}]
    assert [finding for finding in ill if not finding.remedy] == []


def test_each_finding_about_a_part_tells_well_from_ill_and_both_from_unknown():
    power = Power(voltage_v=15.2, current_a=-0.5)
    fault = structs.replace(FEEDBACK, fault="the bumper is pressed", fault_code="bumper")
    blocked = structs.replace(FEEDBACK, fault="a wheel motor draws too much current", fault_code="motor_blocked")
    both, on, off = frozenset({True, False}), frozenset({True}), frozenset({False})
    judged = {
        "no settings": (findings.settings(None, in_use=True), "warn"),
        "settings that were not read yet": (findings.settings(Path("robot.toml"), in_use=False), "warn"),
        "other version": (findings.versions("1.0", "1.1"), "bad"),
        "untold version": (findings.versions("1.0", None), "unknown"),
        "no port": (findings.port("base", "roomba600", "", exists=False, known=[]), "bad"),
        "unplugged": (findings.port("lidar", "ld19", "/dev/serial/x", exists=False, known=["/dev/serial/y"]), "bad"),
        "a silent lidar": (findings.lidar("ld19", "", 3.0, 0), "bad"),
        "a lidar just begun": (findings.lidar("ld19", "", None, 0), "unknown"),
        "damaged packets": (findings.lidar("ld19", "", 0.1, 7), "warn"),
        "slow": (findings.lidar_rate(4.0, 5.5, 360.0), "warn"),
        "hardly turns": (findings.lidar_rate(2.0, 5.5, 900.0), "bad"),
        "few samples": (findings.lidar_rate(5.5, 5.5, 90.0), "bad"),
        "not rated": (findings.lidar_rate(5.5, None, 360.0), "unknown"),
        "all returns": (findings.lidar_returns([0.1] * 12, [False] * 12), "ok"),
        "a covered side": (findings.lidar_returns([0.1] * 9 + [0.95] + [0.1] * 2, [False] * 12), "warn"),
        "a masked side": (findings.lidar_returns([0.1] * 11 + [None], [False] * 11 + [True]), "ok"),
        "a side without samples": (findings.lidar_returns([0.1] * 11 + [None], [False] * 12), "warn"),
        "blind": (findings.lidar_returns([0.99] * 12, [False] * 12), "bad"),
        "a silent base": (findings.base("roomba600", "no frame", FEEDBACK), "bad"),
        "a bumper that is tried": (findings.base("roomba600", "", fault), "warn"),
        "a blocked motor": (findings.base("roomba600", "", blocked), "bad"),
        "a bumper that works": (findings.switch("bumper_left", both, now=False), "ok"),
        "a bumper that is stuck": (findings.switch("bumper_left", on, now=True), "warn"),
        "an untried bumper": (findings.switch("bumper_left", off, now=False), "unknown"),
        "rolled": (findings.encoders(0.5, 0.49, 2249.0), "ok"),
        "not rolled": (findings.encoders(0.01, 0.0, None), "unknown"),
        "a dead encoder": (findings.encoders(0.5, 0.0, None), "warn"),
        "reversed": (findings.encoders(-0.5, -0.5, None), "warn"),
        "turned": (findings.encoders(-0.5, 0.5, None), "unknown"),
        "full": (findings.battery(0.9, 0.2), "ok"),
        "low": (findings.battery(0.1, 0.2), "warn"),
        "untold": (findings.battery(None, 0.2), "unknown"),
        "a sound battery": (findings.voltage(power, 15.8, 15.5), "ok"),
        "a worn battery": (findings.voltage(power, 15.8, 13.9), "warn"),
        "no load": (findings.voltage(power, 15.8, None), "unknown"),
        "no voltmeter": (findings.voltage(None, None, None), "unknown"),
    }
    assert {name: finding.state for name, (finding, _) in judged.items()} == {
        name: state for name, (_, state) in judged.items()
    }
    ill = [finding for finding, _ in judged.values() if finding.state in {"warn", "bad"}]
    assert [finding for finding in ill if not finding.remedy] == []
    assert "90 degrees" not in findings.lidar_returns([0.1] * 9 + [0.95] + [0.1] * 2, [False] * 12).text
    assert "to the right (95 % missing)" in findings.lidar_returns([0.1] * 9 + [0.95] + [0.1] * 2, [False] * 12).text


def scan(heading: float, rng: np.random.Generator, *, rod: bool = False) -> LaserScan:
    """A turn in a square room of 4 m, with a post of the robot at 1 rad and, if asked for, a rod beside it at -2 rad.

    A wall unit of the room stands as near to the robot as the rod, at 3 rad in the room.
    """
    angles = np.linspace(-math.pi, math.pi, 400, endpoint=False) + 1e-6
    world = angles + heading
    ranges = 2.0 / np.maximum(np.abs(np.cos(world)), np.abs(np.sin(world))) + 0.01 * rng.standard_normal(400)
    ranges[np.abs(np.angle(np.exp(1j * (world - 3.0)))) < 0.05] = 0.24
    ranges[np.abs(angles - 1.0) < 0.06] = 0.15
    if rod:
        ranges[np.abs(angles + 2.0) < 0.05] = 0.24
    return LaserScan(angles, ranges, np.ones(400, np.uint8), 0.0, 0.18, 1)


@pytest.mark.parametrize("turns", [False, True])
def test_what_stays_near_is_the_robots_inside_its_outline_and_beside_it_once_it_has_turned(turns):
    rng = np.random.default_rng(5)
    own = OwnReturns(Footprint.circle(0.17).vertices, (0.0, 0.0, 0.0))
    for number in range(30):
        own.take(scan(heading := 0.05 * number * turns, rng, rod=True), heading)
    found = own.sectors()
    wanted = [(1.0, 0.06), *([(-2.0, 0.05)] if turns else [])]
    assert len(found) == len(wanted)
    for middle, half in wanted:
        (hides,) = [sector for sector in found if sector[0] <= middle <= sector[1]]
        assert middle - half - 0.07 < hides[0] <= middle - half
        assert middle + half <= hides[1] < middle + half + 0.07
    assert own.turned is turns


def test_missing_returns_are_counted_by_where_they_are_in_the_robots_frame():
    seen = scan(0.0, np.random.default_rng(5))
    seen.ranges_m[np.abs(seen.angles_rad) < 0.26] = np.nan  # ahead of the lidar, which points to the left
    missing = missing_by_sector([seen], math.pi / 2, 12.0)
    assert missing[3] == pytest.approx(1.0, abs=0.05)
    assert sum(missing) == pytest.approx(missing[3], abs=0.05)
    assert masked_sectors([(-0.3, 0.3)]).index(True) == 0
    assert sum(masked_sectors([(-0.3, 0.3)])) == 1


FILE = """[base]
driver = "roomba600"
[lidar]
driver = "rplidar-a1"
mirrored = false
masks = [
  [1.0, 1.2],  # the left post
]
"""


def test_what_is_set_by_looking_is_written_with_the_old_values_beside_it(tmp_path):
    file = tmp_path / "robot.toml"
    file.write_text(FILE)
    place = Place(file, {})
    reply = place.write(Mount(yaw_rad=1.5, mirrored=True, masks=[(1.0, 1.2), (3.1, 3.3)]))
    assert reply.accepted
    lines = file.read_text().splitlines()
    assert any(line.startswith("yaw_rad = 1.5 # set ") and line.endswith("before: 0.0") for line in lines)
    assert any(line.startswith("mirrored = true # set ") and line.endswith("before: false") for line in lines)
    (masks,) = [line for line in lines if line.startswith("masks")]
    assert masks.startswith("masks = [[1.0, 1.2], [3.1, -2.983]] # set ")
    assert masks.endswith("before: [[1.0, 1.2]]")
    assert (
        "has this already" in place.write(Mount(yaw_rad=1.5, mirrored=True, masks=[(1.0, 1.2), (3.1, -2.983)])).reason
    )


def test_a_calibration_since_the_agents_start_is_not_undone_by_looking(tmp_path):
    file = tmp_path / "robot.toml"
    file.write_text(FILE)
    place, running = Place(file, {}), (0.0, False, ((1.0, 1.2),))
    assert place.write(Mount(yaw_rad=0.1, mirrored=False, masks=[(1.0, 1.2)]), running).accepted
    assert place.write(Mount(yaw_rad=0.2, mirrored=False, masks=[(1.0, 1.2)]), running).accepted, "its own change"
    calibrating.write(file, [Changed("lidar.yaw_rad", before=0.2, now=0.21, half=None)], "drive.mcap 0123456789ab")
    refused = place.write(Mount(yaw_rad=0.2, mirrored=False, masks=[]), running)
    assert not refused.accepted
    assert "restart the agent" in refused.reason
    assert "yaw_rad = 0.21" in file.read_text()


def test_masks_that_would_hide_what_is_ahead_are_refused_and_nothing_is_written(tmp_path):
    file = tmp_path / "robot.toml"
    file.write_text(FILE)
    with pytest.raises(SettingsError, match="the masks hide 100 %"):
        settings_file.write(file, changes(LidarSettings(driver="x"), 0.0, [(-1.0, 1.0)], mirrored=False), "set", "test")
    reply = Place(file, {}).write(Mount(yaw_rad=0.0, mirrored=False, masks=[(-1.0, 1.0)]))
    assert not reply.accepted
    assert "robot.toml:" in reply.reason
    assert file.read_text() == FILE
    assert "--robot-file" in Place(None, {}).write(Mount(yaw_rad=0.0, mirrored=False, masks=[])).reason


def test_a_calibration_that_found_the_lidar_mirrored_is_written(tmp_path):
    file = tmp_path / "robot.toml"
    file.write_text(FILE)
    calibrating.write(file, [Changed("lidar.mirrored", before=False, now=True, half=None)], "drive.mcap 0123456789ab")
    assert "mirrored = true # calibrated " in file.read_text()
    assert "(drive.mcap 0123456789ab), before: false\n" in file.read_text()
