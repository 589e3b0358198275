"""Measures what floors cost a machine: so many systems as `fognav up` runs them, each with the same traffic.

Servers and services of each floor are real processes, encrypted. One process a floor (`python -m
fognav_experiments.bench.floors`) plays its robots and nodes, as often as these speak: robots follow what the planner
releases of their paths, from one random goal to the next, and a node after the other sees an obstacle. What it takes
itself is no part of the figures. Memory is each process's share of what it has in common with others (PSS).
"""

from __future__ import annotations

import asyncio
import itertools
import secrets
import shutil
import sys
import threading
import time
from contextlib import AsyncExitStack, asynccontextmanager
from os import SEEK_END
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np
import psutil

from fog_contracts import channels as ch
from fog_contracts.messages import MapDelta, NodeReading, Pose, RobotGoal, RobotPath, RobotRelease
from fog_runtime.clock import SystemClock, ticker
from fog_runtime.configuration.site import load_site
from fog_runtime.credentials import Credentials
from fog_runtime.transports.mqtt_edge import MqttEdge
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor import net
from fognav.output import FailedError
from fognav.programs import CONSOLE, PLANNER
from fognav.stack import Stack, StackConfig, StackUsers
from fognav_experiments.bench.common import SITE, ask, in_background
from fognav_experiments.bench.pipeline import BENCH, write_nodes
from fognav_experiments.bench.room import STATE_STEPS, STEP_S, BlindRobot, ChangingMap

if TYPE_CHECKING:
    from asyncio.subprocess import Process
    from collections.abc import AsyncIterator, Callable, Mapping, Sequence

    from fog_contracts.handlers import Ids

_READY_S: Final = 300.0
SETTLE_S: Final = 30.0
"""How long the robots drive before anything is measured: kernels are loaded, and first paths searched."""
_HAZARD_EVERY_S: Final = 30.0
_HAZARD_LASTS_S: Final = 10.0
_READING_S: Final = 0.1
_TURNS: Final = 10
_DRIVES_M_S: Final = 0.1
_SECONDS: Final = 20_000
"""The simulator's log of a second or two, in bytes."""
_STANDS_S: Final = 10.0
MB: Final = 1e6


class Traffic(NamedTuple):
    """What is played on each floor, and for how long (s) before anything is measured."""

    robots: int
    nodes: int
    settle_s: float = SETTLE_S


async def measure(
    folder: Path, counts: Sequence[int], traffic: Traffic, seconds: float, on_step: Callable[[str], object]
) -> dict[str, Any]:
    """Return the figures of each count of floors, and how well those of the others follow from the first and the last.

    `folder` is empty. Raises `FailedError`.
    """
    write_nodes(folder, traffic.nodes)
    found = [await _floors(folder, count, traffic, seconds, on_step) for count in counts]
    return {"counts": found, "model": model(found)}


def model(found: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the lines through the least and the largest count, and how far (%) the others are from what was measured.

    They are of memory and of processor time.
    """
    least, largest = min(found, key=_count), max(found, key=_count)
    if _count(least) == _count(largest):
        return {}
    made = {}
    for name in ("memory_mb", "cpu_percent"):
        first, last = (float(sum(each[name].values())) for each in (least, largest))
        each_floor = (last - first) / (_count(largest) - _count(least))
        fixed = first - each_floor * _count(least)
        between = [each for each in found if each is not least and each is not largest]
        made[name] = {
            "fixed": round(fixed, 2),
            "each_floor": round(each_floor, 2),
            "error_percent": {
                str(_count(each)): round(100.0 * ((fixed + each_floor * _count(each)) / total - 1.0), 1)
                for each in between
                if (total := sum(each[name].values())) > 0.0
            },
        }
    return made


def _count(figures: Mapping[str, Any]) -> int:
    return int(figures["floors"])


async def _floors(
    folder: Path, count: int, traffic: Traffic, seconds: float, on_step: Callable[[str], object]
) -> dict[str, Any]:
    """Return the figures of so many floors, all together."""
    async with AsyncExitStack() as contexts:
        players, stacks = [], []
        for number in range(1, count + 1):
            on_step(f"{count} floors: starting {number}")
            users = StackUsers(site=SITE, unrestricted=(BENCH,))
            config = StackConfig(site_dir=folder, robot="none", extra={"HAZARDS_WAIT_S": "0"}, users=users)
            stack = await contexts.enter_async_context(Stack(config))
            await stack.start_servers(_READY_S)
            await stack.start_services(_READY_S)
            stacks.append(stack)
            players.append(await contexts.enter_async_context(_player(stack, folder, traffic, number)))
        on_step(f"{count} floors: measuring for {seconds:g} s")
        await asyncio.sleep(traffic.settle_s)
        for player in players:
            assert player.stdin is not None
            player.stdin.write(b"begin\n")
        cpu, sent = _cpu_s(stacks), psutil.net_io_counters(pernic=True)["lo"].bytes_sent
        load = psutil.getloadavg()[0]
        await asyncio.sleep(seconds)
        used = {name: after - cpu[name] for name, after in _cpu_s(stacks).items()}
        sent = psutil.net_io_counters(pernic=True)["lo"].bytes_sent - sent
        memory = _memory_mb(stacks)
        played = await asyncio.gather(*(_ended(player) for player in players))
    ages = [age for each in played for age in each["ages_ms"]]
    return {
        "floors": count,
        "memory_mb": {name: round(each, 1) for name, each in memory.items()},
        "cpu_percent": {name: round(100.0 * each / seconds, 2) for name, each in used.items()},
        "kbit_s_each": round(8e-3 * sent / seconds / count, 1),
        "missions": sum(each["missions"] for each in played),
        "driven_m": round(sum(each["driven_m"] for each in played), 1),
        "hazards": len(ages),
        "reading_to_delta_p50_ms": round(float(np.percentile(ages, 50)), 1) if ages else None,
        "reading_to_delta_p99_ms": round(float(np.percentile(ages, 99)), 1) if ages else None,
        "load": round(load, 1),
    }


def _processes(stacks: Sequence[Stack]) -> list[tuple[str, psutil.Process]]:
    """Return all processes of the floors by their programs, those that serve HTTP for a service among its own."""
    found = []
    for stack in stacks:
        for name, pid in stack.pids().items():
            process = psutil.Process(pid)
            found += [(name, each) for each in (process, *process.children(recursive=True))]
    return found


def _cpu_s(stacks: Sequence[Stack]) -> dict[str, float]:
    """Return the processor time (s) that each program has taken, on all floors together."""
    used: dict[str, float] = {}
    for name, process in _processes(stacks):
        used[name] = used.get(name, 0.0) + sum(process.cpu_times()[:2])
    return used


def _memory_mb(stacks: Sequence[Stack]) -> dict[str, float]:
    used: dict[str, float] = {}
    for name, process in _processes(stacks):
        used[name] = used.get(name, 0.0) + process.memory_full_info().pss / MB
    return used


@asynccontextmanager
async def _player(stack: Stack, site: Path, traffic: Traffic, seed: int) -> AsyncIterator[Process]:
    """Run the process that plays a floor's robots and nodes; it notes hazards once it is told to begin."""
    asked = [
        site, stack.mqtt_url, stack.zenoh_endpoint, stack.port(PLANNER), stack.token_file, stack.security.file(BENCH),
        traffic.robots, traffic.nodes, seed,
    ]  # fmt: skip
    pipe = asyncio.subprocess.PIPE
    player = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "fognav_experiments.bench.floors", *map(str, asked), stdin=pipe, stdout=pipe, stderr=pipe
    )
    try:
        yield player
    finally:
        if player.returncode is None:
            player.kill()
            await player.wait()


async def _ended(player: Process) -> dict[str, Any]:
    """End a player, and return what it found; raises `FailedError`."""
    async with asyncio.timeout(60.0):
        out, err = await player.communicate(b"end\n")
    if player.returncode != 0:
        raise FailedError(f"a player of robots and nodes failed: {err.decode(errors='replace').strip()[-800:]}")
    return msgspec.json.decode(out.splitlines()[-1], type=dict[str, Any])


async def stops(sites: Path, folder: Path, trials: int, on_step: Callable[[str], object]) -> dict[str, Any]:
    """Return how long (ms) a press that stops all floors takes, from the request to the wheels of the robots on both.

    Each floor has a whole simulated robot. A hundred times a second is noted what its base is told, and where it is:
    when it is told to stand, and when it does; of both robots the later one counts. `folder` is empty. Raises
    `FailedError`.
    """
    there = folder / "upstairs"
    shutil.copytree(sites / "estig", there)
    text = (there / "site.toml").read_text("utf-8")
    (there / "site.toml").write_text(text.replace('id = "estig"', 'id = "upstairs"', 1), "utf-8")
    logs = [folder / f"truth-{number}.jsonl" for number in (1, 2)]
    async with AsyncExitStack() as contexts:
        on_step("starting two floors, each with a robot")
        second = await contexts.enter_async_context(Stack(_with_robot(there, logs[1])))
        await second.start(_READY_S)
        listed = folder / "floors.toml"
        (folder / "upstairs.toml").write_text(f'user = "bench"\ntoken = "{second.token}"\n', "utf-8")
        address = f"http://{net.LOOPBACK}:{second.port(CONSOLE)}"
        listed.write_text(f'[floors.upstairs]\naddress = "{address}"\ncredentials = "upstairs.toml"\n', "utf-8")
        linked = {"FLOORS_FILE": str(listed)}
        first = await contexts.enter_async_context(Stack(_with_robot(sites / "estig", logs[0], linked)))
        await first.start(_READY_S)
        driven = [_Driven(stack, log) for stack, log in zip((first, second), logs, strict=True)]
        times = []
        for trial in range(trials):
            for each in driven:
                await each.drive("b")
            begun = time.monotonic()
            pressed = await ask(first, CONSOLE, "POST", "/api/v1/floors/stop", {})
            if not isinstance(pressed.body, list) or not all(floor["acknowledged"] for floor in pressed.body):
                raise FailedError(f"not all floors acknowledged the stop: {pressed.reason or pressed.body}")
            stopped = np.array([await each.stopped(begun) for each in driven])
            times.append(1000.0 * (stopped.max(axis=0) - begun))
            on_step(f"press {trial + 1} of {trials}: told {times[-1][0]:.0f} ms, standing {times[-1][1]:.0f} ms")
    figures = np.percentile(times, (50, 99, 100), axis=0).T
    return {
        "presses": trials,
        **{
            f"{what}_{name}_ms": round(float(value), 1)
            for what, values in zip(("told", "standing"), figures, strict=True)
            for name, value in zip(("p50", "p99", "max"), values, strict=True)
        },
    }


def _with_robot(site: Path, log: Path, console: Mapping[str, str] | None = None) -> StackConfig:
    extra = {"HAZARDS_WAIT_S": "0", "TRUTH_LOG": str(log)}
    return StackConfig(site_dir=site, robot="r1", extra=extra, console=console or {})


class _Driven:
    """A floor's robot, and what its base is told and does, as its simulator notes it."""

    def __init__(self, stack: Stack, log: Path) -> None:
        self._stack, self._log = stack, log

    def _seen(self, last: int) -> list[dict[str, float]]:
        """Return the lines in so many bytes of the log."""
        if not self._log.exists():
            return []
        with self._log.open("rb") as file:
            file.seek(max(0, file.seek(0, SEEK_END) - last))
            return [msgspec.json.decode(line, type=dict[str, float]) for line in file.read().split(b"\n")[1:-1]]

    async def drive(self, place: str) -> None:
        """Send it to a place, and wait until it drives; raises `FailedError`."""
        await self._ask("PUT", "/api/v1/robots/r1/goal", {"place": place})
        deadline = time.monotonic() + _READY_S
        while (
            not (seen := self._seen(_SECONDS)) or min(min(each["left"], each["right"]) for each in seen) < _DRIVES_M_S
        ):
            if time.monotonic() > deadline:
                raise FailedError(f"the robot does not drive to {place} within {_READY_S:.0f} s")
            await self._ask("POST", "/api/v1/robots/r1/commands", {"kind": "enable"})
            await asyncio.sleep(0.5)

    async def _ask(self, method: str, path: str, body: object) -> None:
        await ask(self._stack, PLANNER, method, path, body)

    async def stopped(self, since: float) -> tuple[float, float]:
        """Return when after `since` its base was told to stand, and when it stood (s, monotonic), as soon as it does.

        Raises `FailedError`.
        """
        while (seen := self._seen(_SECONDS))[0]["distance"] < seen[-1]["distance"]:
            if time.monotonic() > since + _STANDS_S:
                raise FailedError(f"a robot drives on {_STANDS_S:.0f} s after its stop")
            await asyncio.sleep(0.05)
        later = [each for each in self._seen(round(_STANDS_S) * _SECONDS) if each["t_mono"] >= since]
        told = next(each for each in later if each["left"] == each["right"] == 0.0)
        return told["t_mono"], next(each for each in later if each["distance"] == seen[-1]["distance"])["t_mono"]


class _Player:
    """The robots and nodes of one floor."""

    def __init__(self, site: Path, robots: int, nodes: int, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        map_ = load_site(site).map
        self._places = ChangingMap(map_)
        self._robots = {}
        for number in range(1, robots + 1):
            x, y = self._places.place(self._rng)
            self._robots[f"r{number}"] = BlindRobot(f"r{number}", np.random.default_rng((seed, number)), x, y)
        self._nodes = [f"n{number}" for number in range(nodes)]
        self._boot = secrets.randbits(32)
        self._ages_ms: list[float] = []
        self._clock = SystemClock()
        self._begun = threading.Event()

    async def play(self, mqtt_url: str, endpoint: str, port: int, token: str, own: Credentials) -> dict[str, Any]:
        """Play until standard input ends; return how old hazards were when they came, and the missions that ended."""
        self._ask = (port, token)
        loop, ended = asyncio.get_running_loop(), asyncio.Event()

        def listen() -> None:
            if sys.stdin.readline():
                self._begun.set()
                sys.stdin.read()
            loop.call_soon_threadsafe(ended.set)

        threading.Thread(target=listen, daemon=True).start()
        mqtt = MqttEdge(mqtt_url, "bench", self._clock, site=SITE, credentials=own)
        async with (
            ZenohEdge.open(
                connect=[endpoint], clock=self._clock, role="sim", id="bench", site=SITE, credentials=own
            ) as edge,
            in_background(mqtt.run(), "mqtt"),
        ):
            edge.subscribe(ch.ROBOT_PATH, RobotPath, self._on_path)
            edge.subscribe(ch.ROBOT_RELEASE, RobotRelease, self._on_release)
            edge.subscribe(ch.MAP_DELTA, MapDelta, self._on_delta)
            await mqtt.wait_connected()
            async with in_background(self._drive(edge), "robots"), in_background(self._read(mqtt), "nodes"):
                await ended.wait()
        return {
            "ages_ms": self._ages_ms,
            "missions": sum(len(robot.missions) for robot in self._robots.values()),
            "driven_m": sum(robot.driven for robot in self._robots.values()),
        }

    def _on_path(self, ids: Ids, path: RobotPath) -> None:
        robot = self._robots[ids["robot"]]
        if robot.goal is not None and path.goal_id == robot.goal.goal_id:
            robot.take(path)

    def _on_release(self, ids: Ids, release: RobotRelease) -> None:
        robot = self._robots[ids["robot"]]
        if robot.path is not None:
            robot.path = robot.path.after(release)

    def _on_delta(self, _ids: Ids, delta: MapDelta) -> None:
        if self._begun.is_set() and delta.part == delta.parts - 1:
            now = self._clock.stamp()
            self._ages_ms += [1000.0 * (now - each.first_reading) for each in delta.traces if each.confirmed > 0]

    async def _drive(self, edge: ZenohEdge) -> None:
        """Let the robots drive, and tell where they are; each that has no goal gets one."""
        steps = 0
        async for now in ticker(self._clock, STEP_S):
            steps += 1
            for number, (name, robot) in enumerate(self._robots.items()):
                robot.drive(now)
                edge.publish(ch.ROBOT_POSE, robot.pose(self._clock.stamp()), robot=name)
                if reached := robot.reached:
                    robot.missions.append(now - robot.given_at)
                if reached or (steps + number) % STATE_STEPS == 0:
                    state = robot.state(reached=reached)
                    path, stamp = robot.path, self._clock.stamp()
                    seen = {} if path is None else {"map_epoch": path.map_epoch, "map_seq": path.map_seq}
                    edge.publish(ch.ROBOT_STATE, msgspec.structs.replace(state, stamp=stamp, **seen), robot=name)
                # A second for the planner to hear of a new robot, and to end a goal that was reached.
                if reached:
                    robot.goal, robot.path, robot.given_at = None, None, now
                elif robot.goal is None and now - robot.given_at > 1.0:
                    robot.given_at = now
                    await self._send(robot)

    async def _send(self, robot: BlindRobot) -> None:
        x, y = self._places.place(self._rng)
        port, token = self._ask
        body = {"pose": {"x": x, "y": y}}
        path = f"/api/v1/robots/{robot.id}/goal"
        answer = await asyncio.to_thread(net.request, "PUT", port, path, body=body, token=token)
        if isinstance(answer.body, dict) and "goal_id" in answer.body:
            robot.goal = RobotGoal(goal_id=answer.body["goal_id"], pose=Pose(x=x, y=y, theta=0.0))

    async def _read(self, mqtt: MqttEdge) -> None:
        """Let each node publish as one does: ten readings a second after a change, else one."""
        for node in self._nodes:
            await mqtt.publish(ch.NODE_AVAILABILITY, ch.ONLINE, node=node)
        begun, seq = self._clock.now(), itertools.count()
        async for now in ticker(self._clock, _READING_S):
            turn = next(seq)
            which, into = divmod(now - begun, _HAZARD_EVERY_S)
            changed = into % _HAZARD_LASTS_S < 1.0
            for number, node in enumerate(self._nodes):
                of_it = int(which) % len(self._nodes) == number
                near = of_it and into < _HAZARD_LASTS_S
                if (of_it and changed) or (turn + number) % _TURNS == 0:
                    measured = (0.8 if near else 2.9) + 0.001 * (turn % 7)
                    reading = NodeReading(
                        seq=turn, boot=self._boot, uptime_ms=round(1000.0 * (now - begun)), range_m=[measured, 2.9],
                        status=["ok", "ok"], state="blocked" if near else "clear", rssi=-60, fw="bench",
                    )  # fmt: skip
                    mqtt.publish_nowait(ch.NODE_READING, reading, node=node)


def main() -> None:
    """Play a floor as the command line says: SITE MQTT_URL ZENOH_ENDPOINT PORT TOKEN CREDENTIALS ROBOTS NODES SEED."""
    site, mqtt_url, endpoint, port, token, own, *numbers = sys.argv[1:]
    robots, nodes, seed = map(int, numbers)
    player = _Player(Path(site), robots, nodes, seed)
    secret = Path(token).read_text("ascii").strip()
    found = asyncio.run(player.play(mqtt_url, endpoint, int(port), secret, Credentials.read(Path(own))))
    sys.stdout.buffer.write(msgspec.json.encode(found) + b"\n")


if __name__ == "__main__":
    main()
