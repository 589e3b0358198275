"""Measures what the robot's processes cost: agent, guardian and watchdog, standing by and driving.

Fog, simulator and emulated devices are processes of their own. Linux's control groups (version 2, or 1 where that is
mounted) can limit the robot to a share of a core.
"""

from __future__ import annotations

import asyncio
import math
import os
import random
import time
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from itertools import count, cycle
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final, NamedTuple

from fog_contracts import channels as ch
from fog_contracts.commands import PROFILE_OF
from fog_contracts.messages import ProfileName, RobotPose, RobotState
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.maps import save_map
from fog_runtime.robot_commands import RobotCommands
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor import net
from fog_supervisor.net import put_goal
from fognav.output import WrongUseError
from fognav.programs import AGENT, MAP_SERVICE, PLANNER, ROBOT, WATCHDOG
from fognav.stack import Stack, StackConfig, StackUsers
from fognav_experiments.bench.common import RunningSystem, corridor_rows, first_child, make_office
from fognav_sim.drive.operator import OperatorPolicy
from robot_agent.agent.edges.exporter import ProcessUsage, memory_mb, sample, usage

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from fog_contracts.grid import StaticMap
    from fog_supervisor.supervisor import Event

CGROUPS = Path("/sys/fs/cgroup")
PERIOD_US = 10_000
"""A group that has used up its share stands still until the next period: with Linux's usual 100 ms a fifth of a core
would be a fast core that stops for 80 ms, and not the slow one that is meant."""


class CpuQuota:
    """A control group with a share of one core; processes that are added, and their children, share it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def add(self, pid: int) -> None:
        """Put a process into the group; its later children are in it from their start."""
        # A process that has just ended needs no limit.
        with suppress(ProcessLookupError):
            (self._folder / "cgroup.procs").write_text(str(pid), "ascii")


@contextmanager
def cpu_quota(share: float, root: Path = CGROUPS) -> Iterator[CpuQuota]:
    """Make a group that may use `share` of one core, 0.2 for a fifth, and remove it at the end.

    All processes in it must have ended by then. Raises `WrongUseError` where this user may make no group.
    """
    quota_us = round(share * PERIOD_US)
    unified = (root / "cgroup.controllers").exists()
    folder = (root if unified else root / "cpu") / f"fognav-bench-{os.getpid()}"
    try:
        if unified:
            (root / "cgroup.subtree_control").write_text("+cpu", "ascii")
        folder.mkdir()
        if unified:
            (folder / "cpu.max").write_text(f"{quota_us} {PERIOD_US}", "ascii")
        else:
            (folder / "cpu.cfs_period_us").write_text(str(PERIOD_US), "ascii")
            (folder / "cpu.cfs_quota_us").write_text(str(quota_us), "ascii")
    except OSError as error:
        with suppress(OSError):
            folder.rmdir()
        raise WrongUseError(
            f"--cpu-quota: {folder} can't be used ({error.strerror}). Run this as root on a system with control "
            "groups, or leave the option out: nothing else limits a process without stopping it"
        ) from error
    try:
        yield CpuQuota(folder)
    finally:
        folder.rmdir()


NAME: Final = "r1"
FLOOR_M: Final = (100.0, 57.0)
"""2000 x 1140 cells of 5 cm."""
GUARDIAN: Final = "robot-guardian"
_PLACES: Final = ("far", "near")
_SITE: Final = "bench"
_WAIT_S: Final = 90.0
_POLL_S: Final = 0.01
_OPERATOR_S: Final = 0.5
_DRIVING_M_S: Final = 0.2
_ZONE_M: Final = (1.5, 6.0)
"""Radius of a zone, which closes a corridor, and how far from the robot it stays."""


class Conditions(NamedTuple):
    """Where and how the robot drives: its profile, the floor's width and height (m), and how often that changes.

    A change closes another corridor anywhere on the floor, and opens the one that was closed before.
    """

    profile: ProfileName = "fog"
    floor_m: tuple[float, float] = FLOOR_M
    changes_per_min: float = 0.0


_NODE: Final = """
[[areas]]
id = "z1"
number = 1
polygon = [[18.8, {low}], [21.2, {low}], [21.2, {high}], [18.8, {high}]]
[[nodes]]
id = "n1"
area = "z1"
x = 20.0
y = {wall}
theta = -1.5707963
height = 0.30
sonars = [{{ angle = -0.1, range_limit = 1.9, range_max = 2.7 }}, {{ angle = 0.1, range_limit = 1.9, range_max = 2.7 }}]
"""


def write_site(folder: Path, floor: StaticMap, *, node: bool = False) -> Path:
    """Write a site with a robot in the south-west of an office, and a place in its north-east; return its folder.

    With `node` one sensor node watches the robot's first corridor.
    """
    right = floor.geometry.bounds[2]
    far, near = _PLACES
    rows = corridor_rows(floor.geometry.bounds[3])
    save_map(folder / "map", floor)
    (folder / "site.toml").write_text(
        f'id = "{_SITE}"\nname = "Benchmark floor"\nmap = "map.yaml"\n'
        f"[places.{far}]\nx = {right - 4.0:.1f}\ny = {rows[-1]:.1f}\n"
        f"[places.{near}]\nx = 4.0\ny = {rows[0]:.1f}\n"
        f'[[robots]]\nid = "{NAME}"\nstart = {{ x = 4.0, y = {rows[0]:.1f}, theta = 0.0 }}\nradius = 0.17\n'
        + (_NODE.format(low=rows[0] - 1.2, high=rows[0] + 1.2, wall=rows[0] + 1.15) if node else ""),
        "utf-8",
    )
    return folder


class RobotSystem(RunningSystem):
    """The running system, with an operator who keeps the robot enabled."""

    def __init__(
        self,
        on_start: Callable[[int], object],
        settings: Mapping[str, str] | None = None,
        conditions: Conditions | None = None,
        *,
        node: bool = False,
    ) -> None:
        """`on_start` is called with the id of each process of the robot that is started, but not with its children.

        `settings`: further FOGNAV_* variables of all processes, named without the prefix. `node`: one sensor
        node watches a corridor.
        """
        super().__init__()
        self._node = node
        self.conditions = conditions or Conditions()
        self.changes = 0
        """How often the map was changed."""
        self._at = (0.0, 0.0)
        self._on_start = on_start
        self._settings = settings
        self._started_at: dict[str, float] = {}
        self._clock = SystemClock()
        self._policy = OperatorPolicy(self._clock.now())
        self.state: RobotState | None = None
        self.speed = 0.0
        """The robot's speed (m/s) by its own last pose."""
        self._goals = cycle(_PLACES)

    async def _start(self) -> None:
        contexts = self._contexts
        folder = Path(contexts.enter_context(TemporaryDirectory(prefix="fognav-bench-")))
        office = make_office(*self.conditions.floor_m)
        site = await asyncio.to_thread(write_site, folder, office, node=self._node)
        users = StackUsers(site=_SITE, robots=(NAME,), nodes=("n1",) if self._node else ())
        config = StackConfig(site_dir=site, robot=NAME, extra=self._settings, users=users)
        self.stack = await contexts.enter_async_context(Stack(config, self._on_event))
        await self.stack.start()
        edge = await contexts.enter_async_context(
            ZenohEdge.open(
                connect=[self.stack.zenoh_endpoint],
                clock=self._clock,
                role="console",
                id="bench",
                site=_SITE,
                credentials=self.stack.security.credentials("console"),
            )
        )
        self._commands = RobotCommands(edge, operator="bench", key=self.stack.operator_key)
        edge.subscribe(ch.ROBOT_STATE, RobotState, self._on_state, robot=NAME)
        edge.subscribe(ch.ROBOT_POSE, RobotPose, self._on_pose, robot=NAME)
        tasks = await contexts.enter_async_context(asyncio.TaskGroup())
        for work in (self._operate(), self._change()):
            contexts.callback(tasks.create_task(work).cancel)

    def _on_event(self, event: Event) -> None:
        if event.kind == "started" and event.program in ROBOT:
            self._started_at[event.program] = event.time_s
            pid = self.stack.supervisor.pid(event.program)
            if pid is not None:
                self._on_start(pid)

    def _on_state(self, _ids: dict[str, str], state: RobotState) -> None:
        self.state = state
        self._policy.on_state(state, self._clock.now())

    def _on_pose(self, _ids: dict[str, str], pose: RobotPose) -> None:
        self.speed, self._at = abs(pose.v), (pose.x, pose.y)

    async def _operate(self) -> None:
        while True:
            command, state = self._policy.command_due(self._clock.now()), self.state
            if command is not None and state is not None:
                await self._commands.send(command, NAME, state)
            await asyncio.sleep(_OPERATOR_S)

    async def _change(self) -> None:
        """Close one corridor after the other, as hazards do."""
        if not self.conditions.changes_per_min:
            return
        dice = random.Random(1)  # noqa: S311  # repeatable, not a secret
        width, height = self.conditions.floor_m
        before = None
        for number in count():
            await asyncio.sleep(60.0 / self.conditions.changes_per_min)
            x, y = dice.uniform(4.0, width - 4.0), float(dice.choice(list(corridor_rows(height))))
            if math.dist((x, y), self._at) < _ZONE_M[1]:
                continue
            shape = {"type": "circle", "centre": [x, y], "radius": _ZONE_M[0]}
            zone = {"id": f"bench-{number}", "kind": "BLOCKED", "shape": shape}
            await self._map_request("POST", "", zone)
            if before is not None:
                await self._map_request("DELETE", f"/{before}")
            before, self.changes = zone["id"], self.changes + 1

    async def _map_request(self, method: str, path: str, body: object = None) -> None:
        port = self.stack.port(MAP_SERVICE)
        assert port is not None
        asked = partial(net.request, method, port, f"/api/v1/zones{path}", body=body, token=self.stack.token)
        answer = await asyncio.to_thread(asked)
        if answer.status >= 300:
            raise RuntimeError(f"the map-service refused a zone: HTTP {answer.status}, {answer.reason}")

    async def switch(self) -> None:
        """Let the robot navigate by the profile that is asked for, and wait until it is enabled again."""
        profile = self.conditions.profile
        if self.state is None or self.state.profile == profile:
            return
        kind = next(kind for kind, name in PROFILE_OF.items() if name == profile)
        for command in ("disable", kind):
            reply = await self._commands.send(command, NAME, self.state)
            if reply is None or not reply.accepted:
                raise RuntimeError(f"the robot refused {command}: {reply.reason if reply else 'no reply'}")
        await self._until(
            lambda: self.state is not None and self.state.profile == profile, f"it navigates by {profile}"
        )
        await self.wait_enabled()

    def pids(self) -> dict[str, int]:
        """Return the ids of the robot's processes, the guardian among them."""
        pids = {name: pid for name, pid in self.stack.pids().items() if name in ROBOT}
        guardian = first_child(pids[WATCHDOG])
        if guardian is not None:
            pids[GUARDIAN] = guardian
        return pids

    async def restart_agent(self) -> float:
        """Restart the agent; return how long (s) it took from its start until it was ready."""
        await self.stack.supervisor.stop(AGENT)
        self.state = None
        self.stack.supervisor.start(AGENT)
        deadline = time.monotonic() + _WAIT_S
        while (problem := await net.readiness(self.stack.port_file(AGENT))) is not None:
            if time.monotonic() > deadline:
                raise TimeoutError(f"the agent was not ready within {_WAIT_S:.0f} s: {problem}")
            await asyncio.sleep(_POLL_S)
        return time.monotonic() - self._started_at[AGENT]

    async def wait_enabled(self) -> None:
        """Wait until the robot is enabled and in NORMAL mode."""
        await self._until(lambda: self.state is not None and self.state.mode == "NORMAL", "the robot is in NORMAL mode")

    async def start_drive(self) -> None:
        """Send the robot to the other end of the floor, some two minutes away or more, and wait until it drives."""
        await self._send_goal()
        await self._until(lambda: self.speed > _DRIVING_M_S, "the robot drives")

    async def _send_goal(self) -> None:
        place = next(self._goals)
        port = self.stack.port(PLANNER)
        answer = await asyncio.to_thread(put_goal, f"http://{net.LOOPBACK}:{port}", NAME, place, self.stack.token)
        if answer.status >= 300:
            raise RuntimeError(f"the planner refused the goal: HTTP {answer.status}, {answer.reason}")

    async def _until(self, condition: Callable[[], bool], expected: str) -> None:
        deadline = time.monotonic() + _WAIT_S
        while not condition():
            if time.monotonic() > deadline:
                state = self.state
                situation = "no state received" if state is None else f"{state.mode}: {'; '.join(state.reasons)}"
                raise TimeoutError(f"not within {_WAIT_S:.0f} s: {expected}; {situation}")
            await asyncio.sleep(_POLL_S)


NORMAL_PRIORITY: Final = {"REALTIME_PRIORITY": "0", "AGENT_REALTIME_PRIORITY": "0"}
"""Settings under a quota, which limits processes of normal priority only."""
SETTLE_S: Final = 5.0
"""Between a change and the measurement that follows it."""


def measure(
    seconds: float, quota: float | None, on_phase: Callable[[str], object], conditions: Conditions | None = None
) -> dict[str, object]:
    """Return the figures; each of the two phases is measured for `seconds`, under a quota of one core if one is given.

    Raises `WrongUseError` for a quota that this system can't enforce, `TimeoutError` for a robot that does not drive.
    """
    with ExitStack() as contexts:
        group = None if quota is None else contexts.enter_context(cpu_quota(quota))
        if group is None:
            return asyncio.run(_measure(seconds, lambda _pid: None, {}, on_phase, conditions))
        return asyncio.run(_measure(seconds, group.add, NORMAL_PRIORITY, on_phase, conditions))


async def _measure(
    seconds: float,
    on_start: Callable[[int], object],
    settings: Mapping[str, str],
    on_phase: Callable[[str], object],
    conditions: Conditions | None,
) -> dict[str, object]:
    on_phase("starting fog, simulator and robot")
    async with RobotSystem(on_start, settings, conditions) as system:
        on_phase("restarting the agent")
        ready_s = await system.restart_agent()
        await system.wait_enabled()
        await system.switch()
        on_phase("standing by")
        idle = await _usage(system, seconds)
        await system.start_drive()
        on_phase("driving")
        driving = await _usage(system, seconds)
        memory = {name: memory_mb(pid) for name, pid in system.pids().items()}
        assert system.state is not None
        jitter_s, mode, changes = system.state.loop.stream_p99_s, system.state.mode, system.changes
    return figures(idle, driving, memory) | {
        "ready_s": round(ready_s, 2),
        "loop_jitter_p99_ms": round(1000.0 * jitter_s, 2),
        "mode": mode,
        "changes": changes,
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
