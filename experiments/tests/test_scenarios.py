"""Scenarios: every file can be played on its site, and what deviates from its expectation is found.

FOGNAV_SCENARIOS=all plays all of them (about 10 minutes), otherwise three short ones.
"""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest

from fog_runtime.configuration.site import load_site
from fognav_experiments.lockstep import DriveEvent
from fognav_experiments.scenarios.description import Expected, FaultyNode, Scenario, SilentNode, deviations
from fognav_experiments.scenarios.stage import Played, ScenarioError, _Stage, markdown_page, play, read_scenario

ROOT = Path(__file__).parents[2]
FILES = {file.stem: file for file in sorted((ROOT / "experiments" / "scenarios").glob("*.toml"))}
PLAYED = (
    sorted(FILES) if os.environ.get("FOGNAV_SCENARIOS") == "all" else ["map-restarts", "no-way-left", "wifi-gap-5s"]
)


@pytest.mark.parametrize("name", FILES)
def test_every_scenario_is_about_its_site(name):
    scenario = read_scenario(FILES[name])
    site = load_site(ROOT / "sites" / scenario.site)
    assert scenario.title
    for x, y in (scenario.start[:2], scenario.goal):
        column, row = site.map.geometry.cell(x, y)
        assert site.map.cells[row, column] == 0
    nodes = {node.id for node in site.site.nodes}
    assert {event.node for event in scenario.events if isinstance(event, (FaultyNode, SilentNode))} <= nodes


@pytest.mark.parametrize("name", PLAYED)
def test_a_scenario_ends_as_expected(name):
    played = play(read_scenario(FILES[name]), ROOT / "sites")
    assert played.deviations == [], [event.description for event in played.result.events]


def test_a_file_with_an_unknown_event_is_refused(tmp_path):
    file = tmp_path / "flood.toml"
    file.write_text('title = "t"\nstart = [0, 0, 0]\ngoal = [1, 1]\n[[events]]\nkind = "flood"\n[expected]\n')
    with pytest.raises(ScenarioError, match=r"flood\.toml: Invalid value 'flood'"):
        read_scenario(file)


class Result(msgspec.Struct):
    contacts: int = 0
    reason: str = "the robot stands at its goal"
    distance_m: float = 10.0
    time_s: float | None = 40.0


@pytest.mark.parametrize(
    ("expected", "result", "outcome", "words"),
    [
        (Expected(), Result(contacts=1), "reached", "1 contacts"),
        (Expected(outcome="refused"), Result(), "reached", "outcome reached"),
        (Expected(distance_m=(0.0, 9.0)), Result(), "reached", "10.0 m driven"),
        (Expected(time_s=(0.0, 30.0)), Result(), "reached", "it took 40.0 s"),
        (Expected(modes=["FAULT"]), Result(), "reached", "never in FAULT"),
        (Expected(never=["HOLD"]), Result(), "reached", "was in HOLD"),
        (Expected(reason="bumper"), Result(), "reached", "no reason 'bumper'"),
    ],
)
def test_each_deviation_from_what_is_expected_is_found(expected, result, outcome, words):
    events = [DriveEvent(time_s=1.0, distance_m=1.0, description="robot: HOLD (the map is 3.1 s old)")]
    (found,) = deviations(expected, result, outcome, events)
    assert words in found
    assert deviations(Expected(modes=["HOLD"], reason="3.1 s old"), Result(), "reached", events) == []


def test_scenarios_can_be_told_from_one_another():
    titles = [read_scenario(file).title for file in FILES.values()]
    assert len(set(titles)) == len(titles) >= 25
    assert isinstance(read_scenario(FILES["kidnapped"]), Scenario)


def test_nodes_that_fail_at_the_same_time_come_back_each_at_its_own_end():
    nodes = [SimpleNamespace(node=SimpleNamespace(id=name)) for name in ("n1", "n2", "n3")]
    fog = SimpleNamespace(nodes=nodes)
    drive = SimpleNamespace(now=0.0, driven=0.0, system=SimpleNamespace(fog=fog), log_event=lambda _text: None)
    events = [SilentNode(node="n1", seconds=10.0), SilentNode(node="n2", seconds=20.0)]
    stage = _Stage(drive, SimpleNamespace(events=events))

    def heard(now):
        drive.now = now
        stage.step()
        return sorted(node.node.id for node in fog.nodes)

    assert [heard(now) for now in (0.0, 10.0, 20.0)] == [["n3"], ["n1", "n3"], ["n1", "n2", "n3"]]


def test_the_page_of_scenarios_says_on_what_they_were_played():
    played = Played(read_scenario(FILES["wifi-gap-5s"]), Result(), "reached", [])
    page = markdown_page({"wifi-gap-5s": played}, {"commit": "3baacc2", "machine cores": 2})
    assert "1 in one go, in lockstep; measured on: commit 3baacc2, machine cores 2." in page
    assert "| reached | 10.0 | 40 | yes |" in page
