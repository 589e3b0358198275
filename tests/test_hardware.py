"""The page on hardware shows what its scripts compute, and the case can be computed with and without a power bank."""

import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

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


def test_page_contains_the_computed_currents() -> None:
    table = run("hardware/power.py").stdout.strip()
    assert table.count("\n") == 3
    assert table in (ROOT / "docs" / "hardware.md").read_text("utf-8")


def test_fewer_messages_make_a_power_bank_last_longer() -> None:
    days = [float(line.split("|")[5].split()[0]) for line in run("hardware/power.py").stdout.splitlines()[2:]]
    assert days == sorted(days, reverse=True)
    assert days[0] > days[-1]


@pytest.mark.skipif(shutil.which("openscad") is None, reason="OpenSCAD is not installed (apt-get install openscad)")
@pytest.mark.parametrize("part", ["body", "plate"])
@pytest.mark.parametrize("bank", ["[0, 0, 0]", "[95, 25, 23]"])
def test_part_of_the_case_is_one_closed_solid(tmp_path: Path, part: str, bank: str) -> None:
    command = ["openscad", "-D", f'part="{part}"', "-D", f"power_bank={bank}", "-o", str(tmp_path / "part.stl")]
    done = subprocess.run(
        [*command, "hardware/node/case.scad"], cwd=ROOT, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    assert "Simple:        yes" in done.stderr
    assert "Volumes:         2" in done.stderr  # the space outside, and one solid
