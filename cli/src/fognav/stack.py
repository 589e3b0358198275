"""The whole system on one machine: real brokers, every process of fog and robot, and simulated hardware."""

import shutil
import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from fog_contracts.site import Site
from fog_runtime.configuration.parts import DEFAULT_BASE, DEFAULT_LIDAR
from fog_runtime.credentials import NOBODY, Credentials
from fog_runtime.keys import ADMIN_TOKEN, OPERATOR_KEY, SESSION_KEY, TOKENS, make_keys, read_operator_key
from fog_runtime.security.site_security import CREDENTIALS, SiteSecurity
from fog_supervisor import net
from fog_supervisor.supervisor import Event, Supervisor
from fognav.programs import (
    AGENT,
    BROKER,
    CONSOLE,
    MODULES,
    PLANNER,
    REDIS,
    ROBOT,
    ROUTER,
    SERVERS,
    SERVICES,
    SIMULATOR,
    URLS,
    WATCHDOG,
    ProgramSet,
    ServerPorts,
    SystemFolder,
    exists,
    server_programs,
    simulated_robot_settings,
    simulator_settings,
)

FOLDER: Final = "locks"


@dataclass(frozen=True, kw_only=True)
class StackUsers:
    """Whom the servers admit: the site's id, and its robots and sensor nodes by id."""

    site: str
    robots: tuple[str, ...] = ()
    nodes: tuple[str, ...] = ()
    unrestricted: tuple[str, ...] = ()
    """Users who may do everything on broker and router, for tests."""


def users_of(site: Site, *, unrestricted: tuple[str, ...] = ()) -> StackUsers:
    """Return the users of a stack: robots, nodes and sources of zones of a site."""
    return StackUsers(
        site=site.id,
        robots=tuple(robot.id for robot in site.robots),
        nodes=tuple(site.senders),
        unrestricted=unrestricted,
    )


class StackSecurity:
    """The security of a stack in its folder; without `StackUsers` everybody is admitted, and nobody has credentials."""

    def __init__(self, folder: Path, users: StackUsers | None) -> None:
        self._security: SiteSecurity | None = None
        if users is not None:
            self._security = SiteSecurity(folder / FOLDER, users.site, unrestricted=users.unrestricted)
            self._security.make([net.LOOPBACK, "localhost"], robots=users.robots, nodes=users.nodes)

    def of(self, program: str) -> Path | None:
        """Return the folder with the credentials of a server program."""
        return None if self._security is None else self._security.folder(program)

    def file(self, user: str) -> Path | None:
        """Return the file of a user's credentials."""
        return None if self._security is None else self._security.credentials(user)

    def credentials(self, user: str) -> Credentials:
        """Read a user's credentials."""
        return NOBODY if self._security is None else Credentials.read(self._security.credentials(user))

    def settings(self, user: str) -> Mapping[str, str]:
        """Return the settings of a process that is this user."""
        return {} if self._security is None else {"CREDENTIALS_FILE": str(self._security.credentials(user))}

    def node_settings(self) -> Mapping[str, str]:
        """Return the settings of a process that is every sensor node."""
        return {} if self._security is None else {"NODE_CREDENTIALS_DIR": str(self._security.directory / CREDENTIALS)}


_SOCKET_PATH_LIMIT: Final = 80
"""Unix socket paths are limited to 108 bytes; folders up to this length leave room for the file's name."""


@dataclass(frozen=True, kw_only=True)
class StackConfig:
    """Configuration of a stack.

    `robot` is the id of the site's robot, `base` and `lidar` name its hardware, and `robot_file` has its settings, of
    which the ports do not count; `extra` contains further FOGNAV_ settings for every process. With `users` the servers
    encrypt, and admit only those users; without, everybody on this machine. The servers named in `embedded` are Python
    packages (`servers.STAND_INS`). `planners` are the planners' programs, each with FOGNAV_ settings of its own: more
    than one take turns. `console` has further settings of the console-service.
    """

    site_dir: Path
    robot: str
    base: str = DEFAULT_BASE
    lidar: str = DEFAULT_LIDAR
    robot_file: Path | None = None
    seed: int = 1
    speed: float = 1.0
    extra: Mapping[str, str] | None = None
    users: StackUsers | None = None
    embedded: frozenset[str] = frozenset()
    planners: Mapping[str, Mapping[str, str]] = field(default_factory=lambda: {PLANNER: {}})
    console: Mapping[str, str] = field(default_factory=dict)


def _new_folder() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="fognav-"))
    if len(str(folder)) > _SOCKET_PATH_LIMIT:
        folder.rmdir()
        folder = Path(tempfile.mkdtemp(prefix="fognav-", dir="/tmp"))  # mkdtemp makes it private
    return folder


class Stack:
    """All processes of one demonstration, by name; leaving the context ends them and removes their files.

    Each stack has its own ports, keys, tokens and files, so that several can run side by side.
    """

    def __init__(self, config: StackConfig, on_event: Callable[[Event], None] = lambda _: None) -> None:
        self.config = config
        self.folder = _new_folder()
        self.files = SystemFolder(self.folder)
        self.keep_files = False
        make_keys(self.folder)
        self.token_file = self.folder / ADMIN_TOKEN
        self.token = self.token_file.read_text("ascii").strip()
        """Bearer token of an administrator of this run."""
        self.key_file = self.folder / OPERATOR_KEY
        self.operator_key = read_operator_key(self.key_file)
        taken: set[int] = set()
        self.mqtt_port, self.redis_port, self.zenoh_port = (net.free_port(taken) for _ in range(3))
        self.security = StackSecurity(self.folder, config.users)
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

    async def start_services(self, timeout_s: float = 90.0) -> None:
        """Start the services alone, after the servers; raises `NotReadyError`."""
        await self._start(SERVICES, SERVICES, timeout_s)

    async def start_system(self, timeout_s: float = 90.0) -> None:
        """Start all other processes, after the servers; raises `NotReadyError`."""
        # The services must be ready before nodes and robots publish, so that no message is missed.
        await self.start_services(timeout_s)
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
        return self.files.log(name)

    def port_file(self, name: str) -> Path:
        """Return the file to which a process writes the port of its HTTP server."""
        return self.files.port_file(name)

    def port(self, name: str) -> int | None:
        """Return the port of a process's HTTP server, or None before it listens."""
        return net.read_port(self.port_file(name))

    def pids(self) -> dict[str, int]:
        """Return the process ids of all running processes."""
        found = ((name, self.supervisor.pid(name)) for name in self.supervisor.names)
        return {name: pid for name, pid in found if pid is not None}

    def _prepare(self) -> None:
        ports = ServerPorts(mqtt=self.mqtt_port, redis=self.redis_port, zenoh=self.zenoh_port)
        server_set = server_programs(self.files, ports, self.security.of, self.config.embedded)
        self._urls = {program.name: program.url for program in server_set}
        programs = ProgramSet(
            self.supervisor,
            self.files,
            {
                "SITE_DIR": str(self.config.site_dir),
                "SPEED": repr(self.config.speed),
                "SEED": str(self.config.seed),
                "MQTT_URL": self.mqtt_url,
                "REDIS_URL": self.redis_url,
                "ZENOH_CONNECT": self.zenoh_endpoint,
                **(self.config.extra or {}),
            },
        )
        for program in server_set:
            programs.add_server(program)
        robot_file = {"ROBOT_FILE": str(self.config.robot_file)} if self.config.robot_file else {}
        hardware = {"BASE": self.config.base, "LIDAR": self.config.lidar, **robot_file}
        simulator = {**simulator_settings(self.folder, hardware), **self.security.node_settings()}
        programs.add_python(SIMULATOR, MODULES[SIMULATOR], {**simulator, **self.security.settings("sim")})
        key = {"OPERATOR_KEY_FILE": str(self.key_file)}
        taken = {self.mqtt_port, self.redis_port, self.zenoh_port}
        services: dict[str, Mapping[str, str]] = {name: {} for name in SERVICES}
        services.update({**self.config.planners, CONSOLE: self.config.console})
        http = {name: net.free_port(taken) for name in services}  # the console-service must know the others'
        behind = {setting: f"http://{net.LOOPBACK}:{http[name]}" for name, setting in URLS.items()}
        for name, further in services.items():
            service = PLANNER if name in self.config.planners else name
            own = {
                "TOKENS_FILE": str(self.folder / TOKENS),
                "SESSION_KEY_FILE": str(self.folder / SESSION_KEY),
                "HTTP_PORT": str(http[name]),
                **(key if service == PLANNER else behind if service == CONSOLE else {}),
            }
            programs.add_python(name, MODULES[service], {**own, **self.security.settings(service), **further})
        robot = self.config.robot
        wires = simulated_robot_settings(self.folder, robot, hardware)
        ready = partial(exists, Path(wires["GUARDIAN_SOCKET"]))
        programs.add_python(WATCHDOG, MODULES[WATCHDOG], wires, ready=ready, rank=2)
        programs.add_python(AGENT, MODULES[AGENT], {**wires, **key, **self.security.settings(robot)}, rank=2)
