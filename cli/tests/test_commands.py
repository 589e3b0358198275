import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fog_contracts import channels as ch
from fog_runtime.record import Recorder
from fognav import checkout, doctor, recording, system
from fognav.__main__ import app
from fognav.commands import installed
from fognav.operate.systems import System
from fognav.output import WrongUseError

runner = CliRunner()


@pytest.fixture(autouse=True)
def _warm_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Refusals don't depend on the kernels, whose check takes seconds; it has tests of its own."""
    monkeypatch.setattr("fognav.kernels.warm_cache", lambda _print_line: None)


@pytest.mark.parametrize(
    "command",
    [
        ["doctor"],
        ["test"],
        ["channels"],
        ["docs"],
        ["demo"],
        ["site", "new"],
        ["site", "check"],
        ["record"],
        ["replay"],
        ["status"],
        ["bench", "fleet"],
        ["bench", "floor"],
        ["bench", "robot"],
        ["bench", "reactions"],
        ["bench", "mutation"],
        ["bench", "rest"],
        ["area", "list"],
        ["backup"],
        ["restore"],
        ["store", "status"],
        ["store", "restore"],
        ["store", "accept"],
        ["area", "override"],
        ["area", "history"],
        ["alert", "list"],
        ["alert", "acknowledge"],
        *(["token", name] for name in ("create", "list", "revoke")),
        *(["zone", name] for name in ("add", "list", "show", "enable", "disable", "remove")),
        *(
            ["robot", name]
            for name in (
                "enable",
                "disable",
                "reset",
                "egress",
                "profile",
                "stop",
                "pose",
                "goal",
                "cancel",
                "status",
                "watch",
                "bringup",
            )
        ),
    ],
)
def test_every_command_has_help_with_an_example(command: list[str]) -> None:
    done = runner.invoke(app, [*command, "--help"])
    assert done.exit_code == 0
    assert "Example: fognav " + " ".join(command) in done.output


@pytest.mark.parametrize("group", [[], ["site"], ["token"], ["zone"], ["robot"]])
def test_list_of_commands_truncates_no_sentence(group: list[str]) -> None:
    done = runner.invoke(app, [*group, "--help"], env={"COLUMNS": "80"})
    commands = [line for line in done.output.splitlines() if re.match(r"  [a-z]", line)]
    assert len(commands) >= 2 + len(group)
    assert [line for line in commands if not line.endswith(".") or line.endswith("...")] == []


def test_commands_are_listed_by_who_uses_them_and_none_has_no_group() -> None:
    listed = runner.invoke(app, ["--help"]).output.partition("\nTry it:\n")[2]
    assert re.findall(r"^(\w.*):$", listed, re.MULTILINE) == list(installed.GROUPS[1:-1])
    assert listed.split()[0] == "demo"


def test_what_is_no_number_is_named_with_how_to_write_one() -> None:
    done = runner.invoke(app, ["map", "convert", "map.yaml", "map.png", "--resolution", "0,1"])
    assert "'--resolution': '0,1' is no number: write it with a point, such as 0.1" in " ".join(done.output.split())


@pytest.mark.parametrize("arguments", [["demo", "--speed", "0"], ["--help"], ["nonsense"]])
def test_usage_shows_the_documented_name_of_the_command(arguments: list[str]) -> None:
    done = subprocess.run([sys.executable, "-m", "fognav", *arguments], capture_output=True, text=True, check=False)
    assert "Usage: fognav " in done.stdout + done.stderr
    assert "python" not in done.stdout + done.stderr


def test_doctor_writes_one_object_with_schema_and_version() -> None:
    done = runner.invoke(app, ["doctor", "--json"])
    printed = json.loads(done.stdout)
    assert printed["schema"] == 1
    assert printed["fognav"]
    assert {"python", "mosquitto", "redis-server", "kernel cache"} <= {check["name"] for check in printed["checks"]}


def test_doctor_of_an_installed_command_needs_no_checkout(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_checkout() -> Path:
        raise WrongUseError("this command works only in a checkout")

    monkeypatch.setattr(checkout, "root", no_checkout)
    done = runner.invoke(app, ["doctor", "--json"], catch_exceptions=False)
    states = {check["name"]: check["state"] for check in json.loads(done.stdout)["checks"]}
    assert states["python packages"] == "ok"
    assert "uv" in states


def test_doctor_fails_with_the_remedy_if_a_server_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(system, "find", lambda tool: None if tool is system.REDIS else Path("/bin/true"))
    done = runner.invoke(app, ["doctor", "--json"])
    assert done.exit_code == 1
    printed = json.loads(done.stdout)
    assert printed["ok"] is False
    (missing,) = [check for check in printed["checks"] if check["state"] == "missing"]
    assert missing["remedy"] == "apt-get install --no-install-recommends redis-server"


def test_browser_is_optional(monkeypatch: pytest.MonkeyPatch) -> None:
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
def test_wrong_use_exits_with_code_2(arguments: list[str]) -> None:
    assert runner.invoke(app, arguments).exit_code == 2


def test_check_of_a_site_names_areas_of_which_their_nodes_see_little() -> None:
    shown = " ".join(runner.invoke(app, ["site", "check", "estig"]).output.split())
    assert "areas of which their nodes see little: z1 38%" in shown


def test_check_of_an_invalid_site_exits_with_code_1(tmp_path: Path) -> None:
    (tmp_path / "site.toml").write_text("id = 3\n")
    done = runner.invoke(app, ["site", "check", str(tmp_path), "--json"])
    assert done.exit_code == 1
    assert json.loads(done.stdout)["ok"] is False


@pytest.mark.parametrize("option", ["--report", "--record"])
def test_file_that_can_t_be_written_is_refused_before_anything_starts(option: str, tmp_path: Path) -> None:
    done = runner.invoke(app, ["demo", "--headless", option, str(tmp_path / "nowhere" / "file")])
    assert done.exit_code == 2
    assert f"there is no folder {tmp_path / 'nowhere'}" in done.output.replace("\n", "")


@pytest.mark.parametrize(("option", "known"), [("--base", "diffdrive, roomba600"), ("--lidar", "ld19, rplidar-a1")])
def test_unknown_hardware_is_refused_with_the_known_names(option: str, known: str) -> None:
    output = error_output("demo", "--headless", option, "tank")
    assert f"{option}: unknown name 'tank'; use one of: {known}" in output


def error_output(*arguments: str | Path) -> str:
    """Run the command, which must refuse its arguments; return its output in one line."""
    done = runner.invoke(app, [str(argument) for argument in arguments])
    assert isinstance(done.exception, SystemExit), done.exception  # no other exception got out
    assert done.exit_code == 2, done.output
    return " ".join(done.output.split())


def copy_of_estig(folder: Path) -> Path:
    return Path(shutil.copytree(checkout.root() / "sites" / "estig", folder / "site"))


@pytest.mark.parametrize(
    ("file", "content", "phrases"),
    [
        ("map.pgm", b"P5\n10 x\n255\n", ["map.yaml: image:", "map.pgm can't be decoded", "Save it again as PGM"]),
        ("map.pgm", b"P5\n2040 1140\n255\n" + bytes(5000), ["map.pgm can't be decoded", "truncated"]),
        ("map.pgm", None, ["map.yaml: image:", "map.pgm is not a file", "Put the image there"]),
        ("map.yaml", b"resolution: 0.05\n", ["map.yaml: image: missing", "Name the image file"]),
        ("map.yaml", b"image: [\n:::", ["map.yaml is not valid YAML (line 2, column 1: ", "Correct that line"]),
        ("map.yaml", b"\x89PNG\xff", ["map.yaml is not a text file", "not the image"]),
        ("map.yaml", None, ["map.yaml can't be read (Is a directory)", "check the path"]),
        ("site.toml", b"id = = 3", ["site.toml is not valid TOML (Invalid value (at line 1, column 6))"]),
        ("site.toml", b'nmae = "x"\nid = "estig"', ["site.toml: nmae: is not a field", "Correct its spelling"]),
    ],
)
def test_demo_refuses_an_invalid_site_with_file_field_and_remedy(
    tmp_path: Path, file: str, content: bytes | None, phrases: list[str]
) -> None:
    site = copy_of_estig(tmp_path)
    (site / file).unlink()
    if content is None:
        (site / file).mkdir()
    else:
        (site / file).write_bytes(content)
    output = error_output("demo", "--headless", "--site", site)
    assert [phrase for phrase in phrases if phrase not in output] == [], output


@pytest.mark.parametrize("command", [["demo", "--headless", "--site"], ["site", "check"]])
def test_folder_without_a_site_is_refused_with_the_known_sites(tmp_path: Path, command: list[str]) -> None:
    (tmp_path / "notes.txt").touch()
    assert f"there is no {tmp_path}/site.toml. Use one of sites/ (estig), or create one" in error_output(
        *command, tmp_path
    )
    assert "notes.txt is a file" in error_output(*command, tmp_path / "notes.txt")
    assert "name its folder" in error_output(*command, tmp_path / "notes.txt")


def test_site_can_be_checked_by_its_name() -> None:
    said = runner.invoke(app, ["site", "check", "estig"]).output
    assert "estig: ok" in said
    assert "range_max" not in said


def test_check_of_a_site_names_nodes_that_take_any_far_echo_for_clear(tmp_path: Path) -> None:
    shutil.copytree(Path(__file__).parents[2] / "sites" / "estig", tmp_path / "floor")
    file = tmp_path / "floor" / "site.toml"
    file.write_text(file.read_text("utf-8").replace(", range_max = 2.85", ""), "utf-8")
    said = runner.invoke(app, ["site", "check", str(tmp_path / "floor")]).output
    assert "floor: ok" in said
    assert "['n4']" in said
    assert "free_width" not in said
    for area in ("z3", "z4"):
        text = file.read_text("utf-8")
        file.write_text(
            text.replace(f'[[areas]]\nid = "{area}"', f'[[areas]]\nid = "{area}"\nfree_width = 0.6'), "utf-8"
        )
    said = runner.invoke(app, ["site", "check", str(tmp_path / "floor")]).output
    assert "areas whose free_width has no effect: ['z4']" in said, "the sonars of z3 still have a range_max"


def test_image_in_place_of_a_map_file_is_refused_with_the_remedy(tmp_path: Path) -> None:
    image = copy_of_estig(tmp_path) / "map.pgm"
    output = error_output("site", "new", "--map", image, "--out", tmp_path / "new")
    assert output.endswith(
        "map.pgm is not a text file. A map is a YAML file that names an image: name that file, not the image"
    )
    assert not (tmp_path / "new").exists()


UNREACHABLE = ["--mqtt", "mqtt://127.0.0.1:1", "--zenoh", "tcp/127.0.0.1:1"]


@pytest.fixture
def short_timeouts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fognav.recording._CONNECT_S", 0.5)


@pytest.mark.usefixtures("short_timeouts")
def test_recording_without_a_broker_keeps_an_existing_file(tmp_path: Path) -> None:
    file = tmp_path / "drive.mcap"
    file.write_bytes(b"an earlier drive")
    output = error_output("record", file, *UNREACHABLE)
    assert "the broker mqtt://127.0.0.1:1 can't be reached: start the system, or name its broker with --mqtt" in output
    assert file.read_bytes() == b"an earlier drive"


@pytest.mark.usefixtures("short_timeouts")
def test_recording_is_of_the_system_that_runs_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    urls = {"mosquitto": "mqtt://127.0.0.1:2", "zenoh-router": "tcp/127.0.0.1:2"}
    demo = System(name="demo-1", kind="demo", site="here", urls=urls, pids={})
    monkeypatch.setattr("fognav.operate.fog.find_systems", lambda: [demo])
    assert "the broker mqtt://127.0.0.1:2 can't be reached" in error_output("record", tmp_path / "drive.mcap")


@pytest.mark.parametrize("url", ["127.0.0.1:1883", "mqtt://here:port"])
def test_invalid_broker_url_is_refused(tmp_path: Path, url: str) -> None:
    file = tmp_path / "new.mcap"
    output = error_output("record", file, "--mqtt", url, "--zenoh", "tcp/127.0.0.1:1")
    assert f"'{url}' is not a broker's URL" in output
    assert "Correct --mqtt" in output
    assert not file.exists()


def write_recording(file: Path) -> bytes:
    with Recorder(file, site="here") as recorder:
        for n in range(1000):
            recorder.write(ch.NODE_AVAILABILITY, {"node": "n1"}, "online", n)
    return file.read_bytes()


@pytest.mark.usefixtures("short_timeouts")
def test_replay_without_a_router_names_its_address(tmp_path: Path) -> None:
    write_recording(tmp_path / "r.mcap")
    assert "the zenoh router tcp/127.0.0.1:1 can't be reached" in error_output(
        "replay", tmp_path / "r.mcap", *UNREACHABLE
    )


def test_recording_without_a_complete_message_is_not_replayed(tmp_path: Path) -> None:
    file = tmp_path / "r.mcap"
    file.write_bytes(write_recording(file)[:60])
    assert "r.mcap contains no complete message" in error_output("replay", file, *UNREACHABLE)


def test_summary_of_a_truncated_recording_counts_the_lost_bytes(tmp_path: Path) -> None:
    file = tmp_path / "r.mcap"
    whole = write_recording(file)
    assert recording.summary(file)["bytes_lost"] == 0
    file.write_bytes(whole[:-4])  # cut in the closing magic, which belongs to the last record
    lost = recording.summary(file)["bytes_lost"]
    assert isinstance(lost, int)
    assert 0 < lost < 200


@pytest.mark.parametrize("name", ["none.mcap", "."])
def test_replay_of_an_unreadable_file_names_it(tmp_path: Path, name: str) -> None:
    assert f"{tmp_path / name} can't be read: " in error_output("replay", tmp_path / name)


def test_replay_of_a_file_that_is_not_a_recording_names_it(tmp_path: Path) -> None:
    file = tmp_path / "no.mcap"
    file.write_bytes(b"this is no recording")
    done = runner.invoke(app, ["replay", str(file)])
    assert done.exit_code == 2
    assert "no.mcap" in done.output
