"""A fog node on this machine: its folder, its logs, its sites' names and ports, and its unit."""

import shutil
import stat
from pathlib import Path

import pytest

from fognav.hosting import log_files, unit
from fognav.hosting.floors import hosted_sites
from fognav.hosting.folders import FORMAT, NodeFolder, default_data
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
    for name in ("FOGNAV_AGGREGATOR_PORT", "FOGNAV_MAP_PORT", "FOGNAV_PLANNER_PORT"):
        monkeypatch.delenv(name, raising=False)
    hosts, locks = ["localhost"], tmp_path / "locks"
    (alone,), _ = hosted_sites([ESTIG], locks, hosts)
    both, made = hosted_sites([upstairs, ESTIG], locks, hosts)
    found = {site.id: site for site in both}
    assert alone.ports == found["estig"].ports == {"hazard-aggregator": 8001, "map-service": 8002, "planner": 8003}
    assert sorted(found["upstairs"].ports.values()) == [8011, 8012, 8013]
    assert found["estig"].name("planner") == "planner"
    assert found["upstairs"].name("planner") == "upstairs.planner"
    assert (found["upstairs"].node_credentials(made) / "n1.toml").exists()
    (later,), _ = hosted_sites([upstairs], locks, hosts)
    assert later.ports == found["upstairs"].ports


def test_two_sites_with_one_id_are_refused(tmp_path, upstairs):
    with pytest.raises(WrongUseError, match="same id 'upstairs'"):
        hosted_sites([upstairs, shutil.copytree(upstairs, tmp_path / "copy")], tmp_path / "locks", ["localhost"])


def test_log_is_bounded_and_followed_across_its_cut(tmp_path):
    file = tmp_path / "planner.log"
    with file.open("a", buffering=1) as program:
        program.write("one\ntwo\n")
        tail = log_files.Tail(file, 1)
        assert tail.first() == ["two"]
        program.write("three\nfou")
        assert tail.added() == ["three"]
        program.write("r\n")
        assert tail.added() == ["four"]
        log_files.bound(file, limit=10)
        assert tail.added() == []
        program.write("five\n")
        assert tail.added() == ["five"]
    assert file.read_text() == "five\n"
    assert (tmp_path / "planner.log.before").read_text() == "one\ntwo\nthree\nfour\n"


def test_unit_runs_the_same_command_with_this_shell_s_settings(monkeypatch):
    monkeypatch.setenv("FOGNAV_MAP_PORT", "9002")
    monkeypatch.setenv("FOGNAV_BIND", "a $b %c")
    text = unit.unit_text(["up", "--site", "/srv/my floor", "--data", "/$d"])
    command = next(line for line in text.splitlines() if line.startswith("ExecStart="))
    assert command.endswith('/fognav up --site "/srv/my floor" --data "/$$d"')
    assert "Environment=FOGNAV_MAP_PORT=9002\n" in text
    assert 'Environment="FOGNAV_BIND=a $b %%c"\n' in text
