"""A backup has the index of a node's recordings, and is restored on an empty machine by the command."""

import asyncio
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from fog_contracts.messages import SimObstacle
from fog_runtime.record import Recorder
from fognav.hosting import backups, folders
from fognav.hosting.folders import NodeFolder, hosted_sites

ESTIG = Path(__file__).parents[2] / "sites" / "estig"
SECOND = 1_000_000_000


def record(file: Path) -> None:
    with Recorder(file) as recorder:
        for second in (100, 107):
            recorder.write_entry(
                "box", SimObstacle(id="box", polygon=[(0, 0), (1, 0), (1, 1)], height=1.0), second * SECOND
            )


@pytest.fixture
def data(tmp_path: Path) -> Path:
    folder = tmp_path / "data"
    record(folder / "recordings" / "morning" / "drive.mcap")
    cut = folder / "recordings" / "cut.mcap"
    cut.write_bytes((folder / "recordings" / "morning" / "drive.mcap").read_bytes()[:200])
    return folder


def test_index_tells_path_size_and_time_also_of_what_was_cut_off(data):
    cut, drive = backups.write_index(data)
    assert (cut.path, cut.bytes, cut.messages, cut.begins) == ("cut.mcap", 200, None, None)
    assert (drive.path, drive.messages, drive.begins, drive.ends) == ("morning/drive.mcap", 2, 100.0, 107.0)


def test_index_of_nothing_is_empty(tmp_path):
    assert backups.write_index(tmp_path) == []


def test_recording_that_was_cut_off_anywhere_is_in_the_index(data):
    whole = (data / "recordings" / "morning" / "drive.mcap").read_bytes()
    for end in range(len(whole)):
        (data / "recordings" / f"{end:05}.mcap").write_bytes(whole[:end])
    index = {each.path: each for each in backups.write_index(data)}
    assert [index[f"{end:05}.mcap"].bytes for end in range(len(whole))] == list(range(len(whole)))
    assert {index[f"{end:05}.mcap"].messages for end in range(len(whole))} == {None}


def test_recording_with_a_damaged_byte_anywhere_is_in_the_index(data):
    whole = (data / "recordings" / "morning" / "drive.mcap").read_bytes()
    for place in range(len(whole)):
        for value in (0xFF, whole[place] ^ 0x80):
            damaged = bytearray(whole)
            damaged[place] = value
            (data / "recordings" / f"{place:05}-{value}.mcap").write_bytes(damaged)
    assert {each.unreadable for each in backups.write_index(data)} == {None}


def test_file_that_can_not_be_read_is_named_in_the_index(tmp_path):
    folder = tmp_path / "recordings"
    folder.mkdir()
    (folder / "folder.mcap").mkdir()
    (folder / "link.mcap").symlink_to(tmp_path / "gone.mcap")
    (folder / "loop.mcap").symlink_to(folder / "loop.mcap")
    os.mkfifo(folder / "pipe.mcap")
    Path(os.fsdecode(os.fsencode(folder) + b"/\xff.mcap")).write_bytes(b"")
    index = {each.path: each.unreadable for each in backups.write_index(tmp_path)}
    assert {path for path, reason in index.items() if reason} == {"link.mcap", "loop.mcap", "pipe.mcap"}
    assert index.keys() == {"link.mcap", "loop.mcap", "pipe.mcap", "\\xff.mcap"}


def test_backup_is_restored_on_an_empty_machine_and_tells_which_recordings_are_gone(data, tmp_path):
    folder, site = NodeFolder(data), shutil.copytree(ESTIG, tmp_path / "site")
    hosted_sites([site], folder.security, ["localhost", "127.0.0.1"])
    token = (folder.keys("estig") / "admin.token").read_text()
    folders.remember(folder.path, folders.settings_of({"estig": site}, "127.0.0.1", [], simulate=False))
    file = tmp_path / "fog.tar.gz"
    asyncio.run(backups.create(file, folder, None))

    home = tmp_path / "home"
    home.mkdir()
    known = {"PATH": os.environ["PATH"], "HOME": str(home), "TMPDIR": str(tmp_path)}
    restored = home / ".local" / "share" / "fognav"
    command = [
        sys.executable,
        "-m",
        "fognav",
        "restore",
        str(file),
        "--site",
        str(home / "site"),
        "--up",
        str(restored),
    ]
    done = subprocess.run(command, env=known, capture_output=True, text=True, timeout=120, check=False, cwd=home)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "restored site estig" in done.stdout + done.stderr
    assert "cut.mcap, morning/drive.mcap" in done.stdout + done.stderr
    assert (restored / "keys" / "estig" / "admin.token").read_text() == token
    assert (home / "site" / "site.toml").read_bytes() == (site / "site.toml").read_bytes()
    (index,) = (restored / "recordings" / "index").iterdir()
    assert [each["path"] for each in json.loads(index.read_bytes())] == ["cut.mcap", "morning/drive.mcap"]


def test_index_that_can_not_be_written_is_told_and_the_rest_is_backed_up(data, tmp_path):
    folder, site = NodeFolder(data), shutil.copytree(ESTIG, tmp_path / "site")
    hosted_sites([site], folder.security, ["localhost", "127.0.0.1"])
    token = (folder.keys("estig") / "admin.token").read_bytes()
    folders.remember(folder.path, folders.settings_of({"estig": site}, "127.0.0.1", [], simulate=False))
    backups.index_folder(folder.path).write_text("a file in the place of the folder")
    file = tmp_path / "fog.tar.gz"
    done = subprocess.run(
        [sys.executable, "-m", "fognav", "backup", str(file), "--up", str(data)],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    assert "backed up site estig" in done.stderr
    assert f"{file} is complete but for the index of the recordings" in done.stderr.replace("\n", " ")
    assert f"{data / 'recordings' / 'index'} (File exists)" in done.stderr.replace("\n", " ")
    other = NodeFolder(tmp_path / "other")
    made = asyncio.run(backups.restore(file, other, tmp_path / "restored", replace=False))
    assert (other.path / "keys" / "estig" / "admin.token").read_bytes() == token
    assert (made.missing, backups.RECORDINGS in made.backup.folders) == ([], False)


def test_recordings_of_a_later_backup_are_named_though_another_floor_s_index_is_there(data, tmp_path):
    folder, site = NodeFolder(data), shutil.copytree(ESTIG, tmp_path / "site")
    hosted_sites([site], folder.security, ["localhost", "127.0.0.1"])
    folder.keys("estig")
    folders.remember(folder.path, folders.settings_of({"estig": site}, "127.0.0.1", [], simulate=False))
    asyncio.run(backups.create(tmp_path / "fog.tar.gz", folder, None))
    other = NodeFolder(tmp_path / "other")
    record(other.path / "recordings" / "later.mcap")
    backups.write_index(other.path)
    made = asyncio.run(backups.restore(tmp_path / "fog.tar.gz", other, tmp_path / "restored", replace=False))
    assert made.missing == ["cut.mcap", "morning/drive.mcap"]
    (index,) = backups.index_folder(other.path).iterdir()
    assert [each["path"] for each in json.loads(index.read_bytes())] == ["later.mcap"]
