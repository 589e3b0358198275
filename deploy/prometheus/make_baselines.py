"""Writes the recorded CPU of robots in the setups `default`, `full` and `fog` as Prometheus's recording rules.

And what all of a robot's processes took alone and with the fog, for the console.

The figures come from the report of an experiment (`fognav experiment report`): from its `drives.csv`, and the machine
from its `README.md`, which also says what the robot's processes took in drives by real processes (`fognav experiment
--live`). Dashboards show them beside what robots take now.

What each thread took is known by component, from drives in lockstep: the calculations of a thread, without the sockets,
the event loop and the waking up that a real one has besides.

Run: python deploy/prometheus/make_baselines.py [FOLDER] [--check]. FOLDER is the report's (docs/results/estig-live);
one of your own says more of your robots' computers. With --check nothing is written, and the exit code is 1 if the file
is out of date.
"""

import argparse
import csv
import json
import re
from collections.abc import Mapping, Sequence
from itertools import dropwhile, takewhile
from pathlib import Path
from statistics import fmean
from typing import Final

ROOT: Final = Path(__file__).parents[2]
FILE: Final = Path(__file__).parent / "rules" / "baselines.yml"
PAGE: Final = ROOT / "console" / "src" / "views" / "baseline.json"
"""What the console compares a robot's CPU with: percent of a core of all of its processes."""
SETUPS: Final = ("default", "full", "fog")
_COLUMN: Final = "cpu_move_base_percent"
"""Planning, layers and local planning: what one program did on the thesis's robot, and its figures 6.5 and 6.9 show."""
_THREADS: Final = {
    ("agent", "decide"): ("cpu_global_planning_s", "cpu_local_planning_s"),
    ("agent", "python"): (
        "cpu_layers_s", "cpu_localization_s", "cpu_safety_and_wheels_s", "cpu_messages_s", "cpu_lidar_driver_s",
    ),
    ("guardian", "python"): ("cpu_guardian_s",),
}  # fmt: skip
"""Which components run on which thread of a real robot, by process and thread."""
_PROCESSES: Final = ("agent", "guardian", "watchdog")
_MACHINE: Final = re.compile(r"^\| machine processor \| ([^|\"{}]+?) \|$", re.MULTILINE)


def compared(drives: Sequence[Mapping[str, str]]) -> dict[str, list[Mapping[str, str]]]:
    """Return the drives of each setup: on those routes that succeeded in all setups.

    Raises `SystemExit` if there are none.
    """
    routes: dict[tuple[str, str], dict[str, Mapping[str, str]]] = {}
    for drive in drives:
        if drive["success"] == "True":
            routes.setdefault((drive["run"], drive["route"]), {})[drive["setup"]] = drive
    complete = [found for found in routes.values() if set(SETUPS) <= found.keys()]
    if not complete:
        raise SystemExit(f"no route was driven in all of {', '.join(SETUPS)}: let `fognav experiment` go on")
    return {setup: [found[setup] for found in complete] for setup in SETUPS}


def planning(drives: Sequence[Mapping[str, str]]) -> float:
    """Return what planning took on average, in cores."""
    return fmean(float(drive[_COLUMN]) / 100.0 for drive in drives)


def threads(drives: Sequence[Mapping[str, str]]) -> dict[tuple[str, str], float]:
    """Return what the components of each thread took on average, in cores, by process and thread."""
    return {
        thread: fmean(sum(float(drive[column]) for column in columns) / float(drive["time_s"]) for drive in drives)
        for thread, columns in _THREADS.items()
    }


def _in_table(line: str) -> bool:
    return line.startswith("|")


def processes(readme: str) -> dict[tuple[str, str], tuple[float, str]]:
    """Return CPU (cores) and number of drives of each setup's processes, of real ones without a quota at speed 1.

    Nothing, if the report has none. Raises `SystemExit` if its table has other columns, or two such rows of a setup.
    """
    section = readme.partition("## What the robot's processes cost")[2].partition("\n## ")[0]
    # Only the first table: that of memory by route may follow it.
    table = takewhile(_in_table, dropwhile(lambda line: not _in_table(line), section.splitlines()))
    lines = [line.strip("| ").split(" | ") for line in table]
    if not lines:
        return {}
    head, _, *rows = lines
    try:
        named = [dict(zip(head, row, strict=True)) for row in rows]
        taken = [row for row in named if (row["quota"], row["speed"]) == ("none", "1") and row["setup"] in SETUPS]
        setups = [row["setup"] for row in taken]
        if len(set(setups)) < len(setups):
            raise SystemExit(
                "the report has several rows of one setup without a quota at speed 1, of different commits: repeat the "
                "drives with one commit"
            )
        return {
            (row["setup"], process): (float(row[f"{process}, %"]) / 100.0, row["drives"])
            for row in taken
            for process in _PROCESSES
        }
    except (KeyError, ValueError) as error:
        raise SystemExit(f"the report's table of processes can't be read: {error!r}") from error


def processor(page: Path, text: str) -> str:
    """Return on which processor a page's figures were measured; raises `SystemExit` if it does not say that."""
    found = _MACHINE.search(text)
    if found is None:
        raise SystemExit(f"{page} names no `machine processor`: `fognav experiment report` writes it")
    return found[1]


def for_page(folder: Path) -> str | None:
    """Return the console's file; None for a report without drives of real processes alone and with the fog."""
    readme = (folder / "README.md").read_text("utf-8")
    real = processes(readme)
    if not {(setup, name) for setup in ("default", "fog") for name in _PROCESSES} <= real.keys():
        return None
    alone, fog = (round(sum(100.0 * real[setup, name][0] for name in _PROCESSES), 2) for setup in ("default", "fog"))
    drives = int(real["default", "agent"][1])
    made = {"alone": alone, "withFog": fog, "drives": drives, "machine": processor(folder / "README.md", readme)}
    return json.dumps(made, indent=2) + "\n"


def rules(folder: Path) -> str:
    """Return the file of rules for a report's folder; raises `SystemExit` if that is no report."""
    try:
        with (folder / "drives.csv").open(encoding="utf-8", newline="") as file:
            drives = compared(list(csv.DictReader(file)))
        readme = (folder / "README.md").read_text("utf-8")
    except (OSError, KeyError, ValueError) as error:
        raise SystemExit(f"{folder} is no report ({error}): `fognav experiment report` writes one") from error
    machine = processor(folder / "README.md", readme)
    real = processes(readme)
    lines = [
        "# Made by deploy/prometheus/make_baselines.py from the report of an experiment: do not edit.",
        "# CPU in cores of planning, layers and local planning, the mean of recorded drives in each setup; and of the",
        "# robot's processes in drives by real ones; and of the calculations of each thread in lockstep.",
        "groups:",
        "  - name: baselines",
        "    rules:",
    ]
    for setup, made in drives.items():
        labels = f'machine: "{machine}", drives: "{len(made)}"'
        lines += [
            "      - record: baseline:planning_cpu:mean",
            f"        expr: vector({planning(made):.5f})",
            f"        labels: {{setup: {setup}, {labels}}}",
        ]
        for (process, thread), cores in threads(made).items():
            lines += [
                "      - record: baseline:thread_cpu:mean",
                f"        expr: vector({cores:.5f})",
                f"        labels: {{setup: {setup}, process: {process}, thread: {thread}, {labels}}}",
            ]
    for (setup, process), (taken, count) in sorted(real.items()):
        labels = f'setup: {setup}, process: {process}, machine: "{machine}", drives: "{count}"'
        lines += [
            "      - record: baseline:process_cpu:mean",
            f"        expr: vector({taken:.5f})",
            f"        labels: {{{labels}}}",
        ]
    return "\n".join(lines) + "\n"


def main() -> int:
    """Write the file, or compare it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT / "docs" / "results" / "estig-live")
    parser.add_argument("--check", action="store_true", help="write nothing")
    options = parser.parse_args()
    made = {FILE: rules(options.folder), PAGE: for_page(options.folder)}
    outdated = False
    for file, text in made.items():
        if text is None or (file.exists() and file.read_text("utf-8") == text):
            continue
        outdated = True
        if options.check:
            print(f"{file.name} is out of date: run this without --check")
        else:
            file.write_text(text, "utf-8")
            print(f"wrote {file}")
    return int(options.check and outdated)


if __name__ == "__main__":
    raise SystemExit(main())
