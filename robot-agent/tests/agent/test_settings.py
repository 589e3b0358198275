"""Settings that are wrong, or valid one by one and senseless together, are refused with line, value and remedy."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from fog_runtime.configuration.robot_file import load_robot, parse_robot
from fog_runtime.configuration.settings import SettingsError, load
from robot_agent import registry
from robot_agent.agent.settings import (
    Settings,
    read_footprint,
    read_given,
    read_operator_key,
    read_site,
    refuse_body,
    refuse_contradictions,
    remarks,
)
from robot_agent.config import VisibilityConfig
from robot_agent.footprint import SECTORS, Footprint
from robot_agent.hardware import LidarTraits, Twist
from robot_agent.safety.stop_field import Visibility
from robot_agent.scan_builder import Mounting

SITE = """
id = "lab"
[[robots]]
id = "r1"
start = { x = 1.0, y = 2.0, theta = 0.5 }
radius = 0.2
"""


def settings(tmp_path, **more):
    environ = {
        "FOGNAV_ROBOT": "r1",
        "FOGNAV_GUARDIAN_SOCKET": str(tmp_path / "socket"),
        "FOGNAV_DATA_DIR": str(tmp_path),
        **{f"FOGNAV_{name.upper()}": str(value) for name, value in more.items()},
    }
    return load(Settings, environ=environ)


def test_site_folder_gives_id_start_pose_and_radius(tmp_path):
    (tmp_path / "site.toml").write_text(SITE)
    site, body, _ = read_site(settings(tmp_path, site_dir=tmp_path))
    assert (site, body.start.x, body.radius) == ("lab", 1.0, 0.2)
    with pytest.raises(
        SettingsError, match=r"FOGNAV_SITE is 'other', but .*site.toml describes 'lab'.* remove FOGNAV_"
    ):
        read_site(settings(tmp_path, site_dir=tmp_path, site="other"))


def test_robot_whose_body_nobody_gives_is_refused_with_the_remedy(tmp_path):
    with pytest.raises(SettingsError, match=r"FOGNAV_SITE_DIR is not set, so this robot's body.*install --site site"):
        read_site(settings(tmp_path, site="lab"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "can't be read"),
        ("id = ", "site.toml: "),
        (SITE.replace('"r1"', '"r2"'), "there is no 'r1' .known: r2."),
        (SITE.replace('"lab"', "3"), "Expected `str`"),
        (SITE.replace("radius = 0.2", ""), "missing required field `radius`.* Add how far .* the robot's body reaches"),
    ],
)
def test_a_wrong_site_file_is_named_with_its_remedy(tmp_path, text, words):
    if text is not None:
        (tmp_path / "site.toml").write_text(text)
    with pytest.raises(SettingsError, match=words):
        read_site(settings(tmp_path, site_dir=tmp_path))


def test_a_robot_id_that_no_channel_could_carry_is_refused(tmp_path):
    with pytest.raises(SettingsError, match="FOGNAV_ROBOT"):
        settings(tmp_path, robot="Robot 1")


def test_the_operators_key_is_hexadecimal_and_long_enough(tmp_path):
    file = tmp_path / "key"
    file.write_text("ab" * 32 + "\n")
    assert read_operator_key(file) == b"\xab" * 32
    for text in ("ab" * 31, "no key", "ü" * 64):
        file.write_text(text)
        with pytest.raises(SettingsError, match="hexadecimal digits"):
            read_operator_key(file)
    for missing in (None, tmp_path / "nowhere"):
        with pytest.raises(SettingsError, match="openssl rand"):
            read_operator_key(missing)


@pytest.mark.parametrize(("x_m", "taken"), [(0.19, True), (0.21, False)])
def test_agent_refuses_a_lidar_outside_of_the_body_that_its_site_gives(tmp_path, x_m, taken):
    (tmp_path / "site.toml").write_text(SITE)
    (tmp_path / "key").write_text("ab" * 32)
    (tmp_path / "robot.toml").write_text(f'[base]\ndriver = "roomba600"\n[lidar]\ndriver = "ld19"\nx_m = {x_m}\n')
    robot = load_robot({"FOGNAV_ROBOT_FILE": str(tmp_path / "robot.toml")})
    given = settings(tmp_path, site_dir=tmp_path, operator_key_file=tmp_path / "key")
    if taken:
        assert read_given(given, robot).body.radius == 0.2
        return
    with pytest.raises(
        SettingsError, match=r"robot.toml:5: lidar.x_m: the lidar's axis \(0.21, 0\) is 0.010 m outside"
    ):
        read_given(given, robot)


@pytest.mark.parametrize(("half_m", "taken"), [(0.15, True), (0.17, False)])
def test_agent_refuses_a_footprint_that_reaches_beyond_the_radius_that_the_fog_knows(tmp_path, half_m, taken):
    (tmp_path / "site.toml").write_text(SITE)
    (tmp_path / "key").write_text("ab" * 32)
    corners = [[x, y] for x, y in ((half_m, half_m), (-half_m, half_m), (-half_m, -half_m), (half_m, -half_m))]
    (tmp_path / "robot.toml").write_text(
        f'[base]\ndriver = "roomba600"\n[lidar]\ndriver = "ld19"\n[body]\nfootprint = {corners}\n'
    )
    robot = load_robot({"FOGNAV_ROBOT_FILE": str(tmp_path / "robot.toml")})
    given = settings(tmp_path, site_dir=tmp_path, operator_key_file=tmp_path / "key")
    if taken:
        assert read_given(given, robot).footprint is not None
        return
    with pytest.raises(SettingsError, match=r"robot.toml:6: body.footprint: it reaches 0.24 m .* is 0.2 m"):
        read_given(given, robot)


def test_footprint_is_a_polygon_in_metres_and_a_wrong_one_is_named():
    assert read_footprint(load_robot({})) is None
    box = read_footprint(load_robot({"FOGNAV_FOOTPRINT": "[[0.2, 0.15], [-0.1, 0.15], [-0.1, -0.15], [0.2, -0.15]]"}))
    assert box.inscribed_radius == pytest.approx(0.1)
    for text in ("200, 150", "[[0.2, 0.15], [0.2, -0.15], [-0.1, 0.15]]"):
        with pytest.raises(SettingsError, match="FOGNAV_FOOTPRINT: "):
            read_footprint(load_robot({"FOGNAV_FOOTPRINT": text}))


FILE = """[base]
driver = "{base}"
options = {{ {options} }}
[lidar]
driver = "{lidar}"
{mounting}
[{table}]
{more}
"""
CIRCLE = Footprint.circle(0.17)
BOX = "footprint = [[0.3, 0.2], [-0.1, 0.2], [-0.1, -0.2], [0.3, -0.2]]"
POSTS = "masks = [[2.0, 2.2], [2.1, 2.4], [-2.2, -2.0], [3.0, -3.0]]"


def robot(mounting="", table="power", more="", base="roomba600", options="", lidar="rplidar-a1"):
    text = FILE.format(base=base, options=options, lidar=lidar, mounting=mounting, table=table, more=more)
    return parse_robot(text, Path("robot.toml"), {})


def checked(given, radius=0.17):
    base = registry.make_base(given)
    refuse_contradictions(given, base)
    refuse_body(given, base, read_footprint(given) or Footprint.circle(radius))


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"base": "diffdrive", "lidar": "ld19"},
        {"mounting": POSTS},
        {"mounting": "x_m = -0.1\ny_m = 0.13"},
        {"mounting": "x_m = 0.25", "table": "body", "more": BOX},
        {"more": "rest_base = true", "options": 'brc = "rts"'},
        {"more": "dock_below = 0.3"},
        {"base": "diffdrive", "options": "wheel_speed_max_m_s = 0.25", "table": "motion", "more": "speed_m_s = 0.25"},
    ],
)
def test_settings_that_go_together_are_taken(given):
    checked(robot(**given))


def refused(place, words, **given):
    with pytest.raises(SettingsError, match=words) as error:
        checked(robot(**given))
    assert str(error.value).startswith(f"robot.toml:{place}: ")


@pytest.mark.parametrize(
    ("masks", "words"),
    [
        ("[1.0, 1.2], [1.5, 1.5]", r"mask 2, \[1\.5, 1\.5\], ends where it begins"),
        ("[-3.142, 3.142]", r"mask 1, \[-3\.142, 3\.142\], ends where it begins"),
        ("[0.0, 6.2831]", "no direction, or all of them. Give the directions"),
        ("[0.1, 3.2], [3.1, 0.2]", "hide 100 % of the directions .* never drives"),
        ("[2.4, 2.0]", "hide 100 % .* counter-clockwise from its first"),
        ("[-0.4, 0.4]", "or mount the lidar where it sees what is ahead"),
    ],
)
def test_masks_of_no_direction_of_all_or_of_what_is_ahead_are_refused(masks, words):
    refused("6: lidar.masks", words, mounting=f"masks = [{masks}]")


def test_lidar_outside_of_the_body_is_refused():
    refused(
        "6: lidar.x_m", r"axis \(0\.2, 0\) is 0\.030 m outside .* Correct x_m and y_m, or let", mounting="x_m = 0.2"
    )
    refused("7: lidar.y_m", r"axis \(0\.1, -0\.18\) is 0\.0\d\d m outside", mounting="x_m = 0.1\ny_m = -0.18")
    refused("6: lidar.x_m", "0.050 m outside .* let `footprint`", mounting="x_m = 0.35", table="body", more=BOX)


def test_wheels_outside_of_the_body_are_refused():
    wide = {"base": "diffdrive", "options": "axle_m = 0.6"}
    refused(" body.footprint", "not include the wheels, 0.300 m to the left", **wide)
    refused("8: body.footprint", "`axle_m` of .base.options.", **wide, table="body", more=BOX)


def test_speed_that_the_wheels_do_not_reach_is_refused():
    slow = {"base": "diffdrive", "options": "wheel_speed_max_m_s = 0.2"}
    words = "0.25 m/s is more than the base's wheels can do, 0.2 m/s. Set it to 0.2 or less"
    refused("8: motion.speed_m_s", words, **slow, table="motion", more="speed_m_s = 0.25")
    refused(" motion.speed_m_s", "0.3 m/s is more", **slow)


def test_power_settings_that_the_base_can_not_follow_are_refused():
    words = "no control line could wake .* Set `brc` of .base.options."
    refused("8: power.rest_base", words, more="rest_base = true")
    refused("8: power.rest_base", "a diffdrive can't be put to sleep", base="diffdrive", more="rest_base = true")
    never = "rest_base = true\nrest_after_s = 0"
    refused("8: power.rest_base", "rest_after_s = 0 the robot never rests", more=never, options='brc = "dtr"')
    words = "0.3, but a diffdrive does not drive into a dock by itself"
    refused("8: power.dock_below", words, base="diffdrive", more="dock_below = 0.3")


def test_camera_without_its_focal_length_or_with_half_of_its_centre_is_refused():
    source = 'source = "/dev/video0"'
    refused("7: camera.focal_px", r"0, so .* or to 640 / \(2 tan", table="camera", more=source)
    refused("9: camera.centre_px", "one number", table="camera", more="focal_px = 590.0\ncentre_px = [320.0]")
    checked(robot(table="camera", more=f"{source}\nfocal_px = 590.0"))


def test_agent_names_what_a_camera_needs_and_what_is_not_installed(tmp_path, monkeypatch):
    (tmp_path / "site.toml").write_text(SITE)
    (tmp_path / "key").write_text("ab" * 32)
    given = settings(tmp_path, site_dir=tmp_path, operator_key_file=tmp_path / "key")
    seeing = robot(table="camera", more='focal_px = 590.0\nsource = "/dev/video0"')
    assert read_given(given, seeing).markers == []
    monkeypatch.setattr("robot_agent.agent.settings.CAMERA_LIBRARIES", ("numpy", "no_such_library"))
    with pytest.raises(
        SettingsError, match=r"a camera needs no_such_library, .* Install requirements/robot-camera.txt"
    ):
        read_given(given, seeing)
    assert read_given(given, robot()).markers == []


def test_a_larger_body_may_carry_its_lidar_farther_out():
    with pytest.raises(SettingsError, match="outside of the robot's body"):
        checked(robot(mounting="x_m = 0.22"))
    checked(robot(mounting="x_m = 0.22"), radius=0.25)


@pytest.mark.parametrize("middle", [0.0, 0.3, -0.5, 1.0])
def test_masks_are_refused_just_where_the_robot_would_never_drive_ahead(middle):
    outcomes = []
    angles = np.linspace(-math.pi, math.pi, 1440, endpoint=False) + 0.001
    for width in np.arange(0.05, 3.5, 0.05).tolist():
        mask = (middle - 0.5 * width, middle + 0.5 * width)
        sight = Visibility(VisibilityConfig())
        seen = angles[~Mounting(masks=(mask,)).masked(angles)]
        for _ in range(2):
            sight.update(seen, np.ones(len(seen), np.bool_), np.zeros(SECTORS, np.bool_))
        stopped = sight.limit((0.1, 0.1), Twist(0.1, 0.0)).zone == "stop"
        try:
            checked(robot(mounting=f"masks = [[{mask[0]}, {mask[1]}]]"))
            outcomes.append("drives")
        except SettingsError:
            outcomes.append("refused")
        assert (outcomes[-1] == "refused") == stopped, mask
    assert set(outcomes) == {"drives", "refused"}


def test_what_may_surprise_is_remarked():
    behind = robot(mounting="masks = [[2.4, -2.4]]", more="rest_base = true", options='brc = "rts"', lidar="ld19")
    checked(behind)
    told = remarks(behind, registry.make_lidar(behind).traits, CIRCLE)
    assert ["never drives backwards" in told[0], "rest_base has no effect" in told[1]] == [True, True]
    can_rest = LidarTraits(range_min_m=0.1, range_max_m=8.0, scan_period_s=0.2, can_rest=True)
    assert remarks(robot(mounting=POSTS, more="rest_base = true"), can_rest, CIRCLE) == []


def test_rim_of_the_body_that_is_nearer_to_the_lidar_than_it_measures_is_remarked():
    traits = registry.make_lidar(robot()).traits
    for x_m, rest in ((0.0, None), (0.01, None), (0.10, "only 0.07 m"), (-0.10, "only 0.07 m")):
        told = remarks(robot(mounting=f"x_m = {x_m}"), traits, CIRCLE)
        assert [rest in one for one in told] == ([True] if rest else []), x_m
    long = Footprint(((0.35, 0.25), (-0.35, 0.25), (-0.35, -0.25), (0.35, -0.25)))
    assert "only 0.05 m" in remarks(robot(mounting="x_m = 0.30"), traits, long)[0]
    assert (
        remarks(robot(mounting="x_m = 0.30", lidar="ld19"), registry.make_lidar(robot(lidar="ld19")).traits, long) == []
    )


def test_distance_beyond_a_footprint_is_that_to_its_side():
    box = Footprint(((0.2, 0.15), (-0.1, 0.15), (-0.1, -0.15), (0.2, -0.15)))
    for x, y, beyond in ((0.25, 0.0, 0.05), (0.0, -0.2, 0.05), (-0.3, 0.1, 0.2), (0.0, 0.0, -0.1), (0.2, 0.15, 0.0)):
        assert box.outside_by(x, y) == pytest.approx(beyond, abs=1e-12)
