"""Directions without expected returns: how the shares in the direction of travel slow and stop the robot."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_agent.config import VisibilityConfig
from robot_agent.hardware import DriveTrain, Twist
from robot_agent.safety.gate import SafetyOutputs, limit_wheels
from robot_agent.safety.stop_field import SECTOR_ANGLES, Visibility, sector_of
from robot_agent.scan_builder import RepeatCounter

AROUND = np.radians(np.arange(-179.5, 180.0, 1.0))
WALLS = np.ones(72, np.bool_)
OPEN = np.zeros(72, np.bool_)
FORWARD, BACKWARD, TURNING = Twist(0.3, 0.0), Twist(-0.3, 0.0), Twist(0.0025, 1.0)


def degrees_off(angles, middle):
    return np.abs((np.degrees(angles) - middle + 180.0) % 360.0 - 180.0)


def seeing(missing=0.0, blind=0.0, *, towards=0.0, walls=WALLS, scans=2, visibility=None):
    """A lidar without returns within `missing` degrees to each side, and without samples within `blind`."""
    visibility = visibility or Visibility(VisibilityConfig())
    angles = AROUND[degrees_off(AROUND, towards) >= blind]
    for _ in range(scans):
        visibility.update(angles, degrees_off(angles, towards) >= missing, walls)
    return visibility


def zone(visibility, twist=FORWARD):
    return visibility.limit((0.3, 0.3), twist).zone


MIDDLES = np.degrees(SECTOR_ANGLES)
AHEAD = MIDDLES[np.abs(MIDDLES) < 40.0].tolist()
"""The sectors of travel straight ahead: 16 of them, since 0.70 rad are 40.1 degrees."""


def scanned(*, blind=(), missing=(), walls=WALLS, config=None):
    """A lidar that takes one sample of each sector but of those whose middles (degrees) are `blind`."""
    seen, returned = (~np.isclose(MIDDLES[:, None], np.reshape(some, (1, -1))).any(axis=1) for some in (blind, missing))
    visibility = Visibility(config or VisibilityConfig())
    for _ in range(2):
        visibility.update(SECTOR_ANGLES[seen], returned[seen], walls)
    return visibility


def heading(degrees, v=0.3):
    """The arc of a robot that will head there (degrees from straight ahead or back) after half of 0.5 s."""
    return Twist(v, math.radians(degrees) / 0.25)


def test_lidar_that_sees_all_around_limits_nothing():
    visibility = seeing()
    assert [zone(visibility, twist) for twist in (FORWARD, BACKWARD, TURNING)] == ["free"] * 3
    assert zone(Visibility(VisibilityConfig())) == "free"


def test_no_return_in_120_degrees_ahead_refuses_travel_there_and_nowhere_else():
    visibility = seeing(missing=60.0)
    refused = visibility.limit((0.3, 0.3), FORWARD)
    assert refused == ((0.0, 0.0), "stop", "the lidar sees nothing ahead: it is blind there, or faces glass")
    assert zone(visibility, BACKWARD) == "free"
    assert visibility.limit((-0.1, 0.1), Twist(0.0, 1.0)) == ((-0.1, 0.1), "free", None)
    assert visibility.limit((-0.1, 0.105), TURNING).wheels == pytest.approx((-0.1025, 0.1025))
    assert "behind" in seeing(missing=60.0, towards=180.0).limit((-0.3, -0.3), BACKWARD).reason


@pytest.mark.parametrize("wheels", [(0.3, 0.3), (0.2, 0.3), (0.0, 0.3), (-0.1, 0.105), (-0.2, 0.2)])
@pytest.mark.parametrize("acceleration", [0.1, 0.5])
def test_robot_never_creeps_into_what_its_lidar_does_not_see(wheels, acceleration):
    visibility = seeing(missing=60.0)
    drive = DriveTrain(axle_m=0.235, wheel_speed_max_m_s=0.5)
    outputs = SafetyOutputs(mode="NORMAL", reasons=(), cap=0.3, stop="none", changed=False, refusal=None)
    last, advanced, turned = (0.0, 0.0), 0.0, 0.0
    for _ in range(1200):
        stepped = limit_wheels(wheels, last, outputs, 0.05, acceleration=acceleration, wheel_speed=0.5)
        last = visibility.limit(stepped, drive.twist(*stepped)).wheels
        twist = drive.twist(*last)
        advanced, turned = advanced + 0.05 * abs(twist.v), turned + 0.05 * abs(twist.w)
    assert advanced < 1e-9
    assert (turned > 1.0) == (wheels in {(-0.1, 0.105), (-0.2, 0.2)})


def test_half_of_the_expected_returns_missing_slows_to_a_tenth_of_a_metre_per_second_on_the_same_arc():
    limited = seeing(missing=25.0).limit((0.2, 0.4), Twist(0.3, 0.0))
    assert limited.zone == "slow"
    assert limited.wheels == pytest.approx((0.2 / 3, 0.4 / 3))
    assert seeing(missing=25.0).limit((0.1, 0.1), Twist(0.1, 0.0)).zone == "free"


def test_open_space_gives_no_return_and_is_no_fault():
    assert zone(seeing(missing=180.0, walls=OPEN)) == "free"
    three = OPEN.copy()
    three[35:38] = True
    assert zone(seeing(missing=180.0, walls=three)) == "free"
    four = OPEN.copy()
    four[34:38] = True
    assert zone(seeing(missing=180.0, walls=four)) == "stop"


def test_directions_without_samples_are_blind_whatever_the_map_says():
    assert zone(seeing(blind=3.0, walls=OPEN)) == "free"
    assert zone(seeing(blind=10.0, walls=OPEN)) == "slow"
    assert zone(seeing(blind=25.0, walls=OPEN)) == "stop"


def test_one_scan_with_a_gap_changes_nothing():
    visibility = seeing()
    assert zone(seeing(missing=60.0, scans=1, visibility=visibility)) == "free"
    assert zone(seeing(scans=1, visibility=visibility)) == "free"
    assert zone(seeing(blind=60.0, scans=1, visibility=visibility)) == "free"
    assert zone(seeing(blind=60.0, scans=1, visibility=visibility)) == "stop"


def test_limit_is_lifted_only_well_below_the_share_at_which_it_began():
    visibility = seeing(missing=40.0)
    assert zone(visibility) == "stop"
    assert zone(seeing(missing=32.5, visibility=visibility)) == "stop"
    assert zone(seeing(missing=25.0, visibility=visibility)) == "slow"
    assert zone(seeing(missing=17.5, visibility=visibility)) == "slow"
    assert zone(seeing(missing=10.0, visibility=visibility)) == "free"
    assert zone(seeing(missing=17.5, visibility=visibility)) == "free"


def test_turning_robot_is_judged_where_it_will_head():
    visibility = seeing(missing=40.0, towards=60.0)
    assert zone(visibility, Twist(0.3, 0.0)) == "free"
    assert zone(visibility, Twist(0.3, 2.7)) != "free"
    assert zone(seeing(missing=40.0, towards=-60.0), Twist(0.3, 2.7)) == "free"
    assert zone(seeing(missing=40.0, towards=-120.0), Twist(-0.3, 2.7)) == "free"
    assert zone(seeing(missing=40.0, towards=140.0), Twist(-0.3, 2.7)) == "stop"


@pytest.mark.parametrize(("turning", "lead"), [(0.8, 0.2), (1.6, 0.4), (3.0, 0.75), (9.0, math.pi / 4)])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_robot_is_judged_half_of_half_a_second_ahead_and_at_45_degrees_at_most(turning, lead, side):
    twist = Twist(0.3, side * turning)
    border = math.degrees(lead + VisibilityConfig().half_width)
    # Where blind sectors begin to count shows where the robot looks.
    inside, outside = (seeing(blind=10.0, towards=side * (border + off), walls=OPEN) for off in (-12.5, 12.5))
    assert (zone(inside, twist), zone(outside, twist)) == ("slow", "free")


def test_sector_counts_by_half_of_its_samples_and_by_one_of_two_scans():
    def after(*returned):
        visibility = Visibility(VisibilityConfig())
        for share in returned:
            angles = np.repeat(SECTOR_ANGLES, 4)
            visibility.update(angles, np.tile(np.arange(4) < share, 72), WALLS)
        return zone(visibility)

    assert (after(2, 2), after(1, 1)) == ("free", "stop")
    assert (after(2, 1), after(1, 2), after(2, 1, 1)) == ("free", "free", "stop")


def test_sector_with_one_sample_is_measured():
    angles = SECTOR_ANGLES
    visibility = Visibility(VisibilityConfig())
    for _ in range(2):
        visibility.update(angles, np.ones(72, np.bool_), OPEN)
    assert zone(visibility) == "free"
    visibility.update(angles[:0], np.zeros(0, np.bool_), OPEN)
    assert zone(visibility) == "free"
    visibility.update(angles[:0], np.zeros(0, np.bool_), OPEN)
    assert visibility.limit((0.3, 0.3), FORWARD).reason == (
        "the lidar sees nothing ahead: it is blind there, or faces glass"
    )
    assert visibility.limit((-0.3, -0.3), BACKWARD).reason == (
        "the lidar sees nothing behind: it is blind there, or faces glass"
    )
    assert visibility.limit((0.05, 0.05), Twist(0.05, 0.0)).wheels == (0.0, 0.0)


@given(st.lists(st.booleans(), min_size=72, max_size=72), st.floats(-5.0, 5.0), st.sampled_from([0.3, -0.3]))
def test_blind_sectors_count_whose_middle_is_within_the_half_width_of_the_direction_of_travel(seen, turning, v):
    config, visibility = VisibilityConfig(), Visibility(VisibilityConfig())
    for _ in range(2):
        visibility.update(SECTOR_ANGLES[np.array(seen)], np.ones(sum(seen), np.bool_), OPEN)
    lead = min(max(0.25 * turning, -math.pi / 4), math.pi / 4)
    heading = lead if v > 0.0 else math.pi - lead
    off = np.abs([math.remainder(angle - heading, math.tau) for angle in SECTOR_ANGLES])
    share = 1.0 - np.mean(np.array(seen)[off <= config.half_width])
    expected = "stop" if share >= config.blind_refused else "slow" if share >= config.blind_slow else "free"
    assert zone(visibility, Twist(v, turning)) == expected


@given(st.floats(-20.0, 20.0))
def test_every_direction_has_a_sector_whose_middle_is_near(angle):
    sector = int(sector_of(np.array([angle]))[0])
    assert 0 <= sector < 72
    off = math.remainder(SECTOR_ANGLES[sector] - angle, math.tau)
    assert abs(off) <= math.radians(2.5) + 1e-9


@pytest.mark.parametrize("length", [1, 2, 3, 5, 64])
def test_buffer_of_scans_that_is_replayed_is_counted_from_its_second_time_on(length):
    rng, counter = np.random.default_rng(1), RepeatCounter()
    buffer = [rng.normal(size=360) for _ in range(length)]
    assert [counter.count(scan) for scan in buffer] == [1] * length
    assert [counter.count(buffer[i % length]) for i in range(5)] == [2, 3, 4, 5, 6]
    assert counter.count(rng.normal(size=360)) == 1


def test_genuine_noise_never_counts_and_a_scan_of_long_ago_is_forgotten():
    rng, counter = np.random.default_rng(1), RepeatCounter()
    first = rng.normal(size=360)
    counter.count(first)
    assert {counter.count(rng.normal(size=360)) for _ in range(64)} == {1}
    assert counter.count(first) == 1


@pytest.mark.parametrize(("samples", "returned", "zone_"), [(1, 1, "free"), (3, 1, "stop"), (3, 2, "free")])
def test_few_samples_of_a_sector_count_by_half_of_them_too(samples, returned, zone_):
    visibility = Visibility(VisibilityConfig())
    for _ in range(2):
        visibility.update(np.repeat(SECTOR_ANGLES, samples), np.tile(np.arange(samples) < returned, 72), WALLS)
    assert zone(visibility) == zone_


def test_angles_of_the_sectors_can_not_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        SECTOR_ANGLES[0] = 0.0


# --- the limits themselves, by whole sectors ---


def test_standing_robot_is_not_limited_and_needs_no_reason():
    assert seeing(missing=180.0).limit((0.0, 0.0), Twist(0.0, 0.0)) == ((0.0, 0.0), "free", None)


@pytest.mark.parametrize(
    ("blind", "expected"),
    [((37.5, 42.5), "slow"), ((42.5, 47.5), "free"), ((-32.5, -37.5), "slow"), ((-37.5, -42.5), "free")],
)
def test_sectors_of_travel_end_at_0_70_rad_to_each_side_of_the_heading(blind, expected):
    # Towards 2.5 degrees these are 17 sectors, from -37.5 to 42.5: two blind ones of them are more than a tenth.
    assert zone(scanned(blind=blind, walls=OPEN), heading(2.5)) == expected


def test_sectors_of_travel_may_begin_straight_behind():
    turning_back = heading(-40.0, v=-0.3)
    assert zone(scanned(blind=(-177.5, -172.5), walls=OPEN), turning_back) == "slow"
    assert zone(scanned(blind=(177.5, 172.5), walls=OPEN), turning_back) == "free"


@pytest.mark.parametrize(("count", "expected"), [(7, "free"), (8, "slow"), (14, "slow"), (15, "stop")])
def test_half_of_the_expected_returns_slows_and_nine_tenths_stop_a_robot_that_was_free(count, expected):
    assert zone(scanned(missing=AHEAD[:count])) == expected


def test_nine_of_ten_expected_returns_are_nine_tenths():
    ten = np.isin(MIDDLES, AHEAD[:10])
    assert zone(scanned(missing=AHEAD[:9], walls=ten)) == "stop"


@pytest.mark.parametrize(("count", "expected"), [(1, "free"), (2, "slow"), (7, "slow"), (8, "stop")])
def test_a_tenth_of_unmeasured_directions_slows_and_half_of_them_stop_a_robot_that_was_free(count, expected):
    assert zone(scanned(blind=AHEAD[:count], walls=OPEN)) == expected


def test_share_of_unmeasured_directions_that_is_exactly_the_limit_slows():
    assert zone(scanned(blind=AHEAD[:2], walls=OPEN, config=VisibilityConfig(blind_slow=2 / 16))) == "slow"


def test_missing_return_is_suspicious_only_where_the_map_expects_one():
    walls = np.isin(MIDDLES, AHEAD[:8])
    assert zone(scanned(missing=AHEAD[8:], walls=walls)) == "free"
    assert zone(scanned(missing=AHEAD[:8], walls=walls)) == "stop"


def test_direction_that_is_not_measured_counts_as_one_without_a_return():
    visibility = Visibility(VisibilityConfig())
    visibility.update(SECTOR_ANGLES, np.zeros(72, np.bool_), WALLS)
    assert zone(visibility) == "free", "one scan alone changes nothing"
    visibility.update(SECTOR_ANGLES[:0], np.zeros(0, np.bool_), WALLS)
    assert zone(visibility) == "stop"


def test_blind_direction_is_seen_again_with_its_next_sample():
    visibility = scanned(blind=MIDDLES, walls=OPEN)
    assert zone(visibility) == "stop"
    visibility.update(SECTOR_ANGLES, np.ones(72, np.bool_), OPEN)
    assert zone(visibility) == "free"
