"""The files of `deploy/robot`: what the robot knows by them, and that its units guard the wheels."""

from __future__ import annotations

import configparser
import os
import re
import shutil
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import guardian_rig as rigs
import pytest
from guardian_rig import wait_for

from fog_contracts.messages import Pose
from fog_runtime.configuration.robot_file import load_robot
from fog_runtime.configuration.settings import SettingsError, load
from robot_agent.agent.settings import Settings, read_given
from robot_agent.config import agent_config
from robot_agent.registry import make_lidar

ROOT = Path(__file__).parents[3]
DEPLOY = ROOT / "deploy/robot"
UNITS = ["fognav-watchdog.service", "fognav-agent.service"]
PYTHON = "/opt/fognav/venv/bin/python"

NO_EXECUTABLE_MEMORY = """
import ctypes, os, sys
assert ctypes.CDLL(None).prctl(65, 1, 0, 0, 0) == 0, "PR_SET_MDWE"
os.execv(sys.executable, [sys.executable, "-c", sys.argv[1]])
"""
LOADS_ALL = """
import mmap
import robot_agent.guardian.__main__, robot_agent.guardian.stop_base
from fog_runtime.configuration.robot_file import default_robot
from robot_agent.registry import make_base, signatures
make_base(default_robot()), signatures()
try:
    mmap.mmap(-1, 4096, prot=mmap.PROT_WRITE | mmap.PROT_EXEC)
except PermissionError:
    print("loaded")
"""


SITE = """
id = "lab"
[[robots]]
id = "r1"
start = { x = 3.0, y = 4.0, theta = 0.5 }
dock = { x = 1.0, y = 4.0, theta = 3.1 }
radius = 0.30
height = 0.9
"""


@pytest.fixture(autouse=True)
def site_file(tmp_path):
    """The fog node's file, which the installer is given."""
    (tmp_path / "fog-node-site.toml").write_text(SITE)
    return tmp_path / "fog-node-site.toml"


@pytest.fixture
def installed(tmp_path):
    """The files as the installer writes them, below a folder."""
    robot_file, key = tmp_path / "robot.toml", tmp_path / "key"
    robot_file.write_text('[base]\ndriver = "roomba600"\n[lidar]\ndriver = "rplidar-a1"\nport = "/dev/pts/7"\n')
    key.write_text("ab" * 32)
    root = tmp_path / "root"
    install(root, "--robot-file", str(robot_file), "--key", str(key))
    return root


def install(root, *more):
    site = root.parent / "fog-node-site.toml"
    command = [DEPLOY / "install", "--robot", "r1", "--site", site, "--fog", "fog.local", "--root", str(root), *more]
    return subprocess.run(command, check=True, capture_output=True, text=True)


def entries(unit, name):
    return re.findall(rf"^{name}=(.*)$", unit.read_text(), re.MULTILINE)


def environment(root):
    lines = (root / "etc/fognav/robot.env").read_text().splitlines()
    return dict(line.split("=", 1) for line in lines if line and not line.startswith("#"))


def environment_below(root):
    """The variables of an installation below a folder: what they name lies there."""
    return {name: f"{root}{text}" if text.startswith("/etc/") else text for name, text in environment(root).items()}


def configured(root):
    """The agent's configuration, as its process makes it of the installed files and nothing else."""
    environ = environment_below(root)
    settings, robot = load(Settings, environ=environ), load_robot(environ)
    given = read_given(settings, robot)
    config = agent_config(
        settings.robot,
        given.operator_key,
        given.base.drive_train,
        make_lidar(robot).traits,
        given.body,
        boot="1",
        footprint=given.footprint,
        settings=robot.settings,
    )
    return given, config


def test_the_kernel_knows_the_device_classes_of_the_units_before_a_plug_loads_their_modules(installed):
    loaded = (installed / "etc/modules-load.d/fognav.conf").read_text().split()
    built_in = {"char-ttyAMA"}  # the board's own port
    modules = {"char-ttyUSB": "usbserial", "char-ttyACM": "cdc_acm", "char-video4linux": "videodev"}
    for unit in UNITS:
        allowed = {entry.split()[0] for entry in entries(installed / "etc/systemd/system" / unit, "DeviceAllow")}
        assert {modules[name] for name in allowed - built_in} <= set(loaded)


def test_installed_files_have_no_placeholder_left_and_are_not_writable_by_others(installed):
    files = [path for path in installed.rglob("*") if path.is_file()]
    assert len(files) == 12
    for path in files:
        assert not re.search(r"@[A-Z]+@", path.read_text()), path
        assert not path.stat().st_mode & 0o022
    assert (installed / "etc/fognav/operator.key").stat().st_mode & 0o077 == 0, "nor by who drives by hand"
    # A fallback with others behind it: the fog node need not serve time, and must not replace a server that does.
    servers = entries(installed / "etc/systemd/timesyncd.conf.d/fognav.conf", "FallbackNTP")[0].split()
    assert servers[0] == "fog.local"
    assert len(servers) > 1
    assert entries(installed / "etc/systemd/timesyncd.conf.d/fognav.conf", "NTP") == []


def test_robot_tries_for_ever_to_be_back_on_its_network(installed):
    """By default NetworkManager pauses for minutes after four failed tries."""
    read = configparser.ConfigParser()
    read.read_string((installed / "etc/NetworkManager/conf.d/fognav.conf").read_text())
    assert read["main"]["autoconnect-retries-default"] == "0"
    assert read["connection"] == {"wifi.powersave": "2", "connection.auth-retries": "0"}


def test_a_second_installation_keeps_what_was_changed_on_the_robot(installed):
    env, toml = installed / "etc/fognav/robot.env", installed / "etc/fognav/robot.toml"
    env.write_text(env.read_text() + "FOGNAV_SEED=9\n")
    before = toml.read_text()
    install(installed)
    assert environment(installed)["FOGNAV_SEED"] == "9"
    assert toml.read_text() == before


def test_a_second_installation_with_credentials_lets_the_robot_through_a_secured_router(installed, tmp_path):
    env, credentials = installed / "etc/fognav/robot.env", tmp_path / "r1.toml"
    env.write_text(env.read_text() + "FOGNAV_SEED=9\n")
    credentials.write_text("")
    assert environment(installed)["FOGNAV_ZENOH_CONNECT"] == "tcp/fog.local:7447"
    install(installed, "--credentials", str(credentials))
    found = environment(installed)
    assert found["FOGNAV_ZENOH_CONNECT"] == "tls/fog.local:7447"
    assert found["FOGNAV_CREDENTIALS_FILE"] == "/etc/fognav/credentials.toml"
    assert found["FOGNAV_SEED"] == "9"


class Update:
    """The installer on a machine of stand-ins: a copy whose folders are below `home`, and commands that write a log."""

    def __init__(self, home, *, state="active", pip_fails=False):
        self.log, self.wheels, commands = home / "log", home / "wheels", home / "bin"
        shutil.copytree(DEPLOY, home / "deploy/robot")
        script = home / "deploy/robot/install"
        script.write_text(re.sub(r"(?<!here)/(opt|etc|var|usr/local)/", rf"{home}/\1/", script.read_text()))
        (home / "usr/local/bin").mkdir(parents=True)
        for folder in (commands, self.wheels, home / "opt/fognav/venv/bin"):
            folder.mkdir(parents=True)
        answers = {
            "id": "[ $1 != -u ] || echo 0",
            "dpkg": "exit 1",
            "systemctl": f"[ $1 != is-active ] || echo {state}",
            **dict.fromkeys(("python3", "udevadm", "runuser", "install"), "true"),
        }
        for name, answer in answers.items():
            self._command(commands / name, answer)
        self._command(home / "opt/fognav/venv/bin/python", f"exit {int(pip_fails)}")
        arguments = ["--robot", "r1", "--site", home / "fog-node-site.toml", "--fog", "f", "--wheels", str(self.wheels)]
        environ = {**os.environ, "PATH": f"{commands}:{os.environ['PATH']}"}
        self.done = subprocess.run([script, *arguments], check=False, capture_output=True, text=True, env=environ)

    def _command(self, path, answer):
        path.write_text(f'#!/bin/sh\necho "{path.name} $*" >>{self.log}\n{answer}\n')
        path.chmod(0o755)

    @property
    def steps(self):
        """What stopped services and installed packages, in order."""
        lines = self.log.read_text().splitlines()
        return [line for line in lines if line.startswith("systemctl stop") or " pip " in line]


def test_an_update_stops_the_services_before_it_replaces_their_packages(tmp_path):
    update = Update(tmp_path)
    assert update.done.returncode == 0, update.done.stderr
    assert update.steps[:2] == ["systemctl stop fognav-agent.service", "systemctl stop fognav-watchdog.service"]
    assert all(" install " in step for step in update.steps[2:])
    assert "stopping fognav-watchdog.service for the update" in update.done.stderr


def test_a_first_installation_stops_nothing(tmp_path):
    assert "systemctl stop" not in "".join(Update(tmp_path, state="inactive").steps)


def test_an_update_that_fails_says_that_the_robot_is_stopped(tmp_path):
    update = Update(tmp_path, state="activating", pip_fails=True)
    assert update.done.returncode == 1
    assert "fognav-agent.service and fognav-watchdog.service stopped" in update.done.stderr


def test_wheels_replace_packages_of_the_same_version(tmp_path):
    update = Update(tmp_path)
    dependencies, members = update.steps[2:]
    assert dependencies.endswith(f"--find-links {update.wheels} --upgrade fognav-cli")
    assert sorted(members.partition("--force-reinstall ")[2].split()) == sorted(needed_by("cli"))


def needed_by(member) -> set[str]:
    """The members that one needs without its extras, itself among them."""
    files = [file for pattern in ("libs/*", "services/*", "*") for file in ROOT.glob(f"{pattern}/pyproject.toml")]
    projects = {file.parent.name: tomllib.loads(file.read_text())["project"] for file in files}
    of_name = {project["name"]: project for project in projects.values()}
    found, left = set(), [projects[member]["name"]]
    while left:
        name = left.pop()
        found.add(name)
        needs = (re.match(r"[\w-]+", need)[0] for need in of_name[name]["dependencies"])
        left += [need for need in needs if need in of_name and need not in found]
    return found


def test_installer_builds_every_member_that_a_robots_computer_needs():
    built = re.search(r"for folder in (.*)\n", (DEPLOY / "install").read_text())[1].split()
    assert {Path(folder).name if folder != "cli" else "fognav-cli" for folder in built} == needed_by("cli")


def test_a_robot_without_a_fog_is_installed_with_its_settings_only_and_joins_a_fog_later(tmp_path, site_file):
    root, toml = tmp_path / "bare", tmp_path / "bare.toml"
    toml.write_text('[base]\ndriver = "roomba600"\n[lidar]\ndriver = "rplidar-a1"\n[body]\nradius_m = 0.21\n')
    command = [DEPLOY / "install", "--robot", "r1", "--root", str(root), "--robot-file", str(toml)]
    subprocess.run([*command, "--fog", "none"], check=True)
    environ = environment_below(root)
    assert "FOGNAV_ZENOH_CONNECT" not in environ
    given = read_given(load(Settings, environ=environ), load_robot(environ))
    assert given.body.radius == pytest.approx(0.21, rel=0.01)
    install(root)
    joined = environment(root)
    assert joined["FOGNAV_ZENOH_CONNECT"] == "tcp/fog.local:7447"
    assert "FOGNAV_FOG" not in joined
    refused = subprocess.run([*command, "--fog", "none", "--site", site_file], check=False, capture_output=True)
    assert refused.returncode == 1
    assert b"name it by --fog" in refused.stderr
    refused = subprocess.run([*command, "--fog", "none"], check=False, capture_output=True)
    assert refused.returncode == 1
    assert b"this robot has a fog by" in refused.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["--robot"],
        ["--robot", "r 1", "--site", "s", "--fog", "f"],
        ["--what", "x"],
        ["--robot", "r1", "--site", "lab", "--fog", "f"],
    ],
)
def test_the_installer_refuses_wrong_arguments(arguments):
    done = subprocess.run([DEPLOY / "install", *arguments], check=False, capture_output=True, text=True)
    assert done.returncode != 0
    assert "usage" in done.stderr or "fognav:" in done.stderr


def test_the_variables_are_settings_that_the_processes_accept(installed):
    environ = environment_below(installed)
    settings = load(Settings, environ=environ)
    assert (settings.robot, settings.zenoh_endpoints) == ("r1", ["tcp/fog.local:7447"])
    assert load_robot(environ).settings.lidar.port == "/dev/pts/7"


def test_address_of_ipv6_is_in_brackets_before_the_router_s_port_and_not_as_the_name_of_a_clock(tmp_path):
    root = tmp_path / "root"
    for _ in range(2):  # the second finds it there
        install(root, "--fog", "fd00::7")
    assert environment(root)["FOGNAV_ZENOH_CONNECT"] == "tcp/[fd00::7]:7447"
    assert "FallbackNTP=fd00::7 " in (root / "etc/systemd/timesyncd.conf.d/fognav.conf").read_text()


def test_installed_robot_knows_its_body_start_and_dock_from_the_sites_file(installed):
    given, config = configured(installed)
    assert (given.site, given.body.start) == ("lab", Pose(x=3.0, y=4.0, theta=0.5))
    assert (config.radius, config.height) == (0.30, 0.9)
    assert config.footprint.inscribed_radius == pytest.approx(0.30)
    assert config.motion.inflation.inscribed_radius == 0.30
    assert config.dock == Pose(x=1.0, y=4.0, theta=3.1)


def test_another_installation_brings_the_site_of_today_to_a_robot_that_had_none(installed, site_file):
    env, site = installed / "etc/fognav/robot.env", installed / "etc/fognav/site/site.toml"
    env.write_text(env.read_text().replace("FOGNAV_SITE_DIR=/etc/fognav/site", "FOGNAV_SITE=lab"))
    site.unlink()
    with pytest.raises(SettingsError, match="FOGNAV_SITE_DIR is not set, so this robot's body"):
        configured(installed)
    site_file.write_text(SITE.replace("0.30", "0.25"))
    install(installed)
    assert configured(installed)[1].radius == 0.25
    assert environment(installed)["FOGNAV_SITE"] == "lab"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (SITE.replace("radius = 0.30", ""), "the entry of r1 has no `radius`, so nobody knows its body: add how far"),
        (SITE.replace('"r1"', '"r2"'), "has no [[robots]] entry with the id r1: add it"),
        (SITE.replace("[[robots]]", "[[robots"), "fog-node-site.toml: "),
    ],
)
def test_installer_refuses_a_robot_whose_body_its_site_does_not_say_and_replaces_nothing(
    installed, site_file, text, problem
):
    site_file.write_text(text)
    with pytest.raises(subprocess.CalledProcessError) as refused:
        install(installed)
    assert problem in refused.value.stderr
    assert configured(installed)[1].radius == 0.30


def test_installer_does_not_call_a_robot_by_another_id_than_its_own(installed, site_file):
    site_file.write_text(SITE + SITE[SITE.index("[[robots]]") :].replace('"r1"', '"r2"').replace("0.30", "0.20"))
    with pytest.raises(subprocess.CalledProcessError) as refused:
        install(installed, "--robot", "r2")
    assert "this is r1 by" in refused.value.stderr
    assert "correct FOGNAV_ROBOT there" in refused.value.stderr


def test_installer_refuses_another_fog_than_the_robot_connects_to_and_replaces_nothing(installed, site_file):
    site_file.write_text(SITE.replace("0.30", "0.25"))
    with pytest.raises(subprocess.CalledProcessError) as refused:
        install(installed, "--fog", "192.168.7.1")
    assert "this robot connects to tcp/fog.local:7447 by" in refused.value.stderr
    assert "and not to 192.168.7.1: correct FOGNAV_ZENOH_CONNECT there" in refused.value.stderr
    assert configured(installed)[1].radius == 0.30
    env = installed / "etc/fognav/robot.env"
    both = "tls/fog.local:7447,tls/192.168.7.1:7447"
    env.write_text(env.read_text().replace("tcp/fog.local:7447", both))
    install(installed, "--fog", "192.168.7.1")
    assert environment(installed)["FOGNAV_ZENOH_CONNECT"] == both


def test_installer_takes_the_files_that_the_robot_has_already(installed, tmp_path):
    etc = installed / "etc/fognav"
    for name in ("operator.key", "credentials.toml"):
        (etc / name).write_text("its own")
    given = ("--site", "site/site.toml"), ("--robot-file", "robot.toml"), ("--key", "operator.key")
    credentials = ("--credentials", str(etc / "credentials.toml"))
    before = {name: (etc / name).read_text() for _, name in given}
    install(installed, *(word for option, name in given for word in (option, str(etc / name))), *credentials)
    assert {name: (etc / name).read_text() for _, name in given} == before
    assert {(etc / name).stat().st_mode & 0o777 for name in ("operator.key", "credentials.toml")} == {0o400}


def test_installed_agent_does_not_start_without_its_body(installed):
    (installed / "etc/fognav/site/site.toml").unlink()
    done = subprocess.run(
        [sys.executable, "-m", "robot_agent"],
        env={**os.environ, **environment_below(installed)},
        check=False,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 1
    assert "site/site.toml can't be read: No such file or directory. Copy the fog node's site.toml there" in done.stderr


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_systemd_accepts_the_units(installed, tmp_path):
    folder = tmp_path / "units"
    folder.mkdir()
    for name in UNITS:
        unit = (installed / "etc/systemd/system" / name).read_text()
        (folder / name).write_text(unit.replace(PYTHON, sys.executable))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", "--recursive-errors=no", *(str(folder / name) for name in UNITS)],
        check=False,
        capture_output=True,
        text=True,
    )
    assert (done.returncode, [line for line in done.stderr.splitlines() if "fognav" in line]) == (0, [])


@pytest.mark.skipif(shutil.which("udevadm") is None, reason="needs udevadm")
def test_udev_accepts_the_rules(installed):
    rules = installed / "etc/udev/rules.d/60-fognav.rules"
    done = subprocess.run(["udevadm", "verify", str(rules)], check=False, capture_output=True, text=True)
    if "Unknown command" in done.stderr or "unrecognized" in done.stderr:
        pytest.skip("this udevadm has no verify")
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_watchdog_is_protected_and_the_agent_may_compile():
    watchdog, agent = (DEPLOY / "systemd" / name for name in UNITS)
    assert entries(watchdog, "Restart") == entries(agent, "Restart") == ["always"]
    assert entries(watchdog, "RestartPreventExitStatus") == ["78"]
    assert int(entries(watchdog, "OOMScoreAdjust")[0]) < int(entries(agent, "OOMScoreAdjust")[0]) < 0
    assert entries(watchdog, "LimitMEMLOCK") == ["infinity"]
    assert entries(watchdog, "MemoryDenyWriteExecute") == ["yes"]
    assert entries(agent, "MemoryDenyWriteExecute") == []
    # The guardian's own real-time priority (10) lies below the watchdog's, within the limit.
    assert 10 < int(entries(watchdog, "CPUSchedulingPriority")[0]) <= int(entries(watchdog, "LimitRTPRIO")[0])
    for unit in (watchdog, agent):
        assert {"char-ttyUSB rw", "char-ttyACM rw"} <= set(entries(unit, "DeviceAllow"))
        assert entries(unit, "DevicePolicy") == ["closed"]
    assert "After" not in watchdog.read_text(), "the watchdog waits for nothing"


def test_the_watchdog_can_not_read_the_operators_key():
    watchdog, agent = (DEPLOY / "systemd" / name for name in UNITS)
    assert entries(watchdog, "UnsetEnvironment") == ["FOGNAV_OPERATOR_KEY_FILE"]
    assert entries(watchdog, "InaccessiblePaths") == ["-/etc/fognav/operator.key"]
    assert entries(agent, "InaccessiblePaths") == []


def test_watchdog_and_guardian_load_without_executable_memory():
    done = subprocess.run(
        [sys.executable, "-c", NO_EXECUTABLE_MEMORY, LOADS_ALL], check=False, capture_output=True, text=True, timeout=60
    )
    if "PR_SET_MDWE" in done.stderr:
        pytest.skip("this kernel has no PR_SET_MDWE")
    assert done.stdout == "loaded\n", done.stderr


@pytest.mark.live
def test_the_units_commands_guard_a_base_and_stop_it_after_the_watchdog_is_killed(installed, tmp_path):
    unit = installed / "etc/systemd/system/fognav-watchdog.service"
    (start,), (afterwards,) = entries(unit, "ExecStart"), entries(unit, "ExecStopPost")
    with rigs.Base(tmp_path / "base") as base:
        environ = {**os.environ, **environment_below(installed), "FOGNAV_BASE_PORT": str(base.link)}
        environ["FOGNAV_GUARDIAN_SOCKET"] = str(tmp_path / "guardian.sock")
        with (tmp_path / "log").open("wb") as log:
            watchdog = subprocess.Popen(start.replace(PYTHON, sys.executable).split(), env=environ, stderr=log)
            try:
                with rigs.Agent(tmp_path / "guardian.sock") as agent:
                    agent.wheels = (0.3, 0.3)
                    wait_for(lambda: base.speeds == (0.3, 0.3), "the base drives")
                    children = Path(f"/proc/{watchdog.pid}/task/{watchdog.pid}/children").read_text().split()
                    # The worst case: both die at once, and the base rolls on.
                    watchdog.send_signal(signal.SIGSTOP)
                    os.kill(int(children[0]), signal.SIGKILL)
                    watchdog.kill()
                    watchdog.wait()
                assert base.speeds == (0.3, 0.3)
                done = subprocess.run(
                    afterwards.replace(PYTHON, sys.executable).split(),
                    env=environ,
                    check=False,
                    capture_output=True,
                    text=True,
                )
                assert done.returncode == 0, done.stderr
                wait_for(lambda: base.speeds == (0.0, 0.0), "the base stops")
            finally:
                watchdog.kill()
                watchdog.wait()
        assert '"memory": "' in (tmp_path / "log").read_text()
        missing = subprocess.run(
            afterwards.replace(PYTHON, sys.executable).split(),
            env={**environ, "FOGNAV_BASE_PORT": str(tmp_path / "nowhere")},
            check=False,
            capture_output=True,
            text=True,
        )
        assert missing.returncode == 1
        assert "stop_failed" in missing.stderr


def test_robot_with_credentials_connects_encrypted_and_one_without_does_not(tmp_path):
    credentials = tmp_path / "r1.toml"
    credentials.write_text('user = "r1"\n')
    install(tmp_path / "locked", "--credentials", str(credentials))
    env = (tmp_path / "locked/etc/fognav/robot.env").read_text()
    assert "FOGNAV_ZENOH_CONNECT=tls/fog.local:7447\n" in env
    assert "FOGNAV_CREDENTIALS_FILE=/etc/fognav/credentials.toml\n" in env
    copied = tmp_path / "locked/etc/fognav/credentials.toml"
    assert copied.read_text() == 'user = "r1"\n'
    assert copied.stat().st_mode & 0o007 == 0
    install(tmp_path / "open")
    env = (tmp_path / "open/etc/fognav/robot.env").read_text()
    assert "FOGNAV_ZENOH_CONNECT=tcp/fog.local:7447\n" in env
    assert "FOGNAV_CREDENTIALS_FILE=\n" in env
