"""Grafana's dashboards are what the table of panels says, and ask only for metrics that exist."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "deploy" / "grafana" / "dashboards"
FILES = sorted(FOLDER.glob("*.json"))
BEGINNINGS = "baseline|disk|fognav|map|process|robot|stage"
OF_PROMETHEUS = {"up", "ALERTS", "process_cpu_seconds_total", "process_resident_memory_bytes"}


def recorded() -> set[str]:
    folder = ROOT / "deploy" / "prometheus" / "rules"
    files = [yaml.safe_load((folder / name).read_text("utf-8")) for name in ("records.yml", "baselines.yml")]
    return {rule["record"] for file in files for group in file["groups"] for rule in group["rules"]}


def exported() -> set[str]:
    """The metrics that the pages name, which another test compares with those of the code."""
    pages = [(ROOT / "docs" / f"{page}.md").read_text("utf-8") for page in ("operations", "operator", "maps")]
    names = re.findall(r"`(fognav_[a-z0-9_]+)[`{]", "\n".join(pages))
    return {name + suffix for name in names for suffix in ("", "_bucket", "_sum", "_count")}


def expressions(file: Path) -> list[str]:
    panels = json.loads(file.read_text("utf-8"))["panels"]
    return [target["expr"] for panel in panels for target in panel.get("targets", [])]


def test_dashboards_are_up_to_date() -> None:
    command = [sys.executable, str(ROOT / "deploy" / "grafana" / "make_dashboards.py"), "--check"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_panels_ask_only_for_metrics_that_exist(file: Path) -> None:
    asked = expressions(file)
    assert len(asked) > 5
    for expression in asked:
        without_labels = re.sub(r"\{[^}]*\}|\(\w+(?:, \w+)*\) *\(|by \([^)]*\)", " ", expression)
        names = set(re.findall(rf"\b(?:{BEGINNINGS})\w*[:_][\w:]+|\bup\b|ALERTS", without_labels))
        assert names, expression
        assert names <= exported() | recorded() | OF_PROMETHEUS, expression


def test_no_two_panels_of_a_page_overlap() -> None:
    for file in FILES:
        taken: set[tuple[int, int]] = set()
        for panel in json.loads(file.read_text("utf-8"))["panels"]:
            place = panel["gridPos"]
            cells = {
                (place["x"] + dx, place["y"] + dy) for dx in range(place["w"]) for dy in range(place["h"])
            }  # fmt: skip
            assert not taken & cells, (file.name, panel["title"])
            assert place["x"] + place["w"] <= 24
            taken |= cells
