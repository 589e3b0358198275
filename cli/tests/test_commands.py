import json
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fognav import doctor, system
from fognav.__main__ import app

runner = CliRunner()


@pytest.mark.parametrize(
    "command", [["doctor"], ["test"], ["demo"], ["site", "new"], ["site", "check"], ["record"], ["replay"]]
)
def test_every_command_has_help_with_an_example(command: list[str]) -> None:
    done = runner.invoke(app, [*command, "--help"])
    assert done.exit_code == 0
    assert "Example: fognav " + " ".join(command) in done.output


@pytest.mark.parametrize("group", [[], ["site"]])
def test_the_list_of_commands_cuts_no_sentence_off(group: list[str]) -> None:
    done = runner.invoke(app, [*group, "--help"], env={"COLUMNS": "80"})
    commands = done.output.partition("Commands:\n")[2].strip().splitlines()
    assert len(commands) >= 2
    assert [line for line in commands if not line.endswith(".") or line.endswith("...")] == []


@pytest.mark.parametrize("arguments", [["demo", "--speed", "0"], ["--help"], ["nonsense"]])
def test_it_calls_itself_by_the_name_that_people_type(arguments: list[str]) -> None:
    done = subprocess.run([sys.executable, "-m", "fognav", *arguments], capture_output=True, text=True, check=False)
    assert "Usage: fognav " in done.stdout + done.stderr
    assert "python" not in done.stdout + done.stderr


def test_doctor_writes_one_object_with_schema_and_version() -> None:
    done = runner.invoke(app, ["doctor", "--json"])
    told = json.loads(done.stdout)
    assert told["schema"] == 1
    assert told["fognav"]
    assert {"python", "mosquitto", "redis-server", "kernel cache"} <= {check["name"] for check in told["checks"]}


def test_doctor_fails_and_says_what_to_do_when_a_server_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(system, "find", lambda tool: None if tool is system.REDIS else Path("/bin/true"))
    done = runner.invoke(app, ["doctor", "--json"])
    assert done.exit_code == 1
    told = json.loads(done.stdout)
    assert told["ok"] is False
    (missing,) = [check for check in told["checks"] if check["state"] == "missing"]
    assert missing["remedy"] == "apt-get install --no-install-recommends redis-server"


def test_a_browser_is_no_must(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(system, "find", lambda _: None)
    assert doctor.check_tool(system.CHROMIUM).state == "optional"


@pytest.mark.parametrize(
    "arguments",
    [
        ["demo", "--site", "/nowhere"],
        ["demo", "--speed", "0"],
        ["demo", "--seed", "-1"],
        ["site", "new", "--map", "/nowhere.yaml", "--out", "/nowhere"],
        ["nonsense"],
    ],
)
def test_wrong_use_has_a_code_of_its_own(arguments: list[str]) -> None:
    assert runner.invoke(app, arguments).exit_code == 2


def test_a_broken_site_is_not_true_rather_than_wrong_use(tmp_path: Path) -> None:
    (tmp_path / "site.toml").write_text("id = 3\n")
    done = runner.invoke(app, ["site", "check", str(tmp_path), "--json"])
    assert done.exit_code == 1
    assert json.loads(done.stdout)["ok"] is False


@pytest.mark.parametrize("option", ["--report", "--record"])
def test_a_file_that_can_t_be_written_is_refused_before_anything_starts(option: str, tmp_path: Path) -> None:
    done = runner.invoke(app, ["demo", "--headless", option, str(tmp_path / "nowhere" / "file")])
    assert done.exit_code == 2
    assert f"there is no folder {tmp_path / 'nowhere'}" in done.output.replace("\n", "")


def test_replaying_what_is_no_recording_names_the_file(tmp_path: Path) -> None:
    file = tmp_path / "no.mcap"
    file.write_bytes(b"this is no recording")
    done = runner.invoke(app, ["replay", str(file)])
    assert done.exit_code == 2
    assert "no.mcap" in done.output
