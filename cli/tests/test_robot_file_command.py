from __future__ import annotations

import json
import tomllib
from itertools import pairwise

import msgspec
import pytest
from typer.testing import CliRunner

from fog_runtime.configuration import parts
from fog_runtime.configuration.robot_file import default_robot, parse_robot
from fog_runtime.configuration.settings import SettingsError
from fognav.__main__ import app
from fognav.commands.robot_file import effective, robot_text
from fognav.demo.options import hardware
from robot_agent import registry

run = CliRunner().invoke


@pytest.mark.parametrize("base", parts.names(registry.BASES))
@pytest.mark.parametrize("lidar", parts.names(registry.LIDARS))
def test_the_file_that_new_writes_loads_and_equals_the_defaults(tmp_path, base, lidar):
    file = tmp_path / "robot.toml"
    assert run(app, ["robot", "new", "--base", base, "--lidar", lidar, "--out", str(file)]).exit_code == 0
    written = parse_robot(file.read_text(), file, {})
    defaults = default_robot(base, lidar)
    assert registry.options(written) == registry.options(defaults)
    assert (
        msgspec.structs.replace(
            written.settings,
            base=msgspec.structs.replace(written.settings.base, options={}),
            lidar=msgspec.structs.replace(written.settings.lidar, options={}),
        )
        == defaults.settings
    )
    everything = {name: value for name, value in effective(defaults).items() if name != "file"}
    assert set(flat(tomllib.loads(file.read_text()))) == set(everything)


def flat(tree, prefix=""):
    for key, value in tree.items():
        yield from flat(value, f"{prefix}{key}.") if isinstance(value, dict) else [prefix + key]


def test_every_setting_has_a_comment_that_says_what_it_means():
    lines = pairwise(robot_text(default_robot()).splitlines())
    assert [line for before, line in lines if " = " in line and line[0] != "#" and not before.startswith("#")] == []


def test_check_prints_the_effective_settings_or_the_line_of_a_mistake(tmp_path):
    file = tmp_path / "robot.toml"
    text = robot_text(default_robot("diffdrive", "ld19"))
    file.write_text(text.replace("x_m = 0.0", "x_m = 0.12"))
    values = json.loads(run(app, ["robot", "check", str(file), "--json"]).stdout)
    assert (values["ok"], values["lidar.x_m"], values["base.options.axle_m"]) == (False, 0.12, 0.28)
    file.write_text(text.replace("axle_m = 0.28", "axle_m = 28"))
    result = run(app, ["robot", "check", str(file), "--json"])
    line = text.splitlines().index("axle_m = 0.28") + 1
    assert result.exit_code == 1
    assert f"robot.toml:{line}: base.options.axle_m" in json.loads(result.stdout)["problem"]
    assert json.loads(result.stdout)["setting"] == "base.options.axle_m"
    file.write_text(text.replace("footprint = []", "footprint = [[1, 1], [0.5, 1], [1, 2]]"))
    refused = json.loads(run(app, ["robot", "check", str(file), "--json"]).stdout)
    assert refused["setting"] == "body.footprint"
    assert f"robot.toml:{line_of(file, '[body]', 'footprint = ')}: body.footprint: " in refused["problem"]


def line_of(file, table, begin):
    """Return the number of the line in a table of a file that begins so."""
    lines = file.read_text().splitlines()
    first = lines.index(table)
    return next(number for number, line in enumerate(lines[first:], first + 1) if line.startswith(begin))


@pytest.mark.parametrize(
    ("base", "lidar", "key", "problem"),
    [
        ("/dev/ttyUSB0", "", "base.port", "/dev/ttyUSB0 is no name to rely on"),
        ("", "/dev/ttyACM7", "lidar.port", "/dev/ttyACM7 is no name to rely on"),
        ("/dev/serial/by-id/a", "/dev/serial/by-id/a", "lidar.port", "the port of the base, too"),
    ],
)
def test_check_refuses_the_ports_that_no_process_would_open(tmp_path, base, lidar, key, problem):
    file = tmp_path / "robot.toml"
    first, second, third = robot_text(default_robot()).split('port = ""')
    file.write_text(f'{first}port = "{base}"{second}port = "{lidar}"{third}')
    result = run(app, ["robot", "check", str(file), "--json"])
    assert result.exit_code == 1
    place = line_of(file, "[lidar]" if key == "lidar.port" else "[base]", "port = ")
    assert json.loads(result.stdout)["setting"] == key
    assert f"robot.toml:{place}: {key}: " in json.loads(result.stdout)["problem"]
    assert problem in json.loads(result.stdout)["problem"]


def test_check_prints_what_a_file_may_say_and_names_the_ports_that_are_not_set(tmp_path):
    file = tmp_path / "robot.toml"
    file.write_text(robot_text(default_robot()).replace('port = ""', 'port = "/dev/serial/by-id/a"', 1))
    result = run(app, ["robot", "check", str(file)])
    assert result.exit_code == 1
    printed = result.output.splitlines()
    assert 'base.driver = "roomba600"' in printed
    assert "lidar.mirrored = false" in printed
    assert "odometry.alphas = [0.05, 0.05, 0.01, 0.05]" in printed
    assert [line for line in printed if "is not set" in line] == [
        "lidar.port is not set: a robot needs it, a demo does not"
    ]


@pytest.mark.parametrize(
    ("before", "after", "problem"),
    [
        ("masks = []", "masks = [[-3.142, 3.142]]", "mask 1, [-3.142, 3.142], ends where it begins"),
        ("masks = []", "masks = [[0.1, 3.2], [3.1, 0.2]]", "the masks hide 100 %"),
        ("rest_base = false", "rest_base = true", "Set `brc` of [base.options]"),
        (
            "footprint = []",
            "footprint = [[0.1, 0.1], [-0.3, 0.1], [-0.3, -0.1], [0.1, -0.1]]",
            "outside of the robot's",
        ),
    ],
)
def test_check_refuses_what_is_valid_alone_and_senseless_together_by_its_line(tmp_path, before, after, problem):
    file, text = tmp_path / "robot.toml", robot_text(default_robot()).replace("x_m = 0.0", "x_m = 0.15")
    file.write_text(text.replace(before, after))
    result = run(app, ["robot", "check", str(file), "--json"])
    assert result.exit_code == 1
    told = json.loads(result.stdout)["problem"]
    wrong = "x_m = 0.15" if before == "footprint = []" else before
    assert f"robot.toml:{text.splitlines().index(wrong) + 1}: " in told
    assert problem in told


def test_check_remarks_what_the_sites_radius_decides(tmp_path):
    file = tmp_path / "robot.toml"
    file.write_text(robot_text(default_robot()).replace("x_m = 0.0", "x_m = 0.2"))
    result = run(app, ["robot", "check", str(file)])
    assert result.exit_code == 1
    assert "unless the site gives this robot a larger `radius` than 0.17 m: " in result.output
    *_, told = json.loads(run(app, ["robot", "check", str(file), "--json"]).stdout)["remarks"]
    place = line_of(file, "[lidar]", "x_m = ")
    assert f"robot.toml:{place}: lidar.x_m: the lidar's axis (0.2, 0) is 0.030 m outside" in told


def test_new_overwrites_nothing_and_knows_its_parts(tmp_path):
    file = tmp_path / "robot.toml"
    file.write_text("mine")
    assert run(app, ["robot", "new", "--out", str(file)]).exit_code == 2
    assert run(app, ["robot", "new", "--base", "tank", "--out", str(tmp_path / "other.toml")]).exit_code == 2
    assert sorted(tmp_path.iterdir()) == [file]
    assert file.read_text() == "mine"


def test_hardware_of_a_demo_is_that_of_its_robot_file_unless_named(tmp_path):
    file = tmp_path / "robot.toml"
    file.write_text(robot_text(default_robot("diffdrive", "ld19")))
    assert hardware(file, None, None) == ("diffdrive", "ld19")
    assert hardware(file, None, "rplidar-a1") == ("diffdrive", "rplidar-a1")
    assert hardware(None, None, "ld19") == ("roomba600", "ld19")
    with pytest.raises(SettingsError, match="can't be read"):
        hardware(tmp_path / "none", None, None)
