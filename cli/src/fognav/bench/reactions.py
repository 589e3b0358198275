"""Measures how long the wheels of a driving robot turn on after its processes were killed or stopped.

The robot's three processes are the real ones; base and lidar are emulators on ptys. The simulator writes 100 times a
second which speeds the base was last commanded: the time of a trial ends with the last line in which a wheel turns.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import statistics
import time
from typing import TYPE_CHECKING, Final, NamedTuple

from fognav.bench.robot_system import GUARDIAN, RobotSystem
from fognav.stack import AGENT, WATCHDOG

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

STOP_LIMIT_S: Final = 0.3
"""Longest time that the design allows for stopping the wheels after the end of a process."""
_OBSERVED_S: Final = 3.0
_LINE_BYTES: Final = 300
_LINES_PER_S: Final = 100


_PAGE: Final = """# Reaction times

How long the wheels of a robot that drives at 0.3 m/s turn on after its processes were killed (`SIGKILL`) or hang
(`SIGSTOP`). Real processes, emulated base and lidar on ptys. Written by `./fognav bench reactions --write FILE`;
`--trials 200` measures longer.

| fault | trials | wheels stopped | median, s | longest, s | limit, s |
|---|---|---|---|---|---|
{table}

When guardian and watchdog die in the same moment, nothing on the robot's computer stops the wheels until the watchdog
is started again: see the limits in the [README](../README.md).

Measured on: {machine}.
"""


class Fault(NamedTuple):
    """Processes that get a signal at the same moment; `limit_s` is None where only hardware could stop the wheels."""

    name: str
    processes: tuple[str, ...]
    number: signal.Signals
    limit_s: float | None = STOP_LIMIT_S


FAULTS: Final = (
    Fault("agent killed", (AGENT,), signal.SIGKILL),
    Fault("agent hangs", (AGENT,), signal.SIGSTOP),
    Fault("guardian killed", (GUARDIAN,), signal.SIGKILL),
    Fault("guardian hangs", (GUARDIAN,), signal.SIGSTOP),
    Fault("watchdog killed", (WATCHDOG,), signal.SIGKILL),
    Fault("agent and guardian killed", (AGENT, GUARDIAN), signal.SIGKILL),
    Fault("agent and guardian hang", (AGENT, GUARDIAN), signal.SIGSTOP),
    Fault("agent and watchdog killed", (AGENT, WATCHDOG), signal.SIGKILL),
    Fault("guardian and watchdog killed", (WATCHDOG, GUARDIAN), signal.SIGKILL, None),
)
"""A watchdog that hangs is none: the wheels keep obeying guardian and agent."""


def stopping_time(lines: Iterable[bytes], begun: float) -> float | None:
    """Return how long (s) after `begun` a wheel was last commanded to turn, by the truth log; None if one still is."""
    last, turns = begun, True
    for text in lines:
        line = json.loads(text)
        if line["t_mono"] >= begun:
            turns = line["left"] != 0.0 or line["right"] != 0.0
            last = line["t_mono"] if turns else last
    return None if turns else last - begun


def measure(trials: int, on_trial: Callable[[str], object]) -> list[dict[str, object]]:
    """Return a row for each fault: times in s, from the signals until the wheels stand.

    Raises `TimeoutError` for a robot that does not drive (again).
    """
    return asyncio.run(_measure(trials, on_trial))


async def _measure(trials: int, on_trial: Callable[[str], object]) -> list[dict[str, object]]:
    times: dict[Fault, list[float | None]] = {fault: [] for fault in FAULTS}
    async with RobotSystem(lambda _pid: None) as system:
        for trial in range(trials):
            for fault in FAULTS:
                on_trial(f"trial {trial + 1} of {trials}: {fault.name}")
                await system.wait_driving()
                times[fault].append(await _try(system, fault))
    return [row(fault, found) for fault, found in times.items()]


async def _try(system: RobotSystem, fault: Fault) -> float | None:
    pids = [system.pids()[name] for name in fault.processes]
    system.speed = 0.0
    begun = time.monotonic()
    for pid in pids:
        os.kill(pid, fault.number)
    await asyncio.sleep(_OBSERVED_S)
    found = stopping_time(_tail(system.truth_log, begun), begun)
    if fault.number == signal.SIGSTOP:
        for pid in pids:
            _end(pid)
    return found


def _end(pid: int) -> None:
    """Kill what was stopped, unless the watchdog has done so already: its supervisor starts another."""
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return


def _tail(log: Path, begun: float) -> list[bytes]:
    with log.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - int((time.monotonic() - begun + 1.0) * _LINES_PER_S * _LINE_BYTES)))
        return file.read().split(b"\n")[1:-1]


def row(fault: Fault, times: list[float | None]) -> dict[str, object]:
    """Return the figures of one fault; a trial in which the wheels did not stop has no time."""
    stopped = [seconds for seconds in times if seconds is not None]
    return {
        "fault": fault.name,
        "trials": len(times),
        "stopped": len(stopped),
        "median_s": round(statistics.median(stopped), 3) if stopped else None,
        "max_s": round(max(stopped), 3) if stopped else None,
        "limit_s": fault.limit_s,
    }


def markdown(rows: list[dict[str, object]], machine: object) -> str:
    """Return `docs/reaction-times.md`."""
    table = [
        f"| {each['fault']} | {each['trials']} | {each['stopped']} | {each['median_s']} | {each['max_s']} | "
        f"{each['limit_s'] or 'none'} |"
        for each in rows
    ]
    return _PAGE.format(table="\n".join(table), machine=machine)
