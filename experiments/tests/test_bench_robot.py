"""`fognav bench robot`: how the figures are made; the whole measurement takes minutes, and is no test."""

import os
import threading
import time
from pathlib import Path

import pytest

from fog_runtime.configuration.site import load_site
from fognav.output import WrongUseError
from fognav_experiments.bench import common, robot
from robot_agent.agent.edges import exporter


def write_thread(proc: Path, pid: int, thread: int, name: str, nanoseconds: int, switches: int) -> None:
    folder = proc / str(pid) / "task" / str(thread)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "comm").write_text(f"{name}\n")
    (folder / "schedstat").write_text(f"{nanoseconds} 90 7\n")
    (folder / "status").write_text(
        f"Name:\t{name}\nvoluntary_ctxt_switches:\t{switches}\nnonvoluntary_ctxt_switches:\t9\n"
    )


def test_usage_sums_threads_of_one_name_and_counts_new_ones_from_zero(tmp_path: Path) -> None:
    write_thread(tmp_path, 5, 5, "main", 1_000_000_000, 10)
    write_thread(tmp_path, 5, 6, "rx", 500_000_000, 0)
    before = exporter.sample(5, tmp_path)
    write_thread(tmp_path, 5, 5, "main", 1_030_000_000, 30)
    write_thread(tmp_path, 5, 6, "rx", 510_000_000, 4)
    write_thread(tmp_path, 5, 7, "rx", 20_000_000, 6)
    used = exporter.usage(before, exporter.sample(5, tmp_path), 2.0)
    assert used.cpu_percent == pytest.approx(3.0)
    assert used.wakeups_per_s == pytest.approx(15.0)
    assert used.threads == pytest.approx({"main": 1.5, "rx": 1.5})


def test_usage_of_a_real_thread_is_its_cpu_time_and_an_ended_process_has_none() -> None:
    ends = threading.Event()
    waits = threading.Thread(target=ends.wait)
    waits.start()
    identifier = waits.native_id
    assert identifier is not None
    before = exporter.sample(os.getpid())
    begun = time.thread_time()
    while time.thread_time() - begun < 0.05:
        pass
    after = exporter.sample(os.getpid())
    ends.set()
    waits.join()
    main = threading.main_thread().native_id
    assert main is not None
    assert after[main].cpu_s - before[main].cpu_s >= 0.05
    assert after[identifier].cpu_s - before[identifier].cpu_s < 0.05
    assert exporter.sample(2**30) == {}
    assert exporter.memory_mb(2**30) == 0.0
    assert exporter.memory_mb(os.getpid()) > 10.0


def test_figures_add_up_the_processes_and_name_each() -> None:
    idle = {"a": exporter.ProcessUsage(1.0, 40.0, {"main": 1.0}), "b": exporter.ProcessUsage(0.5, 10.0, {"x": 0.5})}
    driving = {
        "a": exporter.ProcessUsage(2.5, 60.0, {"main": 2.0, "rx": 0.5}),
        "b": exporter.ProcessUsage(0.75, 10.0, {"x": 0.75}),
    }
    figures = robot.figures(idle, driving, {"a": 200.0, "b": 20.0})
    processes = figures.pop("processes")
    assert figures == {
        "cpu_percent": 3.25, "idle_cpu_percent": 1.5, "rss_mb": 220.0, "wakeups_per_s": 70.0, "idle_wakeups_per_s": 50.0
    }  # fmt: skip
    assert isinstance(processes, dict)
    assert processes["a"] == {
        "cpu_percent": 2.5, "idle_cpu_percent": 1.0, "rss_mb": 200.0, "wakeups_per_s": 60.0, "idle_wakeups_per_s": 40.0,
        "threads": {"main": 2.0, "rx": 0.5}, "idle_threads": {"main": 1.0},
    }  # fmt: skip


@pytest.mark.parametrize("version", [1, 2])
def test_quota_is_written_in_the_words_of_either_version_of_control_groups(
    tmp_path: Path, version: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cpu").mkdir()
    if version == 2:
        (tmp_path / "cgroup.controllers").write_text("cpu memory")
    kept: list[dict[str, str]] = []
    removed: list[Path] = []

    def rmdir(folder: Path) -> None:
        kept.append({file.name: file.read_text() for file in folder.iterdir()})
        removed.append(folder.parent)

    monkeypatch.setattr(Path, "rmdir", rmdir)
    with robot.cpu_quota(0.2, tmp_path) as group:
        group.add(41)
    words = {"cpu.max": "2000 10000"} if version == 2 else {"cpu.cfs_period_us": "10000", "cpu.cfs_quota_us": "2000"}
    assert kept == [{**words, "cgroup.procs": "41"}]
    assert removed == [tmp_path if version == 2 else tmp_path / "cpu"]


def test_quota_that_the_system_refuses_is_named_with_the_remedy(tmp_path: Path) -> None:
    with (
        pytest.raises(WrongUseError, match=r"--cpu-quota: .*Run this as root"),
        robot.cpu_quota(0.2, tmp_path / "none"),
    ):
        pass


def test_site_of_the_benchmark_is_valid_and_its_robot_stands_on_free_floor(tmp_path: Path) -> None:
    floor = common.make_office(60.0, 40.0)
    loaded = load_site(robot.write_site(tmp_path, floor))
    start, far = loaded.site.robots[0].start, loaded.site.places["far"]
    for place in (start, far):
        column, row = floor.geometry.cell(place.x, place.y)
        assert loaded.map.cells[row, column] == 0
    assert far.x - start.x > 40.0
