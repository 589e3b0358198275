"""Drives by real processes beside the same ones in lockstep: what agrees, what does not, and what they cost."""

from __future__ import annotations

import msgspec
import pytest

from fognav_experiments.comparison.agreement import agreement, compare_drives, resources
from fognav_experiments.comparison.document import to_markdown
from fognav_experiments.comparison.measured import MeasuredDrive
from fognav_experiments.comparison.records import Folder, FolderError, Record

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
    assert "1 of the drives were repeated" in text
    assert "1 of them agree with lockstep" in text
    assert "200" not in text
    assert agreement([other], [LOCKSTEP]) == []


def test_cost_is_that_of_the_robot_s_processes_by_setup_and_quota():
    limited = msgspec.structs.replace(LIVE, cpu_quota=0.2, cpu_percent={"robot-agent": 8.0, "robot-guardian": 2.0})
    text = to_markdown(resources([LIVE, limited]))
    assert "| fog | none | 1 | 6.00 | 1.00 | 0.00 | 7.00 | 200 | 30 | 0 | 230 | 240 |" in text
    assert "| fog | 0.2 of a core | 1 | 8.00 | 2.00 | 0.00 | 10.00 |" in text
    assert resources([msgspec.structs.replace(LIVE, cpu_percent={}, peak_mb={})]) == []
    assert LIVE.robots_peak_mb() == 230.0


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
