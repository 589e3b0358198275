"""`fognav bridge` and `fognav up --bridge`: what can't be used is refused before anything starts, with the remedy."""

import re
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fognav.__main__ import app
from fognav.commands import bridge

ROOT = Path(__file__).parents[2]
HOME = 'adapters = "home-assistant"\nhome_assistant_credentials_file = "ha.toml"\n'
FLEET = 'adapters = "vda5050"\nvda5050_mqtt_url = "mqtt://fleet.local"\n'
NETWORK = 'home_assistant_mqtt_url = "mqtt://ha.local"\n'


def checked(tmp_path, text: str, *command: str) -> tuple[int, str]:
    file = tmp_path / "bridge.toml"
    file.write_text(text)
    (tmp_path / "ha.toml").write_text('user = "fognav"\n[passwords]\nmqtt = "secret"\n')
    done = CliRunner().invoke(app, [*(command or ("bridge", "--check")), str(file)])
    return done.exit_code, done.output


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "setting adapters is missing"),
        ('adapters = "home-asistant"', "'home-asistant' is none. Name one or several of: home-assistant"),
        ('adapters = "ros2"', "ros2_router names where `rmw_zenohd` listens"),
        ('adapters = "ros2"\nros2_router = "here"', "here can't be used to reach ROS's router"),
        ('adapters = "vda5050"', "vda5050_mqtt_url names the fleet control's broker"),
        (FLEET, "names who takes part"),
        (FLEET + 'vda5050_robots = "r1, +"', "'+' is no robot's id"),
        (FLEET + 'vda5050_zones = "kit"', "'kit' is not MANUFACTURER/SERIAL"),
        (FLEET + 'vda5050_robots = "r1"\nvda5050_credentials_file = "ha.toml"', "vda5050_unencrypted = true"),
        ('adapters = "home-assistant"\nurl = "x"', "unknown setting 'url'"),
        (HOME + NETWORK, "everybody in the network could read the password"),
        (HOME + NETWORK.replace("//", "//fognav:secret@"), "which no log shows"),
        (HOME.replace("ha.toml", "other.toml") + NETWORK, "other.toml can't be read"),
    ],
)
def test_settings_that_can_not_be_used_are_refused_with_the_remedy(tmp_path, text, reason):
    code, said = checked(tmp_path, text)
    assert (code, reason in said.replace("\n", " ")) == (2, True), said


@pytest.mark.parametrize(
    "text",
    [
        'adapters = "home-assistant"',
        HOME + NETWORK.replace("mqtt:", "mqtts:"),
        HOME + NETWORK + "home_assistant_unencrypted = true",
    ],
)
def test_password_leaves_this_computer_encrypted_or_where_somebody_has_said_that_it_may_be_read(tmp_path, text):
    code, said = checked(tmp_path, text)
    assert code == 0, said


def test_nothing_starts_with_a_bridge_that_can_not_run(tmp_path, monkeypatch):
    code, said = checked(tmp_path, "", "up", "--data", str(tmp_path / "data"), "--bridge")
    assert (code, "adapters is missing" in said) == (2, True), said
    assert not (tmp_path / "data").exists()
    monkeypatch.setattr(bridge, "find_spec", lambda _: None)
    code, said = checked(tmp_path, HOME)
    assert (code, "install the package fog-bridges" in said) == (1, True), said


def test_adapter_without_its_packages_names_the_file_of_their_pins(tmp_path, monkeypatch):
    (tmp_path / "rosbags.py").write_text("raise ImportError('there is none')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    code, said = checked(tmp_path, 'adapters = "ros2"\nros2_router = "tcp/192.168.7.5:7447"')
    named = re.search(r"-r (requirements/\S+)", said.replace("\n", " "))
    assert (code, named is not None) == (2, True), said
    assert (ROOT / named[1]).is_file()


def test_bridges_that_end_without_a_word_are_told_of_with_how_they_ended(tmp_path, monkeypatch):
    monkeypatch.setattr(bridge, "_COMMAND", (sys.executable, "-c", "import os; os.kill(os.getpid(), 9)"))
    code, said = checked(tmp_path, HOME)
    assert (code, "ended without a word, by signal 9 (Killed)" in said.replace("\n", " ")) == (1, True), said
