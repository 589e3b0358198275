"""What the documents point at must be there."""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LINK = re.compile(r"\]\(([^)\s]+)\)")


def documents() -> list[Path]:
    listed = subprocess.run(["git", "ls-files", "*.md"], cwd=ROOT, capture_output=True, text=True, check=False)
    return [ROOT / name for name in listed.stdout.split()] or sorted(ROOT.glob("*.md"))


@pytest.mark.parametrize("document", documents(), ids=lambda path: str(path.relative_to(ROOT)))
def test_every_relative_link_leads_somewhere(document: Path) -> None:
    targets = [link.partition("#")[0] for link in LINK.findall(document.read_text("utf-8"))]
    missing = [t for t in targets if t and "://" not in t and not (document.parent / t).exists()]
    assert not missing, f"{document.relative_to(ROOT)} points at {', '.join(missing)}"


def test_the_readme_names_only_test_folders_that_exist() -> None:
    named = re.findall(r"\./fognav test ((?:[\w./-]+ ?)+)", (ROOT / "README.md").read_text("utf-8"))
    folders = [folder for group in named for folder in group.split() if "/" in folder]
    assert folders
    assert [folder for folder in folders if not (ROOT / folder).exists()] == []
