"""The reports in docs/results are what `fognav experiment report` makes of the archives beside them."""

from __future__ import annotations

import lzma
from itertools import zip_longest
from pathlib import Path

import pytest

from fognav_experiments.comparison import records
from fognav_experiments.comparison.records import Folder
from fognav_experiments.comparison.report import publish
from fognav_experiments.comparison.runner import site_digest

pytestmark = pytest.mark.timeout(900)
ROOT = Path(__file__).parents[2]
ARCHIVES = sorted((ROOT / "docs" / "results").glob(f"*/{records.ARCHIVE}"))
SMALL = {"estig-floor", "intel"}
"""One of a site of this checkout, one of another floor; the others take a minute of a core."""
WITH_FLOOR = {"README.md", "tracks.svg", "break-even.svg"}
"""They say what the floor allows, and show its stops and areas, which are not in the archive."""


def lines_of(file: Path) -> list[str]:
    """Return a file's lines; of an archive those in it, which other versions of the compressor pack otherwise."""
    data = file.read_bytes()
    return (lzma.decompress(data) if file.suffix == ".xz" else data).decode("utf-8").splitlines()


def difference(published: Path, made: Path) -> str:
    """Return the first line in which two files differ, in words; "" if none."""
    pairs = zip_longest(lines_of(published), lines_of(made), fillvalue="(its end)")
    return next(
        (
            f"{published}:{number}: {one[:200]!r} is published, and the archive gives {other[:200]!r}"
            for number, (one, other) in enumerate(pairs, 1)
            if one != other
        ),
        "",
    )


def test_results_have_an_archive():
    assert ARCHIVES


@pytest.mark.parametrize("packed", ARCHIVES, ids=lambda file: file.parent.name)
def test_published_report_was_made_with_the_map_of_its_floor(packed):
    assert "What the floor allows to save" in (packed.parent / "README.md").read_text("utf-8"), "name its --site"


@pytest.mark.parametrize(
    "packed",
    [
        pytest.param(file, marks=() if file.parent.name in SMALL else pytest.mark.long, id=file.parent.name)
        for file in ARCHIVES
    ],
)
@pytest.mark.drive
def test_published_report_is_what_its_archive_gives(packed, tmp_path):
    folder, report, published = Folder(tmp_path / "drives"), tmp_path / "report", packed.parent
    records.unpack_archive(packed, folder)
    asked = folder.description()["asked"]
    site = ROOT / "sites" / asked["site"]
    known = site.is_dir() and site_digest(site) == asked["site_digest"]
    names = {file.name for file in publish(folder, report, site if known else None)}
    remedy = f"run: fognav experiment report {packed} --out {published}"
    assert {file.name for file in published.iterdir()} == names, remedy
    if not known:
        names -= WITH_FLOOR
    differences = [found for name in sorted(names) if (found := difference(published / name, report / name))]
    assert not differences, f"{differences[0]}; {remedy}"
