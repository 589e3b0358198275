"""The whole firmware of the board on this computer, in simulated time, behind stand-ins for the board's libraries."""

import asyncio
import configparser
import hashlib
import json
import shutil
import subprocess
from contextlib import asynccontextmanager, suppress
from functools import partial
from pathlib import Path
from queue import Empty, Queue
from threading import Event, Thread
from urllib.request import urlopen

import msgspec
import numpy as np
import paho.mqtt.client as paho
import pytest
import zenoh
from typer.testing import CliRunner

from fog_contracts import channels as ch
from fog_contracts.codec import decode, encode
from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.messages import (
    AreaHazard,
    MapDelta,
    NodeCalibration,
    NodeConfig,
    NodeReading,
    NodeUpdate,
    NodeValue,
)
from fog_runtime.configuration.maps import save_map
from fog_runtime.transports.zenoh_edge import session_config
from fog_supervisor.servers import start_mosquitto
from fognav.commands.node import node_app
from fognav.programs import AGGREGATOR, MAP_SERVICE
from fognav.stack import Stack, StackConfig

# Compiled once, not by each worker of a parallel run.
pytestmark = pytest.mark.xdist_group("firmware-board")

# Of the cryptographic library that each board's core brings along: a header, and how a program is linked with it. The
# stand-in for the second stack is asked before a signature is checked.
WRAPPED = "-Wl,--wrap=br_ecdsa_i15_vrfy_asn1"
CRYPTOGRAPHY = {
    "esp8266": ("bearssl/bearssl.h", ["-lbearssl", WRAPPED]),
    "esp32": ("mbedtls/ecdsa.h", ["-lmbedcrypto"]),
}
ENVIRONMENTS = {"esp8266": "d1_mini", "esp32": "d1_mini32"}
NO_CRYPTOGRAPHY = "no {}, or no openssl: apt-get install libbearssl-dev libmbedtls-dev openssl"
BOARDS = {"esp8266": ("ESP8266", [(14, 5), (12, 4)]), "esp32": ("ESP32", [(18, 22), (19, 21)])}
SETTINGS = {
    "site": "lab", "node": "n1", "wifi_name": "net", "wifi_password": "secret", "broker": "fog.lan", "tls": False,
    "port": 1883, "user": "n1", "every_reading": True, "sonars": [{"range_limit_m": 1.5}, {"range_limit_m": 2}],
}  # fmt: skip
PEM = "-----BEGIN CERTIFICATE----- MIIB -----END CERTIFICATE-----"


@pytest.fixture(scope="session")
def programs(firmware, compiler, built):
    """The firmware of each board as a program of this computer."""
    folder, counted = built
    warnings = ("-Wall", "-Wextra", "-Wshadow", "-Werror")
    checked = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    for board, (macro, _) in BOARDS.items():
        stand_ins = [] if cryptography(board) else ["host/board/crypto"]
        folders = ["src", "lib/node_core/src", "lib/node_edge/src", "host/board", *stand_ins]
        files = [str(file) for source in folders for file in sorted((firmware / source).glob("*.cpp"))]
        includes = [f"-I{firmware / source}" for source in ("include", *folders[1:])]
        number = "-DFOGNAV_FIRMWARE_NUMBER=firmware_number()"
        options = [f"-D{macro}", '-DFOGNAV_FIRMWARE="test"', number, *flags(firmware, board), "-std=gnu++17"]
        options += [*warnings, *checked, *counted]
        command = [compiler, *options, *includes, *files, *cryptography(board), "-o", str(folder / board)]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    return {board: folder / board for board in BOARDS}


def flags(firmware, board):
    """Return what a board's own environment of platformio.ini defines."""
    found = configparser.ConfigParser(interpolation=None)
    found.read(firmware / "platformio.ini")
    text = found.get(f"env:{ENVIRONMENTS[board]}", "build_flags", fallback="")
    return [word for word in text.split() if word.startswith("-D")]


def cryptography(board):
    """How a board's program is linked with the real library, if that is installed here."""
    header, options = CRYPTOGRAPHY[board]
    return options if Path("/usr/include", header).is_file() and shutil.which("openssl") else []


def openssl(folder, *arguments, text=None):
    return subprocess.run(["openssl", *arguments], cwd=folder, input=text, check=True, capture_output=True).stdout


def make_key(folder, name):
    """Return the public key of a new private one, as `update_key` takes it."""
    openssl(folder, "ecparam", "-name", "prime256v1", "-genkey", "-noout", "-out", name)
    return openssl(folder, "ec", "-in", name, "-pubout", "-outform", "DER")[-65:].hex()


class Board:
    """A board that is switched on: it runs as long as a test lets time pass, and tells what it does."""

    def __init__(self, program, pins, flash, **world):
        self.pins = pins
        self.flash = flash
        self._process = subprocess.Popen(
            [program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env={"FLASH": str(flash), "ASAN_OPTIONS": "detect_leaks=0", **world},
        )  # fmt: skip
        self.restarted = False
        self.started = self._read()

    def _read(self):
        lines = []
        for line in self._process.stdout:
            if line == "done\n":
                return lines
            lines.append(line.rstrip("\n"))
        self.restarted = "restart" in lines
        assert self.restarted, f"it ended without a restart: {lines[-5:]}"
        return lines

    def tell(self, *lines):
        """Return what the firmware does upon these lines."""
        found = []
        for line in lines:
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()
            found += self._read()
            if self.restarted:
                break
        return found

    def run(self, seconds):
        return self.tell(f"run {round(seconds * 1000)}")

    def measures(self, *millimetres):
        """Let the sonars measure these ranges from now on."""
        pairs = zip(self.pins, millimetres, strict=True)
        self.tell(*(f"sonar {trigger} {echo} {metres}" for (trigger, echo), metres in pairs))

    def send(self, channel, message):
        text = message if isinstance(message, str) else encode(channel, message).decode()
        self.tell(f"message {channel.key(site='lab', node='n1')} {text}")

    def close(self):
        self._process.communicate(timeout=60)  # the end of its input ends it


@pytest.fixture
def switch_on(programs, tmp_path):
    boards = []

    def switch_on(settings=None, board="esp8266", authority=None, **world):
        if settings is not None:
            Path(tmp_path / "node.json").write_text(json.dumps(settings))
        if authority is not None:
            Path(tmp_path / "ca.pem").write_text(authority)
        world = {"RANDOM_BITS": str(4 + len(boards)), **world}
        boards.append(Board(programs[board], BOARDS[board][1], tmp_path, **world))
        return boards[-1]

    yield switch_on
    for each in boards:
        each.close()


def published(lines, channel, kind=None, **ids):
    """Return the messages of a channel among what the firmware did."""
    topic = channel.key(**(ids or {"site": "lab", "node": "n1"}))
    texts = []
    for line in lines:
        found, _, rest = line.removeprefix("publish ").partition("|")
        if line.startswith("publish ") and found == topic:
            qos, retained, text = rest.split("|", 2)
            assert (int(qos), bool(int(retained))) == (channel.qos, channel.retained)
            texts.append(text if kind is None else decode(channel, text.encode(), kind))
    return texts


@pytest.mark.parametrize("kind", BOARDS)
def test_node_joins_connects_announces_itself_and_publishes_what_it_measures(switch_on, kind):
    board = switch_on(SETTINGS, kind)
    board.measures(1000, 3000)
    lines = board.run(5)
    assert board.started[:4] == [
        "server fog.lan 1883", "client node-lab-n1", "user n1", "will fog/v1/lab/nodes/n1/availability 1 1 offline",
    ]  # fmt: skip
    assert lines[:2] == ["join net", "connect"]
    assert [f"subscribe {row.key(site='lab', node='n1')} 1" in lines for row in (
        ch.NODE_CONFIG, ch.NODE_COMMAND, ch.NODE_UPDATE)] == [True] * 3  # fmt: skip
    assert published(lines, ch.NODE_AVAILABILITY) == ["online"]
    assert published(lines, ch.NODE_PROBLEM) == [""]
    last = published(lines, ch.NODE_READING, NodeReading)[-1]
    assert last.range_m == [pytest.approx(1.0, abs=0.005), pytest.approx(3.0, abs=0.005)]
    assert (last.status, last.state, last.rssi, last.fw) == (["ok", "ok"], "blocked", -60, "test")


def test_node_comes_back_after_a_loss_and_announces_itself_again(switch_on):
    board = switch_on(SETTINGS)
    board.measures(3000, 3000)
    board.run(5)
    board.tell("broker 0")
    assert published(board.run(20), ch.NODE_READING)[1:] == []
    board.tell("broker 1")
    lines = board.run(40)
    assert published(lines, ch.NODE_AVAILABILITY) == ["online"]
    assert len(published(lines, ch.NODE_READING)) > 20
    board.tell("network 0")
    board.run(20)
    board.tell("network 1")
    assert published(board.run(60), ch.NODE_AVAILABILITY) == ["online"]


def test_node_of_a_floor_with_two_brokers_tries_both_in_turn(switch_on):
    board = switch_on({**TLS, "broker": "nowhere.lan", "second_broker": "fog.lan"}, authority=PEM)
    board.tell("certificate fog.lan")
    lines = board.run(30)
    assert [line for line in lines if line.startswith("server")] == ["server fog.lan 8883"]
    assert "time from fog.lan" in lines
    assert "serial connected to the broker at fog.lan" in lines
    board.tell("broker 0", "run 20000", "broker 1")
    lines = board.run(60)
    assert "server nowhere.lan 8883" in lines
    assert "serial connected to the broker at fog.lan" in lines


def test_board_restarts_after_ten_minutes_without_a_broker(switch_on):
    board = switch_on(SETTINGS)
    board.tell("broker 0")
    board.run(590)
    assert not board.restarted
    board.run(20)
    assert board.restarted


@pytest.mark.parametrize("kind", BOARDS)
def test_node_is_back_after_an_hour_without_its_access_point(switch_on, kind):
    """It tries again and again, and restarts every ten minutes, for a radio may hang: neither ever ends."""
    board = switch_on(SETTINGS, kind)
    board.run(5)
    joined, seconds = 0, 0
    board.tell("network 0")
    while seconds < 3600:
        joined += board.run(30).count("join net")
        seconds += 30
        if board.restarted:
            board = switch_on(None, kind)
            board.tell("network 0")
    assert joined > 60, "once a minute at the least"
    board.tell("network 1")
    assert published(board.run(60), ch.NODE_AVAILABILITY) == ["online"]


@pytest.mark.parametrize("kind", BOARDS)
def test_encrypted_node_trusts_its_authority_alone_and_asks_the_fog_for_the_time(switch_on, kind):
    settings = {key: value for key, value in SETTINGS.items() if key not in {"tls", "port"}}
    board = switch_on(settings, kind, PEM)
    assert board.started[:2] == ["trust", "server fog.lan 8883"]
    board.tell("certificate fog.lan")
    assert ("watchdog" in board.started) == (kind == "esp32")  # an ESP8266's watches by itself
    lines = board.run(5)
    assert "time from fog.lan" in lines
    assert published(lines, ch.NODE_AVAILABILITY) == ["online"]


TLS = {key: value for key, value in SETTINGS.items() if key not in {"tls", "port"}}


@pytest.mark.parametrize("settings", [SETTINGS, TLS], ids=["plain", "tls"])
def test_memory_that_an_esp8266_has_beside_its_radio_suffices(switch_on, settings):
    board = switch_on(settings, authority=PEM, HEAP="18000")
    board.tell("certificate fog.lan")
    lines = board.run(5)
    assert published(lines, ch.NODE_AVAILABILITY) == ["online"]
    assert len(published(lines, ch.NODE_READING)) > 20


def test_messages_that_find_no_memory_are_told_and_no_node_is_connected_and_silent(switch_on):
    board = switch_on(SETTINGS)
    board.run(5)
    board.tell("heap 3000")
    assert [line for line in board.run(5) if line.startswith("serial")] == [
        "serial no message can be sent: 3000 bytes of memory are free in one piece, and 4096 are kept"
    ]
    board.tell("broker 0", "run 5000", "broker 1")
    lines = board.run(30)
    assert "serial connected to the broker at fog.lan" in lines
    assert not published(lines, ch.NODE_AVAILABILITY)
    board.tell("heap 9000")
    lines = board.run(60)
    assert "serial messages can be sent again: 9000 bytes of memory are free in one piece, and 4096 are kept" in lines
    assert published(lines, ch.NODE_AVAILABILITY) == ["online"]


@pytest.mark.parametrize("kind", BOARDS)
def test_node_that_is_told_an_address_checks_the_name_that_every_broker_of_ours_has(switch_on, kind):
    board = switch_on({**TLS, "broker": "192.168.7.1"}, kind, PEM)
    board.tell("certificate 192.168.7.1")  # as an address, which neither library compares
    assert not published(board.run(60), ch.NODE_AVAILABILITY)
    board.tell(f"certificate {ch.BROKER_NAME}")
    lines = board.run(60)
    assert f"verified {ch.BROKER_NAME}" in lines
    assert published(lines, ch.NODE_AVAILABILITY) == ["online"]


def test_name_that_an_esp8266_cannot_look_up_is_refused(switch_on):
    settings = {**SETTINGS, "broker": "fog.local"}
    assert "serial broker is a name in .local, which this board can't look up: give the fog node's address" in (
        switch_on(settings).started
    )
    assert published(switch_on(settings, "esp32").run(5), ch.NODE_AVAILABILITY) == ["online"]


@pytest.mark.parametrize("kind", BOARDS)
@pytest.mark.parametrize("settings", [SETTINGS, TLS], ids=["plain", "tls"])
def test_host_that_is_silent_resets_no_board(switch_on, settings, kind):
    board = switch_on({**settings, "broker": "192.168.7.1"}, kind, PEM)
    board.tell("broker silent")
    lines = board.run(120)
    assert not board.restarted
    assert any("nobody answers at 192.168.7.1" in line for line in lines)
    board.tell("broker 1")
    assert published(board.run(60), ch.NODE_AVAILABILITY) == ["online"]


@pytest.mark.parametrize("kind", BOARDS)
def test_fresh_board_without_a_file_system_opens_its_portal(switch_on, kind):
    assert "network fognav-c0ffee" in switch_on(board=kind, FRESH="1").started


@pytest.mark.parametrize("kind", BOARDS)
@pytest.mark.parametrize(
    ("change", "world", "words"),
    [
        ({}, "wifi absent", "Wi-Fi network net was not joined: there is none of this name here"),
        ({}, "network 0", "Wi-Fi network net was not joined: is it in reach, and wifi_password right?"),
        ({"broker": "nowhere.lan"}, "broker 1", "the name nowhere.lan is not known in this network"),
        ({}, "broker 0", "nobody answers at fog.lan, port 8883"),
        ({}, "broker silent", "nobody answers at fog.lan, port 8883"),
        ({}, "authority theirs", "Is ca.pem that of the fog node's authority"),
        ({}, "certificate other.lan", "is its certificate for fog.lan (fognav ca issue)?"),
        ({}, "broker 5", "the broker refuses the node's user or password"),
        ({}, "broker 4", "the broker refuses the node's user or password"),
        ({}, "broker 3", "the broker can't serve the node now"),
        ({"tls": False}, "broker ends", "do port and tls of node.json fit together?"),
        ({}, "broker 1", "connected to the broker at fog.lan"),
    ],
)
def test_serial_port_says_in_words_what_is_wrong(switch_on, kind, change, world, words):
    board = switch_on({**TLS, **change}, kind, PEM)
    board.tell("certificate fog.lan", world)
    spoken = [line for line in board.run(60) if line.startswith(("serial", "  "))]
    assert any(words in line for line in spoken), spoken
    assert ("connected to the broker" in "".join(spoken)) == (words.startswith("connected"))


def test_esp8266_tells_a_wrong_password_of_the_network_and_a_lost_connection(switch_on):
    board = switch_on(SETTINGS)
    board.tell("wifi secret")
    assert "serial the Wi-Fi network net was not joined: wifi_password of node.json is wrong" in board.run(60)
    board.tell("wifi reachable", "run 60000", "broker 0")
    assert "serial the connection to the broker was lost" in board.run(10)


def test_configuration_counts_and_one_that_is_refused_is_told(switch_on):
    board = switch_on(SETTINGS)
    board.measures(1000, 3000)
    board.run(5)
    board.send(ch.NODE_CONFIG, NodeConfig(version=1, range_limit_m=[0.5, 0.5], no_echo_is_clear=[False, False]))
    assert published(board.run(2), ch.NODE_READING, NodeReading)[-1].state == "clear"
    board.send(ch.NODE_CONFIG, NodeConfig(version=2, range_limit_m=[0.5], no_echo_is_clear=[False]))
    assert published(board.run(1), ch.NODE_PROBLEM) == ["range_limit_m is for another number of sonars"]
    board.send(ch.NODE_CONFIG, NodeConfig(version=3, range_limit_m=[2.0, 2.0], no_echo_is_clear=[False, False]))
    lines = board.run(2)
    assert published(lines, ch.NODE_PROBLEM) == [""]
    assert published(lines, ch.NODE_READING, NodeReading)[-1].state == "blocked"


def learned(board, command=ch.CALIBRATE, *, keep=True):
    """Return what a board has learned, and whether it was told to keep that."""
    board.send(ch.NODE_COMMAND, command)
    lines = board.run(45)
    (report,) = published(lines, ch.NODE_CALIBRATION, NodeCalibration)
    assert not any("calibration.json" in line for line in lines)
    if keep:
        board.send(ch.NODE_COMMAND, ch.KEEP)
        lines = board.run(1)
        assert "write /calibration.json" in lines
        assert published(lines, ch.NODE_CALIBRATION, NodeCalibration) == [report]
    return report


def test_calibration_on_command_is_stored_reported_and_outlives_a_restart(switch_on):
    board = switch_on(SETTINGS)
    board.measures(1000, -1)
    board.run(5)
    report = learned(board)
    assert (report.result, report.no_echo_is_clear) == (["done", "done"], [False, True])
    assert report.range_limit_m == [pytest.approx(0.8, abs=0.01), 4.0]
    assert published(board.run(1), ch.NODE_READING, NodeReading)[-1].state == "clear"
    board.close()
    again = switch_on()
    again.measures(1000, -1)
    lines = again.run(5)
    assert published(lines, ch.NODE_CALIBRATION, NodeCalibration) == [report]
    assert published(lines, ch.NODE_READING, NodeReading)[-1].state == "clear"


def test_calibration_that_nobody_keeps_counts_neither_now_nor_after_a_restart(switch_on):
    board = switch_on(SETTINGS)
    board.measures(1000, -1)
    board.run(5)
    learned(board, keep=False)
    assert published(board.run(2), ch.NODE_READING, NodeReading)[-1].state == "blocked"
    board.close()
    again = switch_on()
    again.measures(1000, -1)
    assert published(again.run(5), ch.NODE_READING, NodeReading)[-1].state == "blocked"
    again.send(ch.NODE_COMMAND, ch.KEEP)
    assert "no calibration to keep" in published(again.run(1), ch.NODE_PROBLEM)[0]


def test_another_configuration_ends_a_calibration_though_the_one_of_before_comes_back_after_a_power_cut(switch_on):
    board = switch_on(SETTINGS)
    board.measures(1000, 3000)
    before = NodeConfig(version=1, range_limit_m=[1.5, 1.5], no_echo_is_clear=[False, False])
    board.send(ch.NODE_CONFIG, before)
    board.run(5)
    learned(board)
    assert published(board.run(2), ch.NODE_READING, NodeReading)[-1].state == "clear"
    board.send(ch.NODE_CONFIG, msgspec.structs.replace(before, version=2, range_limit_m=[1.6, 1.6]))
    lines = board.run(2)
    assert "remove /calibration.json" in lines
    assert published(lines, ch.NODE_CALIBRATION) == [""]
    assert published(lines, ch.NODE_READING, NodeReading)[-1].state == "blocked"
    board.close()
    again = switch_on()
    again.measures(1000, 3000)
    again.send(ch.NODE_CONFIG, before)
    assert published(again.run(5), ch.NODE_READING, NodeReading)[-1].state == "blocked"


def test_what_a_clone_says_for_no_echo_outlives_other_limits_and_a_restart(switch_on):
    board = switch_on(SETTINGS)
    board.measures(400, 400)
    config = NodeConfig(version=1, range_limit_m=[1.5, 1.5], no_echo_is_clear=[False, False])
    board.send(ch.NODE_CONFIG, config)
    board.run(5)
    assert learned(board, ch.LEARN_NO_ECHO).no_echo_us == [pytest.approx(2330, abs=20)] * 2
    board.send(ch.NODE_CONFIG, msgspec.structs.replace(config, version=2))
    board.run(2)
    board.close()
    again = switch_on()
    again.measures(400, 400)
    assert published(again.run(5), ch.NODE_READING, NodeReading)[-1].status == ["no_echo", "no_echo"]


@pytest.mark.parametrize(
    ("field", "forgotten"), [("node n2", True), ("range_limit_m_0 1.4", True), ("wifi_name x", False)]
)
def test_board_that_is_set_up_as_another_node_forgets_its_calibration(switch_on, field, forgotten):
    board = switch_on({**SETTINGS, "button": 13})
    board.measures(1000, 3000)
    board.run(5)
    learned(board)
    board.tell("pin 13 0", "run 3500", "pin 13 1")
    lines = board.tell(f"field {field}", "request /settings", "run 10")
    assert "write /node.json" in lines
    assert ("remove /calibration.json" in lines) == forgotten
    settings = json.loads((board.flash / "node.json").read_text())
    assert settings["button"] == 13
    assert len(settings["sonars"]) == 2


def test_portal_of_a_node_with_a_certificate_asks_for_no_other_one(switch_on):
    board = switch_on({**SETTINGS, "tls": True, "button": 13}, authority=PEM)
    board.run(5)
    board.tell("pin 13 0", "run 3500", "pin 13 1")
    lines = board.tell("field wifi_name other", "request /settings", "run 10")
    assert [line for line in lines if line.startswith("write")] == ["write /node.json"]
    assert (board.flash / "ca.pem").read_text() == PEM


def test_command_that_is_not_known_is_told(switch_on):
    board = switch_on(SETTINGS)
    board.run(5)
    board.send(ch.NODE_COMMAND, "dance")
    assert "does not know" in published(board.run(1), ch.NODE_PROBLEM)[0]


def test_thesis_topic_home_assistant_and_values_are_options(switch_on):
    values = [{"kind": "temperature", "sensor": "ds18b20", "pin": 13}, {"kind": "gas", "sensor": "analog"}]
    board = switch_on({**SETTINGS, "thesis_area": 4, "home_assistant": True, "values": values})
    board.measures(1000, 3000)
    board.tell("celsius 30.5", "analog 512")
    lines = board.run(6)
    assert set(published(lines, ch.THESIS_AREA, number="4")) == {"blocked"}
    (description,) = published(lines, ch.HOME_ASSISTANT, node="n1")
    assert json.loads(description)["dev"]["ids"] == "fognav-lab-n1"
    found = {(value.kind, value.value, value.unit) for value in published(lines, ch.NODE_VALUE, NodeValue)}
    assert found == {("temperature", 30.5, "C"), ("gas", 1.651, "V")}
    board.tell("celsius -127")
    assert {value.kind for value in published(board.run(3), ch.NODE_VALUE, NodeValue)} == {"gas"}


@pytest.mark.parametrize(
    ("sensor", "says", "range_m"),
    [
        ({"sensor": "ds18b20", "pin": 13}, "celsius 30.5", 1.018),  # sound is faster than at 20 degrees
        ({"sensor": "ds18b20", "pin": 13}, "celsius 85", 1.0),  # what it says when it was without power
        ({"sensor": "analog", "full_scale_v": 60}, "analog 512", 1.0),  # 30 volts, whatever their name
    ],
)
def test_ranges_follow_the_temperature_that_a_thermometer_measures_where_people_live(switch_on, sensor, says, range_m):
    board = switch_on({**SETTINGS, "values": [{"kind": "temperature", **sensor}]})
    board.measures(1000, 3000)
    board.tell(says)
    last = published(board.run(30), ch.NODE_READING, NodeReading)[-1]
    assert last.range_m[0] == pytest.approx(range_m, abs=0.004)


@pytest.mark.parametrize("sensor", ["vl53l0x", "vl53l1x"])
def test_rangers_share_the_bus_and_measure(switch_on, sensor):
    each = {"sensor": sensor, "range_limit_m": 1}
    board = switch_on({**SETTINGS, "sonars": [{**each, "shutdown": 14}, each]})
    board.tell("range 640")
    lines = board.started + board.run(5)
    # The one without a pin leaves the common address before the other wakes up.
    assert lines[:3] == ["i2c 4 5", f"ranger {sensor} at 49", f"ranger {sensor} at 48"]
    last = published(lines, ch.NODE_READING, NodeReading)[-1]
    assert (last.range_m, last.state) == ([0.64, 0.64], "blocked")


def test_node_without_settings_opens_a_portal_and_is_set_up_there(switch_on):
    board = switch_on()
    assert "network fognav-c0ffee" in board.started
    assert "answer 200 <!doctype html><html lang=en>" in board.tell("request /", "run 10")[0]
    assert board.tell("request /generate_204", "run 10") == ["header Location http://192.168.4.1/", "answer 302 "]
    fields = {"site": "lab", "node": "n1", "wifi_name": "net", "tls": "1", "range_limit_m_0": "1.5"}
    board.tell(*(f"field {name} {text}" for name, text in fields.items()))
    assert board.tell("request /settings", "run 10") == [
        "answer 400 broker is missing: the name or address of the fog node"
    ]
    board.tell("field broker fog.lan")
    assert "answer 400 ca.pem is missing" in board.tell("request /settings", "run 10")[0]
    board.tell(f"field authority {PEM}")
    lines = board.tell("request /settings", "run 10")
    assert lines[:3] == [
        "write /ca.pem",
        "write /node.json",
        "answer 200 Saved. The node restarts and joins your network.",
    ]
    assert board.restarted
    again = switch_on()
    again.pins = again.pins[:1]
    again.tell("certificate fog.lan")
    again.measures(1000)
    assert published(again.run(5), ch.NODE_AVAILABILITY) == ["online"]


@pytest.mark.parametrize("text", ["", "{}", "x" * 3000])
def test_node_with_damaged_settings_says_so_and_opens_a_portal(switch_on, tmp_path, text):
    Path(tmp_path / "node.json").write_text(text)
    board = switch_on()
    assert board.started[0].startswith("serial ")
    assert "network fognav-c0ffee" in board.started


def test_button_held_for_three_seconds_opens_the_portal_until_nobody_uses_it(switch_on):
    board = switch_on({**SETTINGS, "button": 13})
    board.run(5)
    assert not any(line.startswith("network") for line in board.tell("pin 13 0", "run 2500", "pin 13 1", "run 1000"))
    assert "network fognav-c0ffee" in board.tell("pin 13 0", "run 3500", "pin 13 1")
    board.run(590)
    assert not board.restarted
    board.run(20)
    assert board.restarted


def test_update_with_a_signature_that_is_not_good_is_told_and_fetches_nothing(switch_on):
    board = switch_on({**SETTINGS, "update_key": "04" + "ab" * 64})
    board.run(5)
    update = NodeUpdate(
        number=9, board="d1-mini", size=1000, sha256="ab" * 32, signature="3006020101020101", url="http://fog/n1.bin"
    )
    board.send(ch.NODE_UPDATE, update)
    assert published(board.run(2), ch.NODE_PROBLEM) == [
        "the update is not signed by the key in update_key of node.json"
    ]


IMAGE = bytes(range(256)) * 40
NAMES = {"esp8266": "d1-mini", "esp32": "d1-mini32"}


def signed_update(folder, board, key="key.pem", image=IMAGE, **change):
    """Return an update to this image, signed as the README says."""
    digest, number = hashlib.sha256(image).hexdigest(), 2
    text = f"fognav-firmware\n{NAMES[board]}\n{number}\n{len(image)}\n{digest}\n"
    signature = openssl(folder, "dgst", "-sha256", "-sign", key, text=text.encode()).hex()
    update = NodeUpdate(
        number=number, board=NAMES[board], size=len(image), sha256=digest, signature=signature, url="http://fog/n1.bin"
    )
    return msgspec.structs.replace(update, **change)


@pytest.fixture(params=BOARDS)
def updatable(request, switch_on, tmp_path):
    """A board with the key of `key.pem`, and its name."""
    if not cryptography(request.param):
        pytest.skip(NO_CRYPTOGRAPHY.format(CRYPTOGRAPHY[request.param][0]))
    board = switch_on({**SETTINGS, "update_key": make_key(tmp_path, "key.pem")}, request.param)
    board.measures(3000, 3000)
    board.run(5)
    return board, request.param


def test_signed_update_is_installed_while_the_node_goes_on_measuring(updatable, switch_on, tmp_path):
    board, kind = updatable
    (tmp_path / "served").write_bytes(IMAGE)
    board.send(ch.NODE_UPDATE, signed_update(tmp_path, kind))
    lines = board.run(60)
    assert [line for line in lines if line.split()[0] in {"fetch", "flash", "write", "restart"}] == [
        "fetch http://fog/n1.bin", "write /update.txt", "flash complete", "restart",
    ]  # fmt: skip
    assert (tmp_path / "flashed").read_bytes() == IMAGE
    again = switch_on(board=kind, FIRMWARE_NUMBER="2")
    again.run(5)
    again.send(ch.NODE_UPDATE, signed_update(tmp_path, kind))  # retained: it comes again with each connection
    lines = again.run(60)
    assert not any(line.startswith("fetch") for line in lines)
    assert not any(published(lines, ch.NODE_PROBLEM))


def test_update_that_did_not_stay_is_told(updatable, switch_on, tmp_path):
    """The board of before runs again, as after a trial that failed; the offer is still there."""
    board, kind = updatable
    (tmp_path / "served").write_bytes(IMAGE)
    board.send(ch.NODE_UPDATE, signed_update(tmp_path, kind))
    board.run(60)
    again = switch_on(board=kind, FIRMWARE_NUMBER="1")
    again.run(5)
    again.send(ch.NODE_UPDATE, signed_update(tmp_path, kind))
    lines = again.run(60)
    assert not any(line.startswith("fetch") for line in lines)
    assert "was installed and did not stay" in published(lines, ch.NODE_PROBLEM)[0]


def test_esp32_keeps_a_new_image_once_it_has_reached_the_broker(switch_on):
    board = switch_on(SETTINGS, "esp32")
    board.tell("broker silent")
    assert "image kept" not in board.started + board.run(60)
    board.tell("broker 1")
    assert "image kept" in board.run(60)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"number": 3}, "not signed by the key"),
        ({"size": len(IMAGE) + 1}, "not signed by the key"),
        ({"sha256": "ab" * 32}, "not signed by the key"),
        ({"signature": "3006020101020101"}, "not signed by the key"),
        ({"signature": "00" * 72}, "not signed by the key"),
        ({"number": 1}, None),  # that of what runs
    ],
)
def test_update_that_differs_from_what_was_signed_is_refused(updatable, tmp_path, change, words):
    board, kind = updatable
    board.send(ch.NODE_UPDATE, signed_update(tmp_path, kind, **change))
    lines = board.run(2)
    problems = published(lines, ch.NODE_PROBLEM)
    assert problems == [] if words is None else words in problems[0]
    assert not any(line.startswith("fetch") for line in lines)


def test_update_signed_by_another_key_is_refused(updatable, tmp_path):
    board, kind = updatable
    make_key(tmp_path, "other.pem")
    board.send(ch.NODE_UPDATE, signed_update(tmp_path, kind, key="other.pem"))
    assert "not signed by the key" in published(board.run(2), ch.NODE_PROBLEM)[0]


@pytest.mark.parametrize(
    ("served", "words"),
    [(None, "does not answer"), (IMAGE[:-1], "does not answer"), (IMAGE[:-1] + b"x", "not what was signed")],
)
def test_image_that_differs_from_what_was_signed_is_not_started(updatable, tmp_path, served, words):
    board, kind = updatable
    if served is not None:
        (tmp_path / "served").write_bytes(served)
    board.send(ch.NODE_UPDATE, signed_update(tmp_path, kind))
    lines = board.run(60)
    assert words in published(lines, ch.NODE_PROBLEM)[0]
    assert "flash complete" not in lines
    assert not board.restarted
    assert not (tmp_path / "update.txt").exists()


def pass_on(lines, client):
    """Publish on a real broker what the firmware publishes."""
    for line in lines:
        if line.startswith("publish "):
            topic, qos, retained, text = line.removeprefix("publish ").split("|", 3)
            client.publish(topic, text, int(qos), bool(int(retained)))


class Bridge(Thread):
    """Passes messages between a board and a real broker, and the image that the board will fetch, until `ended`."""

    def __init__(self, port, restart, folder):
        super().__init__(daemon=True)
        self.ended = Event()
        self.boards = [restart()]
        self._restart, self._folder = restart, folder
        self._inbox = Queue()
        self._client = paho.Client(paho.CallbackAPIVersion.VERSION2)
        self._client.on_message = lambda _client, _data, message: self._inbox.put(message.payload.decode())
        self._client.connect("127.0.0.1", port)
        self._client.subscribe(ch.NODE_UPDATE.key(site="lab", node="n1"), 1)
        self._client.loop_start()

    def run(self):
        while not self.ended.is_set():
            if self.boards[-1].restarted:
                self.boards.append(self._restart(FIRMWARE_NUMBER="2"))
                self.boards[-1].measures(3000, 3000)
            pass_on(self.boards[-1].run(0.5), self._client)
            with suppress(Empty):
                self._deliver(self._inbox.get(timeout=0.1))
        self._client.loop_stop()

    def _deliver(self, text):
        if text:
            with urlopen(json.loads(text)["url"], timeout=60) as answer:
                (self._folder / "served").write_bytes(answer.read())
        self.boards[-1].send(ch.NODE_UPDATE, text)


GAS = """
id = "lab"
map = "map.yaml"
[[areas]]
id = "kitchen"
polygon = [[1.0, 1.0], [3.0, 1.0], [3.0, 2.0], [1.0, 2.0]]
[[nodes]]
id = "n1"
area = "kitchen"
x = 2.0
y = 0.1
theta = 1.57
sonars = [{ range_limit = 1.5 }, { range_limit = 2.0 }]
[[sources]]
id = "gas"
area = "kitchen"
quantity = { node = "n1", kind = "gas" }
number = { above = 2.0, hysteresis = 0.3 }
"""


@asynccontextmanager
async def fog_with_a_gas_sensor(folder):
    """Yield the port of a broker, with aggregator and map-service, and the hazards and deltas that they publish."""
    folder.mkdir()
    (folder / "site.toml").write_text(GAS)
    save_map(folder / "map", StaticMap(GridGeometry(80, 60, 0.05, 0.0, 0.0), np.zeros((60, 80), np.uint8)))
    hazards, causes = [], []
    async with Stack(StackConfig(site_dir=folder, robot="none", extra={"HAZARDS_WAIT_S": "0"})) as stack:
        await stack.start_servers()
        with zenoh.open(session_config("client", connect=[stack.zenoh_endpoint])) as session:
            session.declare_subscriber(
                ch.MAP_DELTA.key(site="lab"),
                lambda sample: causes.extend(decode(ch.MAP_DELTA, sample.payload.to_bytes(), MapDelta).causes),
            )
            client = paho.Client(paho.CallbackAPIVersion.VERSION2)
            client.on_message = lambda _client, _data, got: hazards.append(
                decode(ch.AREA_HAZARD, got.payload, AreaHazard)
            )
            client.connect("127.0.0.1", stack.mqtt_port)
            client.subscribe(ch.AREA_HAZARD.key(site="lab", area="kitchen"), 1)
            client.loop_start()
            for name in (AGGREGATOR, MAP_SERVICE):
                stack.supervisor.start(name)
            await stack.supervisor.wait_ready([AGGREGATOR, MAP_SERVICE], 90)
            yield client, hazards, causes
            client.loop_stop()


@pytest.mark.live
async def test_gas_that_a_board_measures_becomes_a_hazard_with_hysteresis_and_changes_the_map(switch_on, tmp_path):
    """Its sensor's volts pass the converter, the firmware, a real broker, the aggregator and the map-service."""
    values = [{"kind": "gas", "sensor": "analog", "full_scale_v": 3.3}]
    board = switch_on({**SETTINGS, "values": values})
    board.measures(3000, 3000)
    async with fog_with_a_gas_sensor(tmp_path / "site") as (client, hazards, causes):

        async def measured_until(counts, reached):
            board.tell(f"analog {counts}")
            async with asyncio.timeout(60):
                while not reached():
                    pass_on(board.run(1), client)
                    await asyncio.sleep(0.1)

        await measured_until(400, lambda: hazards and hazards[-1].state == "clear")
        await measured_until(700, lambda: hazards[-1].state == "blocked")
        assert hazards[-1].cause == "source gas: 2.258 is above 2"
        await measured_until(700, lambda: ("hazard", "kitchen", "blocked") in {(c.kind, c.id, c.state) for c in causes})
        before = len(hazards)
        for counts in (560, 700):  # 1.81 V: below the limit, within the hysteresis
            board.tell(f"analog {counts}")
            pass_on(board.run(2), client)
        await measured_until(400, lambda: hazards[-1].state == "clear")
        assert {hazard.state for hazard in hazards[before:-1]} <= {"blocked"}


@pytest.fixture(params=[("esp32", []), ("esp8266", ["--board", "d1-mini"])], ids=["D1 mini 32", "D1 mini"])
def bridge(request, switch_on, tmp_path):
    """A board whose `update_key` is that of `key.pem`, on a real broker; and how to update it from the command line."""
    kind, options = request.param
    if not cryptography(kind):
        pytest.skip(NO_CRYPTOGRAPHY.format(CRYPTOGRAPHY[kind][0]))
    made = CliRunner().invoke(node_app, ["key", str(tmp_path / "key.pem")])
    assert made.exit_code == 0, made.output
    (tmp_path / "node.json").write_text(json.dumps({**SETTINGS, "update_key": made.output.strip()}))
    (tmp_path / "firmware.bin").write_bytes(IMAGE)
    with start_mosquitto(tmp_path / "broker") as broker:
        bridge = Bridge(broker.port, partial(switch_on, board=kind), tmp_path)
        bridge.start()

        def update(number, key="key.pem"):
            words = ["update", "n1", "--image", str(tmp_path / "firmware.bin"), "--number", str(number)]
            words += ["--key", str(tmp_path / key), "--broker", f"mqtt://127.0.0.1:{broker.port}", "--site-id", "lab"]
            return CliRunner().invoke(node_app, [*words, *options, "--seconds", "60"])

        yield bridge, update
        bridge.ended.set()
        bridge.join()


@pytest.mark.live
def test_command_updates_a_node_over_a_real_broker_and_withdraws_the_offer(bridge, tmp_path):
    board, update = bridge
    done = update(2)
    assert done.exit_code == 0, done.output
    assert "node n1 has started anew, with firmware test" in done.output
    assert (tmp_path / "flashed").read_bytes() == IMAGE
    assert len(board.boards) == 2
    refused = update(1)
    assert refused.exit_code == 1
    assert "node n1 was not updated: the update is older than what runs" in refused.output
    make_key(tmp_path, "other.pem")
    refused = update(3, "other.pem")
    assert "not signed by the key in update_key" in refused.output
    assert len(board.boards) == 2
