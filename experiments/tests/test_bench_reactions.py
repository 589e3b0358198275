"""The benchmark of reactions: how a time is read from the commanded speeds, what is tried, and the table."""

from __future__ import annotations

import asyncio
import json
import re
from typing import TYPE_CHECKING

import pytest
from typer.testing import CliRunner

from fognav import checkout, kernels
from fognav.output import WrongUseError
from fognav_experiments.bench.reactions import trials
from fognav_experiments.bench.reactions.body import Commanded, slower_after
from fognav_experiments.bench.reactions.faults import FAULTS
from fognav_experiments.bench.reactions.trials import due, measure, percentile, read_log, row
from fognav_experiments.commands import bench

if TYPE_CHECKING:
    from pathlib import Path

BY_NAME = {fault.name: fault for fault in FAULTS}


def commanded(*entries: tuple[float, float, float]) -> list[Commanded]:
    return [Commanded(at, (left, right)) for at, left, right in entries]


def test_time_ends_when_the_last_wheel_is_commanded_to_stand() -> None:
    drives = commanded((0.0, 0.3, 0.3), (10.1, 0.0, 0.1), (10.2, 0.0, 0.0), (10.4, 0.1, -0.1), (10.5, 0.0, 0.0))
    assert slower_after(drives, 10.0, 0.0) == pytest.approx(0.5)
    assert slower_after(drives[:3], 10.0, 0.0) == pytest.approx(0.2)
    assert slower_after(drives, 10.6, 0.0) == 0.0
    assert slower_after(drives[:4], 10.0, 0.0) is None, "a wheel still turns"
    assert slower_after(commanded((0.0, 0.3, 0.3)), 10.0, 0.0) is None


def test_robot_that_only_slows_down_is_judged_by_the_middle_of_its_axle() -> None:
    drives = commanded((0.0, 0.3, 0.3), (10.1, 0.2, 0.2), (10.3, 0.4, -0.4), (10.4, 0.1, 0.19))
    assert slower_after(drives, 10.0, 0.15) == pytest.approx(0.3)
    assert slower_after(drives[:2], 10.0, 0.15) is None


def test_percentile_is_a_value_that_was_measured() -> None:
    values = [float(value) for value in range(1, 201)]
    assert percentile(values, 0.99) == 198.0
    assert percentile([3.0, 1.0, 2.0], 0.99) == 3.0
    assert percentile([1.0], 0.5) == 1.0


def test_trials_that_do_not_stop_the_wheels_count_as_beyond_the_limit_and_have_no_time() -> None:
    killed = row(BY_NAME["agent killed"], [0.1, None, 0.3, 0.31])
    assert (killed["trials"], killed["stopped"], killed["beyond_limit"]) == (4, 3, 2)
    assert (killed["median_s"], killed["max_s"], killed["limit_s"]) == (0.3, 0.31, 0.3)
    assert row(BY_NAME["agent killed"], [None])["max_s"] is None
    unlimited = row(BY_NAME["watchdog and guardian hang"], [None])
    assert (unlimited["limit_s"], unlimited["beyond_limit"]) == (None, 0)


def test_faults_are_tried_in_turn_until_each_has_its_trials(tmp_path: Path) -> None:
    log = tmp_path / "log"
    log.write_text('{"fault": "agent killed", "seconds": 0.1}\n{"fault": "agent killed", "seconds": null}\n')
    times = read_log(log)
    assert times == {"agent killed": [0.1, None]}
    wanted = {"agent killed": 3, "cliff": 2}
    assert list(due(times, lambda fault: wanted.get(fault.name, 0))) == ["agent killed", "cliff", "cliff"]
    assert list(due(times, lambda _: 0)) == []
    assert read_log(tmp_path / "none") == {}
    log.write_text("no log\n")
    with pytest.raises(WrongUseError, match="line 1: no trial of this command"):
        read_log(log)


def test_page_has_a_table_for_each_kind_of_fault_with_its_limit() -> None:
    rows = [row(BY_NAME[name], [0.02, 0.03]) for name in ("agent killed", "cliff", "watchdog and guardian killed")]
    text = trials.markdown(rows, "the command", "a machine", 2)
    assert "| agent killed | 2 | 2 | 0.025 | 0.03 | 0.03 | 0.3 | 0 | 0.3 |" in text
    assert "| cliff | 2 | 2 | 0.025 | 0.03 | 0.03 | 0.05 | 0 | one sensor frame: 0.05 |" in text
    assert "| watchdog and guardian killed | 2 | 2 | 0.025 | 0.03 | 0.03 | none | 0 | none: needs hardware |" in text
    assert "## Operator" not in text
    assert f"Measured at commit {checkout.revision()} on: a machine, 2 robots at once, at a niceness of " in text


def test_page_that_is_written_again_keeps_its_remarks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def nothing(*_: object) -> dict[str, list[float | None]]:
        return {}

    monkeypatch.setattr(trials, "measure", nothing)
    monkeypatch.setattr(kernels, "warm_cache", lambda _tell: None)
    log, written = tmp_path / "log", tmp_path / "page.md"
    for seconds in (0.021, 0.023):
        log.write_text(json.dumps({"fault": "cliff", "seconds": seconds}) + "\n")
        arguments = ["reactions", "--trials", "1", "--log", str(log), "--write", str(written)]
        result = CliRunner().invoke(bench.bench_app, arguments, catch_exceptions=False)
        assert result.exit_code == 0, result.output
        if seconds == 0.021:
            written.write_text(written.read_text("utf-8") + "\nA fourth robot ran beside.\n", "utf-8")
    text = written.read_text("utf-8")
    assert "| 0.023 |" in text
    assert "| 0.021 |" not in text
    assert text.endswith("-->\n\nA fourth robot ran beside.\n")
    assert trials.remarks((checkout.root() / "docs" / "reaction-times.md").read_text("utf-8"))


def test_only_some_kinds_of_faults_are_tried_and_make_no_page(tmp_path: Path) -> None:
    with pytest.raises(WrongUseError, match="no faults of kind wheel: name one of process, device"):
        trials.run(1, 1, 1, None, None, print, ["key", "wheel"])
    with pytest.raises(WrongUseError, match="leave out --only or --write"):
        trials.run(1, 1, 1, None, tmp_path / "page.md", print, ["key"])


def test_documented_limits_are_those_that_are_judged_by() -> None:
    text = (checkout.root() / "docs" / "reaction-times.md").read_text("utf-8")
    for fault in FAULTS:
        (cells,) = [line.split(" | ") for line in text.splitlines() if line.startswith(f"| {fault.name} |")]
        limit = "none" if fault.limit_s is None else str(round(fault.limit_s, 3))
        assert (cells[6], cells[8]) == (limit, f"{fault.design} |"), fault.name


def test_silence_counts_from_when_the_agent_has_looked_for_the_last_message() -> None:
    for name in ("map silent, slow", "map silent, stop", "planner silent, slow", "network gone, slow",
                 "network gone, stop", "change of the map lost"):  # fmt: skip
        assert "poll 0.05 + " in BY_NAME[name].design
    assert BY_NAME["lidar falls silent"].limit_s == pytest.approx(0.45)


def test_every_limit_is_the_sum_of_the_parts_that_its_row_names() -> None:
    for fault in FAULTS:
        turns = re.match(r"3 turns of 0.19", fault.design)
        parts = sum(float(part) for part in re.findall(r"\d+\.\d+", fault.design)) + (2 * 0.19 if turns else 0.0)
        assert fault.limit_s is None or fault.limit_s == pytest.approx(parts), fault.name
        assert (fault.limit_s is None) == fault.design.startswith("none")
        assert fault.limit_s is None or fault.limit_s < fault.observed_s, fault.name
    assert len(BY_NAME) == len(FAULTS)


@pytest.mark.live
@pytest.mark.reaction
@pytest.mark.timeout(180)
async def test_real_robot_stops_and_drives_again_after_faults(tmp_path: Path) -> None:
    names = ["guardian killed", "bumper pressed", "zone over the robot", "key released", "page closed"]
    log = tmp_path / "log"
    wanted = due({}, lambda fault: int(fault.name in names))
    found = await asyncio.wait_for(measure(wanted, 1, log, print), 170.0)
    assert sorted(found) == sorted(names)
    assert all(seconds is not None for times in found.values() for seconds in times)
    assert read_log(log) == found
