"""The pages about operations, run as they are written, from an empty home folder: install, add, back up, restore; and
two machines that become two floors.

What only the operating system's administrator can do is recorded instead of done, and the unit is run as systemd would
(`unit_manager`).
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from floor_ports import floor_ports

from fog_runtime.configuration.site import load_site

pytestmark = [pytest.mark.live, pytest.mark.timeout(900)]

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "operations.md").read_text("utf-8")
CAMPUS = (ROOT / "docs" / "campus.md").read_text("utf-8")


def block(beginning: str, page: str = PAGE) -> str:
    """Return the block of a page that begins with these words."""
    (found,) = [text for text in re.findall(r"```\w+\n(.*?)```", page, re.DOTALL) if text.startswith(beginning)]
    return str(found)


def pose_in(site: Path) -> str:
    """Return a pose from which a node sees area z1 of this site: another map has another."""
    first = next(node for node in load_site(site).site.nodes if node.area == "z1")
    return f"{first.x},{first.y},{first.theta}"


class Machine:
    """A home folder with nothing in it, and programs in the place of those of the operating system."""

    def __init__(self, folder: Path) -> None:
        self.home = folder / "home"
        self.checkout = self.home / "fognav"
        self.asked = folder / "asked"
        programs, self._runtime, self._unit = folder / "programs", folder / "runtime", folder / "unit"
        self._programs = programs
        for each in (self.home, programs, self._runtime, self._unit):
            each.mkdir(mode=0o700)
        manager = ROOT / "tests" / "support" / "unit_manager.py"
        self._program(programs / "systemctl", f'exec "{sys.executable}" "{manager}" "{self._unit}" "$@"')
        for name in ("sudo", "loginctl"):
            self._program(programs / name, f'echo {name} "$@" >>"{self.asked}"')
        git = shutil.which("git")
        assert git is not None, "git is not installed"
        cloning = f'[ "$1" != clone ] || {{ echo git "$@" >>"{self.asked}"; mkdir -p "$3"; exit; }}'
        self._program(programs / "git", f'{cloning}\nexec "{git}" "$@"')
        inherited = {
            name: value for name, value in os.environ.items() if not name.startswith(("FOGNAV_", "XDG_"))
        }  # fmt: skip
        self._environment = {
            **inherited,
            **floor_ports(),
            "FOGNAV_BIND": "127.0.0.1",
            "HOME": str(self.home),
            "USER": "pi",
            "UNIT_MANAGER_FOR": str(os.getpid()),
            "PATH": f"{programs}:{inherited['PATH']}",
            "XDG_RUNTIME_DIR": str(self._runtime),
        }

    @staticmethod
    def _program(file: Path, text: str) -> None:
        file.write_text(f"#!/bin/sh\n{text}\n")
        file.chmod(0o755)

    def clone(self) -> None:
        """Put there what `git clone` would, as far as the page needs it: the command, and a map."""
        (self.checkout / "sites").mkdir(parents=True)
        self._program(self.checkout / "fognav", f'exec "{sys.executable}" -m fognav "$@"')
        for file in (ROOT / "sites" / "estig").glob("map.*"):
            shutil.copy(file, self.checkout / f"MAP{file.suffix}")
        yaml = self.checkout / "MAP.yaml"
        yaml.write_text(yaml.read_text("utf-8").replace("map.pgm", "MAP.pgm"), "utf-8")

    def site(self, name: str) -> None:
        """Put the folder of a site there."""
        folder = shutil.copytree(ROOT / "sites" / "estig", self.checkout / "sites" / name)
        text = (folder / "site.toml").read_text("utf-8")
        (folder / "site.toml").write_text(text.replace('id = "estig"', f'id = "{name}"', 1), "utf-8")

    def sends_to(self, other: "Machine") -> None:
        """Let scp bring files into the other machine's checkout."""
        self._program(self._programs / "scp", f'cp "$1" "{other.checkout}"')

    @property
    def console(self) -> str:
        """Where its console-service serves."""
        return f"https://127.0.0.1:{self._environment['FOGNAV_CONSOLE_PORT']}"

    def type(self, commands: str, *, where: Path | None = None, git_folder: Path | None = None) -> str:
        """Run lines as somebody types them, and return what they print; `git_folder`: what git takes for its own."""
        environment = self._environment | ({} if git_folder is None else {"GIT_DIR": str(git_folder)})
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", commands], cwd=where or self.checkout, env=environment,
            stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=600, check=False,
        )  # fmt: skip
        log = self._unit / "log"
        told = log.read_text() if log.exists() else ""
        assert done.returncode == 0, f"{commands}\n{done.stdout}{done.stderr}\n{told}"
        return done.stdout + done.stderr

    def printed(self) -> str:
        """Return what the unit has printed so far."""
        return (self._unit / "log").read_text()

    def wait_printed(self, words: str, *, after: str) -> None:
        """Wait until the unit prints some words after what it had printed."""
        deadline = time.monotonic() + 120.0
        while words not in self.printed().removeprefix(after):
            assert time.monotonic() < deadline, self.printed()
            time.sleep(0.1)


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[Machine]:
    made = Machine(tmp_path)
    made.clone()
    yield made
    made.type("systemctl --user stop fognav.service")


def history_with_a_newer_release(folder: Path) -> Path:
    """Return git's folder of a clone whose remote has released a version since."""
    identity = ("-c", "user.name=t", "-c", "user.email=t@example.org", "-c", "commit.gpgsign=false")

    def git(root: Path, *arguments: str) -> None:
        subprocess.run(["git", "-C", str(root), *identity, *arguments], check=True, capture_output=True)

    remote, clone = folder / "remote", folder / "clone"
    remote.mkdir()
    git(remote, "init", "--quiet")
    git(remote, "commit", "--quiet", "--allow-empty", "--message", "What is installed")
    git(folder, "clone", "--quiet", str(remote), str(clone))
    git(remote, "commit", "--quiet", "--allow-empty", "--message", "Find a way through the new door")
    git(remote, "tag", "--annotate", "v0.2.0", "--message", "A release")
    return clone / ".git"


def test_fog_node_is_installed_extended_backed_up_and_restored_as_the_page_says(machine, tmp_path):
    said = machine.type(block("sudo apt-get install"), where=machine.home)
    assert "site office" in said
    assert "fog-office" in said
    asked = machine.asked.read_text()
    assert "sudo systemctl disable --now mosquitto redis-server" in asked
    assert "loginctl enable-linger pi" in asked

    token = machine.type("cat ~/.local/share/fognav/keys/office/admin.token").strip()
    machine.type('./fognav zone add --circle 9,42.6,0.5 --reason "wet floor"')
    machine.type("./fognav token create anna --role operator --file ~/.local/share/fognav/keys/office/tokens.toml")

    backup = block("./fognav backup fog.tar.gz")
    assert "backed up site office" in machine.type(backup)
    (nightly,) = re.findall(r"^0 3 \* \* \* (.*)$", PAGE, re.MULTILINE)
    (tmp_path / "media").mkdir()
    # A site's name alone is looked for in the checkout, which is not this folder here.
    nightly = nightly.replace("--site office", "--site sites/office")
    machine.type(nightly.replace("\\%", "%").replace("/media/backup", str(tmp_path / "media")))
    assert [each.name[:7] for each in (tmp_path / "media").iterdir()] == ["office-"]

    shutil.copytree(machine.checkout / "sites" / "office", machine.checkout / "sites" / "upstairs")
    upstairs = machine.checkout / "sites" / "upstairs" / "site.toml"
    upstairs.write_text(upstairs.read_text("utf-8").replace('id = "office"', 'id = "upstairs"', 1), "utf-8")
    adding = block("./fognav node add n8")
    machine.type(adding.replace("--pose 40.0,26.95,1.5708", f"--pose {pose_in(machine.checkout / 'sites' / 'office')}"))
    assert (machine.home / ".local/share/fognav/locks/credentials/r2.toml").exists()
    assert {"fog-office", "fog-upstairs"} <= set(re.findall(r"fog-\w+", machine.type("./fognav status")))

    before = machine.printed()
    machine.type("./fognav ca rotate --locks ~/.local/share/fognav/locks")
    machine.wait_printed("changed: mosquitto uses", after=before)
    assert "wet floor" in machine.type("./fognav zone list --fog fog-office")

    (checking,) = set(re.findall(r"`(\./fognav upgrade --check)`", PAGE))
    said = machine.type(checking, git_folder=history_with_a_newer_release(tmp_path))
    assert ": 1 changes" in said
    assert "Find a way through the new door" in said

    machine.type("systemctl --user stop fognav.service && rm -r ~/.local/share/fognav")
    restored = machine.type(block("./fognav restore fog.tar.gz"))
    assert "restored site office" in restored
    assert machine.type("cat ~/.local/share/fognav/keys/office/admin.token").strip() == token
    assert shlex.split(backup, comments=True)[2] == shlex.split(block("./fognav restore"), comments=True)[2]


def shown(machine: Machine, words: str) -> str:
    """Return the list of floors once it has these words."""
    deadline = time.monotonic() + 120.0
    while words not in (said := machine.type("./fognav floor list || true")):
        assert time.monotonic() < deadline, said
        time.sleep(0.5)
    return said


@pytest.mark.long
def test_two_machines_become_two_floors_one_of_which_shows_and_stops_both_as_the_page_says(machine, tmp_path):
    (tmp_path / "second").mkdir()
    second = Machine(tmp_path / "second")
    second.clone()
    try:
        second.site("upstairs")
        second.sends_to(machine)
        setting_up = block("./fognav up --check --site sites/upstairs", CAMPUS)
        second.type(setting_up.replace("--systemd", "--systemd --sim"))
        second.type(block("./fognav token create from-ground", CAMPUS))
        assert not (second.checkout / "upstairs.toml").exists()
        listed = block("[floors.upstairs]", CAMPUS).replace("https://fog2.local:8004", second.console)
        (machine.checkout / "floors.toml").write_text(listed, "utf-8")
        machine.site("ground")
        linking = block("./fognav up --systemd --site sites/ground", CAMPUS)
        machine.type(linking.replace("./fognav floor list", ""))
        second.type("./fognav robot enable")
        assert "ground: ready" in shown(machine, "upstairs: ready; robots: r1 NORMAL")
        one, both = [line for line in block("./fognav floor stop", CAMPUS).splitlines() if line]
        assert "upstairs: stopped: r1" in machine.type(one)
        shown(machine, "upstairs: ready; stopped; ")
        second.type("./fognav robot enable")
        said = machine.type(both)
        assert "ground: stopped: no robot; away: r1" in said
        assert "upstairs: stopped: r1" in said
        second.type("systemctl --user stop fognav.service")
        assert "ground: ready" in shown(machine, "upstairs: NOT REACHABLE since ")
        assert "upstairs: NOT ACKNOWLEDGED" in machine.type(f"{both.partition('#')[0]} || true")
    finally:
        second.type("systemctl --user stop fognav.service")
