"""The pages on hardware show what their scripts compute; the printed parts fit, with and without what is optional."""

import ast
import json
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fognav.__main__ import app

ROOT = Path(__file__).parents[1]


def run(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *command], cwd=ROOT, capture_output=True, text=True, check=False)


def test_drawings_are_those_that_the_script_draws() -> None:
    checked = run("hardware/wiring.py", "--check")
    assert checked.returncode == 0, checked.stdout


GPIO = {"D0": 16, "D1": 5, "D2": 4, "D3": 0, "D4": 2, "D5": 14, "D6": 12, "D7": 13, "D8": 15}


def test_drawn_pins_are_those_of_the_firmware() -> None:
    header = (ROOT / "firmware" / "lib" / "node_edge" / "src" / "board_pins.hpp").read_text("utf-8")
    board = header.partition("kD1Mini = {")[2].partition("};")[0]
    standard, thesis = re.findall(r"^    \{\{\{(\d+), (\d+)\}, \{(\d+), (\d+)\}\}\}", board, re.MULTILINE)
    drawn = runpy.run_path(str(ROOT / "hardware" / "wiring.py"))["PROFILES"]
    for pins, profile in ((standard, "standard"), (thesis, "thesis")):
        assert [str(GPIO[name]) for sonar in drawn[profile] for name in (sonar.trigger, sonar.echo)] == list(pins)


def test_page_contains_the_computed_currents_and_their_terms() -> None:
    printed = run("hardware/power.py").stdout.strip()
    assert printed in (ROOT / "docs" / "hardware.md").read_text("utf-8")
    table, _, arithmetic = printed.partition("\n\n")
    rows = [line.split("|") for line in table.splitlines()[2:]]
    blocks = re.findall(r"^(\S.*), in mA:\n((?:  .*\n)+)", arithmetic, re.MULTILINE)
    assert [name for name, _ in blocks] == [row[1].strip() for row in rows]
    for (_, lines), row in zip(blocks, rows, strict=True):
        *terms, together, bank = lines.splitlines()
        assert sum(float(term.split()[0]) for term in terms) == pytest.approx(float(together.split()[0]), abs=0.25)
        assert f"{float(together.split()[0]):.0f} mA" == row[2].strip()
        hours = float(bank.rpartition("= ")[2].removesuffix(" h"))
        assert hours / 24 == pytest.approx(float(row[5].split()[0]), abs=0.06)


def test_fewer_messages_make_a_power_bank_last_longer() -> None:
    rows = [line for line in run("hardware/power.py").stdout.splitlines()[2:] if line.startswith("|")]
    days = [float(line.split("|")[5].split()[0]) for line in rows]
    assert days == sorted(days, reverse=True)
    assert days[0] > days[-1]


def test_page_contains_the_computed_currents_of_a_robot_and_their_sum() -> None:
    printed = run("hardware/power.py", "robot").stdout.strip()
    assert printed in (ROOT / "docs" / "robot-hardware.md").read_text("utf-8")
    *parts, together = [
        [int(value) for value in re.findall(r"(\d+) mA \|", line)] for line in printed.splitlines()[2:-1]
    ]
    assert [sum(column) for column in zip(*parts, strict=True)] == together


def test_each_wire_of_the_drawn_cable_leads_to_its_counterpart() -> None:
    drawn = runpy.run_path(str(ROOT / "hardware" / "wiring.py"))
    at = {name: drawn["MINI_DIN"][pin] for name, (_, pin) in drawn["FTDI"].items()}
    assert at == {"GND": "GND", "TXD": "RXD", "RXD": "TXD", "RTS": "BRC"}


needs_openscad = pytest.mark.skipif(
    shutil.which("openscad") is None, reason="OpenSCAD is not installed (apt-get install openscad)"
)


CASE = "hardware/node/case.scad"
DECKS = "hardware/robot/decks.scad"


def openscad(file: str, part: str, out: Path, *values: str) -> subprocess.CompletedProcess[str]:
    """Compute a part with coarse circles, which is several times faster."""
    options = [word for value in (f'part="{part}"', "$fn=12", *values) for word in ("-D", value)]
    return subprocess.run(
        ["openscad", *options, "-o", str(out), file], cwd=ROOT, capture_output=True, text=True, timeout=300, check=False
    )


def assert_nothing_there(done: subprocess.CompletedProcess[str]) -> None:
    assert "Current top level object is empty" in done.stderr, "something is in another part's way"
    assert "WARNING" not in done.stderr


def assert_one_closed_solid(done: subprocess.CompletedProcess[str]) -> None:
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    assert "Simple:        yes" in done.stderr
    assert "Volumes:         2" in done.stderr  # the space outside, and one solid


@pytest.mark.drive
@needs_openscad
@pytest.mark.parametrize("bank", ["[0, 0, 0]", "[95, 25, 23]"])
def test_boards_sonars_and_plug_fit_into_the_case(tmp_path: Path, bank: str) -> None:
    assert_nothing_there(openscad(CASE, "collisions", tmp_path / "part.stl", f"power_bank={bank}"))


@pytest.mark.drive
@needs_openscad
@pytest.mark.parametrize("part", ["body", "plate"])
@pytest.mark.parametrize("bank", ["[0, 0, 0]", "[95, 25, 23]"])
def test_part_of_the_case_is_one_closed_solid(tmp_path: Path, part: str, bank: str) -> None:
    assert_one_closed_solid(openscad(CASE, part, tmp_path / "part.stl", f"power_bank={bank}"))


@pytest.mark.drive
@needs_openscad
@pytest.mark.parametrize("values", [(), ("roof=true",), ("power_bank=[160, 70, 27]", "has_switch=false")])
def test_what_the_robot_carries_fits_on_its_decks_and_within_its_outline(
    tmp_path: Path, values: tuple[str, ...]
) -> None:
    assert_nothing_there(openscad(DECKS, "collisions", tmp_path / "part.stl", *values))


@pytest.mark.drive
@needs_openscad
def test_computer_that_stands_in_a_post_is_found(tmp_path: Path) -> None:
    assert openscad(DECKS, "collisions", tmp_path / "part.stl", "pi_at=[-64, -17]").returncode == 0
    assert (tmp_path / "part.stl").is_file()


@needs_openscad
@pytest.mark.parametrize("part", ["lower", "upper", "roof", "foot", "post", "roof_post"])
def test_part_of_the_decks_is_one_closed_solid_that_a_printer_of_220_mm_prints(tmp_path: Path, part: str) -> None:
    assert_one_closed_solid(openscad(DECKS, part, tmp_path / "part.stl"))
    corners = np.array(re.findall(r"vertex (\S+) (\S+) (\S+)", (tmp_path / "part.stl").read_text("ascii")), float)
    assert np.ptp(corners, axis=0).max() <= 220.0


def settings_of_decks(out: Path, *values: str) -> list[str]:
    """Return the lines for robot.toml, site.toml and the reader."""
    assert openscad(DECKS, "settings", out, *values).returncode == 0
    return re.findall(r'^ECHO: "(.*)"$', out.read_text("utf-8"), re.MULTILINE)


@needs_openscad
@pytest.mark.parametrize("values", [(), ("roof=true",)])
def test_page_has_the_settings_of_the_decks_and_robot_check_accepts_them(
    tmp_path: Path, values: tuple[str, ...]
) -> None:
    lines = settings_of_decks(tmp_path / "settings.echo", *values)
    assert "```text\n" + "\n".join(lines) + "\n```" in (ROOT / "docs" / "robot-hardware.md").read_text("utf-8")
    file = tmp_path / "robot.toml"
    assert CliRunner().invoke(app, ["robot", "new", "--out", str(file)]).exit_code == 0
    text = file.read_text("utf-8")
    for line in lines[:3]:  # x_m, y_m, masks
        text, replaced = re.subn(rf"^{line.partition(' ')[0]} = .*$", line, text, count=1, flags=re.MULTILINE)
        assert replaced == 1  # of [lidar], which comes before [camera]
    file.write_text(text, "utf-8")
    checked = json.loads(CliRunner().invoke(app, ["robot", "check", str(file), "--json"]).output)
    assert "problem" not in checked
    assert [remark.partition(" ")[0] for remark in checked["remarks"]][:2] == ["base.port", "lidar.port"]


@pytest.mark.drive
@needs_openscad
@pytest.mark.parametrize("values", [(), ("roof=true",)])
def test_lidar_sees_nothing_of_the_robot_beside_its_masks(tmp_path: Path, values: tuple[str, ...]) -> None:
    assert_nothing_there(openscad(DECKS, "seen", tmp_path / "part.stl", *values))


@needs_openscad
def test_masks_hide_the_posts_from_both_beam_and_lens(tmp_path: Path) -> None:
    (line,) = [line for line in settings_of_decks(tmp_path / "s.echo", "roof=true") if line.startswith("masks")]
    masks = ast.literal_eval(line.partition(" = ")[2])
    assert openscad(DECKS, "shown_roof_posts", tmp_path / "posts.stl", "roof=true").returncode == 0
    corners = np.array(re.findall(r"vertex (\S+) (\S+) \S+", (tmp_path / "posts.stl").read_text("ascii")), float)
    for optics_mm in (-25.0, 0.0, 25.0):  # a line of sight passes the axis at this distance
        directions = np.arctan2(corners[:, 1], corners[:, 0]) - np.arcsin(optics_mm / np.hypot(*corners.T))
        assert all(any(low <= angle <= high for low, high in masks) for angle in directions)
