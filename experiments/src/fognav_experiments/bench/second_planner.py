"""Measures warnings while the planner that leads becomes slow, lossy or dead, and another one takes its place, live.

As `warning`, with two planners. Each reaches router and Redis through a relay of its own, which holds up what passes:
so the delay comes as a network's does, and a loss as it does on TCP, where all that follows waits for the repetition.
An obstacle comes before the change (the control), around its beginning, and after it, while the first planner is still
slow.
"""

from __future__ import annotations

import asyncio
import random
import time
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
import zenoh

from fog_runtime.clock import SystemClock
from fog_runtime.stores.redis_connection import RedisConnection
from fog_runtime.transports.zenoh_edge import session_config
from fog_supervisor import net
from fog_supervisor.supervisor import NotReadyError, log_tail
from fognav.output import FailedError, WrongUseError
from fognav.programs import PLANNER, SERVERS, SERVICES
from fognav.stack import Stack, StackConfig, users_of
from fognav_experiments.bench.warning import BENCH, POLL_S, READY_S, TIMEOUT_S, Trials, WatchedWorld, running_nodes
from fognav_sim.drive.hazard import entry_distance
from fognav_sim.live import StillFloor

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping, Sequence

    from fog_runtime.configuration.site import LoadedSite
    from fognav_sim.drive.hazard import PlannedHazard

Fault = Literal["slow", "lossy", "dead"]
FAULTS: Final[tuple[Fault, ...]] = ("slow", "lossy", "dead")
PLANNERS: Final = (PLANNER, "planner-2")
SLOW_S: Final = 0.5
"""By how much answers come later: half of it on the way to the planner, half on the way back."""
LOSS: Final = 0.3
"""Share of lost packets of a lossy way ..."""
_REPEATED_S: Final = 0.2
"""... which are repeated after so long, again after twice as long, and so on (RFC 6298 with Linux's least time)."""
_BEFORE_S: Final = 0.3
"""The obstacle comes between so long before the planner's change ..."""
_AFTER_S: Final = 1.5
"""... and so long after it."""
_CHUNK: Final = 65536


def fault(name: str) -> Fault:
    """Return the fault of this name; raises `WrongUseError`."""
    for each in FAULTS:
        if each == name:
            return each
    raise WrongUseError(f"--leader {name}: choose one of {', '.join(FAULTS)}")


class Relay:
    """Connects clients with a server of this machine, each way through a line that may be slow or lossy."""

    def __init__(self) -> None:
        self.port = net.free_port()
        self.target = 0
        self.delay_s = 0.0
        """On each way."""
        self.loss = 0.0
        self._random = random.Random(1)  # noqa: S311  # no secret

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Listen while the context is open; set `target` before anybody connects."""
        connections: list[asyncio.Task[None]] = []

        def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            connections.append(asyncio.create_task(self._serve(reader, writer)))

        server = await asyncio.start_server(accept, net.LOOPBACK, self.port)
        try:
            yield
        finally:
            server.close()
            for connection in connections:
                connection.cancel()
            await asyncio.gather(*connections, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            there, back = await asyncio.open_connection(net.LOOPBACK, self.target)
        except OSError:
            writer.close()
            return
        try:
            await asyncio.gather(self._line(reader, back), self._line(there, writer))
        finally:
            writer.transport.abort()
            back.transport.abort()

    async def _line(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
        """Pass bytes on in their order, until one side ends."""
        sent: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()

        async def receive() -> None:
            data = b"."
            while data:
                try:
                    data = await source.read(_CHUNK)
                except OSError:
                    data = b""
                sent.put_nowait((time.monotonic() + self.delay_s, data))

        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(receive())
            while True:
                due, data = await sent.get()
                await asyncio.sleep(max(0.0, due - time.monotonic()))
                repeated_s = _REPEATED_S
                while self._random.random() < self.loss:
                    await asyncio.sleep(repeated_s)
                    repeated_s *= 2
                if not data or sink.is_closing():
                    sink.close()
                    return
                sink.write(data)


class _Way:
    """A planner's way to router and Redis."""

    def __init__(self) -> None:
        self.router, self.redis = Relay(), Relay()

    def settings(self) -> dict[str, str]:
        """Return the planner's settings."""
        return {
            "ZENOH_CONNECT": f"tls/{net.LOOPBACK}:{self.router.port}",
            "REDIS_URL": f"rediss://{net.LOOPBACK}:{self.redis.port}/0",
        }

    def set(self, delay_s: float = 0.0, loss: float = 0.0) -> None:
        """Let what is sent from now on pass so."""
        for relay in (self.router, self.redis):
            relay.delay_s, relay.loss = delay_s, loss


async def measure(
    loaded: LoadedSite, fault: Fault, trials: int, seed: int, on_progress: Callable[[], object]
) -> list[dict[str, Any]]:
    """Return the figures (ms) before, during and after the change; raises `FailedError` if the fog does not answer."""
    site = loaded.site
    floor = StillFloor(loaded, (), SystemClock(), world=WatchedWorld)
    assert isinstance(floor.world, WatchedWorld)
    users = users_of(site, unrestricted=(BENCH,))
    ways = {name: _Way() for name in PLANNERS}
    settings = {name: way.settings() for name, way in ways.items()}
    extra = {"HAZARDS_WAIT_S": "0"}
    config = StackConfig(site_dir=loaded.directory, robot="none", extra=extra, users=users, planners=settings)
    async with AsyncExitStack() as contexts:
        for way in ways.values():
            await contexts.enter_async_context(way.router.running())
            await contexts.enter_async_context(way.redis.running())
        stack = await contexts.enter_async_context(Stack(config))
        for way in ways.values():
            way.router.target, way.redis.target = stack.zenoh_port, stack.redis_port
        await stack.start_servers(READY_S)
        programs = [*SERVICES, *PLANNERS[1:]]
        for name in programs:
            stack.supervisor.start(name)
        try:
            await stack.supervisor.wait_ready([*SERVERS, *programs], READY_S)
        except NotReadyError as error:
            raise FailedError(f"{error}\n{log_tail(stack.log(PLANNERS[1]))}") from error
        await contexts.enter_async_context(running_nodes(loaded, floor, stack.mqtt_url, stack.security.credentials))
        own = session_config("client", connect=[stack.zenoh_endpoint], credentials=stack.security.credentials(BENCH))
        session = await asyncio.to_thread(zenoh.open, own)
        contexts.callback(session.close)
        changes = _Changes(stack, loaded, floor.world, session, seed)
        changes.let(fault, ways)
        await contexts.enter_async_context(changes.robot.publishing())
        for number in range(trials):
            await changes.change(number)
            on_progress()
        return changes.rows()


class _Changes(Trials):
    """Obstacles before, during and after a planner's change."""

    planners = PLANNERS

    def let(self, fault: Fault, ways: Mapping[str, _Way]) -> None:
        """Choose what happens to planners on these ways."""
        self.fault, self.ways = fault, ways
        self._took: dict[str, list[float | None]] = {"before": [], "during": [], "after": []}
        self._taken_over: list[float] = []

    def rows(self) -> list[dict[str, Any]]:
        """Return the figures of each phase."""
        return [row(self.fault, phase, took, self._taken_over) for phase, took in self._took.items()]

    async def change(self, number: int) -> None:
        """Measure one obstacle in each phase; the planner that leads then becomes slow, lossy or dead."""
        leader = await self._leader()
        self._took["before"].append(await self.meet(await self.drive(3 * number), self.path_around))
        hazard = await self.drive(3 * number + 1)
        await self._forget_pause()
        epoch = self.robot.latest().planner_epoch
        fails_after_s = self.random.uniform(-_AFTER_S, _BEFORE_S)
        failing = asyncio.create_task(self._fail(leader, max(0.0, fails_after_s)))
        if fails_after_s < 0.0:
            await failing
            await asyncio.sleep(-fails_after_s)
        # A planner that has taken over already may have chosen another way, which the obstacle does not close.
        if self._enters(hazard):
            self._took["during"].append(await self.meet(hazard, self.path_around))
        failed_at = await failing

        for _ in range(round(TIMEOUT_S / POLL_S)):
            if self.robot.latest().planner_epoch == epoch:
                await asyncio.sleep(POLL_S)
        if self.robot.latest().planner_epoch > epoch:
            self._taken_over.append(self.robot.taken_over[self.robot.latest().planner_epoch] - failed_at)
            self._took["after"].append(await self.meet(await self.drive(3 * number + 2), self.path_around))
        for way in self.ways.values():
            way.set()
        await self.stack.supervisor.wait_ready(PLANNERS, READY_S)

    async def _fail(self, planner: str, after_s: float) -> float:
        """Let a planner fail; return when it did (s)."""
        await asyncio.sleep(after_s)
        if self.fault == "dead":
            self.stack.supervisor.kill(planner)
        else:
            slow = self.fault == "slow"
            self.ways[planner].set(SLOW_S / 2 if slow else 0.0, 0.0 if slow else LOSS)
        return time.time()

    def _enters(self, hazard: PlannedHazard) -> bool:
        return entry_distance(self.robot.latest().points, hazard.area.polygon) is not None

    async def _leader(self) -> str:
        """Return the planner that leads, once the other one stands by."""
        found = ""

        async def leads() -> bool:
            nonlocal found
            details = {name: await self._lease(name) for name in PLANNERS}
            found = next((name for name, each in details.items() if each.startswith("leads with")), "")
            return bool(found) and any("stands by: planner-" in each for each in details.values())

        await self.until(leads, "one planner leads, and the other one is ready")
        return found

    async def _lease(self, name: str) -> str:
        port = self.stack.port(name)
        if port is None:
            return ""
        try:
            answer = await asyncio.to_thread(net.request, "GET", port, "/readyz")
        except OSError:
            return ""
        body = answer.body
        return str(body["parts"]["lease"]["detail"]) if answer.status == 200 and isinstance(body, dict) else ""

    async def _forget_pause(self) -> None:
        """Let Redis forget when a lease was handed over last: the next trial does not wait for that."""
        own = self.stack.security.credentials("administrator")
        redis = RedisConnection(self.stack.redis_url, timeout_s=READY_S, credentials=own)
        await redis.write(("DEL", f"fog:{self.loaded.site.id}:planner:handed"))
        await redis.aclose()


def row(fault: Fault, phase: str, took: Sequence[float | None], taken_over: Sequence[float]) -> dict[str, Any]:
    """Return the figures of one phase (ms): from an obstacle's first echo to the robot's path, and the takeovers'."""
    arrived = [1000.0 * each for each in took if each is not None]
    figures: dict[str, Any] = {
        "planner": fault, "phase": phase, "warnings": len(took), "missed": len(took) - len(arrived)
    }  # fmt: skip
    for label, p in (("p50", 50), ("p99", 99), ("max", 100)):
        figures[f"echo_to_path_{label}_ms"] = round(float(np.percentile(arrived, p)), 1) if arrived else None
    if phase == "during":
        figures["taken_over"] = len(taken_over)
        figures["takeover_p50_ms"] = round(1000.0 * float(np.median(taken_over))) if taken_over else None
        figures["takeover_max_ms"] = round(1000.0 * max(taken_over)) if taken_over else None
    return figures
