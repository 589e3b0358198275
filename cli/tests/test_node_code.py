"""Commands that simulate sensor nodes say so in one line where those run a model instead of the firmware."""

import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fognav import kernels, system
from fognav.__main__ import app
from fognav.demo import view
from fognav_sim import live, nodes
from fognav_sim.nodes import why_model


class ReachedError(Exception):
    """The command went on to its work."""


@pytest.fixture(autouse=True)
def no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    def reached(*_: object, **__: object) -> None:
        raise ReachedError

    monkeypatch.setattr(kernels, "warm_cache", lambda _: None)
    for module, name in ((view, "run_demo"), (live, "StillFloor")):
        monkeypatch.setattr(module, name, reached)


@pytest.mark.parametrize(
    "command",
    [
        ["demo", "--headless", "--embedded"],
        ["node", "sim", "n1", "--broker", "mqtt://127.0.0.1:1"],
    ],
)
def test_command_says_in_one_line_that_nodes_run_a_model_and_why(command, tmp_path: Path, monkeypatch) -> None:
    for folder, lines in ((tmp_path, 1), (nodes.find_firmware(), 0)):
        monkeypatch.setenv("FOGNAV_FIRMWARE_DIR", str(folder))
        done = CliRunner().invoke(app, command)
        assert isinstance(done.exception, ReachedError), done.output
        said = " ".join(done.output.split())
        assert (
            said.count("simulated sensor nodes run a model in Python, not the firmware: there are no sources") == lines
        )


@pytest.fixture
def no_compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("fognav_sim.nodes.CACHE", str(tmp_path / "cache"))


@pytest.mark.usefixtures("no_compiler")
def test_missing_compiler_is_the_reason() -> None:
    assert "there is no C++ compiler: install g++" in str(why_model())


class Installer:
    """Stands for the system's packages: links the real compiler into the PATH, or fails."""

    def __init__(self, folder: Path, *, fails: bool) -> None:
        self.folder, self.fails, self.asked_for = folder, fails, [""]
        self.compiler = shutil.which("g++")

    def available(self) -> bool:
        return True

    def install(self, tools: Sequence[system.Tool]) -> None:
        self.asked_for = [tool.package for tool in tools]
        if self.fails:
            raise system.MissingToolsError("no space left on device")
        assert self.compiler is not None
        (self.folder / "g++").symlink_to(self.compiler)


@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not installed: apt-get install -y g++")
@pytest.mark.parametrize(
    ("agreed", "fails", "said"),
    [
        (True, False, ["installing g++"]),
        (True, True, ["no space left", "run a model"]),
        (False, False, ["run a model"]),
    ],
    ids=["installed", "failed", "refused"],
)
def test_missing_compiler_is_installed_if_the_user_agrees_and_else_nodes_run_a_model(
    tmp_path: Path, monkeypatch, request, agreed, fails, said
) -> None:
    installer, lines = Installer(tmp_path, fails=fails), list[str]()
    request.getfixturevalue("no_compiler")
    monkeypatch.delenv("CI", raising=False)
    monkeypatch.setattr(system, "APT", installer)
    monkeypatch.setattr("fognav_sim.nodes.build_library", lambda _: nodes.find_compiler())
    monkeypatch.setattr(system, "find", lambda tool: shutil.which(tool.executables[0]))
    system.prepare_node_code(lines.append, yes=agreed)
    assert len(lines) == len(said) + (agreed and fails)
    assert all(part in " ".join(lines) for part in said)
    assert installer.asked_for == (["g++"] if agreed else [""])
