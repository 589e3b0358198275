"""The programs of a fog node on this machine, as they are run, and as other commands see them."""

import os
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from fog_runtime.configuration.parts import DEFAULT_BASE, DEFAULT_LIDAR
from fog_runtime.keys import ADMIN_TOKEN, OPERATOR_KEY, TOKENS
from fog_runtime.locks.site_locks import CERTIFICATE, KEY, SiteLocks
from fog_supervisor import net
from fog_supervisor.supervisor import Event, Supervisor
from fognav.hosting.floors import HostedSite
from fognav.hosting.folders import NodeFolder
from fognav.hosting.local_nodes import KIND, UP
from fognav.hosting.lock_changes import LockChanges
from fognav.hosting.settings import REDIS_PORT
from fognav.operate.registry import System
from fognav.operate.systems import MQTTS_PORT, ZENOH_PORT, port
from fognav.output import WrongUseError
from fognav.programs import (
    AGENT,
    BROKER,
    LOCKS,
    MODULES,
    PLANNER,
    REDIS,
    ROUTER,
    SERVERS,
    SERVICES,
    SIMULATOR,
    WATCHDOG,
    ProgramSet,
    Ready,
    ServerPorts,
    exists,
    server_programs,
    simulated_robot_settings,
    simulator_settings,
)

_HARDWARE: Final = {"BASE": DEFAULT_BASE, "LIDAR": DEFAULT_LIDAR}


@dataclass(frozen=True, kw_only=True)
class NodeConfig:
    """What a fog node runs: `address` is where its servers listen; with `simulate`, each site's first robot, too."""

    folder: NodeFolder
    sites: Sequence[HostedSite]
    locks: SiteLocks
    address: str
    simulate: bool = False


class LocalNode:
    """The programs of a fog node: broker, store and router, and the services of each site."""

    def __init__(self, config: NodeConfig, on_event: Callable[[Event], None]) -> None:
        """Describe them, without starting any; raises `ServerError`, and `WrongUseError` for a site without robot."""
        self.config = config
        self.supervisor = Supervisor(on_event)
        self._sites: dict[str, HostedSite] = {}
        self._devices: list[Path] = []
        # Made once: who deletes admin.token later, when it is kept elsewhere, must not end the node.
        self._keys = {site.id: config.folder.keys(site.id) for site in config.sites}
        ports = ServerPorts(
            mqtt=port(MQTTS_PORT), redis=port(REDIS_PORT), zenoh=port(ZENOH_PORT), address=config.address
        )
        self.server_set = server_programs(config.folder, ports, config.locks.folder)
        self._urls = {program.name: program.url for program in self.server_set}
        common = {
            "MQTT_URL": self._urls[BROKER],
            "REDIS_URL": self._urls[REDIS],
            "ZENOH_CONNECT": self._urls[ROUTER],
        }
        self._programs = ProgramSet(self.supervisor, config.folder, common)
        for program in self.server_set:
            self._programs.add_server(program)
        for site in config.sites:
            self._add_services(site)
            if config.simulate:
                self._add_robot(site)

    @property
    def service_names(self) -> list[str]:
        """The services of every site."""
        return [site.name(service) for site in self.config.sites for service in SERVICES]

    @property
    def listening(self) -> dict[str, tuple[str, int]]:
        """The address and port on which each program will listen, by its name."""
        address = self.config.address
        services = {
            site.name(name): (address, number) for site in self.config.sites for name, number in site.ports.items()
        }
        return {program.name: (program.address, program.port) for program in self.server_set} | services

    async def start(self, timeout_s: float) -> None:
        """Start everything, servers first, and wait until each program is ready; raises `NotReadyError`."""
        # Services before nodes and robots, so that no message is missed; the simulator makes the robot's devices.
        robot_parts = [name for name in self.supervisor.names if name not in {*SERVERS, *self.service_names}]
        simulators = [name for name in robot_parts if name.endswith(SIMULATOR)]
        agents = [name for name in robot_parts if name not in simulators]
        for names in (SERVERS, self.service_names, simulators, agents):
            for name in names:
                self.supervisor.start(name)
            await self.supervisor.wait_ready(names, timeout_s)

    def lock_changes(self) -> LockChanges:
        """Watch the files of every program's locks, those of simulated nodes and robots, too."""
        locks = self.config.locks
        servers: dict[str, list[Path]] = {name: [locks.folder(folder)] for name, folder in LOCKS.items()}
        services = {
            site.name(service): [locks.folder("http"), locks.credentials(site.name(service))]
            for site in self.config.sites
            for service in SERVICES
        }
        robots = {} if not self.config.simulate else self._robot_locks()
        return LockChanges(self.supervisor, servers | services | robots)

    def _robot_locks(self) -> dict[str, list[Path]]:
        files: dict[str, list[Path]] = {}
        for site in self.config.sites:
            nodes = [node.id for node in site.loaded.site.nodes]
            for program, users in ((SIMULATOR, ["sim", *nodes]), (AGENT, [site.loaded.site.robots[0].id])):
                files[site.name(program)] = [self.config.locks.credentials(site.name(user)) for user in users]
        return files

    def system(self, site: HostedSite) -> System:
        """Return a site's part of the fog node as it is now."""
        folder, keys = self.config.folder, self._keys[site.id]
        host = net.reachable(self.config.address)
        own = [name for name in self.supervisor.names if self._sites.get(name, site) is site]
        found = {name: self.supervisor.pid(name) for name in own}
        return System(
            name=f"fog-{site.id}",
            kind=KIND,
            site=site.id,
            urls={
                **{service: f"https://{host}:{number}" for service, number in site.ports.items()},
                ROUTER: self._urls[ROUTER],
                BROKER: self._urls[BROKER],
            },
            pids={UP: os.getpid(), **{name: pid for name, pid in found.items() if pid is not None}},
            token_file=str(keys / ADMIN_TOKEN),
            credentials_file=str(self.config.locks.credentials(site.name("console"))),
            robots=[robot.id for robot in site.loaded.site.robots],
            data=str(folder.path),
        )

    def remove_devices(self) -> None:
        """Remove the folders of the simulated robots' devices, after the end of all programs."""
        for folder in self._devices:
            shutil.rmtree(folder, ignore_errors=True)

    def _add(
        self, site: HostedSite, part: str, settings: Mapping[str, str], *, ready: Ready | None = None, rank: int = 1
    ) -> None:
        name = site.name(part)
        self._sites[name] = site
        self._programs.add_python(
            name, MODULES[part], {"SITE_DIR": str(site.directory), **settings}, ready=ready, rank=rank
        )

    def _credentials(self, site: HostedSite, user: str) -> dict[str, str]:
        return {"CREDENTIALS_FILE": str(self.config.locks.credentials(site.name(user)))}

    def _add_services(self, site: HostedSite) -> None:
        keys, http = self._keys[site.id], self.config.locks.folder("http")
        for service in SERVICES:
            settings = {
                "TOKENS_FILE": str(keys / TOKENS),
                "HTTP_HOST": self.config.address,
                "HTTP_PORT": str(site.ports[service]),
                "HTTP_CERTIFICATE_FILE": str(http / CERTIFICATE),
                "HTTP_KEY_FILE": str(http / KEY),
                **self._credentials(site, service),
                **({"OPERATOR_KEY_FILE": str(keys / OPERATOR_KEY)} if service == PLANNER else {}),
            }
            self._add(site, service, settings)

    def _add_robot(self, site: HostedSite) -> None:
        robots = site.loaded.site.robots
        if not robots:
            raise WrongUseError(f"{site.directory}/site.toml has no [[robots]]: add one with its start")
        robot = robots[0].id
        key = {"OPERATOR_KEY_FILE": str(self._keys[site.id] / OPERATOR_KEY)}
        # Paths of sockets are short, and that of the data may be long.
        folder = Path(tempfile.mkdtemp(prefix="fognav-"))
        self._devices.append(folder)
        simulator = {
            **simulator_settings(folder, _HARDWARE),
            "ROBOT": robot,
            "NODE_CREDENTIALS_DIR": str(site.node_credentials(self.config.locks)),
            **self._credentials(site, "sim"),
        }
        self._add(site, SIMULATOR, simulator)
        wires = {**key, **simulated_robot_settings(folder, robot, _HARDWARE)}
        ready = partial(exists, Path(wires["GUARDIAN_SOCKET"]))
        self._add(site, WATCHDOG, wires, ready=ready, rank=2)
        self._add(site, AGENT, {**wires, **self._credentials(site, robot)}, rank=2)
