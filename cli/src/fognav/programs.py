"""The programs of a system in one folder, each defined once: the demo's, the tests', and a fog node's on this machine.

logs/NAME.log     what each program says
ports/NAME        the port of its HTTP server
data/NAME/        what it stores
"""

import asyncio
import os
import sys
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from fog_supervisor import net, servers
from fog_supervisor.servers import ServerProgram
from fog_supervisor.supervisor import Program, Supervisor
from fognav import checkout

BROKER: Final = "mosquitto"
REDIS: Final = "redis"
ROUTER: Final = "zenoh-router"
AGGREGATOR: Final = "hazard-aggregator"
MAP_SERVICE: Final = "map-service"
PLANNER: Final = "planner"
CONSOLE: Final = "console-service"
BRIDGE: Final = "bridge"
SIMULATOR: Final = "simulator"
WATCHDOG: Final = "robot-watchdog"
AGENT: Final = "robot-agent"

SERVERS: Final = (BROKER, REDIS, ROUTER)
SERVICES: Final = (AGGREGATOR, MAP_SERVICE, PLANNER, CONSOLE)
ROBOT: Final = (WATCHDOG, AGENT)

MODULES: Final[Mapping[str, str]] = {
    AGGREGATOR: "hazard_aggregator",
    MAP_SERVICE: "map_service",
    PLANNER: "planner",
    CONSOLE: "console_service",
    BRIDGE: "fog_bridges",
    SIMULATOR: "fognav_sim",
    WATCHDOG: "robot_agent.guardian.watchdog",
    AGENT: "robot_agent",
}
"""The Python module of each program that is ours."""
URLS: Final[Mapping[str, str]] = {AGGREGATOR: "AGGREGATOR_URL", MAP_SERVICE: "MAP_URL", PLANNER: "PLANNER_URL"}
"""The console-service's settings for the addresses of the services behind it."""
SECURITY: Final[Mapping[str, str]] = {BROKER: "mosquitto", REDIS: "redis", ROUTER: "zenoh"}
"""The folder of each server's credentials (`fog_runtime.security.site_security`)."""
_FOLDERS: Final = ("logs", "ports", "data")

Ready = Callable[[], Awaitable[str | None]]


@dataclass(frozen=True, kw_only=True)
class ServerPorts:
    """Where broker and router listen for others, and Redis for the services of this machine."""

    mqtt: int
    redis: int
    zenoh: int
    address: str = net.LOOPBACK
    """Of broker and router; Redis listens on the loopback address only."""


class SystemFolder:
    """The files of one system's programs; the folder is private, and made where it is missing."""

    def __init__(self, path: Path) -> None:
        self.path = path
        for name in _FOLDERS:
            (path / name).mkdir(mode=0o700, parents=True, exist_ok=True)

    def log(self, name: str) -> Path:
        """Return the log file of a program."""
        return self.path / "logs" / f"{name}.log"

    def port_file(self, name: str) -> Path:
        """Return the file to which a program writes the port of its HTTP server."""
        return self.path / "ports" / name

    def data(self, name: str) -> Path:
        """Return the folder of what a program stores, and make it."""
        folder = self.path / "data" / name
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        return folder


def server_programs(
    folder: SystemFolder,
    ports: ServerPorts,
    security: Callable[[str], Path | None],
    embedded: Collection[str] = (),
) -> Sequence[ServerProgram]:
    """Return broker, store and router, configured in the folder; `security` gives the folder of each one's.

    Those named in `embedded` are Python packages instead (`servers.STAND_INS`). Raises `ServerError` when one is
    not installed.
    """
    at = {name: security(SECURITY[name]) for name in SERVERS}
    if BROKER in embedded:
        broker = servers.embedded_broker_program(ports.mqtt, address=ports.address, security=at[BROKER])
    else:
        broker = servers.mosquitto_program(folder.data(BROKER), ports.mqtt, address=ports.address, security=at[BROKER])
    store = servers.embedded_redis_program if REDIS in embedded else servers.redis_program
    return (
        broker,
        store(folder.data(REDIS), ports.redis, security=at[REDIS]),
        servers.router_program(ports.zenoh, address=ports.address, security=at[ROUTER]),
    )


class ProgramSet:
    """Adds programs to a supervisor, with their settings, logs and checks of readiness."""

    def __init__(self, supervisor: Supervisor, folder: SystemFolder, common: Mapping[str, str]) -> None:
        """Use a folder; `common` are the settings of every Python program, without their prefix FOGNAV_."""
        self._supervisor = supervisor
        self._folder = folder
        self._common = {"REVISION": checkout.revision(), **common}

    def add_server(self, program: ServerProgram) -> None:
        """Add a server, which is ready when it answers."""
        ready = partial(
            net.server_problem, program.port, program.probe, program.reply,
            host=net.reachable(program.address), encrypted=program.encrypted,
        )  # fmt: skip
        self._supervisor.add(
            Program(
                name=program.name,
                arguments=program.command,
                environment=inherited_environment(),
                log=self._folder.log(program.name),
                ready=ready,
            )
        )

    def add_python(
        self,
        name: str,
        module: str,
        settings: Mapping[str, str],
        *,
        ready: Ready | None = None,
        rank: int = 1,
    ) -> None:
        """Add a Python program, which is ready when its `/readyz` or `ready` says so."""
        port_file = self._folder.port_file(name)
        own = {
            **self._common,
            "PORT_FILE": str(port_file),
            "DATA_DIR": str(self._folder.data(name)),
            "MAPS_DIR": str(self._folder.data("maps")),
            **settings,
        }
        self._supervisor.add(
            Program(
                name=name,
                arguments=(sys.executable, "-m", module),
                environment={**inherited_environment(), **{f"FOGNAV_{key}": value for key, value in own.items()}},
                log=self._folder.log(name),
                ready=ready or readiness(port_file, own),
                before=partial(port_file.unlink, missing_ok=True),
                rank=rank,
            )
        )


def readiness(port_file: Path, settings: Mapping[str, str]) -> Ready:
    """Return the check of a program's `/readyz`, at the address and by the scheme of its settings."""
    host = net.reachable(settings.get("HTTP_HOST", net.LOOPBACK))
    return partial(net.readiness, port_file, host=host, encrypted="HTTP_CERTIFICATE_FILE" in settings)


def inherited_environment() -> dict[str, str]:
    """Return the environment of every program: settings of this shell must not affect them.

    Python keeps what it compiles of the checkout, as it does of installed packages: else each start compiles it again,
    which takes a robot's agent 0.2 s.
    """
    inherited = {key: value for key, value in os.environ.items() if not key.startswith("FOGNAV_")}
    return {**inherited, "PYTHONUNBUFFERED": "1", "PYTHONDONTWRITEBYTECODE": ""}


_OF_OPERATORS: Final = ("TIME_IN_COST", "WAIT", "WALL_CLOCK")


def operators_settings() -> dict[str, str]:
    """Return what whoever starts a fog node sets for its services (docs/operator.md), without the prefix FOGNAV_."""
    return {name: value for name in _OF_OPERATORS if (value := os.environ.get(f"FOGNAV_{name}"))}


def simulated_robot_settings(folder: Path, robot: str, hardware: Mapping[str, str]) -> dict[str, str]:
    """Return the settings of a robot's programs whose devices a simulator makes in `folder`/sim."""
    return {
        **hardware,
        "ROBOT": robot,
        "BASE_PORT": str(folder / "sim" / "base"),
        "LIDAR_PORT": str(folder / "sim" / "lidar"),
        "GUARDIAN_SOCKET": str(folder / "guardian.sock"),
    }


def simulator_settings(folder: Path, hardware: Mapping[str, str]) -> dict[str, str]:
    """Return the settings of the simulator that makes these devices, and make their folder."""
    (folder / "sim").mkdir(mode=0o700, parents=True, exist_ok=True)
    return {**hardware, "RUN_DIR": str(folder / "sim")}


async def exists(path: Path) -> str | None:
    """Return None when a file exists, else that it does not: readiness of a program that makes it."""
    return None if await asyncio.to_thread(path.exists) else f"{path} does not exist yet"
