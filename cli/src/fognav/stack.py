"""The whole system on one machine: real brokers, every process of fog and robot, and simulated hardware."""

import asyncio
import os
import shutil
import sys
import tempfile
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from fog_runtime.default_parts import DEFAULT_BASE, DEFAULT_LIDAR
from fog_runtime.keys import ADMIN_TOKEN, OPERATOR_KEY, TOKENS, make_keys
from fog_runtime.operator_key import read_operator_key
from fog_supervisor import net, servers
from fog_supervisor.supervisor import Event, Program, Supervisor
from fognav import checkout
from fognav.stack_doors import Doors, StackDoors

BROKER: Final = "mosquitto"
REDIS: Final = "redis"
ROUTER: Final = "zenoh-router"
AGGREGATOR: Final = "hazard-aggregator"
MAP_SERVICE: Final = "map-service"
PLANNER: Final = "planner"
SIMULATOR: Final = "simulator"
WATCHDOG: Final = "robot-watchdog"
AGENT: Final = "robot-agent"

SERVERS: Final = (BROKER, REDIS, ROUTER)
SERVICES: Final = (AGGREGATOR, MAP_SERVICE, PLANNER)
ROBOT: Final = (WATCHDOG, AGENT)

_SOCKET_PATH_LIMIT: Final = 80
"""Unix socket paths are limited to 108 bytes; folders up to this length leave room for the file's name."""

Ready = Callable[[], Awaitable[str | None]]


@dataclass(frozen=True, kw_only=True)
class StackConfig:
    """Configuration of a stack.

    `robot` is the id of the site's robot, `base` and `lidar` name its hardware, and `robot_file` has its settings, of
    which the ports do not count; `extra` contains further FOGNAV_ settings for every process. With `doors` the servers
    encrypt, and admit only those users; without, everybody on this machine.
    """

    site_dir: Path
    robot: str
    base: str = DEFAULT_BASE
    lidar: str = DEFAULT_LIDAR
    robot_file: Path | None = None
    seed: int = 1
    speed: float = 1.0
    extra: Mapping[str, str] | None = None
    doors: Doors | None = None


def _new_folder() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="fognav-"))
    if len(str(folder)) > _SOCKET_PATH_LIMIT:
        folder.rmdir()
        folder = Path(tempfile.mkdtemp(prefix="fognav-", dir="/tmp"))  # mkdtemp makes it private
    return folder


async def _exists(path: Path) -> str | None:
    exists = await asyncio.to_thread(path.exists)
    return None if exists else f"{path} does not exist yet"


def _nothing() -> None:
    pass


class Stack:
    """All processes of one demonstration, by name; leaving the context ends them and removes their files.

    Each stack has its own ports, keys, tokens and files, so that several can run side by side.
    """

    def __init__(self, config: StackConfig, on_event: Callable[[Event], None] = lambda _: None) -> None:
        self.config = config
        self.folder = _new_folder()
        self.keep_files = False
        make_keys(self.folder)
        self.token_file = self.folder / ADMIN_TOKEN
        self.token = self.token_file.read_text("ascii").strip()
        """Bearer token of an administrator of this run."""
        self.key_file = self.folder / OPERATOR_KEY
        self.operator_key = read_operator_key(self.key_file)
        taken: set[int] = set()
        self.mqtt_port, self.redis_port, self.zenoh_port = (net.free_port(taken) for _ in range(3))
        self.doors = StackDoors(self.folder, config.doors)
        self._urls: dict[str, str] = {}
        self.supervisor = Supervisor(on_event)
        self._prepare()

    @property
    def zenoh_endpoint(self) -> str:
        """Where the zenoh router listens."""
        return self._urls[ROUTER]

    @property
    def mqtt_url(self) -> str:
        """Where the MQTT broker listens."""
        return self._urls[BROKER]

    @property
    def redis_url(self) -> str:
        """Where Redis listens."""
        return self._urls[REDIS]

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def start(self, timeout_s: float = 90.0) -> None:
        """Start everything and wait until each process is ready; raises `NotReadyError`."""
        await self.start_servers(timeout_s)
        await self.start_system(timeout_s)

    async def start_servers(self, timeout_s: float = 90.0) -> None:
        """Start broker, store and router; whoever subscribes now receives every message. Raises `NotReadyError`."""
        await self._start(SERVERS, SERVERS, timeout_s)

    async def start_system(self, timeout_s: float = 90.0) -> None:
        """Start all other processes, after the servers; raises `NotReadyError`."""
        # The services must be ready before nodes and robots publish, so that no message is missed.
        await self._start(SERVICES, SERVICES, timeout_s)
        # The simulator provides the robot's serial ports, so it starts before the robot.
        await self._start([SIMULATOR], [SIMULATOR], timeout_s)
        await self._start(ROBOT, [WATCHDOG], timeout_s)

    async def _start(self, names: Iterable[str], wait_for: Iterable[str], timeout_s: float) -> None:
        for name in names:
            self.supervisor.start(name)
        await self.supervisor.wait_ready(wait_for, timeout_s)

    async def close(self) -> None:
        """End every process and, unless `keep_files`, remove the run's folder."""
        await self.supervisor.close()
        if not self.keep_files:
            shutil.rmtree(self.folder, ignore_errors=True)

    def log(self, name: str) -> Path:
        """Return the log file of a process."""
        return self.folder / "logs" / f"{name}.log"

    def port_file(self, name: str) -> Path:
        """Return the file to which a process writes the port of its HTTP server."""
        return self.folder / "ports" / name

    def port(self, name: str) -> int | None:
        """Return the port of a process's HTTP server, or None before it listens."""
        return net.read_port(self.port_file(name))

    def pids(self) -> dict[str, int]:
        """Return the process ids of all running processes."""
        found = ((name, self.supervisor.pid(name)) for name in self.supervisor.names)
        return {name: pid for name, pid in found if pid is not None}

    def _prepare(self) -> None:
        for name in ("logs", "ports", "data", "sim"):
            (self.folder / name).mkdir(mode=0o700)
        self._add_servers()
        robot_file = {"ROBOT_FILE": str(self.config.robot_file)} if self.config.robot_file else {}
        hardware = {"BASE": self.config.base, "LIDAR": self.config.lidar, **robot_file}
        simulator = {**hardware, **self.doors.node_settings(), "RUN_DIR": str(self.folder / "sim")}
        self._add_python(SIMULATOR, "fognav_sim", simulator, user="sim")
        key = {"OPERATOR_KEY_FILE": str(self.key_file)}
        for name, module in zip(SERVICES, ("hazard_aggregator", "map_service", "planner"), strict=True):
            own = {"TOKENS_FILE": str(self.folder / TOKENS), **(key if name == PLANNER else {})}
            self._add_python(name, module, own, user=name)
        socket = self.folder / "guardian.sock"
        wires = {
            **hardware,
            **key,
            "ROBOT": self.config.robot,
            "BASE_PORT": str(self.folder / "sim" / "base"),
            "LIDAR_PORT": str(self.folder / "sim" / "lidar"),
            "GUARDIAN_SOCKET": str(socket),
        }
        robot, ready = self.config.robot, partial(_exists, socket)
        self._add_python(WATCHDOG, "robot_agent.guardian.watchdog", wires, ready=ready, rank=2)
        self._add_python(AGENT, "robot_agent", wires, user=robot, rank=2)

    def _add_servers(self) -> None:
        data = self.folder / "data"
        for name in (BROKER, REDIS):
            (data / name).mkdir(mode=0o700)
        for program in (
            servers.mosquitto_program(data / BROKER, self.mqtt_port, locks=self.doors.of("mosquitto")),
            servers.redis_program(data / REDIS, self.redis_port, locks=self.doors.of("redis")),
            servers.router_program(self.zenoh_port, locks=self.doors.of("zenoh")),
        ):
            self._urls[program.name] = program.url
            ready = partial(net.server_problem, program.port, program.probe, program.reply, encrypted=program.encrypted)
            self._add(program.name, program.command, ready=ready)

    def _add_python(
        self,
        name: str,
        module: str,
        own: Mapping[str, str],
        *,
        user: str | None = None,
        ready: Ready | None = None,
        rank: int = 1,
    ) -> None:
        port_file = self.port_file(name)
        data = self.folder / "data" / name
        data.mkdir()
        settings = {
            "SITE_DIR": str(self.config.site_dir),
            "SPEED": repr(self.config.speed),
            "SEED": str(self.config.seed),
            "MQTT_URL": self.mqtt_url,
            "REDIS_URL": self.redis_url,
            "ZENOH_CONNECT": self.zenoh_endpoint,
            "REVISION": checkout.revision(),
            "PORT_FILE": str(port_file),
            "DATA_DIR": str(data),
            **(self.doors.settings(user) if user is not None else {}),
            **(self.config.extra or {}),
            **own,
        }
        self._add(
            name,
            (sys.executable, "-m", module),
            environment={f"FOGNAV_{key}": value for key, value in settings.items()},
            ready=ready or partial(net.readiness, port_file),
            before=partial(port_file.unlink, missing_ok=True),
            rank=rank,
        )

    def _add(
        self,
        name: str,
        arguments: tuple[str, ...],
        *,
        ready: Ready,
        environment: Mapping[str, str] | None = None,
        before: Callable[[], None] = _nothing,
        rank: int = 0,
    ) -> None:
        # Settings of this shell must not affect the processes.
        inherited = {key: value for key, value in os.environ.items() if not key.startswith("FOGNAV_")}
        self.supervisor.add(
            Program(
                name=name,
                arguments=arguments,
                environment={**inherited, "PYTHONUNBUFFERED": "1", **(environment or {})},
                log=self.log(name),
                ready=ready,
                before=before,
                rank=rank,
            )
        )
