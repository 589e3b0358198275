"""Sweeps of what the fog's saving depends on: what is driven, where, and what the heat maps say of it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import ring_site as ring

from fog_kernels.sonar import default_config
from fog_runtime.configuration.site import load_site
from fognav_experiments.comparison import runner, sensor_kinds
from fognav_experiments.comparison.drives import ExperimentSpec, RouteSpec, draw
from fognav_experiments.comparison.records import DriveFiles, Folder, unpack_archive
from fognav_experiments.comparison.sensitivity import (
    BASE,
    Axis,
    Plane,
    SweepTask,
    SweptDrive,
    Variation,
    gain,
    publish,
    sweep,
    sweep_tasks,
    swept_drive,
    unwarned,
    varied_site,
)
from fognav_experiments.comparison.sensor_kinds import KINDS, WHAT, coverage, saved

ESTIG = Path(__file__).parents[2] / "sites" / "estig"
RESULTS = Path(__file__).parents[2] / "docs" / "results"
pytestmark = pytest.mark.timeout(900)

DEBOUNCE = Plane(Axis("readings", [2, 20]), Axis("pause_ms", [50, 500]))
SPEED = Plane(Axis("areas", [1, 0]), Axis("speed_m_s", [0.2, 0.3]))
RING = ExperimentSpec(routes=[RouteSpec(start="west", goal="east", areas=["z1"])])
DRAWN = next(found for run in range(1, 100) for found in draw(RING, 1, run) if found.moment == "before")


@pytest.fixture(scope="module")
def estig():
    return load_site(ESTIG)


def swept(setup, variation, distance_m, run=1, **changes):
    values = {
        "run": run, "route": "ab", "seed": 1, "area": "z1", "success": True, "outcome": "reached",
        "time_s": distance_m / 0.3,
    } | changes  # fmt: skip
    return SweptDrive(setup=setup, variation=variation, distance_m=distance_m, **values)


# --- what is driven ---


def test_point_that_changes_nothing_drives_with_nodes_as_they_are_by_default(estig):
    assert BASE.pause_ms == default_config(estig.site.nodes[0]).pause_ms


def test_each_drive_comes_once_and_the_robot_on_its_own_once_per_speed(estig):
    drawn = draw(runner.read_spec(estig, ESTIG), 1, 1)[:2]
    asked = sweep_tasks([DEBOUNCE, SPEED], drawn)
    assert len({task.name for task in asked}) == len(asked)
    led = [task for task in asked if task.setup == "fog"]
    alone = [task for task in asked if task.setup == "default"]
    assert len(led) == 2 * (4 + 4)
    assert {task.variation for task in alone} == {BASE, Variation(speed_m_s=0.2)}
    assert len(alone) == 2 * 2


def test_routes_of_a_sweep_are_those_whose_obstacle_bars_the_way(estig):
    spec = runner.read_spec(estig, ESTIG)
    found = runner.barred_routes(estig, spec, 1, 2)
    assert [(drawn.run, drawn.route.name, drawn.area) for drawn in found] == [(2, "ab", "z4"), (2, "bc", "z4")]
    with pytest.raises(runner.SpecError, match="ask for fewer"):
        runner.barred_routes(estig, ExperimentSpec(routes=[spec.routes[2]]), 1, 1000)


def test_a_variation_changes_debouncing_and_leaves_as_many_areas_with_their_nodes(estig):
    site = varied_site(estig.site, Variation(readings=7, areas=3), seed=5)
    assert len(site.areas) == 3
    assert {area.debounce["to_blocked"] for area in site.areas} == {7}
    assert {node.area for node in site.nodes} == {area.id for area in site.areas}
    assert varied_site(estig.site, Variation(readings=7, areas=3), seed=5) == site
    assert {varied_site(estig.site, Variation(areas=1), seed).areas[0].id for seed in range(40)} == {
        area.id for area in estig.site.areas
    }
    assert varied_site(estig.site, BASE, 1) == estig.site


# --- what they show ---


def test_a_gain_is_the_mean_difference_of_the_routes_that_both_robots_drove():
    slow = Variation(areas=1, speed_m_s=0.2)
    drives = [
        swept("default", unwarned(slow), 100.0), swept("fog", slow, 70.0),
        swept("default", unwarned(slow), 80.0, run=2), swept("fog", slow, 70.0, run=2),
        swept("default", unwarned(slow), 90.0, run=3), swept("fog", slow, 10.0, run=3, success=False),
        swept("default", BASE, 500.0), swept("fog", BASE, 70.0, run=4),
    ]  # fmt: skip
    found = gain(drives, slow)
    assert found.metres.mean == pytest.approx(20.0)
    assert found.seconds.mean == pytest.approx(20.0 / 0.3)
    assert found.metres.n == 2
    assert gain(drives, BASE) is None


def test_a_heat_map_has_a_cell_for_every_point_and_the_greenest_where_most_is_saved(tmp_path):
    drives = [swept("default", BASE, 100.0)]
    drives += [swept("fog", point, 60.0 + 10.0 * n) for n, point in enumerate(DEBOUNCE.points()[:3])]
    files = publish(drives, [DEBOUNCE], "fognav experiment sensitivity", {"machine": {"cores": 2}}, tmp_path)
    assert {file.name for file in files} == {"README.md", "readings-pause-ms.svg"}
    picture = (tmp_path / "readings-pause-ms.svg").read_text("utf-8")
    assert picture.count("fill: #2a9d5c") == 1
    words = re.findall(r">([^<>]+)</text>", picture)
    assert {"40.0 m", "30.0 m", "20.0 m", "133 s"} <= set(words)
    text = (tmp_path / "README.md").read_text("utf-8")
    assert "| 2 | 50 | 1 | 40.0 | 133.3 |" in text
    assert "confidence interval" not in text


def test_the_page_gives_few_situations_no_interval_and_names_the_commits_of_its_drives(tmp_path):
    drives = [swept("default", BASE, 100.0 + run, run, commit="a") for run in (1, 2)]
    drives += [swept("fog", DEBOUNCE.points()[0], 60.0, run) for run in (1, 2)]
    publish(drives, [DEBOUNCE], "fognav experiment sensitivity", {}, tmp_path)
    text = (tmp_path / "README.md").read_text("utf-8")
    assert "fewer than 10 situations, too few for a confidence interval" in text
    assert "| 2 | 50 | 2 | 41.5 | 138.3 |" in text
    assert "| commit | a: 2 of the drives |" in text
    assert "| commit | not known: 2 of the drives |" in text


# --- other sensors in the nodes' places ---


def test_a_kind_sees_as_much_of_an_area_as_its_beams_cover_and_only_what_it_can_see(estig):
    shares = {
        kind.name: {what: coverage(estig, estig.site.areas[0], kind, what) for what in WHAT} for kind in KINDS
    }  # fmt: skip
    sonar, sonar_of_all_faces, narrow, wide, presence, contact = (shares[kind.name] for kind in KINDS)
    assert 0.0 < sonar["box"] < sonar_of_all_faces["box"] < 1.0
    assert narrow["box"] < wide["box"] < 1.0
    assert narrow["door"] < narrow["box"], "a thin thing is seen at fewer places"
    assert presence == {"box": 0.0, "door": 0.0, "people": 1.0}
    assert contact == {"box": 0.0, "door": 1.0, "people": 0.0}


def test_published_kinds_of_sensors_are_what_the_archive_of_drives_gives(estig, tmp_path):
    folder = Folder(tmp_path / "drives")
    unpack_archive(RESULTS / "estig-floor" / "drives.jsonl.xz", folder)
    records = folder.drives.read()
    assert str(saved(estig, records, None, "box").metres) == "944.2 ± 375.7", "that of the drives themselves"
    command = "fognav experiment sensors docs/results/estig-floor/drives.jsonl.xz --out DIR"
    for file in sensor_kinds.publish(estig, records, command, tmp_path):
        assert file.read_text("utf-8") == (RESULTS / "sensors" / file.name).read_text("utf-8"), file.name


# --- where they are driven ---


@pytest.mark.drive
def test_a_short_block_or_a_false_alarm_costs_a_warned_robot_a_detour_unless_the_planner_knows_such_blocks():
    site, blocks = ring.ring_site(), Plane(Axis("stays_s", [4]), Axis("known_blocks", [0, 20]))
    alarms = blocks._replace(false_alarms=True)
    asked = sweep_tasks([blocks, alarms], [DRAWN])
    assert len(asked) == 2 * (1 + 2)  # nobody warns the robot on its own, and what the planner knows is nothing to it
    drives = [swept_drive(site, "", task) for task in asked]
    assert all(drive.success for drive in drives)
    for plane in (blocks, alarms):
        unknown, known = (gain(drives, point).metres.mean for point in plane.points())
        assert unknown < -1.0
        assert known > -0.3


@pytest.mark.drive
def test_a_bad_radio_slows_the_robot_that_the_fog_leads_and_harms_nobody():
    site, radio = ring.ring_site(), Plane(Axis("delay_ms", [0, 100]), Axis("gaps_per_min", [0]))
    good, bad = (swept_drive(site, "", SweepTask(DRAWN, "fog", point)) for point in radio.points())
    assert good.success
    assert bad.outcome != "contact"
    assert set(good.modes_s) == {"NORMAL"}
    assert bad.modes_s["DEGRADED"] + bad.modes_s["HOLD"] > bad.modes_s["NORMAL"]


@pytest.mark.drive
def test_a_sweep_drives_both_robots_and_goes_on_where_it_was(tmp_path):
    site = ring.ring_site()
    plane = Plane(Axis("readings", [3]), Axis("pause_ms", [100]))
    asked = sweep_tasks([plane], [DRAWN])
    files = DriveFiles(tmp_path, SweptDrive)
    drives = list(sweep(site, asked, files, jobs=2))
    assert list(sweep(site, asked, files, jobs=2)) == []
    assert {drive.setup for drive in drives} == {"default", "fog"}
    assert all(drive.success for drive in drives)
    assert gain(drives, plane.points()[0]).metres.mean > 0.5
