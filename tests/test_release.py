"""A release is made by one command, and an upgrade finds the newest one."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from fognav.hosting.upgrading import Versions

ROOT = Path(__file__).parents[1]


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    for name in ("VERSION", "CHANGELOG.md"):
        shutil.copy(ROOT / name, tmp_path)
    (tmp_path / "VERSION").write_text("0.1.0\n")
    return tmp_path


def release(checkout: Path, version: str, date: str = "2027-01-31") -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / ".ci" / "release"), version, "--date", date, "--root", str(checkout)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def git(checkout: Path, *arguments: str) -> str:
    identity = ["-c", "user.name=t", "-c", "user.email=t@example.org"]
    command = ["git", "-C", str(checkout), *identity, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def test_release_has_its_number_in_both_files_and_all_that_was_unreleased(checkout):
    (checkout / "CHANGELOG.md").write_text(
        "# Changelog\n\n## [Unreleased]\n\n### Added\n- A door.\n\n## [0.1.0] - 2026-01-01\n"
    )
    done = release(checkout, "0.2.0")
    assert done.returncode == 0, done.stderr
    assert "git tag -a v0.2.0" in done.stdout
    assert (checkout / "VERSION").read_text() == "0.2.0\n"
    assert (checkout / "CHANGELOG.md").read_text() == (
        "# Changelog\n\n## [Unreleased]\n\n## [0.2.0] - 2027-01-31\n\n### Added\n- A door.\n\n## [0.1.0] - 2026-01-01\n"
    )


def test_this_changelog_can_be_released(checkout):
    if not re.search(r"## \[Unreleased\]\n+###", (checkout / "CHANGELOG.md").read_text("utf-8")):
        pytest.skip("this is a release: nothing has changed since")
    assert release(checkout, "99.0.0").returncode == 0


def test_first_release_has_the_version_that_is_there_already_and_is_made_once(checkout):
    (checkout / "CHANGELOG.md").write_text("# Changelog\n\n## [Unreleased]\n\n### Added\n- A door.\n")
    assert release(checkout, "0.1.0").returncode == 0
    assert "## [0.1.0] - 2027-01-31\n\n### Added" in (checkout / "CHANGELOG.md").read_text()
    (checkout / "CHANGELOG.md").write_text("## [Unreleased]\n- One.\n\n## [0.1.0] - 2027-01-31\n")
    assert "0.1.0 is not newer" in release(checkout, "0.1.0").stderr


@pytest.mark.parametrize("date", ["31.1.2027", "2027-02-30", "2027-1-5x"])
def test_date_that_is_none_changes_nothing(checkout, date):
    before = (checkout / "CHANGELOG.md").read_bytes()
    assert release(checkout, "0.2.0", date).returncode == 2
    assert ((checkout / "VERSION").read_text(), (checkout / "CHANGELOG.md").read_bytes()) == ("0.1.0\n", before)


@pytest.mark.parametrize("version", ["0.1.0", "0.0.9", "two"])
def test_older_or_malformed_version_changes_nothing(checkout, version):
    with (checkout / "CHANGELOG.md").open("a") as log:
        log.write("\n## [0.1.0] - 2026-01-01\n- First.\n")
    before = (checkout / "CHANGELOG.md").read_bytes()
    assert release(checkout, version).returncode == 1
    assert ((checkout / "VERSION").read_text(), (checkout / "CHANGELOG.md").read_bytes()) == ("0.1.0\n", before)


def test_release_without_changes_is_refused(checkout):
    (checkout / "CHANGELOG.md").write_text("# Changelog\n\n## [Unreleased]\n\n## [0.1.0] - 2026-01-01\n- First.\n")
    assert "nothing to release" in release(checkout, "0.2.0").stderr


def test_upgrade_finds_the_newest_of_the_releases(checkout):
    (checkout / "CHANGELOG.md").write_text("## [Unreleased]\n- One.\n")
    git(checkout, "init", "--quiet")
    for version in ("0.9.0", "0.10.0"):
        assert release(checkout, version).returncode == 0
        git(checkout, "add", "-A")
        git(checkout, "commit", "--quiet", "-m", f"Release {version}")
        git(checkout, "tag", "-a", f"v{version}", "-m", f"Fognav {version}")
        log = checkout / "CHANGELOG.md"
        log.write_text(log.read_text().replace("## [Unreleased]\n", "## [Unreleased]\n- More.\n", 1))
    assert Versions(checkout).newest() == git(checkout, "rev-parse", "v0.10.0^{commit}")
    assert git(checkout, "show", "v0.10.0:VERSION") == "0.10.0"


def test_without_tags_the_releases_of_the_history_are_found_by_what_they_wrote(checkout):
    log, versions = checkout / "CHANGELOG.md", Versions(checkout)
    git(checkout, "init", "--quiet", "--initial-branch", "main")

    def commit(subject: str) -> str:
        git(checkout, "add", "-A")
        git(checkout, "commit", "--quiet", "-m", subject)
        return git(checkout, "rev-parse", "HEAD")

    log.write_text("# Changelog\n\n## [Unreleased]\n- One.\n")
    commit("Keep the version in a file, which releases nothing yet")
    assert versions.releases() == []
    releases = []
    for version in ("0.9.0", "0.10.0"):
        assert release(checkout, version).returncode == 0
        releases.insert(0, (version, commit(f"Release {version}")))
        log.write_text(log.read_text().replace("## [Unreleased]\n", "## [Unreleased]\n- More.\n", 1))
        commit("Something else")
    log.write_text(log.read_text().replace("2027-01-31", "2027-02-01"))
    commit("Correct the dates of the releases")
    assert versions.releases() == releases

    # A clone fetches them with its branch; what is not released yet is none of its upgrade's business.
    clone = checkout / "clone"
    git(checkout, "clone", "--quiet", str(checkout), str(clone))
    git(clone, "reset", "--quiet", "--hard", releases[1][1])
    assert Versions(clone).newest() == releases[0][1]
    assert Versions(clone).releases() == releases[1:]
    git(clone, "merge", "--quiet", "--ff-only", "origin/main")
    assert Versions(clone).contains(Versions(clone).newest())
