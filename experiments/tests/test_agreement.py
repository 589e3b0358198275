"""Drives by real processes beside the same ones in lockstep: what agrees, what does not, and what they cost."""

from __future__ import annotations

import re
from collections import Counter

import msgspec
import pytest

from fognav_experiments import figures
from fognav_experiments.comparison import break_even
from fognav_experiments.comparison.drives import MeasuredDrive
from fognav_experiments.comparison.records import Folder, FolderError, Record
from fognav_experiments.comparison.repeated import (
    agreement,
    beside_lockstep,
    compare_drives,
    compared,
    of_processes,
    processes,
    resources,
)
from fognav_experiments.comparison.report import build
from fognav_experiments.comparison.situations import by_situation
from fognav_experiments.figures import to_markdown

SHARED = {
    "setup": "fog", "run": 2, "route": "ab", "seed": 7, "area": "z4", "moment": "before", "trigger_m": 0.0,
    "outcome": "reached", "reason": "", "success": True, "distance_m": 70.0, "time_s": 240.0, "paths": 2, "stops": [],
    "route_areas": ["z1"], "modes": {"NORMAL": 2, "DEGRADED": 1}, "min_clearance_m": 0.3, "load": 1.0, "version": "0",
}  # fmt: skip
LOCKSTEP = Record(
    **SHARED, planned_m=67.0, contacts=0, barrier_distance_m=9.0, pose_error_m=0.1, reaction_s=None, received_bytes=1,
    operator_commands=1, cpu_s={}, jobs=1, wall_s=60.0,
)  # fmt: skip
LIVE = MeasuredDrive(
    **SHARED, kind="live", plans=2, cpu_percent={"robot-agent": 6.0, "robot-guardian": 1.0, "planner": 9.0},
    peak_mb={"robot-agent": 200.0, "robot-guardian": 30.0, "planner": 300.0},
)  # fmt: skip


def test_drives_agree_within_the_tolerances():
    near = msgspec.structs.replace(LIVE, distance_m=71.9, time_s=250.0, paths=3, modes={"NORMAL": 5, "HOLD": 1})
    assert compare_drives(near, LOCKSTEP).differences == []


@pytest.mark.parametrize(
    ("changes", "difference"),
    [
        ({"outcome": "timeout", "reason": "too late"}, "outcome timeout (too late), in lockstep reached"),
        ({"distance_m": 103.0}, "103.0 m, in lockstep 70.0 m"),
        ({"time_s": 260.0}, "260.0 s, in lockstep 240.0 s"),
        ({"time_s": None}, "only one of them ended"),
        ({"paths": 4}, "4 paths followed, in lockstep 2"),
        ({"route_areas": []}, "through none, in lockstep through z1"),
        ({"modes": {"NORMAL": 2, "FAULT": 1}}, "was in FAULT, in lockstep in none"),
    ],
)
def test_what_goes_beyond_a_tolerance_is_named(changes, difference):
    assert compare_drives(msgspec.structs.replace(LIVE, **changes), LOCKSTEP).differences == [difference]


def test_the_report_counts_those_that_agree_and_leaves_out_drives_under_a_quota():
    limited = msgspec.structs.replace(LIVE, cpu_quota=0.2, distance_m=200.0)
    other = msgspec.structs.replace(LIVE, setup="full")
    text = to_markdown(agreement([LIVE, limited, other], [LOCKSTEP]))
    assert "1 of them agree with lockstep" in text
    assert "200" not in text
    assert agreement([other], [LOCKSTEP]) == []


def test_cost_is_that_of_the_robot_s_processes_by_setup_and_quota():
    limited = msgspec.structs.replace(LIVE, cpu_quota=0.2, cpu_percent={"robot-agent": 8.0, "robot-guardian": 2.0})
    text = to_markdown(resources([LIVE, limited]))
    assert "| fog | none | 1 | - | 1 to 1 | 1 | 6.00 | 1.00 | 0.00 | 7.00 | 200 | 30 | 0 | 230 | 240 |" in text
    assert "| fog | 0.2 of a core | 1 | - | 1 to 1 | 1 | 8.00 | 2.00 | 0.00 | 10.00 |" in text
    assert resources([msgspec.structs.replace(LIVE, cpu_percent={}, peak_mb={})]) == []
    assert LIVE.robots_peak_mb() == 230.0


def test_difference_of_processes_is_of_drives_that_succeeded_and_is_doubted_unless_loads_were_alike():
    def drive(setup, agent, **changes):
        return msgspec.structs.replace(LIVE, setup=setup, cpu_percent={"robot-agent": agent}, **changes)

    failed = drive("default", 90.0, success=False)
    alike = of_processes([drive("default", 8.0, load=14.0), failed, drive("fog", 5.0, load=10.0)])
    assert alike is not None
    assert (alike.before, alike.fog, alike.doubt) == (8.0, 5.0, "")
    for other in ({"load": 5.0}, {"load": 10.0, "commit": "2ba7f7651ee5"}):
        found = of_processes([drive("default", 8.0, load=14.0), drive("fog", 5.0, **other)])
        assert found is not None
        assert "0 of 1 pairs of drives count" in found.doubt
    assert of_processes([failed, drive("fog", 5.0)]) is None
    elsewhere = drive("default", 30.0, run=LIVE.run + 1)
    assert of_processes([elsewhere, drive("fog", 5.0)]) is None, "of other draws, nothing can be told"
    beside = of_processes([elsewhere, drive("default", 8.0, load=14.0), drive("fog", 5.0, load=10.0)])
    assert beside == alike


def test_detours_of_which_a_warning_saves_nothing_are_shown_among_what_warnings_cost():
    def drives(default_s, fog_s):
        times = {"default": default_s, "fog": fog_s}
        return {
            setup: msgspec.structs.replace(LOCKSTEP, setup=setup, time_s=time_s, moment="before", ready=True)
            for setup, time_s in times.items()
        }

    free, met = drives(120.0, 120.0), drives(250.0, 249.0)
    text = to_markdown(break_even.blocks([free, met], [met]))
    assert "| 120 | 249 | 250 | 1 | 129 | 99 % | - | - | - |" in text
    assert "it only costs" in text
    assert "break-even.svg" not in text


def test_areas_that_are_called_by_numbers_are_no_drawn_floors():
    pairs = [{setup: msgspec.structs.replace(LOCKSTEP, setup=setup, area="3") for setup in ("default", "fog")}]
    (table,) = (block for block in by_situation(pairs, pairs, "default", "fog") if isinstance(block, figures.Table))
    assert (table.header[:2], table.rows[0][:2]) == (["route", "blocked"], ["A to B", "3"])


def test_drives_of_different_commits_are_not_called_the_same_and_each_names_commit_and_load():
    live = msgspec.structs.replace(LIVE, commit="2ba7f7651ee5", load=16.8)
    text = to_markdown(agreement([live], [LOCKSTEP], begun_with="7217190"))
    assert "## The same routes and seeds by real processes" in text
    assert (
        "The routes and seeds of 1 drives were repeated by real processes and another version of the program: brokers"
        in text
    )
    assert "| 0002-ab-fog | 2ba7f7651ee5 | 7217190 | 16.8 |" in text
    same = to_markdown(agreement([live], [msgspec.structs.replace(LOCKSTEP, commit="2ba7f76")], begun_with="7217190"))
    assert "## The same drives by real processes" in same
    assert "1 of the drives were repeated by real processes: brokers" in same


def test_the_cost_of_one_commit_is_not_mixed_with_that_of_another():
    drives = [msgspec.structs.replace(LIVE, commit=commit, load=load) for commit, load in (("a", 2.0), ("b", 20.0))]
    text = to_markdown(resources(drives))
    assert "| fog | none | 1 | a | 2 to 2 | 1 | 6.00 |" in text
    assert "| fog | none | 1 | b | 20 to 20 | 1 | 6.00 |" in text


def test_a_drive_that_failed_has_no_mean_time_and_stands_in_the_report():
    failed = msgspec.structs.replace(LIVE, route="cd", success=False, outcome="timeout", reason="late", time_s=None)
    assert "| 200 | 30 | 0 | 230 | - |" in to_markdown(resources([failed]))
    record = msgspec.structs.replace(
        LOCKSTEP, track=[(0.0, 0.0), (1.0, 1.0)], cpu_s={"local planning": 2.4, "localization": 2.4, "guardian": 2.4}
    )
    cpu_s = {"local planning": 2.4, "localization": 2.4}
    others = [msgspec.structs.replace(record, setup=setup, cpu_s=cpu_s) for setup in ("default", "full")]
    experiment = {"asked": {"site": "estig", "site_digest": "0", "seed": 1}, "measured_on": {"commit": "7217190"}}
    text = to_markdown(build([record, *others], experiment, measured=[failed]))
    assert "| 0002-cd-fog | live | timeout | late |" in text
    assert "None of 3 drives in lockstep failed" in text
    assert "Of 1 drives by real processes 1 failed, and 0 had a protective stop or a fault." in text
    assert "at 1 drive at a time" in text
    assert "| fog / default | 2.00 | 2.00 | 2.00 | +1.00 |" in text
    assert "so ratios count" not in text


def test_a_drive_at_another_speed_is_another_record_and_is_compared_with_the_same_one_in_lockstep():
    fast = msgspec.structs.replace(LIVE, speed=2.0, asked_speed=4.0)
    assert fast.name == "0002-ab-fog-speed4"
    assert [pair.lockstep for pair in compared([fast], [LOCKSTEP])] == [LOCKSTEP]
    text = to_markdown(resources([LIVE, fast]))
    assert "| fog | none | 1 | - |" in text
    assert "| fog | none | 2 | - |" in text


def test_drives_with_and_without_a_quota_stand_beside_one_another(tmp_path):
    files = Folder(tmp_path).measured("live")
    limited = msgspec.structs.replace(LIVE, cpu_quota=0.2)
    for drive in (LIVE, limited):
        assert not files.has(drive.name)
        files.write(drive)
    assert sorted(files.read(), key=lambda drive: drive.name) == [LIVE, limited]
    assert LIVE.name == LOCKSTEP.name
    (tmp_path / "live" / "0003-ab-fog.json").write_text("{}")
    with pytest.raises(FolderError, match=r"0003-ab-fog\.json can't be read"):
        files.read()


def test_drives_of_a_real_robot_are_compared_apart_from_those_of_real_processes():
    live, lockstep = (msgspec.structs.replace(drive, commit="2ba7f76") for drive in (LIVE, LOCKSTEP))
    real = msgspec.structs.replace(live, kind="hardware", cpu_percent={}, peak_mb={})
    text = to_markdown(agreement([live, real], [lockstep]))
    by_processes, by_robot = "by real processes: brokers", "by a real robot: as the thesis's figures 6.11 and 6.12"
    assert 0 < text.index(by_processes) < text.index(by_robot)
    assert "by a real robot" not in to_markdown(agreement([live], [lockstep]))


EXPERIMENT = {"asked": {"site": "estig", "site_digest": "0", "seed": 1}, "measured_on": {"commit": "7217190"}}


def in_each_setup(drive, **changes):
    return [msgspec.structs.replace(drive, setup=setup, **changes) for setup in ("default", "full", "fog")]


def test_memory_is_drawn_by_route_and_setup_from_what_each_drive_took():
    drives = [
        LIVE,
        msgspec.structs.replace(LIVE, run=3, peak_mb={"robot-agent": 210.0, "robot-guardian": 30.0}),
        msgspec.structs.replace(LIVE, setup="default", peak_mb={"robot-agent": 260.0, "robot-guardian": 40.0}),
        msgspec.structs.replace(LIVE, setup="default", route="cd", peak_mb={"robot-agent": 400.0}),
    ]
    cpu, cpu_table, figure, table = processes(drives)
    assert (cpu.file, figure.file) == ("live-cpu.svg", "live-memory.svg")
    assert cpu_table.rows[0] == ["A to B", "7.00", "7.00 (7.00 to 7.00)"]
    assert "mean of 4 drives" in figure.caption
    bars = Counter(re.findall(r"fill: (#\w+)", figure.svg))
    assert bars[figures.COLOURS["default"]] == 1 + 2  # in the legend, and on each route
    assert bars[figures.COLOURS["fog"]] == 1 + 1
    assert [row[:2] for row in table.rows] == [["A to B", "300.0"], ["C to D", "400.0"]]
    assert table.rows[0][2] == "235.0 (230.0 to 240.0)"
    assert "intervals" not in figure.caption, "two drives of one situation"
    assert table.rows[1][2] == "-"


def test_drives_under_a_quota_and_robots_whose_exporter_told_nothing_are_in_no_figure():
    assert processes([msgspec.structs.replace(LIVE, cpu_quota=0.2)]) == []
    assert processes([msgspec.structs.replace(LIVE, kind="hardware", peak_mb={}, cpu_percent={})]) == []


def test_figures_6_9_and_6_10_are_those_of_a_real_robot_by_what_its_exporter_told():
    threads = {"robot-agent": {"decide": 4.0, "python": 2.0}}
    real = [msgspec.structs.replace(drive, thread_percent=threads) for drive in in_each_setup(LIVE, kind="hardware")]
    cpu, _, memory, _, _, by_thread = processes(real)
    assert (cpu.file, memory.file) == ("hardware-cpu.svg", "hardware-memory.svg")
    assert cpu.caption.startswith("As figure 6.9")
    assert memory.caption.startswith("As figure 6.10")
    assert by_thread.rows[0] == ["hardware", "robot-agent", "decide", "4.00", "4.00", "4.00"]


def test_distance_and_time_stand_beside_lockstep_for_drives_that_reached_their_goal_in_both():
    drives = [
        msgspec.structs.replace(LIVE, distance_m=71.0, time_s=244.0),
        msgspec.structs.replace(LIVE, run=3, distance_m=73.0, time_s=246.0),
        msgspec.structs.replace(LIVE, run=4, success=False, outcome="timeout", distance_m=500.0, time_s=None),
        msgspec.structs.replace(LIVE, run=5, distance_m=500.0),  # not driven in lockstep
        msgspec.structs.replace(LIVE, run=2, cpu_quota=0.2, distance_m=500.0),
    ]
    records = [msgspec.structs.replace(LOCKSTEP, run=run) for run in (2, 3, 4)]
    heading, words, distance, time, table = beside_lockstep(drives, records)
    assert heading.text == "Lockstep beside real processes"
    assert words.text.startswith("2 drives that reached their goal")
    assert (distance.file, time.file) == ("live-distance.svg", "live-time.svg")
    assert "As figure 6.11" in distance.caption
    assert "As figure 6.12" in time.caption
    (row,) = table.rows
    assert row[:5] == ["A to B", "fog", "2", "70.0 (70.0 to 70.0)", "72.0 (71.0 to 73.0)"]
    assert row[5] == "2.00 (1.00 to 3.00)"
    assert row[8] == "5.00 (4.00 to 6.00)"
    assert beside_lockstep(drives[2:], records) == []


def test_the_report_says_where_the_figures_of_memory_and_reality_are():
    record = msgspec.structs.replace(
        LOCKSTEP, track=[(0.0, 0.0), (1.0, 1.0)], cpu_s={"local planning": 2.4, "localization": 2.4, "guardian": 2.4}
    )
    records = in_each_setup(record)
    lockstep_only = to_markdown(build(records, EXPERIMENT))
    assert "| 6.6 | memory of move_base, simulated | only by real processes" in lockstep_only
    assert "| 6.11 | distance, simulated and real | only by real processes" in lockstep_only
    assert "for which there is no robot here." in lockstep_only
    live = to_markdown(build(records, EXPERIMENT, measured=in_each_setup(LIVE)))
    assert "| 6.6 | memory of move_base, simulated | live-memory.svg, and the table below it |" in live
    assert "| 6.10 | memory of move_base, real | only by a real robot (fognav experiment --hardware)" in live
    assert "| 6.11 | distance, simulated and real | live-distance.svg, and the table below |" in live
    assert "| 6.12 | time, simulated and real | live-time.svg, and the table below |" in live
    for figure in ("live-memory.svg", "live-cpu.svg", "live-distance.svg", "live-time.svg"):
        assert f"]({figure})" in live
    assert "3 drives by real processes on a simulated one are compared with lockstep" in live
    real = in_each_setup(LIVE, kind="hardware", peak_mb={}, cpu_percent={})
    both = to_markdown(build(records, EXPERIMENT, measured=[*in_each_setup(LIVE), *real]))
    assert "| live-time.svg and hardware-time.svg, and the table below |" in both
    assert "## Lockstep beside a real robot" in both


def test_the_report_says_how_many_drives_ran_at_a_time_and_at_which_load():
    record = msgspec.structs.replace(
        LOCKSTEP, track=[(0.0, 0.0), (1.0, 1.0)], cpu_s={"local planning": 2.4, "localization": 2.4, "guardian": 2.4}
    )
    pairs = [*in_each_setup(record), *in_each_setup(record, run=3, jobs=2, load=4.0)]
    text = to_markdown(build(pairs, EXPERIMENT))
    assert "| 1 at a time | 3 of the drives, at a load average of 1.0 to 1.0 |" in text
    assert "| 2 at a time | 3 of the drives, at a load average of 4.0 to 4.0 |" in text
