import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout whose uv and python only record their arguments."""
    folder = tmp_path / "check out"
    (folder / "requirements").mkdir(parents=True)
    (folder / "requirements" / "dev.txt").write_text("pinned==1 --hash=sha256:0\n")
    (folder / "VERSION").write_text("1.0\n")
    for member in ("libs/one", "services/two", "cli"):
        (folder / member).mkdir(parents=True)
        (folder / member / "pyproject.toml").write_text(f'[project]\nname = "{member}"\n')
    (folder / "cli" / "build.txt").write_text("builder==1 --hash=sha256:0\n")
    shutil.copy(ROOT / "fognav", folder / "fognav")
    tools = tmp_path / "tools"
    tools.mkdir()
    uv = tools / "uv"
    uv.write_text(
        f'#!/bin/sh\n[ "$1" = --version ] && echo "uv 0.13.0" && exit\nprintf \'%s\\n\' "$*" >>"{tmp_path}/uv.log"\n'
        'if [ "$1" = venv ]; then for last; do :; done; mkdir -p "$last/bin"\n'
        'printf \'#!/bin/sh\\necho "ran: $*"\\n\' >"$last/bin/python"; chmod +x "$last/bin/python"; fi\n'
    )
    uv.chmod(0o755)
    return folder


def start(program: Path, checkout: Path, *arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PATH": f"{checkout.parent / 'tools'}:{os.environ['PATH']}", "CI": ""}
    return subprocess.run(
        [program, *arguments], check=False, capture_output=True, text=True, cwd=cwd, env=environment, timeout=60
    )


def uv_log(checkout: Path) -> list[str]:
    log = checkout.parent / "uv.log"
    return log.read_text().splitlines() if log.exists() else []


def test_first_start_installs_pins_with_hashes_then_the_members(checkout: Path) -> None:
    done = start(checkout / "fognav", checkout, "doctor", "--json")
    assert done.returncode == 0, done.stderr
    assert done.stdout == "ran: -m fognav doctor --json\n"
    steps = [line for line in done.stderr.splitlines() if "set-up, step" in line]
    assert [line.partition(": the ")[0].partition(" Python")[0] for line in steps] == [
        "fognav: set-up, step 1 of 3",
        "fognav: set-up, step 2 of 3: 2",
        "fognav: set-up, step 3 of 3",
    ]
    venv, pins, members = uv_log(checkout)
    assert venv.startswith("venv")
    assert f"--compile-bytecode --require-hashes -r {checkout}/requirements/dev.txt -r {checkout}/cli/build.txt" in pins
    assert "--no-deps --no-build-isolation" in members
    for member in ("libs/one", "services/two", "cli"):
        assert f"--editable {checkout}/{member}" in members


def test_second_start_installs_and_prints_nothing(checkout: Path) -> None:
    start(checkout / "fognav", checkout)
    calls = len(uv_log(checkout))
    done = start(checkout / "fognav", checkout, "a b", "c")
    assert (done.stdout, done.stderr) == ("ran: -m fognav a b c\n", "")
    assert len(uv_log(checkout)) == calls


def test_launcher_works_through_a_relative_symlink(checkout: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "link").symlink_to("../check out/fognav")
    done = start(elsewhere / "link", checkout, cwd=elsewhere)
    assert done.returncode == 0, done.stderr
    assert (checkout / ".fognav" / "stamp").exists()
    assert [path.name for path in elsewhere.iterdir()] == ["link"]


@pytest.mark.parametrize("changed", ["requirements/dev.txt", "cli/build.txt", "VERSION", "libs/one/pyproject.toml"])
def test_changed_pins_version_or_members_trigger_the_set_up_again(checkout: Path, changed: str) -> None:
    start(checkout / "fognav", checkout)
    calls = len(uv_log(checkout))
    with (checkout / changed).open("a") as file:
        file.write("# changed\n")
    start(checkout / "fognav", checkout)
    assert len(uv_log(checkout)) > calls


def test_set_up_that_failed_half_way_is_done_again_when_the_checkout_is_back(checkout: Path) -> None:
    start(checkout / "fognav", checkout)
    pins, uv = checkout / "requirements" / "dev.txt", checkout.parent / "tools" / "uv"
    before, works = pins.read_text(), uv.read_text()
    pins.write_text("pinned==2 --hash=sha256:0\n")
    uv.write_text(works + 'case "$*" in *--editable*) exit 2;; esac\n')
    assert start(checkout / "fognav", checkout).returncode == 1
    pins.write_text(before)
    uv.write_text(works)
    calls = len(uv_log(checkout))
    assert start(checkout / "fognav", checkout).returncode == 0
    assert any("requirements/dev.txt" in call for call in uv_log(checkout)[calls:])


@pytest.mark.parametrize("cut", ["killed", "before this boot", "before its id was on the disk"])
def test_lock_of_a_set_up_that_was_cut_short_is_removed(checkout: Path, cut: str) -> None:
    ended = subprocess.Popen(["true"])
    ended.wait()
    owner = {"killed": f"{ended.pid}\n", "before this boot": f"{os.getpid()} another-boot\n"}.get(cut, "")
    (checkout / ".fognav" / "lock").mkdir(parents=True)
    (checkout / ".fognav" / "lock" / "pid").write_text(owner)
    done = start(checkout / "fognav", checkout)
    assert done.returncode == 0, done.stderr
    assert not (checkout / ".fognav" / "lock").exists()


def test_failed_step_shows_its_output_and_leaves_no_stamp(checkout: Path) -> None:
    uv = checkout.parent / "tools" / "uv"
    uv.write_text('#!/bin/sh\n[ "$1" = --version ] && echo "uv 0.13.0" && exit\necho "no route to the index"; exit 2\n')
    (checkout / ".venv" / "bin").mkdir(parents=True)
    shutil.copy("/bin/true", checkout / ".venv" / "bin" / "python")
    done = start(checkout / "fognav", checkout)
    assert done.returncode == 1
    assert "no route to the index" in done.stderr
    assert "this step failed" in done.stderr
    assert not (checkout / ".fognav" / "stamp").exists()
    assert not (checkout / ".fognav" / "lock").exists()
