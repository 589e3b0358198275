"""Tries all faults on several robots at once, and keeps their times in a log that later runs continue.

Each robot has a process of its own (`python -m fognav_experiments.bench.reactions.trials`), which tries the faults that
standard input names. It also writes the page `docs/reaction-times.md`.
"""

from __future__ import annotations

import asyncio
import inspect
import json
import math
import os
import statistics
import sys
import time
from collections import deque
from typing import TYPE_CHECKING, Final

from fognav import checkout
from fognav.output import FailedError, WrongUseError
from fognav_experiments import machine
from fognav_experiments.bench.reactions.faults import FAULTS, Fault
from fognav_experiments.bench.reactions.rig import Rig

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping, Sequence
    from pathlib import Path


BY_HAND: Final = frozenset({"key", "page"})
_WORKER: Final = "fognav_experiments.bench.reactions.trials"
_PROBLEMS_MAX: Final = 20
"""Robots that did not drive (again), after which the machine or the robot is to blame."""

Times = dict[str, list[float | None]]


def run(  # noqa: PLR0913  # how often, on how many robots, which, and where to
    processes: int,
    others: int,
    robots: int,
    log: Path | None,
    page: Path | None,
    tell: Callable[[str], object],
    kinds: Sequence[str] = (),
) -> list[dict[str, object]]:
    """Try each fault of processes so often, with the trials of the log, and each other one; return a row for each.

    kinds: only faults of these kinds, if there are any. Writes the page; what people remarked on it stays. Raises as
    `measure` and `read_log` do, and `WrongUseError` for kinds that there are not.
    """
    times = read_log(log)
    if unknown := set(kinds) - set(_TITLES):
        raise WrongUseError(f"there are no faults of kind {min(unknown)}: name one of {', '.join(_TITLES)}")
    if kinds and page is not None:
        raise WrongUseError("a page has the faults of all kinds: leave out --only or --write")

    def wanted(fault: Fault) -> int:
        return 0 if kinds and fault.kind not in kinds else processes if fault.kind == "process" else others

    waiting = due(times, wanted)
    found = asyncio.run(measure(waiting, robots, log, tell))
    rows = [row(fault, every) for fault in FAULTS if (every := times.get(fault.name, []) + found.get(fault.name, []))]
    if page is not None:
        command = f"fognav bench reactions --trials {processes} --others {others} --robots {robots}"
        kept = remarks(page.read_text("utf-8")) if page.exists() else ""
        written = markdown(rows, f"{command} --log FILE --write PAGE", machine.sentence(), robots, kept)
        page.write_text(written, "utf-8")
    return rows


def read_log(log: Path | None) -> Times:
    """Return the times of earlier runs, by fault; raises `WrongUseError` for a file that is no such log."""
    times: Times = {}
    if log is None or not log.exists():
        return times
    for number, line in enumerate(log.read_text("utf-8").splitlines(), 1):
        try:
            entry = json.loads(line)
            times.setdefault(entry["fault"], []).append(entry["seconds"])
        except (ValueError, KeyError, TypeError) as error:
            raise WrongUseError(f"{log}, line {number}: no trial of this command. Name another file") from error
    return times


def due(times: Times, wanted: Callable[[Fault], int]) -> deque[str]:
    """Return the faults that are to be tried, in turn, until each has as many trials as wanted."""
    missing = {fault.name: wanted(fault) - len(times.get(fault.name, ())) for fault in FAULTS}
    rounds = max(0, *missing.values())
    return deque(name for done in range(rounds) for name, count in missing.items() if count > done)


async def measure(waiting: deque[str], robots: int, log: Path | None, tell: Callable[[str], object]) -> Times:
    """Try the waiting faults on so many robots at once; return the times in s, None where the wheels were not stopped.

    Raises `FailedError` when robots do not drive any more.
    """
    times: Times = {}
    total, problems = len(waiting), 0

    def on_result(entry: Mapping[str, object]) -> None:
        nonlocal problems
        if "problem" in entry:
            problems += 1
            tell(f"no trial of {entry['fault']}: {entry['problem']}")
            if problems >= _PROBLEMS_MAX:
                raise FailedError(f"{problems} trials failed, the last one because: {entry['problem']}")
            waiting.append(str(entry["fault"]))
            return
        seconds = entry["seconds"]
        times.setdefault(str(entry["fault"]), []).append(float(seconds) if isinstance(seconds, float) else None)
        if log is not None:
            with log.open("a", encoding="utf-8") as file:
                file.write(json.dumps(entry) + "\n")
        tell(f"{sum(map(len, times.values()))} of {total}: {entry['fault']}: {seconds}")

    async with asyncio.TaskGroup() as tasks:
        for number in range(min(robots, total)):
            tasks.create_task(_robot(number + 1, waiting, on_result))
    return times


async def _robot(seed: int, waiting: deque[str], on_result: Callable[[Mapping[str, object]], None]) -> None:
    pipe = asyncio.subprocess.PIPE
    worker = await asyncio.create_subprocess_exec(sys.executable, "-m", _WORKER, str(seed), stdin=pipe, stdout=pipe)
    assert worker.stdin is not None
    assert worker.stdout is not None
    try:
        while waiting:
            worker.stdin.write(f"{waiting.popleft()}\n".encode())
            line = await worker.stdout.readline()
            if not line:
                raise FailedError(f"robot {seed} ended with exit code {await worker.wait()}: see its error above")
            on_result(json.loads(line))
    finally:
        # The end of its input ends the worker, which ends its robot.
        worker.stdin.close()
        await worker.wait()


def percentile(values: list[float], share: float) -> float:
    """Return the smallest value that at least `share` of the values do not exceed."""
    return sorted(values)[max(0, math.ceil(share * len(values)) - 1)]


def row(fault: Fault, times: list[float | None]) -> dict[str, object]:
    """Return the figures of one fault in s; a trial in which the wheels were not stopped has no time."""
    stopped = [seconds for seconds in times if seconds is not None]
    late = [seconds for seconds in stopped if fault.limit_s is not None and seconds > fault.limit_s]
    return {
        "fault": fault.name,
        "kind": fault.kind,
        "trials": len(times),
        "stopped": len(stopped),
        "median_s": round(statistics.median(stopped), 3) if stopped else None,
        "p99_s": round(percentile(stopped, 0.99), 3) if stopped else None,
        "max_s": round(max(stopped), 3) if stopped else None,
        "limit_s": None if fault.limit_s is None else round(fault.limit_s, 3),
        "design": fault.design,
        "beyond_limit": len(late) + (len(times) - len(stopped) if fault.limit_s is not None else 0),
    }


_PAGE: Final = """# Reaction times

How long the wheels of a robot that drives at 0.3 m/s, or at 0.15 m/s by hand, turn on after a fault: the time until
the emulated base was last commanded to turn a wheel, or, where a fault only slows the robot, to exceed 0.15 m/s.
Watchdog, guardian and agent are the real processes, on ptys to a byte-exact emulated base and lidar in a simulated
corridor; map, planner and operator speak to them over a real zenoh router. Written by

```sh
{command}
```

which continues the trials in the log FILE, if there is one; without it the command starts anew.

{tables}

When guardian and watchdog die or hang in the same moment, nothing on the robot's computer stops the wheels until the
watchdog is started again or goes on: see the limits in the [README](../README.md). The same holds for the cable of the
base. A watchdog that hangs alone is no fault: the wheels keep obeying guardian and agent.

Measured at commit {commit} on: {machine}, {robots} robots at once, at a niceness of {niceness}.
Robots, emulated devices and whatever else ran shared its cores: a load above their
number means that all of them waited for a processor, and the times beyond a limit include that.

{mark}
"""
_MARK: Final = "<!-- Remarks: what stands below this line is kept when the command writes the page again. -->"
_HEAD: Final = """| fault | trials | stopped | median, s | p99, s | longest, s | limit, s | beyond | its parts, s |
|---|---|---|---|---|---|---|---|---|
"""
_TITLES: Final = {
    "process": "Processes killed (`SIGKILL`) or stopped (`SIGSTOP`)",
    "device": "Base and lidar",
    "fog": "Map, planner and network",
    "operator": "Operator",
    "key": "Driven by hand, by a held key of `fognav teleop`",
    "page": "Driven by hand, by a held page of `fognav teleop --page`",
}


def remarks(page: str) -> str:
    """Return what people wrote below the mark of a page, "" for one without."""
    return page.partition(_MARK)[2].strip()


def markdown(rows: Sequence[dict[str, object]], command: str, where: str, robots: int, kept: str = "") -> str:
    """Return the page, of this process and the checkout that it runs from, with the remarks `kept` at its end."""
    tables = []
    for kind, title in _TITLES.items():
        lines = [_line(each) for each in rows if each["kind"] == kind]
        if lines:
            tables.append(f"## {title}\n\n{_HEAD}" + "\n".join(lines))
    page = _PAGE.format(
        mark=_MARK,
        tables="\n\n".join(tables),
        command=command,
        machine=where,
        robots=robots,
        commit=checkout.revision() or "unknown",
        niceness=os.getpriority(os.PRIO_PROCESS, 0),
    )
    return f"{page}\n{kept}\n" if kept else page


def _line(each: dict[str, object]) -> str:
    limit = "none" if each["limit_s"] is None else each["limit_s"]
    figures = " | ".join(str(each[name]) for name in ("trials", "stopped", "median_s", "p99_s", "max_s"))
    return f"| {each['fault']} | {figures} | {limit} | {each['beyond_limit']} | {each['design']} |"


_BETWEEN_S: Final = 0.3
"""Time that the agent gets to notice what has ended, before it is disabled."""


async def _finished(result: Awaitable[object] | None) -> None:
    if inspect.isawaitable(result):
        await result


async def try_fault(rig: Rig, fault: Fault) -> float | None:
    """Return how long (s) after the fault the wheels were still too fast; None if they are in the end."""
    if fault.kind in BY_HAND:
        await rig.wait_driving_by_hand(page=fault.kind == "page")
    else:
        await rig.wait_driving()
    begun = time.monotonic()
    await _finished(fault.begin(rig))
    await asyncio.sleep(max(0.0, begun + fault.observed_s - time.monotonic()))
    found = rig.body.slower_after(begun, fault.speed)
    await _finished(fault.end(rig))
    await rig.let_go()
    await rig.revive()
    await asyncio.sleep(_BETWEEN_S)
    await rig.disable()
    return found


async def _work(seed: int) -> None:
    """Try the faults that lines of standard input name; one line out, of JSON, has the time, or why there is none."""
    faults = {fault.name: fault for fault in FAULTS}
    names = asyncio.Queue[str]()
    asyncio.get_running_loop().add_reader(sys.stdin, lambda: names.put_nowait(sys.stdin.readline().strip()))
    name = await names.get()
    while name:
        try:
            async with Rig(seed) as rig:
                while name:
                    seconds = await try_fault(rig, faults[name])
                    _tell(fault=name, seconds=seconds)
                    name = await names.get()
        except* (TimeoutError, ProcessLookupError) as problems:
            # Another robot goes on with the next fault: its predecessor does not drive any more.
            _tell(fault=name, problem="; ".join(str(problem) for problem in problems.exceptions))
            seed += 1000
        name = await names.get() if name else name


def _tell(**values: object) -> None:
    sys.stdout.write(json.dumps(values) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    asyncio.run(_work(int(sys.argv[1])))
