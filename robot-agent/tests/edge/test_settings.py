from __future__ import annotations

import pytest

from fog_runtime.configuration.robot_file import load_robot
from fog_runtime.configuration.settings import SettingsError, load
from robot_agent.agent.settings import Settings, read_footprint, read_given, read_operator_key, read_site

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
    site, body = read_site(settings(tmp_path, site_dir=tmp_path))
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
