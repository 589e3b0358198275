"""A robot joins the floor that its own record names, leaves it once it is handed over, and goes on as it was."""

import errno
import json
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest
from little_world import AGENT, L_PATH, LittleWorld

from fog_contracts.messages import Berth, HandOver, Stop, Tour
from fog_runtime.configuration.settings import SettingsError
from robot_agent.agent import berths
from robot_agent.agent.berths import read_berths
from robot_agent.agent.core import RESUMES_S
from robot_agent.agent.hand_driving import ResetFault
from robot_agent.agent.settings import Settings, read_site
from robot_agent.config import AgentConfig

FLOORS = """
first = "ground"
[floors.ground]
zenoh_connect = "tls/fog1.local:7447"
site_dir = "ground"
operator_key = "ground/operator.key"
credentials = "ground/robot.toml"
[floors.upstairs]
zenoh_connect = "tls/fog2.local:7447"
site_dir = "upstairs"
operator_key = "upstairs/operator.key"
"""
SITE = """
id = "upstairs"
[[robots]]
id = "r1"
start = { x = 1.0, y = 1.0, theta = 0.0 }
radius = 0.2
[[lifts]]
id = "north"
cabin = { x = 8.0, y = 2.0, theta = 3.1 }
wait = { x = 6.0, y = 2.0, theta = 0.0 }
floors = ["ground", "upstairs"]
"""
MISSION = Tour(id="t", leg=2, ahead=(Stop(place="desk"), Stop(floor="ground", place="desk")))
UP = HandOver(origin="ground", floor="upstairs", epoch=1, lift="north", who="anna", mission=MISSION)


def settings(tmp_path: Path, text: str = FLOORS) -> Settings:
    file = tmp_path / "floors.toml"
    file.write_text(text)
    return Settings(
        site_dir=Path(), data_dir=tmp_path / "data", robot="r1", guardian_socket=tmp_path / "s", floors_file=file
    )


def known(tmp_path: Path) -> berths.Berths:
    found = read_berths(settings(tmp_path).floors_file, tmp_path / "data")
    assert found is not None
    return found


def test_robot_joins_the_first_floor_then_the_one_that_it_was_handed_over_to(tmp_path: Path) -> None:
    first = known(tmp_path)
    at = first.settings(settings(tmp_path))
    assert (at.site, at.zenoh_connect) == ("ground", "tls/fog1.local:7447")
    assert at.credentials_file == tmp_path / "ground" / "robot.toml"
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "pose.json").write_text("{}")
    after = Berth(floor="upstairs", epoch=1, came_by=UP)
    first.store(after, enabled=False)
    later = known(tmp_path)
    assert later.berth == after
    at = later.settings(settings(tmp_path))
    assert (at.site, at.credentials_file) == ("upstairs", None)
    assert not (tmp_path / "data" / "pose.json").exists()
    assert not later.take_enabled()


def test_robot_that_came_by_a_lift_starts_in_its_cabin(tmp_path: Path) -> None:
    (tmp_path / "site.toml").write_text(SITE)
    at = Settings(site_dir=tmp_path, data_dir=tmp_path, robot="r1", guardian_socket=tmp_path / "s")
    assert read_site(at)[1].start.x == 1.0
    assert read_site(at, "north")[1].start.x == 8.0


def test_only_the_planned_start_goes_on_enabled_and_only_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    after = Berth(floor="upstairs", epoch=1, came_by=UP)
    known(tmp_path).store(after, enabled=True)
    assert known(tmp_path).take_enabled()
    assert not known(tmp_path).take_enabled()
    known(tmp_path).store(after, enabled=True)
    with monkeypatch.context() as full:
        full.setattr(berths, "atomic_write", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
        assert not known(tmp_path).take_enabled(), "nothing would keep the next start from it"
    monkeypatch.setattr(berths, "boot_id", lambda: "another start of the computer")
    assert not known(tmp_path).take_enabled()


@pytest.mark.parametrize(
    ("text", "record", "named"),
    [
        ("first = 3", None, "docs/campus.md"),
        (FLOORS.replace('first = "ground"', 'first = "attic"'), None, "there is no floor 'attic'"),
        (FLOORS, "{", "can't be read"),
        (FLOORS, json.dumps({"berth": {"floor": "attic", "epoch": 4}}), "attic"),
    ],
)
def test_wrong_lists_and_records_are_refused_by_name(tmp_path: Path, text: str, record: str | None, named: str) -> None:
    if record is not None:
        (tmp_path / "data").mkdir()
        (tmp_path / "data" / "floor.json").write_text(record)
    with pytest.raises(SettingsError, match=named):
        read_berths(settings(tmp_path, text).floors_file, tmp_path / "data")


# --- The core -------------------------------------------------------------------------------------------------------

FIRST = Berth(floor="ground")
ON_FLOORS = replace(AGENT, berth=FIRST, floors=("ground", "upstairs"))


def test_robot_takes_a_hand_over_while_it_stands_and_says_what_it_has_stored_until_it_ends() -> None:
    world = LittleWorld(config=ON_FLOORS).ready()
    assert (world.state().berth, world.state().floors) == (FIRST, ["ground", "upstairs"])
    assert world.state().carries_missions
    world.drive_to(L_PATH)
    world.run(3.0)
    assert world.command("hand_over", given=UP).code == "driving"
    assert world.command("cancel").accepted
    world.run(2.0)
    assert world.agent.berth_to_store is None
    assert world.command("hand_over", given=UP).accepted
    assert world.command("hand_over", given=UP).accepted
    assert world.agent.berth_to_store == Berth(floor="upstairs", epoch=1, came_by=UP)
    assert world.agent.goes_on
    assert world.state().berth == FIRST
    assert world.command("disable").accepted
    assert not world.agent.goes_on, "stopped while the record is written"
    world.agent.leave()
    assert world.command("enable").code == "other_run"
    assert not world.agent.goes_on


@pytest.mark.parametrize(
    ("config", "given", "code"),
    [
        (AGENT, UP, "one_floor"),
        (ON_FLOORS, None, "one_floor"),
        (ON_FLOORS, HandOver(origin="ground", floor="attic", epoch=1), "no_floor"),
        (ON_FLOORS, HandOver(origin="ground", floor="upstairs", epoch=2), "other_berth"),
    ],
)
def test_a_hand_over_that_makes_no_sense_is_refused(config: AgentConfig, given: HandOver | None, code: str) -> None:
    world = LittleWorld(config=config)
    reply = world.command("hand_over", given=given)
    assert (reply.accepted, reply.code) == (False, code)
    assert world.agent.berth_to_store is None


def test_robot_that_was_enabled_goes_on_after_the_ride_once_it_knows_where_it_is() -> None:
    world = LittleWorld(config=replace(ON_FLOORS, resumes=True))
    world.agent.load(world.master.snapshot(), world.now)
    while not world.state().enabled:
        assert world.now < 1_010.0, world.state()
        was_known = world.agent.localizer.status == "good"
        world.run(0.05)
    assert was_known


@pytest.mark.parametrize("command", ["disable", "cancel", "profile_fog"])
def test_whoever_tells_the_robot_anything_meanwhile_ends_that(command: str) -> None:
    world = LittleWorld(config=replace(ON_FLOORS, resumes=True))
    world.agent.load(world.master.snapshot(), world.now)
    world.command(command)
    world.run(3.0)
    assert world.state().codes == ["not_enabled"]
    assert not world.state().enabled


def test_fault_that_is_reset_at_the_robot_meanwhile_ends_that_too() -> None:
    world = LittleWorld(config=replace(ON_FLOORS, resumes=True))
    world.bumper, world.fault = True, "the bumper is pressed (left)"
    assert world.run(0.5, lambda w: w.state().mode == "FAULT")
    world.bumper, world.fault = False, None
    world.run(0.1)
    assert world.agent.on_hand(ResetFault(), world.now).accepted
    world.agent.load(world.master.snapshot(), world.now)
    world.run(3.0)
    assert world.state().codes == ["not_enabled"]
    assert not world.state().enabled


def test_robot_that_is_in_fault_is_handed_over_by_nobody() -> None:
    world = LittleWorld(config=ON_FLOORS).ready()
    world.bumper, world.fault = True, "the bumper is pressed (left)"
    assert world.run(0.5, lambda w: w.state().mode == "FAULT")
    assert world.command("hand_over", given=UP).code == "fault_latched"
    assert not world.agent.goes_on


def test_robot_that_takes_too_long_until_it_is_ready_waits_for_an_operator() -> None:
    world = LittleWorld(config=replace(ON_FLOORS, resumes=True))
    world.run(RESUMES_S + 1.0)
    world.agent.load(world.master.snapshot(), world.now)
    world.run(3.0)
    assert world.state().codes == ["not_enabled"]
    assert not world.state().enabled
