"""Certificates, users and credentials by commands: a file for each, and what can't work is refused with the reason."""

import datetime as dt
import json
import shutil
import stat
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fog_runtime.credentials import Credentials
from fog_runtime.security.site_security import SiteSecurity
from fog_runtime.token_file import create_token
from fognav import doctor
from fognav.__main__ import app
from fognav.commands import status
from fognav.credentials import VARIABLE
from fognav.hosting.folders import NodeFolder
from fognav.operate.systems import System
from fognav.output import WrongUseError

ROOT = Path(__file__).parents[2]


@pytest.fixture
def security(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SiteSecurity:
    monkeypatch.setenv(VARIABLE, str(tmp_path / "data" / "locks"))
    done = run("ca", "create", "--site", "estig", "--host", "fog.local", "--host", "127.0.0.1", "--json")
    assert set(done["credentials"]) >= {"map-service", "planner", "hazard-aggregator", "console", "r1", "n1"}
    return SiteSecurity.open(tmp_path / "data" / "locks")


def invoke(*words: str):
    return CliRunner().invoke(app, words)


def run(*words: str) -> dict:
    done = invoke(*words)
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def test_authority_is_shown_rotated_and_finished_by_commands(security: SiteSecurity) -> None:
    assert run("ca", "show", "--json")["rotating"] is False
    before = Credentials.read(security.credentials("r1")).authority
    assert run("ca", "rotate", "--json")["rotating"] is True
    overlap = Credentials.read(security.credentials("r1")).authority
    assert before.strip() in overlap
    assert "not finished" in invoke("ca", "rotate").output.replace("\n", " ")
    assert run("ca", "rotate", "--finish", "--json")["rotating"] is False
    assert before.strip() not in Credentials.read(security.credentials("r1")).authority
    assert "nothing to finish" in invoke("ca", "rotate", "--finish").output.replace("\n", " ")


def test_certificates_that_expire_soon_are_named_by_show_and_doctor(security: SiteSecurity) -> None:
    check = doctor.check_certificates()
    assert check is not None
    assert check.state == "ok"
    soon = security.authority.issue("redis", ["fog"], now=dt.datetime.now(dt.UTC), days=5)
    (security.folder("redis") / "server.pem").write_bytes(soon.chain)
    shown = invoke("ca", "show", "--json")
    assert shown.exit_code == 1
    assert json.loads(shown.stdout)["expiring"] == ["redis"]
    check = doctor.check_certificates()
    assert check is not None
    assert (check.state, check.remedy) == ("optional", f"fognav ca issue --credentials {security.directory}")
    run("ca", "issue", "--json")
    assert run("ca", "show", "--json")["expiring"] == []


def test_certificates_of_a_node_that_runs_here_are_shown_by_status_and_doctor(
    security: SiteSecurity, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(VARIABLE)
    data = security.directory.parent
    node = System(name="fog-estig", kind="fog node", site="estig", urls={}, pids={}, data=str(data))
    monkeypatch.setattr(status, "find_systems", lambda: [node])
    ends = min(security.expiries().values())
    assert run("status", "--json")["systems"][0]["certificates_end"] == ends.isoformat()
    assert f"valid until {ends:%Y-%m-%d}\n" in invoke("status").output
    soon = security.authority.issue("redis", ["fog"], now=dt.datetime.now(dt.UTC), days=5)
    (security.folder("redis") / "server.pem").write_bytes(soon.chain)
    assert ": see fognav doctor\n" in invoke("status").output
    monkeypatch.setenv("XDG_DATA_HOME", str(data.parent))
    data.rename(data.with_name("fognav"))
    told = invoke("status")
    assert told.exit_code == 0, "what runs is shown although its credentials are gone"
    assert "fog-estig: fog node" in told.output
    assert f"certificates of fog-estig: {data}" in told.output.replace("\n", " ")
    check = doctor.check_certificates()
    assert check is not None
    assert (check.state, "fognav/locks" in check.remedy) == ("optional", True)


def test_doctor_names_credentials_that_can_not_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    assert doctor.check_certificates() is None
    monkeypatch.setenv(VARIABLE, str(tmp_path / "nowhere"))
    check = doctor.check_certificates()
    assert check is not None
    assert check.state == "missing"
    assert "fognav ca create" in check.found


def test_root_is_sent_to_the_owner_of_credentials_whose_programs_could_not_read_them(
    security: SiteSecurity, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {file: file.read_bytes() for file in security.directory.rglob("*") if file.is_file()}
    monkeypatch.setattr("os.geteuid", lambda: security.directory.stat().st_uid + 1)
    for words in (("ca", "rotate"), ("ca", "create"), ("robot", "add", "r1", "--remove"), ("source", "user", "door")):
        done = invoke(*words)
        assert (done.exit_code, f"{security.directory} belongs to" in done.output) == (2, True), done.output
    with pytest.raises(WrongUseError, match="belongs to"):
        NodeFolder(security.directory.parent)
    assert {file: file.read_bytes() for file in security.directory.rglob("*") if file.is_file()} == before


def test_added_robot_gets_one_file_and_a_removed_one_is_unknown(security: SiteSecurity) -> None:
    file = Path(run("robot", "add", "r9", "--json")["credentials"])
    assert Credentials.read(file).user == "r9"
    assert set(Credentials.read(file).passwords) == {"zenoh"}
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert "r9" in security.users()
    run("robot", "add", "r9", "--remove", "--json")
    assert "r9" not in security.users()
    for words, reason in (
        (("r9", "--remove"), "there is no robot r9"), (("R 9",), "an id has only"), (("planner",), "name of a part"),
    ):  # fmt: skip
        done = invoke("robot", "add", *words)
        assert done.exit_code != 0
        assert reason in done.output.replace("\n", " ")


def test_robot_and_node_of_a_further_floor_leave_those_of_the_same_id_on_the_first_one_alone(
    security: SiteSecurity, tmp_path: Path
) -> None:
    upstairs = Path(shutil.copytree(ROOT / "sites" / "estig", tmp_path / "upstairs")) / "site.toml"
    upstairs.write_text(upstairs.read_text().replace('id = "estig"', 'id = "upstairs"', 1))
    board = ("--wifi", "Lab", "--wifi-password", "", "--fog-host", "192.168.7.1", "--out", str(tmp_path / "board"))
    replace = ("node", "replace", "n1", "--site", str(upstairs.parent), *board)
    assert "not of upstairs" in invoke(*replace).output
    security.add_floor("upstairs", robots=["r1"], nodes=["n1"])
    lists = [security.folder("mosquitto") / "users", security.folder("zenoh") / "users"]
    before = [set(file.read_text().splitlines()) for file in lists]
    run(*replace, "--json")
    assert json.loads((tmp_path / "board" / "node.json").read_text())["user"] == "upstairs.n1"
    assert "of which floor?" in invoke("robot", "add", "r1").output
    assert Credentials.read(Path(run("robot", "add", "r1", "--floor", "upstairs", "--json")["credentials"])).user == (
        "upstairs.r1"
    )
    changed = [set(file.read_text().splitlines()) - known for file, known in zip(lists, before, strict=True)]
    assert [[line.partition(":")[0] for line in each] for each in changed] == [["upstairs.n1"], ["upstairs.r1"]]


def test_added_node_s_board_gets_the_password_and_the_authority(security: SiteSecurity, tmp_path: Path) -> None:
    floor = Path(shutil.copytree(ROOT / "sites" / "estig", tmp_path / "floor"))
    network = ("--wifi", "Lab", "--wifi-password", "secret12", "--fog-host", "192.168.7.1")
    words = ("--area", "z4", "--pose", "33.20,38.15,1.5708", *network, "--site", str(floor))
    run("node", "add", "n8", *words, "--out", str(tmp_path / "board"), "--json")
    board = json.loads((tmp_path / "board" / "node.json").read_text())
    assert (board["user"], board["tls"]) == ("n8", True)
    assert (tmp_path / "board" / "ca.pem").read_text().strip() == security.authority.trusted.strip()
    assert "n8" in security.users()
    assert not security.credentials("n8").exists()


def test_token_is_handed_out_as_one_file_with_the_authority(security: SiteSecurity, tmp_path: Path) -> None:
    tokens = tmp_path / "tokens.toml"
    tokens.write_text("")
    create_token(tokens, "first", "admin")
    out = tmp_path / "anna.toml"
    run("token", "create", "anna", "--role", "operator", "--file", str(tokens), "--out", str(out), "--json")
    credentials = Credentials.read(out)
    assert (credentials.user, len(credentials.token) > 30, credentials.passwords) == ("anna", True, {})
    assert credentials.authority.strip() == security.authority.trusted.strip()
    assert credentials.token not in tokens.read_text()
    again = invoke("token", "create", "bob", "--file", str(tokens), "--out", str(out))
    assert "already exists" in again.output.replace("\n", " ")
