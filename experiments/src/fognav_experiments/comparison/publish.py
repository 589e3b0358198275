"""Writes the report of a folder: Markdown with its figures, one HTML file, and CSV of all drives and of the means."""

from __future__ import annotations

import csv
import io
from typing import TYPE_CHECKING

from fog_runtime.files import SHARED, atomic_write
from fognav_experiments.comparison.document import Figure, to_html, to_markdown
from fognav_experiments.comparison.records import FolderError, write_csv
from fognav_experiments.comparison.report import TITLE, build, summary_rows

if TYPE_CHECKING:
    from pathlib import Path

    from fognav_experiments.comparison.records import Folder


def publish(folder: Folder, target: Path) -> list[Path]:
    """Write the report of a folder's records into another one, or the same; return its files. Raises `FolderError`."""
    experiment, records = folder.machine(), folder.read()
    if not records:
        raise FolderError(f"{folder.path} holds no drives yet: run `fognav experiment --out {folder.path}` first")
    blocks = build(records, experiment)
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
    return [target / name for name in (*texts, "drives.csv")]
