"""Upgrades of a fog node in a small repository, whose `fognav` is a script: what is kept, and the way back."""

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from typer.testing import CliRunner, Result

from fognav import aside
from fognav.__main__ import app
from fognav.aside import BACKUPS, Aside
from fognav.hosting import folders, local_nodes, upgrading
from fognav.hosting.folders import NodeFolder, hosted_sites
from fognav.hosting.local_nodes import RunningNode
from fognav.hosting.upgrading import Upgrade, Versions
from fognav.operate.systems import System
from fognav.output import FailedError, WrongUseError

ESTIG = Path(__file__).parents[2] / "sites" / "estig"
LAUNCHER = """\
#!/bin/sh
here=$(dirname "$0")
echo "{name} $*" >>"$here/calls"
[ "$1" = up ] || exit {set_up}
[ -z "{signal}" ] || {{ kill -s "{signal}" $PPID; exec sleep 600; }}
while [ "$1" != --data ]; do shift; done
echo {name} >"$2/data/redis/written-by"
exit {start}
"""


def git(root: Path, *arguments: str) -> str:
    identity = ["-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false"]
    done = subprocess.run(["git", "-C", str(root), *identity, *arguments], capture_output=True, text=True, check=True)
    return done.stdout.strip()


@pytest.fixture
def add_version(tmp_path: Path) -> Callable[..., str]:
    root = tmp_path / "checkout"
    root.mkdir()
    git(root, "init", "-q")
    (root / ".gitignore").write_text("calls\n")

    def add(name: str, *, set_up: int = 0, start: int = 0, signal: str = "") -> str:
        (root / "fognav").write_text(LAUNCHER.format(name=name, set_up=set_up, start=start, signal=signal))
        (root / "fognav").chmod(0o755)
        git(root, "add", "-A")
        git(root, "commit", "-qm", f"version {name}")
        return git(root, "rev-parse", "HEAD")

    return add


@pytest.fixture
def folder(tmp_path: Path) -> NodeFolder:
    made = NodeFolder(tmp_path / "data")
    hosted_sites([ESTIG], made.security, ["localhost", "127.0.0.1"])
    made.keys("estig")
    folders.remember(made.path, folders.settings_of({"estig": ESTIG}, "0.0.0.0", [], simulate=False))
    return made


@pytest.fixture
def started(folder: NodeFolder, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What was started again: systemd runs this node, and a terminal another one."""
    found: list[str] = []
    nodes = [RunningNode(1, folder.path, ["fog-estig"]), RunningNode(2, folder.path / "other", ["fog-other"])]
    monkeypatch.setattr(upgrading, "running_nodes", lambda: nodes)
    monkeypatch.setattr(upgrading, "end_node", lambda pid: found.append(f"end {pid}"))
    monkeypatch.setattr(upgrading, "systems_of", lambda _: [])
    monkeypatch.setattr(local_nodes, "systemd_runs", lambda pid: pid == 1)
    monkeypatch.setattr(local_nodes, "start_unit", lambda: found.append("unit"))
    return found


def run(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments))


def calls(root: Path) -> list[str]:
    return [" ".join(line.split()[:2]) for line in (root / "calls").read_text().splitlines()]


@pytest.mark.live
def test_upgrade_makes_a_backup_tries_the_new_version_and_keeps_the_data(add_version, folder, started, tmp_path):
    root = tmp_path / "checkout"
    old = add_version("old")
    new = add_version("new")
    git(root, "reset", "-q", "--hard", old)
    versions = Versions(root)
    assert versions.changes(new) == ["version new"]
    token = (folder.path / "keys" / "estig" / "admin.token").read_text()
    told: list[str] = []
    Upgrade(folder, versions, told.append).run(versions.named(new))
    assert git(root, "rev-parse", "HEAD") == new
    assert calls(root) == ["new --version", "new up"]
    assert (folder.path / "keys" / "estig" / "admin.token").read_text() == token
    assert (folder.path / "data" / "redis" / "written-by").read_text() == "new\n"
    assert "--bind 127.0.0.1" in (root / "calls").read_text()  # nobody else reaches what may be undone
    (backup,) = (folder.path / BACKUPS).glob("*-estig.tar.gz")
    assert f"backup: {backup}" in told
    assert started == ["end 1", "unit"]
    assert not folder.path.with_name("data.before-upgrade").exists()
    with pytest.raises(WrongUseError, match="not newer"):
        versions.changes(old)


@pytest.mark.live
@pytest.mark.parametrize("broken", [{"set_up": 1}, {"start": 1}, {"signal": "HUP"}, {"signal": "TERM"}])
def test_version_that_fails_leaves_version_and_data_of_before(add_version, folder, started, tmp_path, broken):
    root = tmp_path / "checkout"
    old = add_version("old")
    new = add_version("new", **broken)
    git(root, "reset", "-q", "--hard", old)
    (folder.data("redis") / "written-by").write_text("old\n")
    recording = folder.path / "recordings" / "a.mcap"
    recording.parent.mkdir()
    recording.write_bytes(b"large")
    with pytest.raises(FailedError, match=rf"are those of before, {old[:12]}, and what was changed after \d\d:"):
        Upgrade(folder, Versions(root), lambda _: None).run(new)
    assert git(root, "rev-parse", "HEAD") == old
    assert calls(root)[-1] == "old --version"  # its environment is there again, too
    assert (folder.path / "data" / "redis" / "written-by").read_text() == "old\n"
    assert started == ["end 1", "unit"]
    assert recording.read_bytes() == b"large"
    assert len(list((folder.path / BACKUPS).iterdir())) == 1
    assert not list(folder.path.parent.glob("data.before-upgrade*"))


def test_nothing_that_an_upgrade_may_undo_is_changed_while_it_runs(folder):
    recording = folder.path / "recordings" / "a.mcap"
    recording.parent.mkdir()
    recording.write_bytes(b"large")
    tokens = folder.path / "keys" / "estig" / "tokens.toml"
    commands = [
        ["token", "create", "anna", "--file", str(tokens)],
        ["token", "revoke", "admin", "--file", str(tokens)],
        *(
            [*words, "--credentials", str(folder.security)]
            for words in (["ca", "issue"], ["ca", "rotate"], ["robot", "add", "r9"], ["source", "user", "door"])
        ),
    ]
    before = tokens.read_text()
    laid = Aside(folder.path)
    laid.lay()
    assert not (laid.copy / "recordings").exists()
    for each in commands:
        done = run(*each)
        assert (done.exit_code, "is being upgraded" in done.output) == (1, True), (each, done.output)
    with pytest.raises(FailedError, match="is being upgraded"), folder.in_use():
        pass
    assert tokens.read_text() == before
    (folder.path / "written-since").touch()
    laid.put_back()
    laid.remove()
    assert not (folder.path / "written-since").exists()
    assert recording.read_bytes() == b"large"
    assert run(*commands[0]).exit_code == 0


@pytest.mark.live
def test_own_changes_of_files_stay_or_stop_the_upgrade(add_version, folder, started, tmp_path):
    root = tmp_path / "checkout"
    (root / "site.toml").write_text("a")
    old = add_version("old")
    (root / "site.toml").write_text("b")
    new = add_version("new")
    git(root, "reset", "-q", "--hard", old)
    (root / "site.toml").write_text("mine")
    with pytest.raises(FailedError, match=r"site\.toml"):
        Upgrade(folder, Versions(root), lambda _: None).run(new)
    assert (git(root, "rev-parse", "HEAD"), (root / "site.toml").read_text()) == (old, "mine")
    assert started == ["end 1", "unit"]


@pytest.mark.live
def test_data_that_cannot_be_copied_aside_changes_nothing_and_leaves_no_copy(add_version, folder, started, tmp_path):
    root = tmp_path / "checkout"
    old = add_version("old")
    new = add_version("new")
    git(root, "reset", "-q", "--hard", old)
    os.mkfifo(folder.data("redis") / "no-file")
    with pytest.raises(FailedError, match="nothing was changed"):
        Upgrade(folder, Versions(root), lambda _: None).run(new)
    assert git(root, "rev-parse", "HEAD") == old
    assert started == ["end 1", "unit"]
    assert not folder.path.with_name("data.before-upgrade").exists()


def test_upgrade_that_was_cut_short_is_told(folder, add_version, tmp_path):
    add_version("old")
    shutil.copytree(folder.path, folder.path.with_name("data.before-upgrade"))
    with pytest.raises(FailedError, match="cut short"):
        Upgrade(folder, Versions(tmp_path / "checkout"), lambda _: None)


def test_node_has_its_data_again_after_a_power_cut_while_they_were_put_back(folder, monkeypatch):
    (folder.path / "kept").touch()
    laid = Aside(folder.path)
    laid.lay()
    (folder.path / "kept").unlink()
    rename = Path.rename

    def cut(path: Path, to: Path) -> Path:
        if path == laid.copy:
            raise KeyboardInterrupt
        return rename(path, to)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", cut)
        with pytest.raises(KeyboardInterrupt):
            laid.put_back()
    with pytest.raises(FailedError, match="is being upgraded"):
        NodeFolder(folder.path)
    laid.remove()  # with its process the lock has gone
    assert (NodeFolder(folder.path).path / "kept").exists()


def test_newest_version_is_the_highest_release(add_version, tmp_path):
    root = tmp_path / "checkout"
    for name in ("v0.9.0", "v0.10.0", "v0.2.0"):
        add_version(name)
        git(root, "tag", name)
    versions = Versions(root)
    assert versions.newest() == versions.named("v0.10.0")
    with pytest.raises(FailedError, match=r"no version v9: name one of the releases \(v0\.10\.0, v0\.9\.0"):
        versions.named("v9")


def test_branch_and_release_are_fetched_before_they_are_named(add_version, tmp_path):
    root, clone = tmp_path / "checkout", tmp_path / "clone"
    old = add_version("old")
    git(root, "branch", "-M", "main")
    git(tmp_path, "clone", "-q", str(root), str(clone))
    new = add_version("new")
    git(root, "tag", "v2.0.0")
    versions = Versions(clone)
    assert [versions.named(name) for name in ("main", "v2.0.0", old[:12])] == [new, new, old]
    assert versions.current() == old


def test_nothing_is_upgraded_under_a_demo_of_the_same_checkout(add_version, folder, monkeypatch, tmp_path):
    root = tmp_path / "checkout"
    old = add_version("old")
    (root / ".venv" / "bin").mkdir(parents=True)
    program = root / ".venv" / "bin" / "python"
    program.symlink_to("/bin/sleep")
    with subprocess.Popen([program, "600"]) as running, subprocess.Popen(["/bin/sleep", "600"]) as other:
        systems = [
            System(name=name, kind="demo", site="estig", urls={}, pids={"sim": each.pid})
            for name, each in (("demo", running), ("elsewhere", other))
        ]
        monkeypatch.setattr(local_nodes, "registered", lambda: systems)
        try:
            deadline = time.monotonic() + 60.0
            # A program that has just been started has no arguments for a moment.
            while not all(psutil.Process(each.pid).cmdline() for each in (running, other)):
                assert time.monotonic() < deadline, "a program that was started has no arguments after a minute"
            with pytest.raises(FailedError, match=r"^demo would run on with parts of both versions"):
                Upgrade(folder, Versions(root), lambda _: None).run(old)
        finally:
            running.kill()
            other.kill()
    assert not (folder.path / BACKUPS).exists()


@pytest.mark.live
def test_interrupted_copy_of_the_data_leaves_none_behind(add_version, folder, started, monkeypatch, tmp_path):
    def copy(*_: object, **__: object) -> None:
        os.kill(os.getpid(), signal.SIGHUP)

    old = add_version("old")
    monkeypatch.setattr(aside.shutil, "copytree", copy)
    with pytest.raises(FailedError, match="it was interrupted, and nothing was changed"):
        Upgrade(folder, Versions(tmp_path / "checkout"), lambda _: None).run(old)
    assert not list(folder.path.parent.glob("data.before-upgrade*"))
    assert started == ["end 1", "unit"]


@pytest.mark.live
def test_new_backup_and_nine_of_earlier_upgrades_stay_and_all_that_others_put_beside_them(
    add_version, folder, started, tmp_path, monkeypatch
):
    new = "2025-12-24T03-00-00-estig.tar.gz"  # the clock is behind
    monkeypatch.setattr(upgrading.time, "strftime", lambda _: new.removesuffix("-estig.tar.gz"))
    old = add_version("old")
    backups = folder.path / BACKUPS
    backups.mkdir()
    for number in range(12):
        (backups / f"2026-01-{number + 10}T03-00-00-estig.tar.gz").touch()
    mine = [backups / name for name in ("before-the-move-estig.tar.gz", "2026-01-01T03-00-00-upstairs.tar.gz")]
    for file in mine:
        file.touch()
    Upgrade(folder, Versions(tmp_path / "checkout"), lambda _: None).run(old)
    found = sorted(file.name for file in backups.iterdir() if file not in mine)
    assert (len(found), found[0]) == (10, new)
    assert all(file.exists() for file in mine)
