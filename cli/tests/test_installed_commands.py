"""Commands of other packages: found by entry points, loaded when they are asked for, and told when they are broken."""

from importlib import metadata

import pytest
import typer
from typer.testing import CliRunner

from fog_runtime.configuration import parts
from fognav.commands import installed

LOADED = []


def add_to(app: typer.Typer) -> None:
    """What a package registers."""
    LOADED.append("measure")
    app.command("measure", help="Measure it.")(lambda: typer.echo("measured"))


@pytest.fixture
def app(monkeypatch: pytest.MonkeyPatch) -> typer.Typer:
    points = [metadata.EntryPoint("measure", f"{__name__}:add_to", "fognav.commands")]
    monkeypatch.setattr(parts, "_points", lambda *_: metadata.EntryPoints(points))
    monkeypatch.setattr(metadata.EntryPoint, "load", lambda _: add_to)
    LOADED.clear()
    app = typer.Typer(name=installed.PROGRAM, cls=installed.Commands, rich_markup_mode=None)
    app.callback()(lambda: None)  # else the only command would take no name
    app.command("own")(lambda: typer.echo("done"))
    return app


def test_command_of_another_package_runs_and_is_listed_after_our_own(app: typer.Typer) -> None:
    assert CliRunner().invoke(app, ["measure"]).stdout == "measured\n"
    commands = CliRunner().invoke(app, ["--help"]).stdout.split("Commands:\n")[1]
    assert commands.split() == ["own", "measure", "Measure", "it."]


def test_command_of_another_package_is_listed_in_the_group_that_it_names(app: typer.Typer) -> None:
    app.command("drive", rich_help_panel="Drive", help="Drive it.")(lambda: None)
    listed = CliRunner().invoke(app, ["--help"]).stdout
    assert listed.split("Drive:\n")[1].split() == ["drive", "Drive", "it."]


def test_our_own_command_loads_no_other_package(app: typer.Typer) -> None:
    assert CliRunner().invoke(app, ["own"]).stdout == "done\n"
    assert LOADED == []


def test_package_that_can_not_be_loaded_is_named(app: typer.Typer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metadata.EntryPoint, "load", lambda _: 1 / 0)
    done = CliRunner().invoke(app, ["--help"])
    assert done.exit_code == 1
    assert "'measure'" in done.stderr
    assert "Correct its package" in done.stderr


def test_without_other_packages_there_are_only_our_own(app: typer.Typer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts, "_points", lambda *_: metadata.EntryPoints())
    assert "No such command 'measure'" in CliRunner().invoke(app, ["measure"]).stderr
