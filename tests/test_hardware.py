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


needs_openscad = pytest.mark.skipif(
    shutil.which("openscad") is None, reason="OpenSCAD is not installed (apt-get install openscad)"
)


def openscad(part: str, bank: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Compute a part with coarse circles, which is several times faster."""
    values = (f'part="{part}"', f"power_bank={bank}", "$fn=12")
    options = [word for value in values for word in ("-D", value)]
    return subprocess.run(
        ["openscad", *options, "-o", str(folder / "part.stl"), "hardware/node/case.scad"],
        cwd=ROOT, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip


@needs_openscad
@pytest.mark.parametrize("bank", ["[0, 0, 0]", "[95, 25, 23]"])
def test_boards_sonars_and_plug_fit_into_the_case(tmp_path: Path, bank: str) -> None:
    done = openscad("collisions", bank, tmp_path)
    assert "Current top level object is empty" in done.stderr, "something is in another part's way"
    assert "WARNING" not in done.stderr


@needs_openscad
@pytest.mark.parametrize("part", ["body", "plate"])
@pytest.mark.parametrize("bank", ["[0, 0, 0]", "[95, 25, 23]"])
def test_part_of_the_case_is_one_closed_solid(tmp_path: Path, part: str, bank: str) -> None:
    done = openscad(part, bank, tmp_path)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    assert "Simple:        yes" in done.stderr
    assert "Volumes:         2" in done.stderr  # the space outside, and one solid
