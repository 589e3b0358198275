"""Measures what the robot's processes cost: agent, guardian and watchdog, standing by and driving."""

from __future__ import annotations

import asyncio
import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Final

from fog_runtime.machine.task_usage import ProcessUsage, memory_mb, sample, usage
from fognav_experiments.bench.cpu_quota import cpu_quota
from fognav_experiments.bench.robot_system import RobotSystem

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

NORMAL_PRIORITY: Final = {"REALTIME_PRIORITY": "0", "AGENT_REALTIME_PRIORITY": "0"}
"""Settings under a quota, which limits processes of normal priority only."""
SETTLE_S: Final = 5.0
"""Between a change and the measurement that follows it."""


def measure(seconds: float, quota: float | None, on_phase: Callable[[str], object]) -> dict[str, object]:
    """Return the figures; each of the two phases is measured for `seconds`, under a quota of one core if one is given.

    Raises `WrongUseError` for a quota that this system can't enforce, `TimeoutError` for a robot that does not drive.
    """
    with ExitStack() as contexts:
        group = None if quota is None else contexts.enter_context(cpu_quota(quota))
        if group is None:
            return asyncio.run(_measure(seconds, lambda _pid: None, {}, on_phase))
        return asyncio.run(_measure(seconds, group.add, NORMAL_PRIORITY, on_phase))


async def _measure(
    seconds: float,
    on_start: Callable[[int], object],
    settings: Mapping[str, str],
    on_phase: Callable[[str], object],
) -> dict[str, object]:
    on_phase("starting fog, simulator and robot")
    async with RobotSystem(on_start, settings) as system:
        on_phase("restarting the agent")
        ready_s = await system.restart_agent()
        await system.wait_enabled()
        on_phase("standing by")
        idle = await _usage(system, seconds)
        await system.start_drive()
        on_phase("driving")
        driving = await _usage(system, seconds)
        memory = {name: memory_mb(pid) for name, pid in system.pids().items()}
        assert system.state is not None
        jitter_s, mode = system.state.loop.stream_p99_s, system.state.mode
    return figures(idle, driving, memory) | {
        "ready_s": round(ready_s, 2),
        "loop_jitter_p99_ms": round(1000.0 * jitter_s, 2),
        "mode": mode,
    }


async def _usage(system: RobotSystem, seconds: float) -> dict[str, ProcessUsage]:
    await asyncio.sleep(SETTLE_S)
    pids = system.pids()
    begun, before = time.monotonic(), {name: sample(pid) for name, pid in pids.items()}
    await asyncio.sleep(seconds)
    elapsed, after = time.monotonic() - begun, {name: sample(pid) for name, pid in pids.items()}
    return {name: usage(before[name], after[name], elapsed) for name in pids}


def figures(
    idle: Mapping[str, ProcessUsage], driving: Mapping[str, ProcessUsage], memory_mb: Mapping[str, float]
) -> dict[str, object]:
    """Return the figures of all processes together, and of each; CPU in percent of one core."""
    return {
        "cpu_percent": round(sum(used.cpu_percent for used in driving.values()), 2),
        "idle_cpu_percent": round(sum(used.cpu_percent for used in idle.values()), 2),
        "rss_mb": round(sum(memory_mb.values()), 1),
        "wakeups_per_s": round(sum(used.wakeups_per_s for used in driving.values()), 1),
        "idle_wakeups_per_s": round(sum(used.wakeups_per_s for used in idle.values()), 1),
        "processes": {
            name: {
                "cpu_percent": round(used.cpu_percent, 2),
                "idle_cpu_percent": round(idle[name].cpu_percent, 2),
                "rss_mb": round(memory_mb[name], 1),
                "wakeups_per_s": round(used.wakeups_per_s, 1),
                "idle_wakeups_per_s": round(idle[name].wakeups_per_s, 1),
                "threads": {thread: round(percent, 2) for thread, percent in used.threads.items()},
                "idle_threads": {thread: round(percent, 2) for thread, percent in idle[name].threads.items()},
            }
            for name, used in driving.items()
        },
    }
