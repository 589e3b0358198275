"""`fognav node`: a site, a board and a broker take what it writes, and what can't work is refused with the reason."""

import asyncio
import ctypes
import json
import os
import pty
import re
import shutil
import stat
import subprocess
import sys
import threading
import tomllib
from pathlib import Path
from types import SimpleNamespace

import msgspec
import paho.mqtt.client as paho
import programs
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import fields
from paho.mqtt.enums import CallbackAPIVersion
from typer.testing import CliRunner, Result

from fog_contracts import channels as ch
from fog_contracts.codec import encode
from fog_contracts.messages import NodeCalibration, NodeConfig, NodeReading
from fog_contracts.site import NodeSite, Sonar
from fog_runtime.configuration.site import load_site
from fog_runtime.security.site_security import SiteSecurity
from fog_supervisor.servers import start_mosquitto
from fognav import site_files
from fognav.commands import node as node_command
from fognav.commands.node import node_app
from fognav.nodes import board_settings, on_broker
from fognav.output import FailedError, WrongUseError
from fognav.programs import AGGREGATOR
from fognav_sim.nodes import Core, FirmwareError, build_library, find_compiler
from hazard_aggregator.debounce.evidence import Options, learned_rates

ROOT = Path(__file__).parents[2]
WALL_BELOW_Z4 = "33.20,38.15,1.5708"


@pytest.fixture
def floor(tmp_path: Path) -> Path:
    return Path(shutil.copytree(ROOT / "sites" / "estig", tmp_path / "floor"))


NETWORK = ("--wifi", "Lab", "--wifi-password", "secret12", "--fog-host", "192.168.7.1", "--no-tls")


def run(*command: str) -> subprocess.CompletedProcess[str]:
    return programs.run(["node", *command], os.environ, ROOT, 120.0)


def add(floor: Path, pose: str = WALL_BELOW_Z4, **options: str) -> subprocess.CompletedProcess[str]:
    values = {"area": "z4", "out": str(floor / "board"), "site": str(floor), **options}
    words = [word for name, value in values.items() for word in (f"--{name}", value)]
    return run("add", "n8", "--pose", pose, "--json", *words, *NETWORK)


def test_added_node_is_in_the_site_and_its_board_accepts_its_settings(floor: Path, tmp_path: Path) -> None:
    before = (floor / "site.toml").read_text("utf-8")
    done = add(floor, passwords=str(tmp_path / "passwords"))
    assert done.returncode == 0, done.stderr
    node = load_site(floor).site.nodes[-1]
    assert (node.id, node.area, node.x, node.y) == ("n8", "z4", 33.2, 38.15)
    assert not any(sonar.no_echo_is_clear for sonar in node.sonars), "what silence means, only a calibration shows"
    assert all(sonar.range_max == pytest.approx(sonar.range_limit + 0.6, abs=0.011) for sonar in node.sonars)
    assert [round(sonar.range_limit, 2) for sonar in node.sonars] == json.loads(done.stdout)["range_limit_m"]
    assert (floor / "site.toml").read_text("utf-8").startswith(before.rstrip("\n"))
    written = floor / "board" / "node.json"
    assert stat.S_IMODE(written.stat().st_mode) == 0o600
    assert stat.S_IMODE((floor / "site.toml").stat().st_mode) == 0o644
    try:
        find_compiler()
        core = Core(build_library(tmp_path / "firmware"))
    except FirmwareError as error:
        pytest.skip(str(error))
    problem, text = core["fognav_settings_problem"], written.read_bytes()
    problem.restype = ctypes.c_char_p
    assert problem(text, ctypes.c_uint32(len(text))) is None


def test_maker_is_told_at_once_of_a_node_that_hears_no_wall_and_of_a_heading_by_which_it_does(floor: Path) -> None:
    done = add(floor, "33.20,38.15,0.35")
    assert done.returncode == 0, done.stderr
    told = " ".join(done.stderr.split())
    assert "no sonar of n8 hears a wall" in told
    found = re.search(r"with --pose (33\.2,38\.15,\S+) it hears a wall", told)
    assert found is not None, told
    shutil.copy(ROOT / "sites" / "estig" / "site.toml", floor)
    again = add(floor, found[1], out=str(floor / "again"))
    assert again.returncode == 0, again.stderr
    assert "hears a wall" not in again.stderr
    assert any(sonar.range_max is not None for sonar in load_site(floor).site.nodes[-1].sonars)


@pytest.mark.parametrize(("options", "every"), [({}, False), ({"every-reading": ""}, True)])
def test_publishing_of_a_node_is_in_the_site_and_in_its_boards_settings(floor: Path, options, every) -> None:
    words = [f"--{name}" for name in options]
    done = run(
        "add", "n8", "--pose", WALL_BELOW_Z4, "--area", "z4", *NETWORK, "--out", str(floor / "board"),
        "--site", str(floor), *words,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert load_site(floor).site.nodes[-1].every_reading is every
    assert json.loads((floor / "board" / "node.json").read_bytes())["every_reading"] is every


def test_list_tells_of_each_node_what_it_says_why_and_since_when(monkeypatch) -> None:
    views = [
        {"id": "n1", "area": "z1", "state": "clear", "reason": "", "age_s": 0.42, "received": 17},
        {"id": "n2", "area": "z2", "state": "unknown", "reason": "silent", "age_s": 71.0, "received": 3},
        {"id": "n3", "area": "z2", "state": "unknown", "reason": "", "age_s": None, "received": 0},
    ]
    for found, lines in (
        (
            views,
            [
                "n1: area z1, clear, 0.4 s ago, 17 readings",
                "n2: area z2, unknown (silent), 71.0 s ago, 3 readings",
                "n3: area z2, unknown, never heard, 0 readings",
            ],
        ),
        ([], ["no nodes"]),
    ):
        fog = SimpleNamespace(
            get=lambda service, path, found=found: {AGGREGATOR: {"/api/v1/nodes": found}}[service][path]
        )
        monkeypatch.setattr(node_command, "find_fog", lambda _, fog=fog: fog)
        assert CliRunner().invoke(node_app, ["list"]).output.splitlines() == lines
        assert json.loads(CliRunner().invoke(node_app, ["list", "--json"]).stdout)["nodes"] == found


def test_node_whose_password_the_broker_cannot_get_is_not_added(floor: Path, tmp_path: Path) -> None:
    before = (floor / "site.toml").read_bytes()
    done = add(floor, passwords=str(tmp_path))
    assert done.returncode == 2
    assert f"the broker's password file {tmp_path} can't be read" in done.stderr
    assert (floor / "site.toml").read_bytes() == before
    assert not (floor / "board" / "node.json").exists()


def test_site_file_is_never_written_with_a_text_that_makes_the_site_invalid(floor: Path, monkeypatch) -> None:
    loaded = load_site(floor)
    node = loaded.site.nodes[0]
    monkeypatch.setattr(site_files, "atomic_write", lambda *_, **__: pytest.fail("the file was written"))
    with pytest.raises(WrongUseError, match=r"'n1' is used twice.*nothing was changed"):
        site_files.with_node(loaded, node)
    with pytest.raises(WrongUseError, match="nothing was changed"):
        site_files.replace(loaded, msgspec.structs.replace(node, area="nowhere"))


@pytest.mark.parametrize(
    ("pose", "options", "says"),
    [
        ("33.2,38.15,-1.5708", {}, "looks at a wall"),
        ("33.2,38.15,1.5708", {"area": "z1"}, "nothing of area z1"),
        ("33.2,38.15,1.5708", {"area": "nowhere"}, "no area 'nowhere'"),
        ("33.2,37.0,1.5708", {}, "in a wall"),
        ("-50,0,0", {}, "not on the map"),
        ("33.2,38.15", {}, "is not X,Y,THETA"),
        ("33.2,38.15,nan", {}, "is not X,Y,THETA"),
    ],
)
def test_node_that_would_be_of_no_use_is_refused_and_nothing_is_written(floor, pose, options, says) -> None:
    before = (floor / "site.toml").read_bytes()
    done = add(floor, pose, **options)
    assert done.returncode == 2
    assert says in done.stderr.replace("\n", " ")
    assert (floor / "site.toml").read_bytes() == before
    assert not (floor / "board").exists()


@pytest.fixture
def security(tmp_path: Path) -> Path:
    made = SiteSecurity(tmp_path / "locks", "estig")
    made.make(["fog.example", "192.168.7.1"])
    return made.directory


def new_board(floor: Path, *words: str) -> Result:
    command = ["add", "n8", "--pose", WALL_BELOW_Z4, "--area", "z4", "--site", str(floor), "--wifi", "Lab"]
    return CliRunner().invoke(node_app, [*command, "--out", str(floor / "board"), *words])


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--fog-host", "192.168.7.1", "--no-tls"], "--wifi-password is missing"),
        (["--wifi-password", "", "--no-tls"], "--fog-host is missing"),
        (["--wifi-password", "", "--fog-host", "fog.local", "--no-tls"], "can't look up names in .local"),
        (["--wifi-password", "", "--fog-host", "FOG.local", "--no-tls"], "can't look up names in .local"),
        (["--wifi-password", "", "--fog-host", "127.0.0.1", "--no-tls"], "that is the board itself"),
        (["--wifi-password", "", "--fog-host", "LocalHost", "--no-tls"], "that is the board itself"),
        (["--wifi-password", "", "--fog-host", "http://fog.lab", "--no-tls"], "neither a name nor an address"),
        (["--wifi-password", "", "--fog-host", "192.168.7.1:8883", "--no-tls"], "neither a name nor an address"),
        (["--wifi-password", "", "--fog-host", "192.168.7", "--no-tls"], "neither a name nor an address"),
        (["--wifi-password", "", "--fog-host", "", "--no-tls"], "neither a name nor an address"),
        (["--wifi-password", "", "--fog-host", "0.0.0.0", "--locks", "LOCKS"], "no board connects to that"),
        (["--wifi-password", "", "--fog-host", "255.255.255.255", "--locks", "LOCKS"], "no board connects to that"),
        (["--wifi-password", "", "--fog-host", "fd00::5", "--locks", "LOCKS"], "own IPv4 address"),
        (["--wifi-password", "", "--fog-host", "10.0.0.1,10.0.0.2,10.0.0.3", "--no-tls"], "knows fewer"),
        (["--wifi-password", "", "--fog-host", "10.0.0.1,localhost", "--no-tls"], "that is the board itself"),
        (["--wifi-password", "short12", "--fog-host", "192.168.7.1", "--no-tls"], "has 7 characters"),
        (["--wifi-password", "g" * 64, "--fog-host", "192.168.7.1", "--no-tls"], "has 64 characters"),
        (["--wifi", "", "--wifi-password", "", "--fog-host", "192.168.7.1", "--no-tls"], "1 to 32 bytes"),
        (["--wifi", 17 * "\u00fc", "--wifi-password", "", "--fog-host", "192.168.7.1", "--no-tls"], "1 to 32 bytes"),
        (["--pose", "33.20,38.15,90", "--wifi-password", "", "--fog-host", "192.168.7.1", "--no-tls"], "are 1.5708"),
        (["--wifi-password", "", "--fog-host", "192.168.7.1"], "nothing says whom the board shall trust"),
        (["--wifi-password", "", "--fog-host", "nobody.example", "--locks", "LOCKS"], "for fog.example, 192.168.7.1"),
        (["--wifi-password", "", "--fog-host", "192.168.7.1", "--no-tls", "--firmware", "esphome"], "TLS only"),
        (
            ["--wifi-password", "", "--fog-host", "192.168.7.2", "--locks", "LOCKS", "--firmware", "esphome"],
            "192.168.7.2 is not in the broker's certificate",
        ),
    ],
)
def test_settings_by_which_no_board_could_connect_are_refused_and_nothing_is_written(
    floor, security, words, says
) -> None:
    before = (floor / "site.toml").read_bytes()
    done = new_board(floor, *(str(security) if word == "LOCKS" else word for word in words))
    assert done.exit_code == 2
    assert says in " ".join(done.stderr.split())
    assert (floor / "site.toml").read_bytes() == before
    assert not (floor / "board").exists()


def test_what_is_missing_is_asked_for_on_a_terminal(floor: Path) -> None:
    board, terminal = pty.openpty()
    command = ["add", "n8", "--pose", WALL_BELOW_Z4, "--area", "z4", "--site", str(floor), "--wifi", "Lab", "--no-tls"]
    with subprocess.Popen(
        [sys.executable, "-m", "fognav", "node", *command, "--out", str(floor / "board")], cwd=ROOT,
        stdin=terminal, stderr=subprocess.PIPE, start_new_session=True,
    ) as process:  # fmt: skip
        assert process.stderr is not None
        for asked, answer in ((b"network Lab: ", b"se cret2\n"), (b"boards' network:", b"192.168.7.1\n")):
            said = b""
            while not said.endswith(asked):
                said += (more := process.stderr.read(1))
                assert more, said
            os.write(board, answer)
        rest = process.stderr.read()
    os.close(board)
    os.close(terminal)
    assert process.returncode == 0, rest
    written = json.loads((floor / "board" / "node.json").read_bytes())
    assert (written["wifi_password"], written["broker"]) == ("se cret2", "192.168.7.1")


@pytest.mark.parametrize("host", ["192.168.7.1", "192.168.7.9", "fog.example"])
def test_board_with_credentials_gets_a_password_and_whom_to_trust(floor: Path, security: Path, host: str) -> None:
    """An address need not be in the certificate: the firmware compares a name that is."""
    done = new_board(floor, "--wifi-password", "", "--fog-host", host, "--locks", str(security))
    assert done.exit_code == 0, done.stderr
    written = json.loads((floor / "board" / "node.json").read_bytes())
    assert (written["broker"], written["port"], written["tls"]) == (host, 8883, True)
    trusted = (floor / "board" / "ca.pem").read_text()
    assert "BEGIN CERTIFICATE" in trusted
    own = board_settings.credentials_in(floor / "board", "n8")
    assert (own.user, own.passwords["mqtt"], own.authority) == ("n8", written["password"], trusted)
    with pytest.raises(WrongUseError, match="that of node n8"):
        board_settings.credentials_in(floor / "board", "n7")


@pytest.mark.parametrize("profile", ["standard", "thesis"])
def test_board_for_esphome_gets_all_that_its_configuration_reads(floor: Path, security: Path, profile: str) -> None:
    words = ("--wifi-password", "a'b\"cdefg", "--locks", str(security), "--firmware", "esphome", "--profile", profile)
    done = new_board(floor, "--fog-host", "192.168.7.1", *words)
    assert done.exit_code == 0, done.stderr
    assert "esphome run" in done.stderr
    configuration = (floor / "board" / "fognav-node.yaml").read_text("utf-8")
    secrets = yaml.safe_load((floor / "board" / "secrets.yaml").read_text("utf-8"))
    assert stat.S_IMODE((floor / "board" / "secrets.yaml").stat().st_mode) == 0o600
    assert set(re.findall(r"!secret (\w+)", configuration)) <= set(secrets)
    assert secrets["wifi_password"] == "a'b\"cdefg"
    assert secrets["authority"] == (floor / "board" / "ca.pem").read_text()
    board = (ROOT / "firmware/lib/node_edge/src/board_pins.hpp").read_text("utf-8").split("kD1Mini32 = ")[1]
    pins = [tuple(map(int, pair)) for pair in re.findall(r"\{(\d+), (\d+)\}", board)]
    own = [(secrets[f"trigger_{number}"], secrets[f"echo_{number}"]) for number in (1, 2)]
    assert own == (pins[:2] if profile == "standard" else pins[2:4])


def test_configuration_for_esphome_uses_the_topics_and_fields_of_the_contract() -> None:
    text = (ROOT / "firmware/esphome/fognav-node.yaml").read_text("utf-8")
    topics = {topic.replace("${site}", "s").replace("${node}", "n") for topic in re.findall(r"topic: (fog/\S+)", text)}
    used = (ch.NODE_READING, ch.NODE_AVAILABILITY, ch.NODE_CONFIG, ch.NODE_COMMAND, ch.NODE_PROBLEM)
    assert topics == {channel.key(site="s", node="n") for channel in used}
    assert set(re.findall(r'root\["(\w+)"\]', text)) == {field.name for field in fields(NodeReading)} - {"rssi"}
    assert set(re.findall(r'x\["(\w+)"\]', text)) <= {field.name for field in fields(NodeConfig)}


@pytest.mark.skipif("FOGNAV_ESPHOME" not in os.environ, reason="FOGNAV_ESPHOME names no `esphome` to check with")
def test_esphome_finds_the_configuration_valid(floor: Path, security: Path) -> None:
    words = ("--wifi-password", "secret12", "--locks", str(security), "--firmware", "esphome")
    assert new_board(floor, "--fog-host", "192.168.7.1", *words).exit_code == 0
    command = [os.environ["FOGNAV_ESPHOME"], "config", str(floor / "board" / "fognav-node.yaml")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, "HOME": str(floor)})
    assert "Configuration is valid" in done.stdout + done.stderr, done.stdout + done.stderr


def test_settings_of_another_board_are_never_overwritten_by_add(floor: Path) -> None:
    (floor / "board").mkdir()
    (floor / "board" / "node.json").write_text("{}")
    before = (floor / "site.toml").read_bytes()
    done = add(floor)
    assert done.returncode == 2
    assert "another node's" in done.stderr.replace("\n", " ")
    assert (floor / "site.toml").read_bytes() == before


def test_replaced_board_has_a_new_password_and_the_same_place(floor: Path, tmp_path: Path) -> None:
    passwords = tmp_path / "passwords"
    board_settings.set_password(passwords, "n1", "old")
    words = (*NETWORK, "--site", str(floor), "--out", str(tmp_path), "--passwords", str(passwords))
    done = run("replace", "n1", *words)
    assert done.returncode == 0, done.stderr
    first = json.loads((tmp_path / "node.json").read_text())
    again = run("replace", "n1", *words)
    assert (again.returncode, "restart" in again.stdout + again.stderr) == (0, False), "the site is as it was"
    second = json.loads((tmp_path / "node.json").read_text())
    assert first["password"] != second["password"]
    assert {**first, "password": ""} == {**second, "password": ""}
    assert passwords.read_text().count("n1:") == 1
    assert run("replace", "n99", *words).returncode == 2


def test_new_board_never_takes_the_file_of_another_node(floor: Path, tmp_path: Path) -> None:
    """Its password is nowhere else: the broker has its hash only."""
    file = tmp_path / "node.json"
    for text, says in (('{"node": "n2"}', "that of node n2"), ("[]", "no node's settings")):
        file.write_text(text)
        done = run("replace", "n1", *NETWORK, "--site", str(floor), "--out", str(tmp_path))
        assert done.returncode == 2
        assert says in " ".join(done.stderr.split())
        assert file.read_text() == text


def test_password_file_keeps_its_owner_and_permissions(tmp_path: Path) -> None:
    """The broker, which reads it, is another user than who adds a node."""
    file = tmp_path / "passwords"
    board_settings.set_password(file, "n1", "first")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    owner = (1883, 1883) if os.geteuid() == 0 else (os.geteuid(), os.getegid())
    os.chown(file, *owner)
    file.chmod(0o640)
    board_settings.set_password(file, "n2", "second")
    found = file.stat()
    assert (stat.S_IMODE(found.st_mode), found.st_uid, found.st_gid) == (0o640, *owner)


def test_password_file_of_another_user_is_left_to_him(tmp_path: Path, monkeypatch) -> None:
    file = tmp_path / "passwords"
    board_settings.set_password(file, "n1", "first")
    before = file.read_bytes()
    monkeypatch.setattr(os, "geteuid", lambda: file.stat().st_uid + 1)
    with pytest.raises(WrongUseError, match="belongs to another user"):
        board_settings.set_password(file, "n2", "second")
    assert file.read_bytes() == before


LEARNED = NodeCalibration(
    boot=1,
    config_version=1,
    result=["done", "done"],
    range_limit_m=[2.7, 2.75],
    range_max_m=[3.2, 3.25],
    no_echo_is_clear=[False, False],
    no_echo_us=[0, 0],
    samples=[256, 256],
    false_echoes=[0, 2],
    no_echoes=[0, 5],
)


def test_calibration_writes_limits_and_how_likely_false_echoes_are_into_the_site(monkeypatch, floor: Path) -> None:
    answers = [LEARNED]

    told: list[object] = []

    async def learn(_url: str, _site: str, _node: str, command: str, *_: object) -> NodeCalibration:
        told.append(command)
        return answers[-1]

    monkeypatch.setattr(on_broker, "learn", learn)
    words = ["calibrate", "n1", "--site", str(floor), "--broker", "mqtt://127.0.0.1:1"]
    done = CliRunner().invoke(node_app, words)
    assert done.exit_code == 0, done.stderr
    assert "blocked below 2.75 m; of 256 samples 2 echoed from nearer, 5 not at all" in done.stderr

    def stored() -> list[tuple[float, float | None, float | None]]:
        (node,) = [node for node in load_site(floor).site.nodes if node.id == "n1"]
        return [(sonar.range_limit, sonar.range_max, sonar.false_echo_rate) for sonar in node.sonars]

    assert told == [ch.CALIBRATE, ch.KEEP]
    shares = [pytest.approx(2 / 260, abs=1e-4), pytest.approx(4 / 260, abs=1e-4)]
    assert "warning" not in done.stderr
    assert stored() == [(2.7, 3.2, shares[0]), (2.75, 3.25, shares[1])]
    # A firmware that does not count or tell them leaves what is known.
    silent = {"samples": [], "false_echoes": [], "no_echoes": [], "range_max_m": []}
    answers.append(msgspec.structs.replace(LEARNED, range_limit_m=[2.6, 2.6], **silent))
    assert CliRunner().invoke(node_app, words).exit_code == 0
    assert stored() == [(2.6, 3.2, shares[0]), (2.6, 3.25, shares[1])]


@pytest.mark.parametrize(
    ("learned", "says"),
    [
        ({"range_limit_m": [1.0, 2.7], "range_max_m": [1.5, 3.2]}, "sonar 1 hears something between 1.00 and 1.50 m"),
        ({"range_limit_m": [2.7, 4.0], "range_max_m": [3.2, 4.5]}, "sonar 2 hears something between 4.00 and 4.50 m"),
        (
            {"range_limit_m": [2.7, 4.0], "range_max_m": [3.2, 0.0], "no_echo_is_clear": [False, True]},
            "sonar 2 hears nothing, and the map has a",
        ),
    ],
    ids=["somebody stood there", "door was open", "sonar is covered"],
)
def test_calibration_that_contradicts_the_map_is_written_only_by_force(monkeypatch, floor: Path, learned, says) -> None:
    told: list[object] = []

    async def learn(_url: str, _site: str, _node: str, command: str, *_: object) -> NodeCalibration:
        told.append(command)
        return msgspec.structs.replace(LEARNED, **learned)

    monkeypatch.setattr(on_broker, "learn", learn)
    before = (floor / "site.toml").read_bytes()
    words = ["calibrate", "n1", "--site", str(floor), "--broker", "mqtt://127.0.0.1:1"]
    done = CliRunner().invoke(node_app, words)
    assert done.exit_code == 1
    assert says in " ".join(done.stderr.split())
    assert (floor / "site.toml").read_bytes() == before
    assert told == [ch.CALIBRATE], "the node keeps its old limits, too"
    assert CliRunner().invoke(node_app, [*words, "--force"]).exit_code == 0
    assert told[1:] == [ch.CALIBRATE, ch.KEEP]
    sonars = next(node for node in load_site(floor).site.nodes if node.id == "n1").sonars
    assert [sonar.range_limit for sonar in sonars] == learned["range_limit_m"]


def test_calibration_says_that_silence_alone_never_clears_an_area(monkeypatch) -> None:
    async def learn(*_: object) -> NodeCalibration:
        silent = {"range_limit_m": [4.0, 4.0], "range_max_m": [0.0, 0.0], "no_echo_is_clear": [True, True]}
        return msgspec.structs.replace(LEARNED, **silent)

    monkeypatch.setattr(on_broker, "learn", learn)
    done = CliRunner().invoke(node_app, ["calibrate", "n1", "--site-id", "estig", "--broker", "mqtt://127.0.0.1:1"])
    assert "warning: no sonar of n1 hears anything" in " ".join(done.stderr.split())


def test_calibration_warns_of_a_sonar_that_hears_more_than_the_rule_takes_into_account(monkeypatch) -> None:
    async def learn(*_: object) -> NodeCalibration:
        return msgspec.structs.replace(LEARNED, false_echoes=[7, 24])

    monkeypatch.setattr(on_broker, "learn", learn)
    done = CliRunner().invoke(node_app, ["calibrate", "n1", "--site-id", "estig", "--broker", "mqtt://127.0.0.1:1"])
    assert done.exit_code == 0, done.stderr
    said = " ".join(done.stderr.split())
    assert "warning: sonar 2 hears something in 10 % of the readings" in said
    assert "warning: sonar 1" not in said
    assert pytest.approx(learned_rates(Options())[1], abs=5e-4) == on_broker.LIKELIEST_FALSE_ECHOES


def test_board_with_another_number_of_sonars_is_told_and_not_written(monkeypatch, floor: Path) -> None:
    learned = NodeCalibration(
        boot=1, config_version=1, result=["done"], range_limit_m=[1.5], no_echo_is_clear=[False], no_echo_us=[0]
    )

    async def learn(*_: object) -> NodeCalibration:
        return learned

    monkeypatch.setattr(on_broker, "learn", learn)
    before = (floor / "site.toml").read_bytes()
    words = ["calibrate", "n1", "--site", str(floor), "--broker", "mqtt://127.0.0.1:1"]
    done = CliRunner().invoke(node_app, words)
    assert done.exit_code == 1
    assert "1 limits, and has 2 sonars" in " ".join(done.stderr.split())
    assert (floor / "site.toml").read_bytes() == before


@pytest.mark.live
def test_broker_accepts_the_stored_password_and_no_other(tmp_path: Path) -> None:
    passwords = tmp_path / "passwords"
    board_settings.set_password(passwords, "n2", "of another node")
    board_settings.set_password(passwords, "n1", "s3cret")
    board_settings.set_password(passwords, "n1", "newer")
    passwords.chmod(0o644)  # the broker may run as another user
    with start_mosquitto(tmp_path / "broker", extra=f"allow_anonymous false\npassword_file {passwords}") as server:
        codes = {}
        for password in ("newer", "s3cret"):
            client = paho.Client(CallbackAPIVersion.VERSION2, protocol=paho.MQTTv5)
            client.username_pw_set("n1", password)
            client.on_connect = lambda _c, _u, _f, code, _p, password=password: codes.update({password: code})
            client.connect("127.0.0.1", server.port)
            for _ in range(200):
                client.loop(0.1)
                if password in codes:
                    break
            client.disconnect()
    assert not codes["newer"].is_failure
    assert codes["s3cret"].is_failure


@given(
    index=st.integers(0, 6),
    limits=st.lists(st.integers(50, 400), min_size=1, max_size=3),
    silent=st.booleans(),
    after=st.sampled_from(["", "\n# the last words\n\n# about it\n[[robots]]\nid = 'r2'\n", "\n[x] # y\nz = 1"]),
)
def test_replacing_a_node_leaves_every_other_line_of_the_site(index, limits, silent, after) -> None:
    text = (ROOT / "sites" / "estig" / "site.toml").read_text("utf-8") + after
    nodes = msgspec.convert(tomllib.loads(text)["nodes"], list[NodeSite])
    sonars = [
        Sonar(range_limit=limit / 100, range_max=None if silent else (limit + 50) / 100, no_echo_is_clear=silent)
        for limit in limits
    ]
    nodes[index] = msgspec.structs.replace(nodes[index], sonars=sonars)
    changed = site_files.replaced(text, nodes[index])
    assert changed is not None
    found, before = tomllib.loads(changed), tomllib.loads(text)
    assert msgspec.convert(found.pop("nodes"), list[NodeSite]) == nodes
    before.pop("nodes")
    assert found == before
    comments = [line for line in text.splitlines() if line.startswith("#")]
    assert [line for line in changed.splitlines() if line.startswith("#")] == comments


def test_node_in_a_table_of_another_form_is_not_touched() -> None:
    node = NodeSite(id="n1", area="z1", x=0.0, y=0.0, theta=0.0, sonars=[Sonar(range_limit=1.0)])
    assert site_files.replaced('nodes = [{ id = "n1", area = "z1" }]\n', node) is None


def test_sonar_that_failed_leaves_its_node_all_its_limits(monkeypatch) -> None:
    told: list[object] = []

    async def learn(_url: str, _site: str, _node: str, command: str, *_: object) -> NodeCalibration:
        told.append(command)
        return msgspec.structs.replace(LEARNED, result=["unsteady", "done"])

    monkeypatch.setattr(on_broker, "learn", learn)
    done = CliRunner().invoke(node_app, ["calibrate", "n1", "--site-id", "estig", "--broker", "mqtt://127.0.0.1:1"])
    assert done.exit_code == 1
    assert "keeps its old limits: sonar 1 measured something that moved" in " ".join(done.stderr.split())
    assert told == [ch.CALIBRATE]


class OlderNode:
    """A node on a real broker whose firmware is of before the command `keep`: what it learns counts at once."""

    def __init__(self, port: int, learned: NodeCalibration) -> None:
        self.commands: list[str] = []
        self._learned = learned
        self._client = paho.Client(CallbackAPIVersion.VERSION2, protocol=paho.MQTTv5)
        self._client.on_message = self._on_message
        self._client.connect("127.0.0.1", port)
        heard = threading.Event()
        self._client.on_subscribe = lambda *_: heard.set()
        self._client.subscribe(ch.NODE_COMMAND.key(site="estig", node="n1"), qos=1)
        self._client.loop_start()
        assert heard.wait(10.0)

    def _on_message(self, client: paho.Client, _: object, message: paho.MQTTMessage) -> None:
        command = message.payload.decode()
        self.commands.append(command)
        if command == ch.CALIBRATE:
            told = encode(ch.NODE_CALIBRATION, self._learned)
            client.publish(ch.NODE_CALIBRATION.key(site="estig", node="n1"), told, qos=1, retain=True)
        else:
            words = "this firmware does not know the command: it knows calibrate and learn-no-echo"
            client.publish(ch.NODE_PROBLEM.key(site="estig", node="n1"), words, qos=1, retain=True)

    def end(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()


@pytest.mark.live
def test_node_of_before_the_command_keep_has_taken_what_it_learned_and_the_command_says_so(tmp_path, floor) -> None:
    with start_mosquitto(tmp_path / "broker") as server:
        words = ["calibrate", "n1", "--site", str(floor), "--broker", server.url]
        node = OlderNode(server.port, LEARNED)
        accepted = CliRunner().invoke(node_app, words)
        node.end()
        assert node.commands == [ch.CALIBRATE, ch.KEEP]
        before = (floor / "site.toml").read_bytes()
        node = OlderNode(
            server.port, msgspec.structs.replace(LEARNED, range_limit_m=[1.0, 2.7], range_max_m=[1.5, 3.2])
        )
        declined = CliRunner().invoke(node_app, words)
        node.end()
    assert accepted.exit_code == 0, accepted.stderr
    assert "older firmware: what it learned counts already" in " ".join(accepted.stderr.split())
    sonars = next(node for node in load_site(floor).site.nodes if node.id == "n1").sonars
    assert [sonar.range_limit for sonar in sonars] == LEARNED.range_limit_m
    assert (declined.exit_code, (floor / "site.toml").read_bytes()) == (1, before)
    assert "has taken what it learned at once: calibrate it again" in " ".join(declined.stderr.split())


@pytest.mark.live
async def test_node_that_does_not_answer_and_broker_that_is_not_there_are_said(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(on_broker, "CALIBRATION_S", 0.5)
    refusal = pytest.raises(FailedError, match=r"n1 did not answer .*fognav node list")
    with start_mosquitto(tmp_path / "broker") as server, refusal:
        await on_broker.learn(server.url, "estig", "n1", "calibrate")
    with pytest.raises(FailedError, match="can't be used"):
        await on_broker.learn(server.url, "estig", "n1", "calibrate")


def test_who_watches_a_node_that_says_nothing_is_told_what_to_look_at(monkeypatch):
    async def nothing(*_):
        await asyncio.sleep(0.1)
        for reading in ():
            yield reading

    monkeypatch.setattr(on_broker, "readings", nothing)
    monkeypatch.setattr(node_command, "_SILENT_S", 0.0)
    done = CliRunner().invoke(node_app, ["watch", "n99", "--site-id", "estig", "--broker", "mqtt://127.0.0.1:1"])
    assert "nothing was heard from n99 yet: is that its id (fognav node list)" in done.output
