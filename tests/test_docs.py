"""The documents' links, names and versions must be valid."""

import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path
from typing import get_args

import pytest

from fog_contracts.messages.basics import AreaState
from fog_contracts.messages.robots import Mode, ProfileName

ROOT = Path(__file__).parents[1]
PARTS = ("libs", "services", "robot-agent", "sim", "experiments", "cli")
LINK = re.compile(r"\]\(([^)\s]+)\)")


def documents() -> list[Path]:
    listed = subprocess.run(["git", "ls-files", "*.md"], cwd=ROOT, capture_output=True, text=True, check=False)
    return [ROOT / name for name in listed.stdout.split()] or sorted(ROOT.glob("*.md"))


@pytest.mark.parametrize("document", documents(), ids=lambda path: str(path.relative_to(ROOT)))
def test_relative_links_point_to_existing_files(document: Path) -> None:
    targets = [link.partition("#")[0] for link in LINK.findall(document.read_text("utf-8"))]
    missing = [t for t in targets if t and "://" not in t and not (document.parent / t).exists()]
    assert not missing, f"{document.relative_to(ROOT)} points at {', '.join(missing)}"


def test_operations_names_every_metric_and_none_that_nobody_exports() -> None:
    sources = [
        path
        for part in ("libs", "services", "bridges", "robot-agent", "sim")
        for path in (ROOT / part).rglob("src/**/*.py")
    ]
    defined = {name for path in sources for name in re.findall(r'"(fognav_[a-z0-9_]+)",', path.read_text("utf-8"))} - {
        "fognav_build"
    } | {"fognav_build_info"}  # an Info, which adds the ending
    defined -= {"fognav_sim", "fognav_sim_sustained_speed"}  # a package, and the simulator's
    pages = [(ROOT / "docs" / f"{page}.md").read_text("utf-8") for page in ("operations", "operator", "maps")]
    named = set(re.findall(r"`(fognav_[a-z0-9_]+)[`{]", "\n".join(pages)))
    assert named <= defined, f"no process exports {sorted(named - defined)}"
    assert defined <= named, f"docs/operations.md lacks {sorted(defined - named)}: say what each is for"


def test_glossary_names_every_mode_profile_and_state_of_an_area() -> None:
    terms = {*get_args(Mode), *get_args(ProfileName), *get_args(AreaState)}
    explained = set(re.findall(r"`([\w.]+)`", (ROOT / "docs" / "glossary.md").read_text("utf-8")))
    assert terms - explained == set()


def test_contributing_names_every_variable_that_makes_tests_longer() -> None:
    longer = re.search(r"^LONGER.*?^\)", (ROOT / "conftest.py").read_text("utf-8"), re.DOTALL | re.MULTILINE)
    assert longer
    variables = set(re.findall(r'"(FOGNAV_\w+)"', longer[0]))
    assert variables
    named = set(re.findall(r"`(FOGNAV_\w+)", (ROOT / "CONTRIBUTING.md").read_text("utf-8")))
    assert variables - named == set()


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="this is no repository")
@pytest.mark.parametrize(
    "file",
    [
        ".env", "locks/admin.token", "board/node.json", "stacks/ground/locks/authority.key", "operator.key", "r2.toml",
        "key.pem", "update-key.pem", "fog.tar.gz", "bridge.toml", "deploy/bridge/password", "firmware/data/node.json",
        "backups/2026-11-01.tar.gz",
    ],
)  # fmt: skip
def test_secrets_that_documented_commands_write_in_a_checkout_are_never_added_to_it(file: str) -> None:
    done = subprocess.run(["git", "check-ignore", "--no-index", "-q", file], cwd=ROOT, check=False)
    assert done.returncode == 0


def test_changelog_has_at_most_40_entries_of_one_line_for_each_release() -> None:
    releases = re.split(r"^## ", (ROOT / "CHANGELOG.md").read_text("utf-8"), flags=re.MULTILINE)[1:]
    entries = [[line for line in release.splitlines()[1:] if line and line[0] != "#"] for release in releases]
    assert [line for lines in entries for line in lines if not line.startswith("- ") or len(line) > 120] == []
    assert [len(lines) for lines in entries if len(lines) > 40] == [], "drop what matters least to who upgrades"


def test_decision_records_that_sources_and_documents_name_exist() -> None:
    numbers = {int(record.stem[:4]) for record in (ROOT / "docs" / "adr").glob("0*.md")}
    files = [path for part in PARTS for path in (ROOT / part).rglob("src/**/*.py")] + documents()
    named = {path: {int(n) for n in re.findall(r"\bADR (\d+)", path.read_text("utf-8"))} for path in files}
    missing = {str(path.relative_to(ROOT)): sorted(n - numbers) for path, n in named.items() if n - numbers}
    assert missing == {}, "docs/adr/README.md says where the others stand"


def test_all_members_have_the_same_version() -> None:
    version = (ROOT / "VERSION").read_text("utf-8").strip()
    members = [ROOT / line for line in ("robot-agent", "sim", "experiments", "cli")]
    members += [*(ROOT / "libs").iterdir(), *(ROOT / "services").glob("*/")]
    files = [member / "pyproject.toml" for member in members if (member / "pyproject.toml").is_file()]
    assert len(files) >= 11
    for file in files:
        settings = tomllib.loads(file.read_text("utf-8"))
        assert settings["project"]["dynamic"] == ["version"], file
        assert (file.parent / settings["tool"]["hatch"]["version"]["path"]).resolve() == ROOT / "VERSION"
        assert metadata.version(settings["project"]["name"]) == version
    assert (
        f"fognav {version}"
        == subprocess.run(
            [sys.executable, "-m", "fognav", "--version"], capture_output=True, text=True, check=True
        ).stdout.strip()
    )


def test_the_steps_of_a_hazard_name_files_that_define_what_they_name() -> None:
    text = (ROOT / "docs/architecture.md").read_text("utf-8")
    section = text.partition("## One hazard, step by step")[2].partition("\n## ")[0]
    rows = [row.split(" | ") for row in section.splitlines() if row.startswith("| ")]
    steps = [row for row in rows if len(row) == 4 and ".py" in row[1]]
    assert len(steps) > 15
    missing = []
    for step, files, names, _ in steps:
        sources = [(ROOT / "docs" / link).read_text("utf-8") for link in LINK.findall(files)]
        for name in re.findall(r"`([\w.:]+)`", names):
            owner, _, member = name.replace("::", ".").rpartition(".")
            # A definition in Python, or in C++ a type before the name and arguments behind it.
            defined = rf"^ *((async )?(def|class) {member}\b|(?!return )\w+ {member}\()"
            found = any(
                re.search(defined, source, re.MULTILINE) and (not owner or f"class {owner}" in source)
                for source in sources
            )
            if not found:
                missing.append(f"{step}: {name}")
    assert missing == []
