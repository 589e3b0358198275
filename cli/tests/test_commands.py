import json
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

runner = CliRunner()


@pytest.mark.parametrize(
    "command",
    [["doctor"], ["test"], ["channels"], ["demo"], ["site", "new"], ["site", "check"], ["record"], ["replay"]],
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


@pytest.mark.parametrize(("option", "known"), [("--base", "diffdrive, roomba600"), ("--lidar", "ld19, rplidar-a1")])
def test_hardware_that_nobody_can_simulate_is_refused_with_what_can_be(option: str, known: str) -> None:
    words = said("demo", "--headless", option, "tank")
    assert f"{option}: there is no 'tank' to simulate; use one of: {known}" in words


def said(*arguments: str | Path) -> str:
    """Return what the command says of something that it can't use, in one line."""
    done = runner.invoke(app, [str(argument) for argument in arguments])
    assert isinstance(done.exception, SystemExit), done.exception  # no other exception got out
    assert done.exit_code == 2, done.output
    return " ".join(done.output.split())


def copy_of_estig(folder: Path) -> Path:
    return Path(shutil.copytree(checkout.root() / "sites" / "estig", folder / "site"))


@pytest.mark.parametrize(
    ("file", "content", "words"),
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
def test_a_demo_refuses_a_broken_site_by_file_field_and_remedy(
    tmp_path: Path, file: str, content: bytes | None, words: list[str]
) -> None:
    site = copy_of_estig(tmp_path)
    (site / file).unlink()
    if content is None:
        (site / file).mkdir()
    else:
        (site / file).write_bytes(content)
    told = said("demo", "--headless", "--site", site)
    assert [word for word in words if word not in told] == [], told


@pytest.mark.parametrize("command", [["demo", "--headless", "--site"], ["site", "check"]])
def test_what_is_no_site_s_folder_is_told_with_what_would_be_one(tmp_path: Path, command: list[str]) -> None:
    (tmp_path / "notes.txt").touch()
    assert f"there is no {tmp_path}/site.toml. Use one of sites/ (estig), or make one" in said(*command, tmp_path)
    assert "notes.txt is a file" in said(*command, tmp_path / "notes.txt")
    assert "name its folder" in said(*command, tmp_path / "notes.txt")


def test_a_site_is_checked_by_its_name_as_well() -> None:
    assert "estig: all is well" in runner.invoke(app, ["site", "check", "estig"]).output


def test_an_image_in_place_of_a_map_file_is_told_so(tmp_path: Path) -> None:
    image = copy_of_estig(tmp_path) / "map.pgm"
    told = said("site", "new", "--map", image, "--out", tmp_path / "new")
    assert told.endswith(
        "map.pgm is not a text file. A map is a YAML file that names an image: name that file, not the image"
    )
    assert not (tmp_path / "new").exists()


NOWHERE = ["--mqtt", "mqtt://127.0.0.1:1", "--zenoh", "tcp/127.0.0.1:1"]


@pytest.fixture
def hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fognav.recording._CONNECT_S", 0.5)


@pytest.mark.usefixtures("hurry")
def test_recording_without_a_system_leaves_an_older_file_as_it_is(tmp_path: Path) -> None:
    file = tmp_path / "drive.mcap"
    file.write_bytes(b"the drive of yesterday")
    told = said("record", file, *NOWHERE)
    assert "the broker mqtt://127.0.0.1:1 can't be reached: start the system, or name its broker with --mqtt" in told
    assert file.read_bytes() == b"the drive of yesterday"


@pytest.mark.parametrize("url", ["127.0.0.1:1883", "mqtt://here:port"])
def test_what_is_no_broker_s_address_is_told(tmp_path: Path, url: str) -> None:
    file = tmp_path / "new.mcap"
    told = said("record", file, "--mqtt", url, "--zenoh", "tcp/127.0.0.1:1")
    assert f"'{url}' names no broker" in told
    assert "Correct --mqtt" in told
    assert not file.exists()


def recorded(file: Path) -> bytes:
    with Recorder(file, site="here") as recorder:
        for n in range(1000):
            recorder.write(ch.NODE_AVAILABILITY, {"node": "n1"}, "online", n)
    return file.read_bytes()


@pytest.mark.usefixtures("hurry")
def test_replaying_without_a_router_names_it(tmp_path: Path) -> None:
    recorded(tmp_path / "r.mcap")
    assert "the zenoh router tcp/127.0.0.1:1 can't be reached" in said("replay", tmp_path / "r.mcap", *NOWHERE)


def test_a_recording_of_which_nothing_whole_is_left_is_not_replayed(tmp_path: Path) -> None:
    file = tmp_path / "r.mcap"
    file.write_bytes(recorded(file)[:60])
    assert "r.mcap holds no whole message" in said("replay", file, *NOWHERE)


def test_a_recording_that_lost_its_end_says_how_much(tmp_path: Path) -> None:
    file = tmp_path / "r.mcap"
    whole = recorded(file)
    assert recording.summary(file)["bytes_lost"] == 0
    file.write_bytes(whole[:-4])  # cut in the closing magic, which belongs to the last record
    lost = recording.summary(file)["bytes_lost"]
    assert isinstance(lost, int)
    assert 0 < lost < 200


@pytest.mark.parametrize("name", ["none.mcap", "."])
def test_replaying_what_can_t_be_read_names_the_file(tmp_path: Path, name: str) -> None:
    assert f"{tmp_path / name} can't be read: " in said("replay", tmp_path / name)


def test_replaying_what_is_no_recording_names_the_file(tmp_path: Path) -> None:
    file = tmp_path / "no.mcap"
    file.write_bytes(b"this is no recording")
    done = runner.invoke(app, ["replay", str(file)])
    assert done.exit_code == 2
    assert "no.mcap" in done.output
