"""The credentials of a fog node in containers: each program gets its own, and nothing of the others."""

import os
from pathlib import Path

import pytest

from fog_runtime.credentials import Credentials
from fog_runtime.keys import ADMIN_TOKEN, OPERATOR_KEY, SESSION_KEY, TOKENS
from fog_runtime.security import __main__ as command
from fog_runtime.security.__main__ import OWNERS, SIMULATION
from fog_runtime.security.site_security import SiteSecurity
from fog_runtime.token_file import token_hash

SITE = Path(__file__).parents[3] / "sites" / "estig"
SERVICES = {"hazard-aggregator", "map-service", "planner", "console-service"}
OF_SERVICE = {"credentials.toml", TOKENS, SESSION_KEY}
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files to other users")


class FogNode:
    """The folders of a fog node's containers, and the command that fills them."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self.security = folder / "locks"
        self.out = folder / "out"
        for program in OWNERS.keys() - {SIMULATION}:
            (self.out / program).mkdir(parents=True)
        self._capsys = capsys
        monkeypatch.setenv("FOGNAV_SITE_DIR", str(SITE))
        monkeypatch.setenv("FOGNAV_LOCKS_DIR", str(self.security))
        monkeypatch.setenv("FOGNAV_HANDED_OUT_DIR", str(self.out))
        monkeypatch.setenv("FOGNAV_HOSTS", "fog.local, 192.168.7.1")

    def run(self, *arguments: str) -> str:
        assert command.main(arguments) == 0, self._capsys.readouterr().err
        return self._capsys.readouterr().out

    def refused(self, *arguments: str) -> str:
        assert command.main(arguments) == 1
        return self._capsys.readouterr().err

    def files(self, program: str) -> set[str]:
        folder = self.out / program
        return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}

    def holders(self, secret: str) -> set[str]:
        """Return whose folders have a file with this text."""
        found = (path for path in self.out.rglob("*") if path.is_file() and secret in path.read_text("utf-8"))
        return {path.relative_to(self.out).parts[0] for path in found}


@pytest.fixture
def node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> FogNode:
    fog_node = FogNode(tmp_path, monkeypatch, capsys)
    if os.geteuid() != 0:
        own = dict.fromkeys(OWNERS, os.geteuid())
        monkeypatch.setattr("fog_runtime.security.__main__.OWNERS", own)
    fog_node.run()
    return fog_node


def test_each_program_gets_its_own_files(node):
    assert node.files("mosquitto") == {"server.pem", "server.key", "users", "access", "mosquitto_sub"}
    assert node.files("redis") == {"server.pem", "server.key", "users", "authority.pem", "health"}
    assert node.files("zenoh") == {"server.pem", "server.key", "users", "access.json5", "health.toml"}
    assert node.files("gateway") == {"server.pem", "server.key"}
    assert node.files("map-service") == node.files("hazard-aggregator") == OF_SERVICE
    assert node.files("planner") == OF_SERVICE | {"operator.key"}
    assert node.files("bridge") == {"credentials.toml", "token"}


def test_no_program_has_a_secret_of_another(node):
    assert node.holders((node.security / OPERATOR_KEY).read_text().strip()) == {"planner"}
    assert node.holders((node.security / SESSION_KEY).read_text().strip()) == SERVICES
    assert node.holders((node.security / ADMIN_TOKEN).read_text().strip()) == set()
    assert node.holders((node.out / "bridge" / "token").read_text().strip()) == {"bridge"}
    assert node.holders((node.security / "authority.pem").read_text()[:200]) == set()
    for service in SERVICES:
        for server, password in Credentials.read(
            SiteSecurity.open(node.security).credentials(service)
        ).passwords.items():
            # The router compares passwords as they are; broker and Redis have hashes.
            assert node.holders(password) == ({service, "zenoh"} if server == "zenoh" else {service})


@needs_root
def test_files_belong_to_the_user_of_their_container_and_nobody_else_reads_them(node):
    for program, owner in OWNERS.items():
        for path in (node.out / program).rglob("*"):
            assert path.stat().st_uid == owner, path
            assert path.stat().st_mode & 0o077 == 0, path


def test_second_start_changes_nothing(node):
    before = {path: path.stat().st_mtime_ns for path in node.out.rglob("*")}
    assert node.run("make") == ""
    assert {path: path.stat().st_mtime_ns for path in node.out.rglob("*")} == before


def test_new_robot_gets_its_credentials_once_and_the_router_learns_of_it(node):
    printed = node.run("robot", "r9")
    assert 'user = "r9"' in printed
    assert "r9:" in (node.out / "zenoh" / "users").read_text()
    node.run("remove", "r9")
    assert "r9:" not in (node.out / "zenoh" / "users").read_text()
    assert "r9 is unknown" in node.refused("remove", "r9")


def test_new_token_reaches_every_service(node):
    assert node.run("token", "create", "anna", "viewer").strip()
    for service in SERVICES:
        assert 'name = "anna"' in (node.out / service / TOKENS).read_text()
    node.run("token", "revoke", "anna")
    assert not any('name = "anna"' in (node.out / service / TOKENS).read_text() for service in SERVICES)


def test_new_token_is_printed_even_if_it_can_not_be_handed_out(node, capsys):
    (node.out / "planner" / TOKENS).unlink()
    (node.out / "planner" / TOKENS).mkdir()
    assert command.main(["token", "create", "ann", "operator"]) == 1
    printed = capsys.readouterr()
    assert TOKENS in printed.err
    assert token_hash(printed.out.strip()) in (node.security / TOKENS).read_text("utf-8")


def test_simulated_robot_gets_secrets_only_where_one_is_wanted(node):
    assert SIMULATION not in (node.security / TOKENS).read_text()
    (node.out / SIMULATION).mkdir()
    node.run()
    token = (node.out / SIMULATION / "token").read_text()
    assert {"operator.key", "token", "credentials/console.toml", "credentials/sim.toml", "credentials/r1.toml"} <= (
        node.files(SIMULATION)
    )
    assert all('role = "operator"' in (node.out / service / TOKENS).read_text() for service in SERVICES)
    node.run()
    assert (node.out / SIMULATION / "token").read_text() == token


def test_token_of_the_simulated_robot_that_was_lost_is_replaced(node):
    (node.out / SIMULATION).mkdir()
    node.run()
    lost = (node.out / SIMULATION / "token").read_text()
    (node.out / SIMULATION / "token").unlink()
    node.run()
    assert (node.out / SIMULATION / "token").read_text() != lost
    assert (node.security / TOKENS).read_text().count(f'name = "{SIMULATION}"') == 1


def test_rotated_authority_reaches_servers_and_services(node):
    before = (node.out / "gateway" / "server.pem").read_text()
    node.run("rotate")
    assert (node.out / "gateway" / "server.pem").read_text() != before
    trusted = (node.out / "redis" / "authority.pem").read_text()
    assert trusted.count("BEGIN CERTIFICATE") == 2
    assert Credentials.read(node.out / "planner" / "credentials.toml").authority.strip() == trusted.strip()
    node.run("rotate", "--finish")
    assert (node.out / "redis" / "authority.pem").read_text().count("BEGIN CERTIFICATE") == 1


def test_certificate_of_the_authority_is_shown_without_its_key(node):
    shown = node.run("certificate")
    assert shown == (node.out / "redis" / "authority.pem").read_text()
    assert "PRIVATE" not in shown


def test_administrator_reads_a_file_of_the_credentials_and_nothing_else(node):
    assert node.run("show", ADMIN_TOKEN) == (node.security / ADMIN_TOKEN).read_text()
    assert "there are: " in node.refused("show", "../out/planner/operator.key").lower()


def renamed(folder: Path, site: str) -> Path:
    """A copy of the floor estig with an id of its own."""
    folder.mkdir(parents=True)
    for file in SITE.iterdir():
        if file.is_file():
            (folder / file.name).write_bytes(file.read_bytes())
    text = (folder / "site.toml").read_text("utf-8")
    (folder / "site.toml").write_text(text.replace('id = "estig"', f'id = "{site}"', 1), "utf-8")
    return folder


@pytest.fixture
def upstairs(node, tmp_path, monkeypatch):
    """What is handed out to a further floor, of the same robots and nodes."""
    renamed(tmp_path / "floors" / "upstairs", "upstairs")
    monkeypatch.setenv("FOGNAV_FLOORS_DIR", str(tmp_path / "floors"))
    out = node.out / "floors" / "upstairs"
    for program in (*SERVICES, SIMULATION):
        (out / program).mkdir(parents=True)
    node.run()
    return out


def test_further_floor_has_users_tokens_and_key_of_its_own(node, upstairs):
    assert {each.name for each in (upstairs / "planner").iterdir()} == OF_SERVICE | {OPERATOR_KEY}
    assert Credentials.read(upstairs / "map-service" / "credentials.toml").user == "upstairs.map-service"
    assert Credentials.read(upstairs / SIMULATION / "credentials" / "r1.toml").user == "upstairs.r1"
    for name in (OPERATOR_KEY, SESSION_KEY, TOKENS):
        assert (upstairs / "planner" / name).read_text() != (node.out / "planner" / name).read_text()
    lists = [node.out / "mosquitto" / "users", node.out / "zenoh" / "users", node.out / "redis" / "users"]
    assert all("upstairs.hazard-aggregator" in file.read_text() for file in lists)
    assert "upstairs.r1:" in (node.out / "zenoh" / "users").read_text()
    token = node.run("--floor", "upstairs", "token", "create", "ann", "operator").strip()
    assert token_hash(token) in (upstairs / "planner" / TOKENS).read_text()
    assert token_hash(token) not in (node.out / "planner" / TOKENS).read_text()


def test_robot_of_a_further_floor_is_let_in_and_removed_by_its_id_there(node, upstairs):
    assert 'user = "upstairs.r9"' in node.run("--floor", "upstairs", "robot", "r9")
    assert "upstairs.r9:" in (node.out / "zenoh" / "users").read_text()
    node.run("--floor", "upstairs", "remove", "r9")
    assert "r9:" not in (node.out / "zenoh" / "users").read_text()
    assert "There are: upstairs" in node.refused("--floor", "attic", "robot", "r9")


def test_second_start_with_a_further_floor_changes_nothing(node, upstairs):
    before = {path: path.stat().st_mtime_ns for path in node.out.rglob("*")}
    node.run("make")
    assert {path: path.stat().st_mtime_ns for path in node.out.rglob("*")} == before


def test_two_floors_of_the_same_id_are_refused(node, upstairs, tmp_path):
    renamed(tmp_path / "floors" / "attic", "upstairs")
    assert "two floors have the same id 'upstairs'" in node.refused()


def test_credentials_of_another_site_are_refused(node, tmp_path, monkeypatch):
    monkeypatch.setenv("FOGNAV_SITE_DIR", str(renamed(tmp_path / "site", "annex")))
    assert "has the credentials of site estig, not of annex" in node.refused()


def test_locks_of_a_version_that_did_not_check_the_router_get_its_password(node):
    file = SiteSecurity.open(node.security).credentials("health")
    text = file.read_text()
    file.write_text("".join(line for line in text.splitlines(keepends=True) if not line.startswith("zenoh = ")))
    node.run()
    password = Credentials.read(node.out / "zenoh" / "health.toml").passwords["zenoh"]
    assert f"health:{password}" in (node.out / "zenoh" / "users").read_text().splitlines()


def test_rights_in_redis_are_those_of_this_version(node):
    users = node.security / "redis" / "users"
    text = users.read_text()
    users.write_text(text.replace(" +hincrby", ""))
    node.run()
    assert users.read_text() == text
