"""Requirements on every installed base and lidar, from any package: driver and emulator on one line."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_runtime.configuration import parts
from fog_runtime.configuration.robot_file import default_robot, load_robot
from fog_runtime.configuration.settings import SettingsError
from fognav_sim import devices, emulators
from robot_agent import registry
from robot_agent.device_signature import StopCommand
from robot_agent.guardian.core import GuardianCore
from robot_agent.guardian.link import WheelCommand
from robot_agent.guardian.watchdog import STOPS
from robot_agent.localization.odometry import Motion, Odometry

STEP = 0.01
BASES = parts.names(registry.BASES)
LIDARS = parts.names(registry.LIDARS)

every_base = pytest.mark.parametrize("name", BASES)
every_lidar = pytest.mark.parametrize("name", LIDARS)


def test_every_base_and_lidar_has_its_stop_command_and_emulator():
    assert {"roomba600", "diffdrive"} <= set(BASES)
    assert {"rplidar-a1", "ld19"} <= set(LIDARS)
    assert parts.names(STOPS) == parts.names(emulators.BASES) == BASES
    assert parts.names(emulators.LIDARS) == LIDARS


def make_base(name):
    return registry.make_base(default_robot(base=name))


def make_lidar(name):
    return registry.make_lidar(default_robot(lidar=name))


@pytest.mark.parametrize("make", [make_base, make_lidar])
def test_an_unknown_name_is_refused_with_the_known_ones(make):
    with pytest.raises(SettingsError, match=r"(base|lidar)\.driver: .*'tank' \(known: "):
        make("tank")


@pytest.mark.parametrize(
    ("make", "part", "name"),
    [(registry.make_base, "BASE", "diffdrive"), (registry.make_lidar, "LIDAR", "ld19")],
)
def test_a_wrong_option_is_refused_by_its_name(make, part, name):
    robot = load_robot({f"FOGNAV_{part}": name, f"FOGNAV_{part}_OPTIONS": '{"wings": 2}'})
    with pytest.raises(SettingsError, match=rf"FOGNAV_{part}_OPTIONS.wings: there is no such setting. Its options: "):
        make(robot)


class Wire:
    """A guardian, a driver and an emulator on one line, in emulated time."""

    def __init__(self, name: str) -> None:
        self.driver = make_base(name)
        self.core = GuardianCore(self.driver)
        self.base = devices.make_base(name)
        self.stop: StopCommand = parts.load(STOPS, name, StopCommand)
        self.now = 10.0
        self.feedback = []
        self.seq = 0

    def handle(self, output) -> None:
        self.feedback += output.feedback
        if output.data:
            self.base.receive(output.data, self.now)

    def run(self, seconds: float, wheels: tuple[float, float] | None = None) -> None:
        for number in range(round(seconds / STEP)):
            if wheels is not None and number % 5 == 0:
                self.seq += 1
                command = WheelCommand(seq=self.seq, left=wheels[0], right=wheels[1])
                self.handle(self.core.on_command(command, self.now))
            self.now += STEP
            left, right = self.base.wheel_speeds_m_s
            self.base.add_wheel_travel(left * STEP, right * STEP)
            self.base.tick(self.now, STEP)
            self.handle(self.core.on_bytes(self.base.outgoing(self.now), self.now))
            self.handle(self.core.tick(self.now))

    def ready(self) -> Wire:
        self.run(0.5)
        assert self.core.latched is None
        assert self.feedback[-1].status.mode_problem is None
        return self


@every_base
def test_a_base_wakes_drives_and_stops(name):
    wire = Wire(name).ready()
    wire.run(0.6, (0.3, 0.15))
    assert wire.base.wheel_speeds_m_s == (0.3, 0.15)
    wire.run(0.25)
    assert wire.base.wheel_speeds_m_s == (0.0, 0.0)
    assert wire.core.latched is None


@every_base
def test_driver_and_emulator_agree_on_the_geometry(name):
    wire = Wire(name)
    assert wire.driver.drive_train.axle_m == wire.base.axle_m
    assert wire.stop.baud == wire.base.baud
    odometry = Odometry(wire.driver.drive_train)
    wire.ready()
    wire.run(0.5, (0.25, 0.2))
    left = right = 0.0
    for _ in range(100):
        motion = odometry.update(wire.feedback[-1].odometry, wire.now)
        assert isinstance(motion, Motion)
        left, right = left + motion.left_m, right + motion.right_m
        wire.run(0.05, (0.25, 0.2))
    # The first reading is the zero; feedback comes every few frames.
    assert (left, right) == pytest.approx((0.25 * 4.95, 0.2 * 4.95), abs=0.02)
    assert odometry.pose[2] == pytest.approx((right - left) / wire.base.axle_m)


@every_base
@pytest.mark.parametrize("sensors", [{"bump_left": True}, {"bump_right": True}, {"cliff": True}])
def test_bumper_and_cliff_stop_the_base_and_latch(name, sensors):
    wire = Wire(name).ready()
    wire.run(0.5, (0.3, 0.3))
    wire.base.set_sensors(**{"bump_left": False, "bump_right": False, "cliff": False, **sensors})
    wire.run(0.05, (0.3, 0.3))
    assert wire.base.wheel_speeds_m_s == (0.0, 0.0)
    status = wire.feedback[-1].status
    assert {key: getattr(status, key.replace("bump", "bumper")) for key in sensors} == sensors
    assert wire.core.latched is not None


@every_base
def test_a_silent_base_is_a_fault(name):
    wire = Wire(name).ready()
    wire.run(0.5, (0.3, 0.3))  # before it has moved it is only waited for
    for _ in range(round(wire.driver.timing.frame_timeout / STEP) + 2):
        wire.now += STEP
        wire.handle(wire.core.tick(wire.now))
    assert "no valid frame" in wire.core.latched


@every_base
@pytest.mark.parametrize("command", ["stop", "hold", "wake", "zero"])
def test_every_stop_works_after_a_command_truncated_anywhere(name, command):
    truncated = Wire(name).driver.drive(0.31, 0.29)
    for cut in range(len(truncated)):
        wire = Wire(name).ready()
        wire.run(0.5, (0.3, 0.3))
        assert wire.base.wheel_speeds_m_s == (0.3, 0.3)
        wire.base.receive(truncated[:cut], wire.now)
        data = {
            "stop": wire.stop.stop,
            # It is repeated until a guardian drives again: the first may complete the truncated command.
            "hold": wire.stop.hold * 2,
            "wake": wire.driver.wake(),
            "zero": wire.core.stop_command() * 2,
        }[command]
        wire.base.receive(data, wire.now)
        assert wire.base.wheel_speeds_m_s == (0.0, 0.0), cut


@every_base
def test_a_base_that_was_stopped_by_the_watchdog_is_woken_by_the_next_guardian(name):
    wire = Wire(name).ready()
    wire.run(0.5, (0.3, 0.3))
    wire.base.receive(wire.stop.stop, wire.now)
    wire.core = GuardianCore(make_base(name))
    wire.ready()
    wire.run(0.6, (0.2, 0.2))
    assert wire.base.wheel_speeds_m_s == (0.2, 0.2)


@every_base
@given(st.integers(0, 2**32), st.lists(st.integers(1, 80), min_size=1, max_size=20))
@settings(max_examples=20, deadline=None)
def test_base_frames_parse_in_pieces_of_any_size_and_damaged_ones_are_counted(name, seed, sizes):
    rng = np.random.default_rng(seed)
    base, whole, cut, damaged = devices.make_base(name), *(make_base(name) for _ in range(3))
    base.receive(whole.wake(), 0.0)
    base.add_wheel_travel(3.0, 2.0)
    clean, dirty, now = b"", b"", 0.0
    for _ in range(40):
        now += STEP
        base.tick(now, STEP)
        piece = base.outgoing(now)
        clean += piece
        corrupted = bytearray(piece)
        if corrupted and len(dirty) > 200 and rng.random() < 0.3:
            corrupted[rng.integers(len(corrupted))] ^= 1 << int(rng.integers(8))
        dirty += corrupted
    whole.receive_data(clean, now)
    for begin, end in itertools.pairwise([0, *np.minimum(np.cumsum(sizes), len(clean)), len(clean)]):
        cut.receive_data(clean[begin:end], now)
    damaged.receive_data(dirty, now)
    expected = list(iter(whole.next_event, None))
    assert len(expected) >= 15
    assert list(iter(cut.next_event, None)) == expected
    survived = list(iter(damaged.next_event, None))
    assert all(reading in expected for reading in survived)
    assert (damaged.corrupted > 0) == (dirty != clean) or len(survived) == len(expected)
    assert whole.corrupted == cut.corrupted == 0


# --- lidars ---


def box(angles, now):
    """Walls of a room 6 m by 4 m with a door without return ahead."""
    ranges = 1.0 / np.maximum(np.abs(np.cos(angles)) / 3.0, np.abs(np.sin(angles)) / 2.0)
    return np.where(np.abs(angles) < 0.1, np.nan, ranges)


def scans_of(name, lidar, seconds, *, pieces=lambda data: [data], begin=0.0):
    driver = make_lidar(name)
    lidar.receive(driver.begin(begin), begin)
    scans = []
    for number in range(1, round(seconds / STEP) + 1):
        now = begin + number * STEP
        for piece in pieces(lidar.outgoing(now)):
            events = driver.receive(piece, now)
            scans += events.scans
            lidar.receive(events.data, now)
        lidar.receive(driver.tick(now), now)
    return scans, driver


@every_lidar
def test_scans_show_the_room_as_it_is(name):
    # Real ranges are noisy; scans that equal an earlier one would count as repeated.
    noise = np.random.default_rng(1)
    noisy = devices.make_lidar(
        name, lambda angles, at: box(angles, at) + noise.uniform(-0.001, 0.001, np.shape(angles))
    )
    scans, driver = scans_of(name, noisy, 3.0)
    traits = driver.traits
    assert len(scans) >= 2.0 / traits.scan_period_s
    for scan in scans:
        truth = box(scan.angles_rad, 0.0)
        # Angles come in small steps: at the edges of the door a sample may fall to either side.
        edge = np.abs(np.abs(scan.angles_rad) - 0.1) < 0.005
        assert (np.isnan(scan.ranges_m) == np.isnan(truth))[~edge].all()
        returned = ~np.isnan(scan.ranges_m) & ~edge
        np.testing.assert_allclose(scan.ranges_m[returned], truth[returned], atol=0.003)
        assert scan.repeats == 1
        assert scan.ended_at - scan.started_at == pytest.approx(traits.scan_period_s, abs=0.02)
        assert scan.angles_rad.size > 300
        assert (scan.quality[returned] > 0).all()
    assert driver.problem == ""


@every_lidar
def test_lidar_scans_parse_one_byte_at_a_time(name):
    whole, _ = scans_of(name, devices.make_lidar(name, box), 1.0)
    single, _ = scans_of(
        name, devices.make_lidar(name, box), 1.0, pieces=lambda data: [bytes((byte,)) for byte in data]
    )
    assert len(whole) == len(single) > 3
    for one, other in zip(whole, single, strict=True):
        assert (one.angles_rad == other.angles_rad).all()
        np.testing.assert_array_equal(one.ranges_m, other.ranges_m)


@every_lidar
def test_lidar_that_already_scans_gives_whole_scans(name):
    lidar = devices.make_lidar(name, box)
    scans_of(name, lidar, 0.77)
    scans, _ = scans_of(name, lidar, 1.0, begin=0.77)
    assert len(scans) >= 3
    assert all(np.ptp(np.unwrap(scan.angles_rad)) > 6.2 for scan in scans)


@every_lidar
def test_stuck_link_gives_identical_scans(name):
    lidar = devices.make_lidar(name, box)
    driver = make_lidar(name)
    lidar.receive(driver.begin(0.0), 0.0)
    repeats = []
    for number in range(300):
        lidar.frozen = number > 100
        now = number * STEP
        events = driver.receive(lidar.outgoing(now), now)
        repeats += [scan.repeats for scan in events.scans]
        lidar.receive(events.data + driver.tick(now), now)
    assert repeats[:2] == [1, 1]
    assert repeats[-1] >= 3


@every_lidar
def test_silent_lidar_is_a_problem_until_it_sends_again(name):
    lidar = devices.make_lidar(name, box)
    driver = make_lidar(name)
    lidar.receive(driver.begin(0.0), 0.0)
    problems = []
    for number in range(500):
        lidar.stalled = 100 < number <= 300
        now = number * STEP
        events = driver.receive(lidar.outgoing(now), now)
        lidar.receive(events.data + driver.tick(now), now)
        problems.append(driver.problem)
    assert problems[100] == ""
    assert "the lidar" in problems[300]
    assert problems[-1] == ""


@every_lidar
@given(st.binary(max_size=400), st.integers(0, 2**32))
@settings(max_examples=20, deadline=None)
def test_no_bytes_raise_and_damaged_scans_stay_finite(name, garbage, seed):
    rng = np.random.default_rng(seed)

    def damage(data):
        damaged = bytearray(data)
        if damaged and rng.random() < 0.05:
            damaged[rng.integers(len(damaged))] ^= int(rng.integers(1, 256))
        return [bytes(damaged)]

    lidar, driver = devices.make_lidar(name, box), make_lidar(name)
    driver.begin(0.0)
    driver.receive(garbage, 0.0)
    driver.tick(0.1)
    scans, _ = scans_of(name, lidar, 1.0, pieces=damage)
    assert all(np.isfinite(scan.angles_rad).all() and np.ptp(scan.angles_rad) <= 2 * np.pi for scan in scans)
