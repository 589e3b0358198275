"""The comparison of setups: its draws, its statistics, its files, and a short run of all four setups."""

from __future__ import annotations

import csv
import gc
import os
import re
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import pytest
import ring_site as ring
from hypothesis import given
from hypothesis import strategies as st
from msgspec import UNSET
from PIL import Image

from fog_contracts.geometry import distance_to_polygon, sampled
from fog_runtime.configuration.site import load_site
from fognav_experiments.commands.driving import show
from fognav_experiments.comparison import computation, film, live_drive, runner
from fognav_experiments.comparison.break_even import Case
from fognav_experiments.comparison.drives import ComparedDrive, ExperimentSpec, MeasuredDrive, RouteSpec, draw
from fognav_experiments.comparison.limits import RouteGeometry, Saved, Saving, allowed_savings
from fognav_experiments.comparison.live_drive import LiveOptions, live_drives, write_route
from fognav_experiments.comparison.records import MOVE_BASE, Asked, Folder, FolderError, comparable
from fognav_experiments.comparison.report import build, paired, publish
from fognav_experiments.comparison.runner import ROUTE_M, FloorDrawError, FloorDraws
from fognav_experiments.comparison.situations import worse
from fognav_experiments.figures import (
    Heading,
    Table,
    clustered,
    compare,
    estimate,
    spread,
    to_markdown,
    told,
)
from fognav_experiments.machine import CpuMeter
from fognav_experiments.rigs import System
from fognav_sim.drive.hazard import path_length

pytestmark = pytest.mark.timeout(900)

ESTIG = Path(__file__).parents[2] / "sites" / "estig"
SPEC = ExperimentSpec(routes=[RouteSpec(start="west", goal="east", areas=["z1"])])
ASKED = Asked(site="ring", site_digest="0" * 16, seed=1)
SETUPS = ["default", "lean", "full", "fog"]
RUN = next(run for run in range(1, 100) if draw(SPEC, 1, run)[0].moment == "before")
"""The route is so short that an obstacle which appears under way would come too late."""


# --- draws ---


def test_the_site_estig_has_the_thesis_s_routes_and_zones():
    spec = runner.read_spec(load_site(ESTIG), ESTIG)
    assert [(route.name, route.areas) for route in spec.routes] == [
        ("ab", ["z1", "z4"]), ("bc", ["z4", "z7"]), ("cd", ["z5", "z1", "z3"]),
    ]  # fmt: skip


def test_each_run_can_be_drawn_alone_and_every_area_and_moment_comes():
    spec = runner.read_spec(load_site(ESTIG), ESTIG)
    runs = [draw(spec, 1, run) for run in range(1, 51)]
    every = [drawn for run in runs for drawn in run]
    assert draw(spec, 1, 7) == runs[6]
    assert draw(spec, 2, 7) != runs[6]
    areas = Counter((drawn.route.name, drawn.area) for drawn in every)
    assert len(areas) == 7
    assert min(areas.values()) > 8
    assert {drawn.moment for drawn in every} == {"before", "under way"}
    assert all((drawn.trigger_m == 0.0) == (drawn.moment == "before") for drawn in every)


def test_setups_of_a_route_come_one_after_another_and_meet_the_same():
    asked = runner.tasks(partial(draw, SPEC, 1), [1, 2], SETUPS)
    assert [task.name for task in asked[:5]] == [
        "0001-westeast-default", "0001-westeast-lean", "0001-westeast-full", "0001-westeast-fog",
        "0002-westeast-default",
    ]  # fmt: skip
    assert asked[0].drawn == asked[1].drawn == asked[2].drawn == asked[3].drawn


def test_draws_over_the_floor_are_all_different_and_most_of_them_meet_what_stands_in_the_way():
    site = load_site(ESTIG)
    on_floor, geometry = FloorDraws(site), RouteGeometry(site)
    drawn = [on_floor.draw(1, run)[0] for run in range(1, 31)]
    assert on_floor.draw(1, 7) == [drawn[6]]
    assert len({one.ends for one in drawn}) == 30
    assert len({one.area for one in drawn}) == 7
    assert {one.moment for one in drawn} == {"before", "under way"}
    for one in drawn:
        assert path_length(geometry.way(*one.ends)) >= ROUTE_M
    savings = [geometry.saving(one) for one in drawn]  # None where the obstacle leaves no way
    assert sum(saving.met for saving in savings) >= 10
    with pytest.raises(FloorDrawError, match="no watched areas"):
        FloorDraws(replace(site, site=msgspec.structs.replace(site.site, areas=[], nodes=[])))


def test_an_experiment_that_the_site_does_not_fit_is_refused(tmp_path):
    (tmp_path / "experiment.toml").write_text('[[routes]]\nstart = "a"\ngoal = "x"\nareas = ["z1", "z99"]\n')
    with pytest.raises(runner.SpecError, match=r"no place x, no area z99"):
        runner.read_spec(load_site(ESTIG), tmp_path)
    with pytest.raises(runner.SpecError, match="does not exist"):
        runner.read_spec(load_site(ESTIG), tmp_path / "nowhere")


# --- what the floor allows to save ---


def test_a_warning_saves_only_where_the_obstacle_bars_the_way_and_at_most_the_way_back():
    site = load_site(ESTIG)
    allowed_savings = RouteGeometry(site)
    drawn = [route for run in range(1, 5) for route in draw(runner.read_spec(site, ESTIG), 1, run)]
    savings = [allowed_savings.saving(route) for route in drawn]
    assert all(saving is not None and saving.saved_m >= 0.0 for saving in savings)
    assert {route.area for route, saving in zip(drawn, savings, strict=True) if saving.met} == {"z4"}
    for route, saving in zip(drawn, savings, strict=True):
        assert saving.met or saving.saved_m < 0.5
        if saving.met and route.moment == "before":
            # The robot sees z4 from 12 m, and comes back to where the ways part.
            assert 25.0 < saving.saved_m < 40.0
            # A robot that learns of it under way saves less.
            late = allowed_savings.saving(msgspec.structs.replace(route, moment="under way", trigger_m=10.0))
            assert late.saved_m < saving.saved_m


def test_an_obstacle_that_appears_behind_the_robot_has_not_met_it():
    """Reports counted it as met, on two recorded floors in a third of the drives: the whole way was looked at."""
    site = load_site(ESTIG)
    route = next(route for route in draw(runner.read_spec(site, ESTIG), 1, 1) if route.route.name == "ab")
    barred = msgspec.structs.replace(route, area="z4", moment="under way", trigger_m=10.0)
    allowed_savings = RouteGeometry(site)
    assert allowed_savings.saving(barred).met
    behind = allowed_savings.saving(msgspec.structs.replace(barred, trigger_m=50.0))
    assert not behind.met
    assert behind.saved_m == pytest.approx(0.0, abs=0.01)


# --- when a warning costs more than it saves ---


def test_a_warning_pays_if_enough_obstacles_stay_and_false_alarms_are_few_enough():
    case = Case("ab", "z4", free_s=220.0, warned_s=240.0, unwarned_s=340.0)
    assert (case.saved_s, case.lost_s) == (100.0, 20.0)
    share = case.true_share
    assert share * case.saved_s == pytest.approx((1.0 - share) * case.lost_s)
    blocked = case.blocked_share(alarms=5.0, lasting_s=60.0)
    assert blocked * case.saved_s == pytest.approx(5.0 * 60.0 / 86_400.0 * case.lost_s)
    assert case.blocked_share(0.0, 600.0) == 0.0


# --- statistics ---


@pytest.mark.parametrize(("allowed_m", "share"), [(20.0, "50 %"), (1e-5, "-"), (0.0, "-")])
def test_what_was_saved_is_no_share_of_what_a_map_allows_by_rounding_alone(allowed_m, share):
    """On a recorded floor the report said that 2,590,647 % of what the map allows had been saved."""
    _, table = allowed_savings([Saved(Saving(50.0 + allowed_m, 50.0, met=True), 10.0, 40.0, ("ab", "z1"))] * 2)
    assert isinstance(table, Table)
    assert [row[table.header.index("share")] for row in table.rows] == [share, share]


def test_a_paired_comparison_gives_the_textbook_s_figures():
    """Student's own example (1908, table of additional hours of sleep)."""
    one = [1.9, 0.8, 1.1, 0.1, -0.1, 4.4, 5.5, 1.6, 4.6, 3.4]
    other = [0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0]
    found = compare(one, other, range(10))
    assert found.difference.mean == pytest.approx(1.58)
    assert found.difference.half == pytest.approx(0.8799, abs=1e-3)
    assert found.p_t == pytest.approx(0.00283, abs=1e-5)
    assert found.p_flip == 4 / 1024


SITUATIONS = st.lists(st.floats(-100, 100), min_size=10, max_size=30)


@given(SITUATIONS, st.integers(2, 5))
def test_driving_a_situation_again_makes_an_interval_no_narrower(values, times):
    """Intervals counted drives: three situations that were driven 150 times had one of 2.7 m, p < 0.0001."""
    once, often = clustered(values, range(len(values))), clustered(values * times, [*range(len(values))] * times)
    assert often.half == pytest.approx(once.half, abs=1e-6)
    assert once.half == pytest.approx(estimate(values).half, abs=1e-6)


def test_few_situations_have_neither_interval_nor_probability_however_often_they_are_driven():
    values, known = [30.0, 0.0, 31.0, 0.1, 29.0, 0.2] * 25, ["a", "b"] * 75
    found = compare(values, [0.0] * 150, known)
    assert (found.difference.half, found.p_t, found.p_flip) == (None, None, None)
    assert told(values, known) == "15.1 (0.0 to 31.0)"
    assert spread(values) == "14.6 (0.0 to 31.0)"


@given(SITUATIONS, st.floats(-100, 100))
def test_estimates_move_with_their_values(values, shift):
    here, there = estimate(values), estimate([value + shift for value in values])
    assert there.mean == pytest.approx(here.mean + shift, abs=1e-6)
    assert there.half == pytest.approx(here.half, abs=1e-6)
    assert compare(values, values, range(len(values))).p_flip == 1.0


# --- CPU ---


def test_cpu_time_is_counted_once_and_for_the_innermost_component():
    cpu = CpuMeter()

    def work(rounds):
        return sum(number * number for number in range(rounds))

    with cpu.measure("outer"):
        work(10_000)
        with cpu.measure("inner"):
            work(1_000_000)
        work(10_000)
    assert set(cpu.seconds) == {"outer", "inner"}
    assert cpu.seconds["inner"] > 3.0 * cpu.seconds["outer"] > 0.0


# --- records ---


def test_a_folder_of_another_experiment_is_refused(tmp_path):
    Folder(tmp_path).begin(ASKED, {})
    Folder(tmp_path).begin(ASKED, {"other": "machine"})
    with pytest.raises(FolderError, match="another experiment"):
        Folder(tmp_path).begin(msgspec.structs.replace(ASKED, seed=2), {})
    with pytest.raises(FolderError, match="no drives yet"):
        publish(Folder(tmp_path), tmp_path)


def systems():
    """Return the ids of the simulated systems in memory."""
    return {id(found) for found in gc.get_objects() if isinstance(found, System)}


@pytest.fixture(scope="module")
def short_run(tmp_path_factory):
    """One run of one route in all setups, the first one alone before the others."""
    folder = Folder(tmp_path_factory.mktemp("comparison"))
    folder.begin(ASKED, {"commit": "none", "machine": {"cores": 2}})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "_site", lambda _folder: ring.ring_site())
        before = systems()
        asked = runner.tasks(partial(draw, SPEC, 1), [RUN], SETUPS)
        (first,) = runner.run(folder.path, asked[:1], folder)
        rest = list(runner.run(folder.path, asked, folder))
        assert list(runner.run(folder.path, asked, folder)) == []
        assert systems() <= before, "drives that ended are still in memory"
    return folder, [first, *rest]


def test_a_run_that_was_killed_goes_on_where_it_was(short_run):
    folder, records = short_run
    assert [record.setup for record in records] == SETUPS
    known = {record.setup: record for record in folder.drives.read()}
    assert known == {record.setup: record for record in records}
    first, *rest = records
    assert len({record.sitting for record in rest}) == 1
    assert len({record.core for record in rest}) == 1
    assert not comparable([first, rest[0]]) or first.sitting == rest[0].sitting


def test_robots_that_the_fog_warns_drive_less_than_one_that_finds_out_by_itself(short_run):
    default, lean, full, fog = short_run[1]
    assert all(record.success for record in short_run[1]), [record.reason for record in short_run[1]]
    for alone in (default, lean):
        assert alone.paths > 1
        assert alone.distance_m > fog.distance_m + 0.5
    assert full.distance_m == pytest.approx(fog.distance_m, abs=1.0)


def test_a_drive_begins_in_every_setup_when_the_robot_is_ready(short_run):
    moves = [next(at for at, *_ in record.timeline.poses[1:]) for record in short_run[1]]
    assert max(moves) - min(moves) < 0.6, moves


def test_each_setup_computes_what_it_should(short_run):
    default, lean, full, fog = short_run[1]
    assert default.cpu_percent(MOVE_BASE) > lean.cpu_percent(MOVE_BASE), "it plans and controls less often"
    assert "global planning" not in fog.cpu_s
    assert default.cpu_s["global planning"] > full.cpu_s["global planning"] > 0.0
    assert default.cpu_percent(MOVE_BASE) > fog.cpu_percent(MOVE_BASE)
    assert default.received_bytes < full.received_bytes < fog.received_bytes


def test_the_report_needs_no_other_file_and_holds_every_drive(short_run, tmp_path):
    folder, records = short_run
    assert paired(records) == [{record.setup: record for record in records}]
    written = publish(folder, tmp_path)
    assert all(file.stat().st_size > 100 for file in written)
    text = (tmp_path / "README.md").read_text("utf-8")
    figures = re.findall(r"\]\((.+?)\)", text)
    assert len(figures) == 5
    assert all((tmp_path / figure).is_file() for figure in figures)
    for thesis in ("around 80 m", "6.5, 6.9", "around 110 % -> around 20 %", "not comparable with the thesis's 3 s"):
        assert thesis in text
    with (tmp_path / "drives.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["distance_m"]) for row in rows] == [record.distance_m for record in folder.drives.read()]
    assert all(float(row["cpu_move_base_percent"]) > 0.0 for row in rows)


def test_the_report_begins_with_what_was_found_and_a_picture_and_ends_with_how_it_was_measured(short_run):
    blocks = build(short_run[1], {"asked": {"site": "ring", "site_digest": "", "seed": 1}, "measured_on": {}})
    title, found, without_map, picture, *_ = blocks
    assert isinstance(title, Heading)
    assert found.text.startswith("Where an obstacle stood in the way, the fog saved a robot ")
    assert "of 1 drives of 1 situations" in found.text
    assert "made without the floor's map" in without_map.text
    assert picture.file == "tracks.svg"
    assert [block.text for block in blocks if isinstance(block, Heading)][-1] == "How this was measured"
    assert "80 m less are 267 s" in to_markdown(blocks), "the thesis's own figures don't fit one another"


def test_each_drive_tells_how_many_are_left_and_for_how_long(short_run, tmp_path, capsys):
    names, files = [record.name for record in short_run[1]], Folder(tmp_path).drives
    assert show(names, files, iter(short_run[1])) == len(names)  # nothing was written here
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].endswith("1 of 4, 1 min left")
    assert lines[3].endswith("4 of 4")


def test_a_film_finds_in_the_records_what_happened_and_when(short_run):
    for record in short_run[1]:
        seen = record.timeline
        assert seen.barrier_at == pytest.approx(0.0, abs=0.2)
        assert seen.poses[0][0] == pytest.approx(0.0, abs=1.0)
        assert seen.poses[-1][0] == pytest.approx(record.time_s, abs=1.0)
        assert bool(seen.paths) == (record.setup == "fog")
        blocked = [area for at, area, blocked in seen.areas if blocked and at > 0.0]
        assert blocked == ([] if record.setup in ("default", "lean") else ["z1"])
    folder = short_run[0]
    assert [record.setup for record in folder.read_drives(RUN, "westeast", ["fog", "default"])] == ["fog", "default"]
    with pytest.raises(FolderError, match=f"no drive {RUN + 1:04}-westeast-fog: run"):
        folder.read_drives(RUN + 1, "westeast", ["fog"])


@pytest.mark.drive
def test_stills_show_the_planned_way_through_the_obstacle_and_round_it(tmp_path, monkeypatch):
    ways = {}
    monkeypatch.setattr(film, "_draw", lambda _axes, run, setup, _drawn: ways.update({setup: run}))
    site, (drawn,) = ring.ring_site(), draw(SPEC, 1, RUN)
    film.write_stills(site, drawn, ["lean", "full"], 2.0, tmp_path / "stills.png")
    area = next(area.polygon for area in site.site.areas if area.id == drawn.area)
    through = {
        setup: any(distance_to_polygon(area, x, y) <= 0.0 for x, y in sampled(run.robot.agent.way(100.0), 0.1))
        for setup, run in ways.items()
    }
    assert through == {"lean": True, "full": False}
    monkeypatch.undo()
    film.write_stills(site, drawn, ["full"], 5.0, tmp_path / "stills.png")
    shown = Image.open(tmp_path / "stills.png").convert("RGB")
    assert shown.width > shown.height > 100
    assert {(208, 40, 40)} < {colour for _, colour in shown.getcolors(shown.width * shown.height)}, "no obstacle"


# --- which drives are compared ---


def like(record, setup="default", **changes):
    shared = {"load": 1.0, "sitting": "s", "jobs": 1, "commit": "c", "ready": True}
    return msgspec.structs.replace(record, setup=setup, **{**shared, **changes})


def test_setups_of_a_route_are_driven_again_until_the_machine_is_loaded_alike_in_all_of_them(short_run, monkeypatch):
    loads = iter([1.2, 4.0, 2.9, 2.0])  # a drive is a load of 1 by itself

    def drive(_folder, _jobs, _commit, _robot, task):
        return like(short_run[1][0], task.setup, load=next(loads), sitting="")

    monkeypatch.setattr(runner, "_drive", drive)
    allowed = os.sched_getaffinity(0)
    records = runner._drive_together(
        Path(), 1, "", None, runner.tasks(partial(draw, SPEC, 1), [RUN], ["default", "fog"])
    )
    assert [record.load for record in records] == [2.9, 2.0]
    assert len({record.sitting for record in records}) == 1
    assert {record.core for record in records} <= allowed
    assert os.sched_getaffinity(0) == allowed


def test_only_drives_of_one_commit_and_sitting_at_a_like_load_tell_how_much_less_is_computed(short_run):
    one = msgspec.structs.replace(short_run[1][0], time_s=100.0)
    dear, cheap = {"cpu_s": {"local planning": 8.0}}, {"cpu_s": {"local planning": 2.0}}
    good = {"default": like(one, **dear), "fog": like(one, "fog", load=1.4, **cheap)}
    others = [
        {"default": like(one, **dear), "fog": like(one, "fog", cpu_s={"local planning": 8.0}, **changed)}
        for changed in ({"load": 1.5}, {"commit": "d"}, {"sitting": "t"}, {"jobs": 2})
    ]
    assert computation.ratio([good, *others], "default", "fog", MOVE_BASE) == pytest.approx(4.0)
    assert computation.counted([good, *others], ("default", "fog")) == [good]
    assert computation.ratio(others, "default", "fog", MOVE_BASE) is None


def test_drives_in_which_a_warned_robot_was_worse_off_are_listed_with_what_was_different(short_run):
    one = msgspec.structs.replace(short_run[1][0], distance_m=50.0, time_s=200.0, modes={"NORMAL": 1}, stops=[])
    pairs = [
        {"default": like(one), "fog": like(one, "fog", **changed)}
        for changed in (
            {"distance_m": 50.2}, {"distance_m": 51.0}, {"time_s": 230.0, "modes": {"HOLD": 1, "DEGRADED": 2}},
            {"distance_m": 60.0, "route_areas": ["z9"]},
        )
    ]  # fmt: skip
    *_, table = worse(pairs, ["default", "fog"], {})
    assert [row[3:5] for row in table.rows] == [["1.0", "0.0"], ["0.0", "30.0"], ["10.0", "0.0"]]
    assert [row[-1] for row in table.rows] == [
        "the same way by another line",
        "held under way 1 time more; was DEGRADED, and slow, 2 times more",
        f"another way: through z9, not {', '.join(one.route_areas) or 'no watched area'}",
    ]
    # A robot that was not waited for began in HOLD.
    late = {"default": like(one, ready=UNSET, modes={"HOLD": 1}), "full": like(one, "full", ready=UNSET, time_s=260.0)}
    late["full"] = msgspec.structs.replace(late["full"], modes={"HOLD": 2})
    *_, table = worse([late], ["default", "full"], {})
    assert table.rows[0][-1] == "held under way 1 time more"
    # Nor did it drive from the start on, as one did that the fog leads.
    unwaited = {"default": like(one, ready=UNSET), "fog": like(one, "fog", ready=UNSET, time_s=201.5)}
    *_, table = worse([unwaited], ["default", "fog"], {})
    assert table.rows[0][4] == "3.5"


# --- by real processes ---


def test_a_live_drive_that_failed_is_driven_again_and_stays_in_the_count(tmp_path, monkeypatch, short_run):
    outcomes = iter(["stopped", "reached", "never"])
    one = msgspec.structs.replace(short_run[1][0], stops=[])
    shared = {name: getattr(one, name) for name in ComparedDrive.__struct_fields__}

    def drive_live(*_):
        outcome = next(outcomes)
        return MeasuredDrive(**shared | {"outcome": outcome, "success": outcome == "reached"}, kind="live", plans=1)

    monkeypatch.setattr(live_drive, "drive_live", drive_live)
    asked, files = runner.tasks(partial(draw, SPEC, 1), [RUN], ["default"]), Folder(tmp_path).measured("live")
    for _ in range(3):  # the command is repeated
        list(live_drives(None, asked, files, LiveOptions(), print))
    first, second = sorted(files.read(), key=lambda drive: drive.attempt)
    assert (first.name, first.outcome, second.outcome) == (asked[0].name, "stopped", "reached")
    assert second.name == f"{asked[0].name}-attempt2"
    assert second.in_lockstep == asked[0].name
    text = to_markdown(build(short_run[1], {"asked": {"site": "ring", "site_digest": "", "seed": 1},
                                            "measured_on": {}}, measured=[first, second]))  # fmt: skip
    assert "Of 2 drives by real processes 1 failed" in text
    assert "1 of them repeat one that had failed, which is counted, too" in text


def test_a_route_s_site_is_the_same_but_for_the_start_of_the_robot_and_the_demonstration(tmp_path):
    site = load_site(ESTIG)
    drawn = draw(runner.read_spec(site, ESTIG), 1, 2)[1]
    write_route(site, drawn, tmp_path)
    written = load_site(tmp_path)
    assert np.array_equal(written.map.cells, site.map.cells)
    assert written.map.geometry == site.map.geometry
    assert (written.site.areas, written.site.nodes) == (site.site.areas, site.site.nodes)
    assert written.site.places == site.site.places
    start, origin = written.site.robots[0].start, site.site.places[drawn.route.start]
    assert (start.x, start.y, start.theta) == (origin.x, origin.y, drawn.theta)
    assert (written.site.demo.goal, written.site.demo.areas) == (drawn.route.goal, [drawn.area])
