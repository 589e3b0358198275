"""A fog node on this machine: its folder, its logs, its sites' names and ports, and its unit."""

import asyncio
import datetime as dt
import errno
import os
import shutil
import signal
import socket
import stat
import subprocess
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fog_runtime import backup
from fog_runtime.backup import STAMP, BackupError
from fog_runtime.credentials import Credentials
from fog_runtime.security.site_security import CERTIFICATE, SiteSecurity
from fog_runtime.stores.redis_connection import RedisConnection
from fog_runtime.token_file import create_token, read_tokens, revoke_token
from fog_supervisor.supervisor import NotReadyError, Program, Supervisor
from fognav.__main__ import app
from fognav.credentials import security_errors
from fognav.hosting import backups, fog_node, folders, local_nodes
from fognav.hosting.fog_node import CredentialChanges, LocalNode, NodeConfig
from fognav.hosting.folders import FORMAT, NodeFolder, default_data, hosted_sites
from fognav.operate.systems import Registration, System, registered
from fognav.output import FailedError, WrongUseError

ESTIG = Path(__file__).parents[2] / "sites" / "estig"


@pytest.fixture
def upstairs(tmp_path: Path) -> Path:
    site = tmp_path / "upstairs"
    shutil.copytree(ESTIG, site)
    text = (site / "site.toml").read_text("utf-8")
    (site / "site.toml").write_text(text.replace('id = "estig"', 'id = "upstairs"', 1), "utf-8")
    return site


def test_data_is_private_and_of_one_process_at_a_time(tmp_path):
    folder = NodeFolder(tmp_path / "data")
    keys = folder.keys("estig")
    assert stat.S_IMODE(folder.path.stat().st_mode) == 0o700
    assert stat.S_IMODE((keys / "admin.token").stat().st_mode) == 0o600
    token = (keys / "admin.token").read_text()
    assert (NodeFolder(tmp_path / "data").keys("estig") / "admin.token").read_text() == token
    with folder.in_use(), pytest.raises(FailedError, match="fognav down"), NodeFolder(folder.path).in_use():
        pass
    with folder.in_use():
        pass


@pytest.mark.parametrize(("text", "reason"), [(str(FORMAT + 1), "newer Fognav"), ("?", "restore it")])
def test_data_of_a_newer_layout_is_left_alone(tmp_path, text, reason):
    NodeFolder(tmp_path / "data")
    (tmp_path / "data" / "format").write_text(text)
    with pytest.raises(FailedError, match=reason):
        NodeFolder(tmp_path / "data")
    assert (tmp_path / "data" / "format").read_text() == text


def test_default_data_follows_the_base_directories(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    assert default_data() == tmp_path / "fognav"
    monkeypatch.setenv("XDG_DATA_HOME", "relative")
    assert default_data() == Path.home() / ".local" / "share" / "fognav"


def test_site_keeps_its_place_and_ports_whatever_the_order(tmp_path, upstairs, monkeypatch):
    for name in ("FOGNAV_AGGREGATOR_PORT", "FOGNAV_MAP_PORT", "FOGNAV_PLANNER_PORT", "FOGNAV_CONSOLE_PORT"):
        monkeypatch.delenv(name, raising=False)
    hosts, security = ["localhost"], tmp_path / "locks"
    (alone,), _ = hosted_sites([ESTIG], security, hosts)
    both, made = hosted_sites([upstairs, ESTIG], security, hosts)
    found = {site.id: site for site in both}
    expected = {"hazard-aggregator": 8001, "map-service": 8002, "planner": 8003, "console-service": 8004}
    assert alone.ports == found["estig"].ports == expected
    assert sorted(found["upstairs"].ports.values()) == [8011, 8012, 8013, 8014]
    assert found["estig"].name("planner") == "planner"
    assert found["upstairs"].name("planner") == "upstairs.planner"
    assert (found["upstairs"].node_credentials(made) / "n1.toml").exists()
    (later,), _ = hosted_sites([upstairs], security, hosts)
    assert later.ports == found["upstairs"].ports


def test_two_sites_with_one_id_are_refused(tmp_path, upstairs):
    with pytest.raises(WrongUseError, match="same id 'upstairs'"):
        hosted_sites([upstairs, shutil.copytree(upstairs, tmp_path / "copy")], tmp_path / "locks", ["localhost"])


def test_log_is_bounded_and_followed_across_its_cut(tmp_path):
    file = tmp_path / "planner.log"
    with file.open("a", buffering=1) as program:
        program.write("one\ntwo\n")
        tail = local_nodes.Tail(file, 1)
        assert tail.first() == ["two"]
        program.write("three\nfou")
        assert tail.added() == ["three"]
        program.write("r\n")
        assert tail.added() == ["four"]
        local_nodes.bound_log(file, limit=10)
        assert tail.added() == []
        program.write("five\n")
        assert tail.added() == ["five"]
    assert file.read_text() == "five\n"
    assert (tmp_path / "planner.log.before").read_text() == "one\ntwo\nthree\nfour\n"


def test_unit_runs_the_same_command_with_this_shell_s_settings(monkeypatch):
    monkeypatch.setenv("FOGNAV_MAP_PORT", "9002")
    monkeypatch.setenv("FOGNAV_BIND", "a $b %c")
    text = local_nodes.unit_text(["up", "--site", "/srv/my floor", "--data", "/$d"])
    command = next(line for line in text.splitlines() if line.startswith("ExecStart="))
    assert command.endswith('/fognav up --site "/srv/my floor" --data "/$$d"')
    assert "Environment=FOGNAV_MAP_PORT=9002\n" in text
    assert 'Environment="FOGNAV_BIND=a $b %%c"\n' in text


async def until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < deadline
        await asyncio.sleep(0.01)


@pytest.fixture
def node(tmp_path: Path) -> LocalNode:
    """A fog node of which nothing runs yet."""
    folder = NodeFolder(tmp_path / "data")
    sites, security = hosted_sites([ESTIG], folder.security, ["localhost", "127.0.0.1"])
    return LocalNode(NodeConfig(folder=folder, sites=sites, security=security, address="127.0.0.2"), lambda _: None)


def test_services_get_what_their_operator_sets_and_no_other_setting_of_the_shell(tmp_path, monkeypatch):
    monkeypatch.setenv("FOGNAV_WALL_CLOCK", "trusted")
    monkeypatch.setenv("FOGNAV_SPEED", "7")
    folder = NodeFolder(tmp_path / "data")
    sites, security = hosted_sites([ESTIG], folder.security, ["localhost"])
    made = LocalNode(NodeConfig(folder=folder, sites=sites, security=security, address="127.0.0.2"), lambda _: None)
    for service in ("map-service", "planner"):
        environment = made.supervisor._get(service).program.environment
        assert (environment["FOGNAV_WALL_CLOCK"], "FOGNAV_SPEED" in environment) == ("trusted", False)


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_systemd_accepts_the_unit(tmp_path, monkeypatch):
    monkeypatch.setenv("FOGNAV_MAP_PORT", "8102")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    file = local_nodes.write_unit(["up", "--site", "/srv/100% $ite"])
    command = ["systemd-analyze", "--user", "verify", "--man=no", "--recursive-errors=no", str(file)]
    known = {"PATH": os.environ["PATH"], "HOME": str(tmp_path), "XDG_RUNTIME_DIR": str(tmp_path)}
    done = subprocess.run(command, env=known, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    file.write_text(file.read_text().replace("Type=notify", "Type=nosuch"))
    done = subprocess.run(command, env=known, capture_output=True, text=True, timeout=60, check=False)
    assert "nosuch" in done.stderr


async def test_certificate_that_ends_soon_is_renewed_while_the_node_runs(node, tmp_path, monkeypatch):
    monkeypatch.setattr(fog_node, "PERIOD_S", 0.01)
    monkeypatch.setattr(fog_node, "RENEWAL_PERIOD_S", 0.05)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    security = node.config.security
    file = security.folder("redis") / CERTIFICATE
    issued = security.authority.issue("redis", security.hosts, now=dt.datetime.now(dt.UTC) - dt.timedelta(days=600))
    file.write_bytes(issued.chain)
    SiteSecurity.open(security.directory).add_device("door", ["door/state"])  # by a command, beside the running node
    told: list[str] = []
    (tmp_path / "fognav").mkdir(mode=0o700)
    with Registration(lambda: node.system(node.config.sites[0])) as registration:
        attending = asyncio.create_task(fog_node.attend(node, [registration], node.credential_changes(), told.append))
        try:
            await until(lambda: told)
        finally:
            attending.cancel()
            await asyncio.wait({attending})
    assert told == ["the certificate of redis was renewed"]
    renewed = SiteSecurity.open(security.directory)
    assert (renewed.expiring(), "door" in renewed.users()) == ([], True)


async def test_bookkeeping_that_fails_is_told_once_and_ends_nothing(node, tmp_path, monkeypatch):
    monkeypatch.setattr(fog_node, "PERIOD_S", 0.01)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "fognav").mkdir(mode=0o755)  # not private, so it can't be used
    keys = node.config.folder.keys("estig")
    for name in ("admin.token", "tokens.toml"):
        (keys / name).unlink()
    log = node.config.folder.log("planner")
    with log.open("wb") as file:
        file.truncate(local_nodes.LIMIT_BYTES)
    before = log.with_name(log.name + ".before")
    before.mkdir()

    told: list[str] = []
    site = node.config.sites[0]
    with Registration(lambda: node.system(site)) as registration:
        attending = asyncio.create_task(fog_node.attend(node, [registration], node.credential_changes(), told.append))
        try:
            await until(lambda: len(told) >= 2)
            assert "site estig" in told[0]
            assert "not a private folder" in told[0]
            assert "log of planner" in told[1]
            await asyncio.sleep(0.1)
            before.rmdir()
            await until(lambda: log.stat().st_size == 0)
            (tmp_path / "fognav").chmod(0o700)
            await until(registered)
            assert len(told) == 2
            before.unlink()
            before.mkdir()
            with log.open("wb") as file:
                file.truncate(local_nodes.LIMIT_BYTES)
            await until(lambda: len(told) == 3)  # it is told again after it has worked
            assert not attending.done()
        finally:
            attending.cancel()
            await asyncio.wait({attending})


async def test_check_that_a_signal_ends_has_failed(node, tmp_path, monkeypatch):
    async def start(_: LocalNode, timeout_s: float) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        await asyncio.sleep(timeout_s)

    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(fog_node, "require_free_ports", lambda _: None)
    monkeypatch.setattr(LocalNode, "start", start)
    with pytest.raises(FailedError, match="ended the check"):
        await fog_node.run_node(node.config, lambda _: None, check=True)
    await fog_node.run_node(node.config, lambda _: None)


async def test_logs_of_a_node_that_never_becomes_ready_are_bounded(node, tmp_path, monkeypatch):
    async def start(_: LocalNode, _timeout_s: float) -> None:
        raise NotReadyError("it waits for nothing that comes")

    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(fog_node, "require_free_ports", lambda _: None)
    monkeypatch.setattr(LocalNode, "start", start)
    log = node.config.folder.log("planner")
    with log.open("wb") as file:
        file.truncate(local_nodes.LIMIT_BYTES)
    with pytest.raises(NotReadyError):
        await fog_node.run_node(node.config, lambda _: None)
    assert log.stat().st_size == 0


async def test_credentials_that_change_while_the_node_starts_come_into_force(node, tmp_path, monkeypatch):
    async def start(started: LocalNode, _: float) -> None:
        started.config.security.add_robot("r7")

    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(fog_node, "PERIOD_S", 0.01)
    monkeypatch.setattr(fog_node, "require_free_ports", lambda _: None)
    monkeypatch.setattr(LocalNode, "start", start)
    told: list[str] = []
    running_node = asyncio.create_task(fog_node.run_node(node.config, told.append))
    await until(lambda: "files have changed: zenoh-router uses the new ones" in told or running_node.done())
    running_node.cancel()
    await asyncio.wait({running_node})
    assert "files have changed: zenoh-router uses the new ones" in told


def test_log_is_cut_without_a_copy_on_a_full_disk(tmp_path):
    file, before = tmp_path / "planner.log", tmp_path / "planner.log.before"
    file.write_text("0123456789")
    before.symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space left"):
        local_nodes.bound_log(file, limit=10)
    assert file.stat().st_size == 0
    assert not before.is_symlink()
    local_nodes.bound_log(file, limit=10)


def test_error_without_a_file_is_told_without_one():
    with pytest.raises(FailedError, match="a file can't be used: No space left on device"), security_errors():
        raise OSError(errno.ENOSPC, "No space left on device")


async def test_port_is_required_free_at_the_address_where_its_program_listens(node):
    assert {address for name, (address, _) in node.listening.items() if name != "redis"} == {"127.0.0.2"}
    with socket.create_server(("127.0.0.1", 0)) as other:
        node.server_set = [
            replace(each, port=other.getsockname()[1]) for each in node.server_set if each.name == "redis"
        ]
        with pytest.raises(FailedError, match=r"redis can't listen on 127\.0\.0\.1 port"):
            fog_node.require_free_ports(node)


def test_address_of_ipv6_is_refused_with_what_to_name(tmp_path):
    ended = CliRunner().invoke(app, ["up", "--bind", "::", "--data", str(tmp_path / "data")])
    assert (ended.exit_code, "a fog node listens on IPv4" in " ".join(ended.output.split())) == (2, True)


def connected(place: backup.Place) -> RedisConnection:
    return RedisConnection(place.redis_url, timeout_s=10.0, credentials=place.credentials)


async def test_backup_of_each_floor_is_restored_on_an_empty_machine(tmp_path, upstairs):
    floors = {"estig": shutil.copytree(ESTIG, tmp_path / "site"), "upstairs": upstairs}
    folder = NodeFolder(tmp_path / "data")
    hosted_sites(list(floors.values()), folder.security, ["localhost", "127.0.0.1"])
    folders.remember(folder.path, folders.settings_of(floors, "127.0.0.1", [], simulate=False))
    tokens = {}
    for floor, directory in floors.items():
        tokens[floor] = (folder.keys(floor) / "admin.token").read_text()
        async with backups.redis_of(folder, floor, directory) as place:
            redis = connected(place)
            await redis.write(("SET", f"fog:{floor}:zones", f"wet floor of {floor}"))
            await redis.aclose()
        await backups.create(tmp_path / f"{floor}.tar.gz", folder, directory)
    with pytest.raises(WrongUseError, match="name one of the sites"):
        await backups.create(tmp_path / "both.tar.gz", folder, None)
    assert (folder.data("upstairs.map-service") / STAMP).exists()
    authority = (folder.security / "authority.pem").read_bytes()
    robot = (folder.security / "credentials" / "upstairs" / "r1.toml").read_bytes()

    empty = NodeFolder(tmp_path / "empty")
    for floor, original in floors.items():
        file, directory = tmp_path / f"{floor}.tar.gz", tmp_path / "restored" / floor
        with empty.in_use(), pytest.raises(FailedError, match="fognav down"):
            await backups.restore(file, empty, directory, replace=False)
        await backups.restore(file, empty, directory, replace=False)
        assert (directory / "site.toml").read_bytes() == (original / "site.toml").read_bytes()
        assert (empty.keys(floor) / "admin.token").read_text() == tokens[floor]
        async with backups.redis_of(empty, floor, directory) as place:
            redis = connected(place)
            assert await redis.read("GET", f"fog:{floor}:zones") == f"wet floor of {floor}".encode()
            await redis.aclose()
    assert (empty.security / "authority.pem").read_bytes() == authority
    assert (empty.security / "credentials" / "upstairs" / "r1.toml").read_bytes() == robot
    with pytest.raises(BackupError, match="nothing was changed"):
        await backups.restore(tmp_path / "estig.tar.gz", empty, tmp_path / "restored" / "estig", replace=False)


async def test_older_backup_of_one_floor_neither_shuts_out_who_was_added_since_nor_admits_who_was_removed(
    tmp_path, upstairs
):
    estig = shutil.copytree(ESTIG, tmp_path / "site")
    folder, hosts = NodeFolder(tmp_path / "data"), ["localhost", "127.0.0.1"]
    hosted_sites([estig], folder.security, hosts)
    tokens = folder.keys("estig") / "tokens.toml"
    create_token(tokens, "left", "operator")
    SiteSecurity.open(folder.security).add_robot("sold")
    folders.remember(folder.path, folders.settings_of({"estig": estig}, "127.0.0.1", [], simulate=False))
    await backups.create(tmp_path / "older.tar.gz", folder, estig)
    hosted_sites([estig, upstairs], folder.security, hosts)
    SiteSecurity.open(folder.security).add_robot("r7")
    SiteSecurity.open(folder.security).remove("sold")
    revoke_token(tokens, "left")
    before = SiteSecurity.open(folder.security).users()
    made, refused, _ = await backups.restore(tmp_path / "older.tar.gz", folder, estig, replace=True)
    assert (sorted(made.folders), refused) == (["recordings", "site"], ["sold"])
    assert [each.name for each in read_tokens(tokens)] == ["admin"]
    assert SiteSecurity.open(folder.security).users() == before
    service = Credentials.read(SiteSecurity.open(folder.security).credentials("upstairs.map-service"))
    async with backups.redis_of(folder, "estig", estig) as place:
        redis = RedisConnection(place.redis_url, timeout_s=10.0, credentials=service)
        assert await redis.read("PING")
        await redis.aclose()


def test_backup_of_a_node_takes_a_site_by_its_name(tmp_path):
    folder = NodeFolder(tmp_path / "data")
    hosted_sites([ESTIG], folder.security, ["localhost", "127.0.0.1"])
    folder.keys("estig")
    folders.remember(folder.path, folders.settings_of({"estig": ESTIG}, "127.0.0.1", [], simulate=False))
    file = tmp_path / "estig.tar.gz"
    done = CliRunner().invoke(app, ["backup", str(file), "--up", str(folder.path), "--site", "estig"])
    assert (done.exit_code, file.exists()) == (0, True), done.output
    done = CliRunner().invoke(app, ["backup", str(file), "--up", str(folder.path), "--site", "cellar"])
    assert done.exit_code != 0
    assert "name one of the sites" in " ".join(done.output.split())


@pytest.mark.parametrize("command", ["backup", "restore"])
def test_mistyped_node_or_site_leaves_nothing_behind(tmp_path, command):
    folder = NodeFolder(tmp_path / "data")
    hosted_sites([ESTIG], folder.security, ["localhost", "127.0.0.1"])
    folder.keys("estig")
    folders.remember(folder.path, folders.settings_of({"estig": ESTIG}, "127.0.0.1", [], simulate=False))
    file, wrong = tmp_path / "estig.tar.gz", tmp_path / "dta"
    assert CliRunner().invoke(app, ["backup", str(file), "--up", str(folder.path)]).exit_code == 0
    if command == "backup":
        done = CliRunner().invoke(app, ["backup", str(tmp_path / "again.tar.gz"), "--up", str(wrong)])
        assert f"{wrong} has no data of a fog node" in " ".join(done.output.split())
    else:
        upstairs = shutil.copytree(ESTIG, tmp_path / "upstairs")
        description = (upstairs / "site.toml").read_text().replace('id = "estig"', 'id = "upstairs"', 1)
        (upstairs / "site.toml").write_text(description)
        options = ["--site", str(upstairs), "--up", str(wrong), "--replace"]
        done = CliRunner().invoke(app, ["restore", str(file), *options])
        assert "has the site upstairs, and the backup is of the site estig" in " ".join(done.output.split())
        assert (upstairs / "site.toml").read_text() == description
    assert done.exit_code != 0
    assert not wrong.exists()


def test_backup_into_a_device_is_refused(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    done = CliRunner().invoke(app, ["backup", str(pipe), "--up", str(tmp_path)])
    assert "it is a folder or a device. Name another file" in " ".join(done.output.split())


async def test_credentials_of_another_authority_are_replaced_by_those_of_the_backup(tmp_path):
    estig, hosts = shutil.copytree(ESTIG, tmp_path / "site"), ["localhost", "127.0.0.1"]
    for name in ("data", "fresh"):
        folder = NodeFolder(tmp_path / name)
        hosted_sites([estig], folder.security, hosts)
        folder.keys("estig")
        folders.remember(folder.path, folders.settings_of({"estig": estig}, "127.0.0.1", [], simulate=False))
    original = NodeFolder(tmp_path / "data")
    await backups.create(tmp_path / "older.tar.gz", original, estig)
    made, *_ = await backups.restore(tmp_path / "older.tar.gz", folder, estig, replace=True)
    assert backups.SECURITY in made.folders
    assert (folder.security / "authority.pem").read_bytes() == (original.security / "authority.pem").read_bytes()


async def test_credentials_of_another_site_are_never_replaced_by_those_of_a_backup(tmp_path, upstairs):
    for name, site, directory in (("data", "estig", ESTIG), ("other", "upstairs", upstairs)):
        folder = NodeFolder(tmp_path / name)
        hosted_sites([directory], folder.security, ["localhost", "127.0.0.1"])
        folder.keys(site)
        folders.remember(folder.path, folders.settings_of({site: directory}, "127.0.0.1", [], simulate=False))
    await backups.create(tmp_path / "estig.tar.gz", NodeFolder(tmp_path / "data"), ESTIG)
    before = (folder.security / "authority.pem").read_bytes()
    with pytest.raises(
        BackupError, match="has the credentials of upstairs too, and the backup's are of another authority"
    ):
        await backups.restore(tmp_path / "estig.tar.gz", folder, tmp_path / "restored", replace=True)
    assert (folder.security / "authority.pem").read_bytes() == before
    assert not (tmp_path / "restored").exists()


def hosted(name: str, pid: int, data: Path) -> System:
    return System(name=name, kind="fog node", site="estig", urls={}, pids={"up": pid}, data=str(data))


def test_one_of_several_nodes_is_named_by_site_or_data(tmp_path, monkeypatch):
    one, other = tmp_path / "one", tmp_path / "other"
    systems = [hosted("fog-estig", 1, one), hosted("fog-upstairs", 1, one), hosted("fog-estig", 2, other)]
    monkeypatch.setattr(local_nodes, "registered", lambda: systems)
    assert local_nodes.named_node("fog-upstairs", None).pid == 1
    assert local_nodes.named_node(None, other).pid == 2
    for name in (None, "fog-estig"):
        with pytest.raises(WrongUseError, match=f"--data {other}"):
            local_nodes.named_node(name, None)
    with pytest.raises(WrongUseError, match="no such fog node runs, only"):
        local_nodes.named_node("fog-cellar", None)
    systems[:] = systems[:2]
    assert local_nodes.named_node(None, None).names == ["fog-estig", "fog-upstairs"]
    systems.clear()
    assert local_nodes.named_node("fog-estig", None) is None


def test_start_of_a_node_is_remembered_with_its_options_and_ports(tmp_path, monkeypatch):
    monkeypatch.setenv("FOGNAV_MAP_PORT", "9002")
    made = folders.settings_of({"estig": ESTIG}, "127.0.0.2", ["fog.local"], simulate=True)
    folders.remember(tmp_path, made)
    found = folders.recall(tmp_path)
    assert found == made
    assert found.arguments == ["--site", str(ESTIG), "--bind", "127.0.0.2", "--host", "fog.local", "--sim"]
    assert found.environment["FOGNAV_MAP_PORT"] == "9002"
    monkeypatch.setenv("FOGNAV_MAP_PORT", "9003")
    assert found.command(Path("/my data")) == (
        f"FOGNAV_MAP_PORT=9002 ./fognav up --site {ESTIG} --bind 127.0.0.2 --host fog.local --sim --data '/my data'"
    )
    (tmp_path / folders.FILE).write_text("{")
    with pytest.raises(FailedError, match="start it once"):
        folders.recall(tmp_path)


async def test_changed_credentials_reach_their_program_alone_and_once(tmp_path):
    shell = 'trap "echo told" HUP; echo started; while :; do sleep 0.02; done'
    folders = {name: tmp_path / name for name in ("mosquitto", "zenoh-router", "planner")}
    logs = {name: tmp_path / f"{name}.log" for name in folders}
    async with Supervisor(lambda _: None) as supervisor:
        for name, folder in folders.items():
            folder.mkdir()
            (folder / "users").write_text("somebody")
            supervisor.add(Program(name=name, arguments=("/bin/sh", "-c", shell), log=logs[name]))
            supervisor.start(name)
        await until(lambda: all(log.exists() and log.read_text() for log in logs.values()))
        changes = CredentialChanges(supervisor, {name: [folder] for name, folder in folders.items()})
        assert await changes.round() is None
        (folders["mosquitto"] / "users").write_text("n8")
        (folders["zenoh-router"] / "users").write_text("r2")
        assert [await changes.round() for _ in range(4)] == [None, "mosquitto", "zenoh-router", None]
        await until(lambda: logs["mosquitto"].read_text() == "started\ntold\n")
        await until(lambda: logs["zenoh-router"].read_text() == "started\nstarted\n")
        (folders["planner"] / "server.pem").write_text("half")
        assert await changes.round() is None
        (folders["planner"] / "server.pem").write_text("whole")
        assert [await changes.round() for _ in range(2)] == [None, "planner"]
        await until(lambda: logs["planner"].read_text() == "started\nstarted\n")
        assert logs["mosquitto"].read_text() == "started\ntold\n"


async def test_program_that_stays_unready_is_told_once_and_holds_no_other_back(tmp_path, monkeypatch):
    async def never() -> str | None:
        return "its port is closed"

    folders = {name: tmp_path / name for name in ("zenoh-router", "planner")}
    async with Supervisor(lambda _: None) as supervisor:
        for name, folder in folders.items():
            folder.mkdir()
            (folder / "users").write_text("somebody")
            program = ("/bin/sleep", "600")
            supervisor.add(Program(name=name, arguments=program, log=tmp_path / f"{name}.log", ready=never))
            supervisor.start(name)
        await until(lambda: all(supervisor.pid(name) for name in folders))
        changes = CredentialChanges(supervisor, {name: [folder] for name, folder in folders.items()})
        for folder in folders.values():
            (folder / "users").write_text("r2")
        assert [await changes.round() for _ in range(3)] == [None, "zenoh-router", None]
        await until(lambda: supervisor.pid("zenoh-router"))
        monkeypatch.setattr(fog_node, "_RESTARTED_S", 0.0)
        with pytest.raises(FailedError, match=r"zenoh-router is not ready .*its port is closed"):
            await changes.round()
        assert await changes.round() == "planner"
