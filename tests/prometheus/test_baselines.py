"""The recorded CPU that dashboards compare robots with comes from the report of an experiment."""

import csv
import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "deploy" / "prometheus" / "make_baselines.py"
README = "| measured on |  |\n| --- | --- |\n| machine processor | Cortex-A72 |\n"


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("make_baselines", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


PROCESSES = """
## What the robot's processes cost

| setup | quota | speed | drives | agent, % | guardian, % | watchdog, % |
| --- | --- | --- | --- | --- | --- | --- |
| default | none | 1 | 3 | 8.00 | 2.00 | 0.20 |
| full | 0.2 of a core | 1 | 2 | 4.00 | 1.00 | 0.10 |

| Memory of the robot's processes, MB | default | full |
| --- | --- | --- |
| A to B | 233.4 ± 1.9 | 206.4 ± 0.0 |

## Another table
| setup |
"""

COMPONENTS = [
    f"cpu_{name}_s"
    for name in (
        "global_planning", "layers", "local_planning", "localization", "safety_and_wheels", "messages", "lidar_driver",
        "guardian",
    )
]  # fmt: skip


def report(folder: Path, *drives: tuple[int, str, float, str], readme: str = README) -> Path:
    """Write a report with drives of one route: run, setup, CPU in percent, and whether it succeeded."""
    with (folder / "drives.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["setup", "run", "route", "success", "time_s", "cpu_move_base_percent", *COMPONENTS])
        # A tenth of a second of each component more than of the one before, in 100 s.
        seconds = [0.1 * number for number, _ in enumerate(COMPONENTS)]
        rows.writerows([setup, run, "ab", success, 100, percent, *seconds] for run, setup, percent, success in drives)
    (folder / "README.md").write_text(readme)
    return folder


def recorded(text: str) -> dict[str, tuple[str, str, str]]:
    (group,) = yaml.safe_load(text)["groups"]
    return {
        rule["labels"]["setup"]: (rule["expr"], rule["labels"]["machine"], rule["labels"]["drives"])
        for rule in group["rules"]
        if rule["record"] == "baseline:planning_cpu:mean"
    }


def test_recorded_baselines_are_those_of_the_published_report():
    done = subprocess.run([sys.executable, SCRIPT, "--check"], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_baseline_is_the_mean_of_the_routes_that_were_driven_in_every_setup(script, tmp_path):
    folder = report(
        tmp_path,
        *((1, setup, percent, "True") for setup, percent in (("default", 4.0), ("full", 2.0), ("fog", 1.0))),
        *((2, setup, percent, "True") for setup, percent in (("default", 6.0), ("full", 2.5), ("fog", 1.5))),
        (3, "default", 90.0, "True"), (3, "full", 90.0, "False"), (3, "fog", 90.0, "True"),
    )  # fmt: skip
    assert recorded(script.rules(folder)) == {
        "default": ("vector(0.05000)", "Cortex-A72", "2"),
        "full": ("vector(0.02250)", "Cortex-A72", "2"),
        "fog": ("vector(0.01250)", "Cortex-A72", "2"),
    }


def test_baselines_of_the_robot_s_processes_are_those_of_real_ones_without_a_quota(script, tmp_path):
    drives = [(1, setup, 1.0, "True") for setup in ("default", "full", "fog")]
    text = script.rules(report(tmp_path, *drives, readme=README + PROCESSES))
    (group,) = yaml.safe_load(text)["groups"]
    found = {
        (rule["labels"]["setup"], rule["labels"]["process"]): (rule["expr"], rule["labels"]["drives"])
        for rule in group["rules"]
        if rule["record"] == "baseline:process_cpu:mean"
    }
    assert found == {
        ("default", "agent"): ("vector(0.08000)", "3"),
        ("default", "guardian"): ("vector(0.02000)", "3"),
        ("default", "watchdog"): ("vector(0.00200)", "3"),
    }
    with pytest.raises(SystemExit, match="table of processes can't be read"):
        script.rules(report(tmp_path, *drives, readme=README + PROCESSES.replace("agent, %", "agent")))


def test_report_that_names_no_processor_is_none(script, tmp_path):
    drives = [(1, setup, 1.0, "True") for setup in ("default", "full", "fog")]
    with pytest.raises(SystemExit, match=r"README\.md names no `machine processor`"):
        script.rules(report(tmp_path, *drives, readme=PROCESSES))


def test_baselines_of_threads_are_the_components_that_run_on_them(script, tmp_path):
    drives = [(1, setup, 1.0, "True") for setup in ("default", "full", "fog")]
    (group,) = yaml.safe_load(script.rules(report(tmp_path, *drives)))["groups"]
    rules = [rule for rule in group["rules"] if rule["record"] == "baseline:thread_cpu:mean"]
    found = {(rule["labels"]["process"], rule["labels"]["thread"]): rule["expr"] for rule in rules}
    assert found == {
        ("agent", "decide"): "vector(0.00200)",  # 0 and 0.2 s
        ("agent", "python"): "vector(0.01900)",  # 0.1, 0.3, 0.4, 0.5 and 0.6 s
        ("guardian", "python"): "vector(0.00700)",
    }
    assert {rule["labels"]["setup"] for rule in rules} == {"default", "full", "fog"}


def test_baselines_are_of_drives_at_speed_1_and_of_one_commit(script):
    row = "| default | none | 1 | 3 | 8.00 | 2.00 | 0.20 |\n"
    faster = row.replace("| 1 |", "| 4 |").replace("8.00", "2.00")
    assert script.processes(PROCESSES.replace(row, row + faster))["default", "agent"] == (0.08, "3")
    with pytest.raises(SystemExit, match="several rows of one setup"):
        script.processes(PROCESSES.replace(row, row + row.replace("8.00", "9.00")))


def test_published_baselines_have_the_whole_robot_in_the_setups_of_the_thesis():
    (group,) = yaml.safe_load((SCRIPT.parent / "rules" / "baselines.yml").read_text("utf-8"))["groups"]
    found = {(rule["labels"]["setup"], rule["labels"].get("process", "planning")) for rule in group["rules"]}
    assert found >= {(s, p) for s in ("default", "full") for p in ("planning", "agent", "guardian", "watchdog")}
    threads = {
        (rule["labels"]["setup"], rule["labels"]["thread"]) for rule in group["rules"] if "thread" in rule["labels"]
    }
    assert threads >= {(setup, thread) for setup in ("default", "full") for thread in ("decide", "python")}


def test_folder_without_a_report_a_complete_route_or_a_machine_is_refused_with_the_remedy(script, tmp_path):
    with pytest.raises(SystemExit, match="is no report"):
        script.rules(tmp_path)
    with pytest.raises(SystemExit, match="in all of default, full, fog"):
        script.rules(report(tmp_path, (1, "default", 4.0, "True")))
    drives = [(1, setup, 1.0, "True") for setup in ("default", "full", "fog")]
    with pytest.raises(SystemExit, match="machine processor"):
        script.rules(report(tmp_path, *drives, readme="# Empty\n"))
