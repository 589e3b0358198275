"""Writes the report of a folder: Markdown with its figures, one HTML file, CSV of drives and means, and the archive."""

from __future__ import annotations

import csv
import io
from typing import TYPE_CHECKING, Any

from fog_runtime.configuration.site import load_site
from fog_runtime.files import SHARED, atomic_write
from fognav_experiments.comparison import archive, runner
from fognav_experiments.comparison.document import Figure, to_html, to_markdown
from fognav_experiments.comparison.draws import draw
from fognav_experiments.comparison.geometry import RouteGeometry
from fognav_experiments.comparison.measured import KINDS
from fognav_experiments.comparison.records import FolderError, write_csv
from fognav_experiments.comparison.report import TITLE, build, summary_rows

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from fog_runtime.configuration.site import LoadedSite
    from fognav_experiments.comparison.geometry import Saving
    from fognav_experiments.comparison.records import Folder, Record


def publish(folder: Folder, target: Path, site: Path | None = None) -> list[Path]:
    """Write the report of a folder's records into another one, or the same; return its files. Raises `FolderError`.

    `site`: folder of the floor; with it the report says what the map allows, if the drives were on this very floor.
    """
    experiment, records = folder.description(), folder.drives.read()
    measured = [drive for kind in KINDS for drive in folder.measured(kind).read()]
    if not records:
        raise FolderError(f"{folder.path} holds no drives yet: run `fognav experiment --out {folder.path}` first")
    known = site is not None and runner.site_digest(site) == experiment["asked"]["site_digest"]
    loaded = load_site(site) if known and site is not None else None
    savings = {} if site is None or loaded is None else _savings(records, experiment["asked"], site, loaded)
    blocks = build(records, experiment, savings, measured, None if loaded is None else loaded.site)
    summary = io.StringIO()
    csv.writer(summary, lineterminator="\n").writerows(summary_rows(records))
    texts = {
        "README.md": to_markdown(blocks),
        "report.html": to_html(TITLE, blocks),
        "summary.csv": summary.getvalue(),
        **{block.file: block.svg for block in blocks if isinstance(block, Figure)},
    }
    for name, text in texts.items():
        atomic_write(target / name, text.encode(), mode=SHARED)
    write_csv(target / "drives.csv", records)
    archive.write(folder, target / archive.NAME)
    return [target / name for name in (*texts, "drives.csv", archive.NAME)]


def _savings(
    records: Sequence[Record], asked: dict[str, Any], place: Path, site: LoadedSite
) -> dict[tuple[int, str], Saving]:
    """Return, by run and route, what the map of the drives allows to save."""
    spec, geometry = runner.read_spec(site, place), RouteGeometry(site)
    drawn = [route for run in {record.run for record in records} for route in draw(spec, asked["seed"], run)]
    found = {(route.run, route.route.name): geometry.saving(route) for route in drawn}
    return {key: saving for key, saving in found.items() if saving is not None}
