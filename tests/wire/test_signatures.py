"""Every installed device is known by what it sends, and what is asked on a strange line moves nothing there."""

from __future__ import annotations

import random
import re

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from fog_runtime.configuration import parts
from fog_runtime.configuration.robot_file import default_robot
from fognav_sim import devices
from robot_agent import registry
from robot_agent.device_signature import LISTEN_S, LineCheck, StopCommand, foreign
from robot_agent.guardian.watchdog import STOPS

SIGNATURES = registry.signatures()
BASES = parts.names(registry.BASES)
LIDARS = parts.names(registry.LIDARS)


def room(angles, _now):
    return 2.0 + np.cos(3.0 * angles)


def sent_by_base(name, seconds=LISTEN_S):
    base, driver = devices.make_base(name), registry.make_base(default_robot(base=name))
    base.receive(driver.wake(), 0.0)
    base.receive(driver.drive(0.2, 0.1), 0.0)
    data = b""
    for step in range(round(seconds / 0.01)):
        base.add_wheel_travel(0.002, 0.001)
        base.tick(0.01 * (step + 1), 0.01)
        data += base.outgoing(0.01 * (step + 1))
    return data


def sent_by_lidar(name, seconds=LISTEN_S, measure=room):
    lidar, driver = devices.make_lidar(name, measure), registry.make_lidar(default_robot(lidar=name))
    lidar.receive(driver.begin(0.0), 0.0)
    for step in range(30):  # until it scans
        events = driver.receive(lidar.outgoing(0.02 * step), 0.02 * step)
        lidar.receive(events.data + driver.tick(0.02 * step), 0.02 * step)
    return lidar.outgoing(0.6 + seconds)


SENT = {**{name: sent_by_base(name) for name in BASES}, **{name: sent_by_lidar(name) for name in LIDARS}}


def test_every_driver_has_a_signature():
    assert sorted(SIGNATURES) == sorted(BASES + LIDARS)


@pytest.mark.parametrize("name", sorted(SENT))
def test_a_device_is_recognized_from_any_byte_on_and_taken_for_no_other(name):
    data = SENT[name]
    for begin in range(0, len(data) - len(data) // 2, 7):
        heard = data[begin:]
        assert [other for other, each in SIGNATURES.items() if each.recognizes(heard)] == [name]


@pytest.mark.parametrize("name", sorted(SENT))
def test_a_damaged_beginning_hides_no_device(name):
    damaged = random.Random(name).randbytes(100) + SENT[name]
    assert SIGNATURES[name].recognizes(damaged)
    own = next(other for other in SIGNATURES if other != name)
    check = LineCheck("/dev/x", own, SIGNATURES)
    check.feed(damaged)
    assert check.settled
    assert f"/dev/x: a {name} speaks on this port, not a {own}; nothing but stop commands was written" in check.problem


@given(st.binary(max_size=600))
def test_noise_is_nobody(data):
    assume(b"\xa5\x5a" not in data)  # with five more bytes that is a lidar's descriptor
    assume(
        not re.search(rb"[A-Za-z]{4}", data)
    )  # a base that starts sends text, and Hypothesis tries the words of sources
    assert not any(each.recognizes(data) for each in SIGNATURES.values())
    assert foreign("roomba600", data, SIGNATURES) is None


@pytest.mark.parametrize("own", sorted(SENT))
def test_the_expected_device_is_believed_even_among_remains_of_another(own):
    for other, data in SENT.items():
        check = LineCheck("/dev/x", own, SIGNATURES)
        check.feed(data[:200] + SENT[own])
        assert (check.problem, check.settled) == (None, True), other


@pytest.mark.parametrize("text", [b"bl-start\r\nSTR730\r\n", b"Flash CRC successful: 0x0 (0x0)\r\n"])
def test_a_roomba_is_known_by_what_it_prints(text):
    assert foreign("rplidar-a1", text, SIGNATURES) == "roomba600"


def test_an_rplidar_is_known_by_its_boot_text_and_its_express_capsules():
    lidar = devices.make_lidar("rplidar-a1", room)
    lidar.receive(b"\xa5\x40", 0.0)
    assert foreign("roomba600", lidar.outgoing(0.0), SIGNATURES) == "rplidar-a1"
    lidar.receive(b"\xa5\x82\x05\0\0\0\0\0\x22", 0.0)
    assert foreign("roomba600", lidar.outgoing(0.2)[50:], SIGNATURES) == "rplidar-a1"


@pytest.mark.parametrize("name", LIDARS)
def test_stops_and_questions_for_other_devices_do_not_disturb_a_lidar(name):
    lidar, driver = devices.make_lidar(name, room), registry.make_lidar(default_robot(lidar=name))
    lidar.receive(driver.begin(0.0), 0.0)
    scans = 0
    stops = [parts.load(STOPS, base, StopCommand) for base in BASES]
    for step in range(150):
        now = 0.02 * step
        events = driver.receive(lidar.outgoing(now), now)
        lidar.receive(events.data + driver.tick(now), now)
        scans += len(events.scans)
        if step > 50:
            for stop in stops:
                lidar.receive(stop.stop + stop.hold, now)
            for each in SIGNATURES.values():
                lidar.receive(each.question, now)
    assert scans >= 10
    assert driver.problem == ""


@pytest.mark.parametrize("asked", [name for name, each in SIGNATURES.items() if each.question])
@pytest.mark.parametrize("name", BASES)
def test_a_question_moves_no_base_and_only_the_one_that_is_meant_answers(asked, name):
    base = devices.make_base(name)
    base.receive(SIGNATURES[asked].question, 0.0)
    base.tick(0.01, 0.01)
    answer = base.outgoing(0.01)
    assert base.wheel_speeds_m_s == (0.0, 0.0)
    assert SIGNATURES[asked].answered(answer) == (asked == name)
    question = LineCheck("/dev/x", "rplidar-a1", SIGNATURES).answer(asked, answer)
    assert (question is not None) == (asked == name)
