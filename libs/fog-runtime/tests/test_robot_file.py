from __future__ import annotations

import tomllib
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog_runtime.configuration.robot_file import (
    ROBOT_FILE,
    default_robot,
    find_line,
    key_lines,
    load_robot,
    parse_robot,
)
from fog_runtime.configuration.settings import SettingsError

FILE = Path("robot.toml")
TEXT = """# my robot
[base]
driver = "tank"
port = "/dev/serial/by-id/tank"

[base.options]
axle_m = 0.25
colour = "red # [not a table]"

[lidar]
driver = "eye"
masks = [
    [1.0, 1.5],
    [2.0, 2.5],
]
x_m = 0.1

[motion]
speed_m_s = 0.2
"""


class TankOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    axle_m: float = 0.3
    colour: str = "green"


def parse(text=TEXT, **environ):
    return parse_robot(text, FILE, environ)


def test_a_file_sets_what_it_names_and_the_rest_keeps_its_default():
    robot = parse()
    assert robot.settings.base.port == "/dev/serial/by-id/tank"
    assert robot.settings.lidar.masks == [(1.0, 1.5), (2.0, 2.5)]
    assert (robot.settings.motion.speed_m_s, robot.settings.motion.turn_rad_s) == (0.2, 2.75)
    assert robot.options("base", TankOptions) == TankOptions(axle_m=0.25, colour="red # [not a table]")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "speed_m_s = 0.2",
            "speed_m_s = 3",
            r"robot.toml:19: motion.speed_m_s: Expected `float` <= 0.3. It has 3, and takes 0.05 to 0.3$",
        ),
        ("x_m = 0.1", 'x_m = "0.1"', r'robot.toml:16: lidar.x_m: .* It has "0.1", and takes -1 to 1$'),
        ("x_m = 0.1", "mirrored = 1", r"robot.toml:16: lidar.mirrored: .* It has 1, and takes true or false$"),
        ("[2.0, 2.5]", "[90, 95]", r"robot.toml:12: lidar.masks: .* takes list of \[2 numbers, -6.284 to 6.284\]$"),
        ('"tank"', '"My tank"', r'robot.toml:3: base.driver: .* "My tank", and takes a name of letters, digits'),
        ("[motion]", "[[motion]]", r"robot.toml:18: motion: .* takes a table, \[motion\]$"),
        ("[motion]", "[lidar.options]\n[motion]\noptions = 1979-05-27", r"robot.toml:20: motion.options: there is no"),
        ("x_m = 0.1", "x_m = 1979-05-27", r"robot.toml:16: lidar.x_m: .* It has 1979-05-27, and takes -1 to 1$"),
        ("x_m = 0.1", "x = 0.1", r"robot.toml:16: lidar.x: there is no such setting. .* driver, port, x_m"),
        ("x_m = 0.1", "x_m = nan", r"robot.toml:16: lidar.x_m: "),
        ("[2.0, 2.5]", "[2.0]", r"robot.toml:12: lidar.masks: "),
        ('driver = "eye"', "", r"robot.toml:10: lidar.driver: this setting is missing"),
        ("[motion]", "[motions]", r"robot.toml:18: motions: there is no such setting. .* base, lidar"),
        ("[lidar]", "[lidar", r"robot.toml is not valid TOML: .*line 10"),
        ("speed_m_s = 0.2", "speed_m_s = 0.1", r"robot.toml:18: motion: degraded_speed_m_s .* must not exceed speed"),
    ],
)
def test_a_mistake_is_named_with_its_line_and_remedy(old, new, message):
    with pytest.raises(SettingsError, match=message):
        parse(TEXT.replace(old, new))


def test_a_wrong_option_of_a_driver_is_named_with_its_line():
    with pytest.raises(SettingsError, match=r"robot.toml:7: base.options.axle_m: .* It has true, and takes a number$"):
        parse(TEXT.replace("axle_m = 0.25", "axle_m = true")).options("base", TankOptions)
    with pytest.raises(
        SettingsError, match=r"robot.toml:8: base.options.colour: .* It has 3, and takes a text in quotes$"
    ):
        parse(TEXT.replace('"red # [not a table]"', "3")).options("base", TankOptions)
    with pytest.raises(SettingsError, match=r"robot.toml:7: base.options.axle: .* Its options: axle_m, colour$"):
        parse(TEXT.replace("axle_m = 0.25", "axle = 0.25")).options("base", TankOptions)


def test_a_byte_order_mark_is_no_mistake_and_another_encoding_is_named(tmp_path):
    file = tmp_path / "robot.toml"
    file.write_bytes(b"\xef\xbb\xbf" + TEXT.encode())
    assert load_robot({ROBOT_FILE: str(file)}).settings == parse().settings
    file.write_bytes("# Größe\n".encode("latin-1") + TEXT.encode())
    with pytest.raises(SettingsError, match=r"robot.toml can't be read: it is no text in UTF-8 .* Save it as UTF-8"):
        load_robot({ROBOT_FILE: str(file)})


def test_variables_override_single_settings():
    robot = parse(FOGNAV_BASE_PORT="/dev/pts/3", FOGNAV_BASE_OPTIONS='{"axle_m": 0.4}', FOGNAV_FOOTPRINT="[[0.1, 0.2]]")
    assert robot.settings.base.port == "/dev/pts/3"
    assert robot.options("base", TankOptions) == TankOptions(axle_m=0.4, colour="red # [not a table]")
    assert robot.settings.body.footprint == [(0.1, 0.2)]


def test_options_of_the_file_do_not_reach_another_driver():
    assert parse(FOGNAV_BASE="boat").settings.base.options == {}
    assert parse(FOGNAV_BASE="tank").settings.base.options != {}


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"FOGNAV_BASE_OPTIONS": "{"}, "FOGNAV_BASE_OPTIONS: .* Give it as JSON"),
        ({"FOGNAV_BASE_OPTIONS": "3"}, "FOGNAV_BASE_OPTIONS: Expected `object`"),
        ({"FOGNAV_BASE": "../tank"}, "FOGNAV_BASE: Expected `str` matching"),
        ({"FOGNAV_FOOTPRINT": "[[1]]"}, "FOGNAV_FOOTPRINT: "),
    ],
)
def test_a_wrong_variable_is_named(variables, message):
    with pytest.raises(SettingsError, match=message):
        parse(**variables)


def test_without_a_file_the_robot_is_the_default_one(tmp_path):
    assert load_robot({}).settings == default_robot().settings
    with pytest.raises(SettingsError, match=r"FOGNAV_ROBOT_FILE: .*none.toml can't be read"):
        load_robot({ROBOT_FILE: str(tmp_path / "none.toml")})
    with pytest.raises(SettingsError, match="can't be read"):
        load_robot({ROBOT_FILE: str(tmp_path)})


NAMES = st.text("abc_-", min_size=1, max_size=3)
VALUES = st.sampled_from(
    [
        "1",
        '"a # b = [c]"',
        "'x]'",
        "[\n 1,\n 2, # ]\n]",
        '"""\ntwo\nlines [\n"""',
        "{ a = 1 }",
        "[[1], [2]]",
        "true # =",
    ]
)


@given(st.dictionaries(NAMES, st.dictionaries(NAMES, VALUES, max_size=4), max_size=4), st.integers(0, 2))
def test_every_key_is_found_on_its_own_line(tables, gap):
    text, expected = "", {}
    for table, values in tables.items():
        text += "\n" * gap
        expected[table] = text.count("\n") + 1
        text += f"[{table}]\n"
        for key, value in values.items():
            text += "# a comment = [\n" * gap
            expected[f"{table}.{key}"] = text.count("\n") + 1
            text += f"{key} = {value}\n"
    tomllib.loads(text)
    assert key_lines(text) == expected
    assert all(find_line(expected, f"{key}.inner.most") == line for key, line in expected.items())
    assert find_line(expected, "elsewhere.x") is None
