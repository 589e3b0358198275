"""One robot for measurements: real watchdog, guardian and agent, emulated devices, and a fog that is played by hand."""

from __future__ import annotations

import asyncio
import os
import random
import secrets
import signal
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from fog_contracts.costs import ROBOT_RADIUS
from fog_contracts.messages import Pose
from fog_contracts.site import RobotSite
from fog_runtime.clock import SystemClock
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor import net
from fog_supervisor.servers import router_program
from fog_supervisor.supervisor import Program, Supervisor
from fognav_experiments.bench.office import corridor_rows, make_office
from fognav_experiments.bench.reactions.body import BASE, LIDAR, Body
from fognav_experiments.bench.reactions.fog import ROBOT, SITE, Fog
from fognav_experiments.bench.running import RunningSystem, first_child

ROUTER: Final = "zenoh-router"
WATCHDOG: Final = "watchdog"
AGENT: Final = "agent"
GUARDIAN: Final = "guardian"
_FLOOR_M: Final = (70.0, 18.0)
_START_X_M: Final = 6.0
_READY_S: Final = 90.0
_FAST_M_S: Final = 0.28
_STEADY_S: Final = 0.4
_STRAIGHT_M_S: Final = 0.03


class Rig(RunningSystem):
    """The running robot. `folder` gets its files and logs."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self._rng = random.Random(seed)  # noqa: S311  # when a fault comes, not a secret
        self._seed = seed
        self._clock = SystemClock()
        self._signalled: list[int] = []

    async def _start(self) -> None:
        contexts = self._contexts
        folder = Path(contexts.enter_context(TemporaryDirectory(prefix="fognav-")))
        floor = await asyncio.to_thread(make_office, *_FLOOR_M)
        y = float(corridor_rows(_FLOOR_M[1])[0])
        robot = RobotSite(id=ROBOT, start=Pose(x=_START_X_M, y=y, theta=0.0), radius=ROBOT_RADIUS)
        self.body = contexts.enter_context(Body(folder, floor, robot, self._seed))
        key = secrets.token_bytes(32)
        site = folder / "site"
        site.mkdir()
        start = f"{{ x = {_START_X_M}, y = {y}, theta = 0.0 }}"
        entry = f'[[robots]]\nid = "{ROBOT}"\nstart = {start}\nradius = {ROBOT_RADIUS}\n'
        (site / "site.toml").write_text(f'id = "{SITE}"\n{entry}', "utf-8")
        (folder / "operator.key").write_text(key.hex() + "\n", "utf-8")
        self._supervisor = await contexts.enter_async_context(Supervisor(lambda _event: None))
        endpoint = self._add_programs(folder, site)
        await self._start_program(ROUTER)
        edge = await contexts.enter_async_context(
            ZenohEdge.open(connect=[endpoint], clock=self._clock, role="console", id="bench", site=SITE)
        )
        self.fog = Fog(edge, self._clock, floor, (_START_X_M - 2.0, _FLOOR_M[0] - 4.0), y, key)
        tasks = await contexts.enter_async_context(asyncio.TaskGroup())
        running = tasks.create_task(self.fog.run())
        contexts.callback(running.cancel)
        await self._start_program(WATCHDOG)
        await self._start_program(AGENT)

    def _add_programs(self, folder: Path, site: Path) -> str:
        port = net.free_port()
        router = router_program(port)
        ready = partial(net.server_problem, router.port, router.probe, router.reply)
        self._supervisor.add(Program(name=ROUTER, arguments=router.command, log=folder / "router.log", ready=ready))
        socket = folder / "guardian.sock"
        settings = {
            "BASE": BASE, "BASE_PORT": self.body.base_link, "LIDAR": LIDAR, "LIDAR_PORT": self.body.lidar_link,
            "GUARDIAN_SOCKET": socket, "ROBOT": ROBOT, "SITE_DIR": site, "DATA_DIR": folder / "data",
            "OPERATOR_KEY_FILE": folder / "operator.key", "ZENOH_CONNECT": router.url, "SEED": self._seed,
        }  # fmt: skip
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("FOGNAV_")}
        environment = inherited | {f"FOGNAV_{name}": str(value) for name, value in settings.items()}
        for name, module in ((WATCHDOG, "robot_agent.guardian.watchdog"), (AGENT, "robot_agent")):
            arguments = (sys.executable, "-m", module)
            log = folder / f"{name}.log"
            self._supervisor.add(Program(name=name, arguments=arguments, log=log, environment=environment, rank=1))
        return router.url

    async def _start_program(self, name: str) -> None:
        self._supervisor.start(name)
        await self._supervisor.wait_ready([name], _READY_S)

    # --- processes ---

    def pid(self, name: str) -> int:
        """Return the id of a running process; raises `ProcessLookupError` if it does not run."""
        program = WATCHDOG if name == GUARDIAN else name
        pid = self._supervisor.pid(program)
        if pid is not None and name == GUARDIAN:
            pid = first_child(pid)
        if pid is None:
            raise ProcessLookupError(f"{name} does not run")
        return pid

    def signal(self, names: tuple[str, ...], number: signal.Signals) -> None:
        """Send a signal to processes, in one go; `revive` undoes it."""
        pids = [self.pid(name) for name in names]
        for pid in pids:
            os.kill(pid, number)
        self._signalled = pids

    async def revive(self) -> None:
        """Let stopped processes go on, and start ended ones without the delay that is for programs that fail."""
        for pid in self._signalled:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        self._signalled = []
        for name in (WATCHDOG, AGENT):
            if self._supervisor.pid(name) is None:
                await self._supervisor.restart(name)

    # --- driving ---

    async def wait_driving(self) -> None:
        """Wait until the robot drives straight on at full speed, and then for a random moment of its cycles."""
        await self.fog.until(lambda: self.fog.pose is not None, _READY_S, "the robot knows its pose")
        self.fog.send_on()
        steady_since: float | None = None
        deadline = self._clock.now() + _READY_S
        while steady_since is None or self._clock.now() - steady_since < _STEADY_S:
            left, right = self.body.wheels
            driving = min(left, right) > _FAST_M_S and abs(left - right) < _STRAIGHT_M_S
            state = self.fog.state
            driving = driving and state is not None and state.mode == "NORMAL"
            steady_since = (steady_since or self._clock.now()) if driving else None
            if self._clock.now() > deadline:
                await self.fog.until(lambda: False, 0.0, "the robot drives straight on")
            await asyncio.sleep(0.01)
        await asyncio.sleep(self._rng.uniform(0.0, 0.2))

    async def disable(self) -> None:
        """Disable the robot, which also clears its count of protective stops; the operator enables it again."""
        await self.fog.stop_unsigned()
