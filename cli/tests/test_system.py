from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

from fognav import system
from fognav.system import AptProvider, MissingToolsError, Tool, ensure

GHOST = Tool("ghost", ("fognav-ghost",), "ghost-package", "nothing")


class Helper:
    """A provider that writes the program into a folder of the PATH."""

    name = "helper"

    def __init__(self, folder: Path, *, works: bool = True) -> None:
        self.folder = folder
        self.works = works
        self.installed: list[str] = []

    def available(self) -> bool:
        return self.works

    def command(self, tools: Sequence[Tool]) -> str:
        return "help me with " + " ".join(tool.package for tool in tools)

    def install(self, tools: Sequence[Tool]) -> None:
        for tool in tools:
            self.installed.append(tool.name)
            program = self.folder / tool.executables[0]
            program.write_text("#!/bin/sh\n")
            program.chmod(0o755)


@pytest.fixture
def helper(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Helper:
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    monkeypatch.delenv("CI", raising=False)
    return Helper(tmp_path)


def never(question: str) -> bool:
    raise AssertionError(f"asked: {question}")


def quiet(_: str) -> None:
    pass


def test_what_is_there_is_neither_installed_nor_asked_about(helper: Helper) -> None:
    helper.install([GHOST])
    found = ensure([GHOST], yes=False, say=quiet, ask=never, providers=[])
    assert found == {"ghost": helper.folder / "fognav-ghost"}


def test_without_consent_nothing_is_installed_and_the_remedy_is_told(helper: Helper) -> None:
    with pytest.raises(MissingToolsError, match=r"missing: ghost.*help me with ghost-package.*--yes"):
        ensure([GHOST], yes=False, say=quiet, ask=lambda _: False, providers=[helper])
    assert helper.installed == []


def test_yes_and_ci_are_consent(helper: Helper, monkeypatch: pytest.MonkeyPatch) -> None:
    assert ensure([GHOST], yes=True, say=quiet, ask=never, providers=[helper])["ghost"].name == "fognav-ghost"
    (helper.folder / "fognav-ghost").unlink()
    monkeypatch.setenv("CI", "true")
    ensure([GHOST], yes=False, say=quiet, ask=never, providers=[helper])
    assert helper.installed == ["ghost", "ghost"]


def test_the_first_provider_that_works_is_taken(helper: Helper, tmp_path: Path) -> None:
    broken = Helper(tmp_path, works=False)
    ensure([GHOST], yes=True, say=quiet, ask=never, providers=[broken, helper])
    assert (broken.installed, helper.installed) == ([], ["ghost"])


def test_without_any_provider_the_message_says_what_to_type(helper: Helper) -> None:
    with pytest.raises(MissingToolsError, match=r"sudo apt-get install .*ghost-package"):
        ensure([GHOST], yes=True, say=quiet, ask=never, providers=[])
    assert helper.installed == []


def test_apt_brings_its_lists_up_to_date_first_and_tells_what_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[list[str]] = []

    def run(arguments: Sequence[str], environment: Mapping[str, str]) -> tuple[int, str]:
        calls.append(list(arguments))
        assert environment["DEBIAN_FRONTEND"] == "noninteractive"
        return (0, "") if arguments[-2:] == ["update", "-q"] else (100, "E: Unable to locate package ghost-package")

    monkeypatch.setattr(system.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(system.os, "geteuid", lambda: 0)
    with pytest.raises(MissingToolsError, match="Unable to locate package ghost-package"):
        AptProvider(run).install([GHOST])
    assert [call[1] for call in calls] == ["update", "install"]
    assert calls[1][-1] == "ghost-package"


def test_apt_without_root_wants_a_sudo_that_does_not_ask(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(system.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(system.os, "geteuid", lambda: 1000)
    assert not AptProvider(lambda *_: (1, "a password is required")).available()
    assert AptProvider(lambda *_: (0, "")).available()
