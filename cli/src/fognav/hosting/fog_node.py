"""The programs of a fog node on this machine: as they are run until a signal, and as other commands see them.

Changes of the credentials come into force while it runs. Mosquitto reads its files again on a signal. Redis, the router
and the services read them at their start only, so each is started again, one at a time, when its own files have
changed: what else is connected goes on meanwhile, and what was connected to it connects again.
"""

import asyncio
import contextlib
import hashlib
import os
import shutil
import signal
import socket
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from fog_runtime import machine
from fog_runtime.configuration.parts import DEFAULT_BASE, DEFAULT_LIDAR
from fog_runtime.keys import ADMIN_TOKEN, BRIDGE_TOKEN, OPERATOR_KEY, SESSION_KEY, TOKENS
from fog_runtime.machine import ServiceManager
from fog_runtime.security.site_security import CERTIFICATE, KEY, SiteSecurity
from fog_runtime.token_file import keep_token
from fog_supervisor import net
from fog_supervisor.supervisor import Event, Supervisor
from fognav.hosting import local_nodes
from fognav.hosting.folders import REDIS_PORT, HostedSite, NodeFolder, renew_due
from fognav.hosting.local_nodes import KIND, UP
from fognav.operate.systems import MQTTS_PORT, ZENOH_PORT, Registration, System, port
from fognav.output import FailedError, WrongUseError
from fognav.programs import (
    AGENT,
    BRIDGE,
    BROKER,
    CONSOLE,
    MODULES,
    PLANNER,
    REDIS,
    ROUTER,
    SECURITY,
    SERVERS,
    SERVICES,
    SIMULATOR,
    URLS,
    WATCHDOG,
    ProgramSet,
    Ready,
    ServerPorts,
    exists,
    operators_settings,
    server_programs,
    simulated_robot_settings,
    simulator_settings,
)

_REREAD_ON: Final[Mapping[str, signal.Signals]] = {BROKER: signal.SIGHUP}
_RESTARTED_S: Final = 180.0
"""How long a restarted program may take before the others are brought up to date without it."""


class CredentialChanges:
    """Watches the files of each program's credentials; `round` is called once a second."""

    def __init__(self, supervisor: Supervisor, files: Mapping[str, Sequence[Path]]) -> None:
        """Watch these files, or all in these folders, by the program that reads them; servers come first."""
        self._supervisor = supervisor
        self._files = files
        self._in_force = {name: self._digest(name) for name in files}
        self._seen = dict(self._in_force)
        self._restarting: str | None = None
        self._restarted_at = 0.0

    async def round(self) -> str | None:
        """Bring the changes of one program into force; return its name, or None.

        Raises `OSError`, and once for each restart `FailedError`, if the program does not become ready after it.
        """
        if self._restarting is not None:
            name = self._restarting
            missing = await self._supervisor.missing([name])
            late = time.monotonic() - self._restarted_at > _RESTARTED_S
            if missing and not late:
                return None  # never two at once
            self._restarting = None
            if missing:
                raise FailedError(
                    f"{name} is not ready {_RESTARTED_S:.0f} s after its restart with them ({missing[name]}). Its log "
                    f"says why (fognav logs {name}); the other programs get theirs"
                )
        for name in self._files:
            found, before = self._digest(name), self._seen[name]
            self._seen[name] = found
            # Several files change together: wait until they rest, so that no key meets another certificate.
            if found != before or found == self._in_force[name]:
                continue
            self._in_force[name] = found
            await self._bring_into_force(name)
            return name
        return None

    async def _bring_into_force(self, name: str) -> None:
        if self._supervisor.pid(name) is None:
            return  # it died, and reads them at its next start
        number = _REREAD_ON.get(name)
        if number is None:
            self._restarting, self._restarted_at = name, time.monotonic()
            await self._supervisor.restart(name)
        else:
            self._supervisor.kill(name, number)

    def _digest(self, name: str) -> bytes:
        found = hashlib.sha256()
        for path in self._files[name]:
            for file in sorted(path.iterdir()) if path.is_dir() else [path] if path.exists() else []:
                found.update(file.name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
        return found.digest()


_HARDWARE: Final = {"BASE": DEFAULT_BASE, "LIDAR": DEFAULT_LIDAR}


@dataclass(frozen=True, kw_only=True)
class NodeConfig:
    """What a fog node runs: `address` is where its servers listen; with `simulate`, each site's first robot, too."""

    folder: NodeFolder
    sites: Sequence[HostedSite]
    security: SiteSecurity
    address: str
    simulate: bool = False
    bridge: Path | None = None
    """Settings of each site's bridge to other systems; None: it has none."""
    floors: Path | None = None
    """The list of floors on other machines, which each site's console shows; None: there are none."""


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
        self.server_set = server_programs(config.folder, ports, config.security.folder)
        self._urls = {program.name: program.url for program in self.server_set}
        common = {
            "MQTT_URL": self._urls[BROKER],
            "REDIS_URL": self._urls[REDIS],
            "ZENOH_CONNECT": self._urls[ROUTER],
            **operators_settings(),
        }
        self._programs = ProgramSet(self.supervisor, config.folder, common)
        for program in self.server_set:
            self._programs.add_server(program)
        taken: set[int] = set()
        bridged = config.sites if config.bridge is not None else []
        self._bridge_ports = {site.id: net.free_port(taken) for site in bridged}
        """Where each site's bridge serves the gateway."""
        for site in config.sites:
            self._add_services(site)
            if config.bridge is not None:
                self._add_bridge(site, config.bridge)
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
        bridges = [site.name(BRIDGE) for site in self.config.sites if self.config.bridge is not None]
        robot_parts = [name for name in self.supervisor.names if name not in {*SERVERS, *self.service_names, *bridges}]
        simulators = [name for name in robot_parts if name.endswith(SIMULATOR)]
        agents = [name for name in robot_parts if name not in simulators]
        for names in (SERVERS, self.service_names, simulators, agents):
            for name in names:
                self.supervisor.start(name)
            await self.supervisor.wait_ready(names, timeout_s)
        for name in bridges:
            self.supervisor.start(name)

    def credential_changes(self) -> CredentialChanges:
        """Watch the files of every program's credentials, those of simulated nodes and robots, too."""
        security = self.config.security
        servers: dict[str, list[Path]] = {name: [security.folder(folder)] for name, folder in SECURITY.items()}
        services = {
            site.name(service): [
                security.folder("http"),
                security.credentials(site.name(service)),
                *([self.config.floors] if self.config.floors is not None and service == CONSOLE else []),
            ]
            for site in self.config.sites
            for service in SERVICES
        }
        robots = {} if not self.config.simulate else self._robot_credentials()
        bridges = {
            site.name(BRIDGE): [security.credentials(site.name(BRIDGE)), self.config.bridge]
            for site in self.config.sites
            if self.config.bridge is not None
        }
        return CredentialChanges(self.supervisor, servers | services | bridges | robots)

    def _robot_credentials(self) -> dict[str, list[Path]]:
        files: dict[str, list[Path]] = {}
        for site in self.config.sites:
            nodes = [node.id for node in site.loaded.site.nodes]
            for program, users in ((SIMULATOR, ["sim", *nodes]), (AGENT, [site.loaded.site.robots[0].id])):
                files[site.name(program)] = [self.config.security.credentials(site.name(user)) for user in users]
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
            credentials_file=str(self.config.security.credentials(site.name("console"))),
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
        return {"CREDENTIALS_FILE": str(self.config.security.credentials(site.name(user)))}

    def _add_services(self, site: HostedSite) -> None:
        keys, http = self._keys[site.id], self.config.security.folder("http")
        host = net.reachable(self.config.address)
        behind = {name: f"https://{host}:{site.ports[service]}" for service, name in URLS.items()}
        for service in SERVICES:
            settings = {
                "TOKENS_FILE": str(keys / TOKENS),
                "SESSION_KEY_FILE": str(keys / SESSION_KEY),
                "HTTP_HOST": self.config.address,
                "HTTP_PORT": str(site.ports[service]),
                "HTTP_CERTIFICATE_FILE": str(http / CERTIFICATE),
                "HTTP_KEY_FILE": str(http / KEY),
                **self._credentials(site, service),
                **({"OPERATOR_KEY_FILE": str(keys / OPERATOR_KEY)} if service == PLANNER else {}),
                **({**behind, **self._bridge_url(site), **self._floors()} if service == CONSOLE else {}),
            }
            self._add(site, service, settings)

    def _floors(self) -> dict[str, str]:
        """Return where the console-service finds the list of floors, if there is one."""
        return {} if self.config.floors is None else {"FLOORS_FILE": str(self.config.floors)}

    def _bridge_url(self, site: HostedSite) -> dict[str, str]:
        """Return where the console-service finds the bridge, if there is one."""
        number = self._bridge_ports.get(site.id)
        return {} if number is None else {"BRIDGE_URL": f"https://{net.LOOPBACK}:{number}"}

    def _add_bridge(self, site: HostedSite, file: Path) -> None:
        token = self._keys[site.id] / BRIDGE_TOKEN
        keep_token(token.with_name(TOKENS), BRIDGE, "operator", token)
        http = self.config.security.folder("http")
        settings = {
            "BRIDGE_FILE": str(file),
            "CONSOLE_URL": f"https://{net.reachable(self.config.address)}:{site.ports[CONSOLE]}",
            "TOKEN_FILE": str(token),
            "HTTP_PORT": str(self._bridge_ports[site.id]),
            "HTTP_CERTIFICATE_FILE": str(http / CERTIFICATE),
            "HTTP_KEY_FILE": str(http / KEY),
            **self._credentials(site, BRIDGE),
        }
        # Whether it is connected is not asked: other systems may be away for days.
        ready = partial(exists, self.config.folder.port_file(site.name(BRIDGE)))
        self._add(site, BRIDGE, settings, ready=ready)

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
            "NODE_CREDENTIALS_DIR": str(site.node_credentials(self.config.security)),
            **self._credentials(site, "sim"),
        }
        self._add(site, SIMULATOR, simulator)
        wires = {**key, **simulated_robot_settings(folder, robot, _HARDWARE)}
        ready = partial(exists, Path(wires["GUARDIAN_SOCKET"]))
        self._add(site, WATCHDOG, wires, ready=ready, rank=2)
        self._add(site, AGENT, {**wires, **self._credentials(site, robot)}, rank=2)


READY_S: Final = 180.0
"""Real seconds for each group of programs to become ready: a Raspberry Pi after a cold boot is slow."""
PERIOD_S: Final = 1.0
"""Between two rounds of bookkeeping."""
RENEWAL_PERIOD_S: Final = 86400.0
"""Between two looks at how long the servers' certificates are valid, of which some months are left when one is due."""


async def run_node(config: NodeConfig, print_line: Callable[[str], None], *, check: bool = False) -> None:
    """Run a fog node until a signal, or with `check` until everything is ready; then end all its programs.

    Raises `FailedError` when a port is taken or a signal cuts the check short, `NotReadyError` when a program does not
    become ready, and as `LocalNode`.
    """

    def say(line: str) -> None:
        # A full disk or a closed terminal behind standard output must not end the programs: nobody is left to tell.
        with contextlib.suppress(OSError):
            print_line(line)

    node = LocalNode(config, lambda event: _tell(event, say))
    running = asyncio.current_task()
    assert running is not None
    loop, stopped = asyncio.get_running_loop(), False

    def stop() -> None:
        nonlocal stopped
        if not stopped:  # a shell repeats the kernel's hang-up
            stopped = True
            running.cancel()

    for number in machine.ending():
        loop.add_signal_handler(number, stop)
    try:
        require_free_ports(node)
        async with node.supervisor:
            with _registered(node) as registrations:
                await _bound_logs(
                    node, local_nodes.Troubles(say)
                )  # a node that never becomes ready is started for ever
                changes = node.credential_changes()  # before the start: programs may have read what changes during it
                await node.start(READY_S)
                _announce(node, print_line)
                if not check:
                    await attend(node, registrations, changes, say)
    except asyncio.CancelledError:
        if not stopped:
            raise
        if check:
            raise FailedError("a signal ended the check before it was done: repeat it (fognav up --check)") from None
        print_line("the fog node has ended; its data stays in " + str(config.folder.path))
    finally:
        node.remove_devices()
        for number in machine.ending():
            loop.remove_signal_handler(number)


@contextlib.contextmanager
def _registered(node: LocalNode) -> Iterator[list[Registration]]:
    """Enter each site of the node into the register; yield the entries, in the order of the sites."""
    with contextlib.ExitStack() as entries:
        registrations = [entries.enter_context(Registration(partial(node.system, site))) for site in node.config.sites]
        for each in registrations:
            each.update()
        yield registrations


async def attend(
    node: LocalNode, registrations: list[Registration], changes: CredentialChanges, print_line: Callable[[str], None]
) -> None:
    """Keep the register and the service manager informed, and the logs bounded; robots need none of that to drive."""
    manager = ServiceManager()
    manager.ready()
    troubles = local_nodes.Troubles(print_line)
    looked = time.monotonic()  # the start has renewed what was due
    while True:
        if time.monotonic() > looked + RENEWAL_PERIOD_S:
            looked = time.monotonic()
            with troubles.told("certificates could not be renewed"):
                for name in await asyncio.to_thread(renew_due, node.config.security.directory):
                    print_line(f"the certificate of {name} was renewed")
        with troubles.told("changed files are not in force"):
            if (changed := await changes.round()) is not None:
                print_line(f"files have changed: {changed} uses the new ones")
        for site, each in zip(node.config.sites, registrations, strict=True):
            with troubles.told(f"the entry of site {site.id} in the register is not current"):
                each.update()
        await _bound_logs(node, troubles)
        manager.alive()
        await asyncio.sleep(PERIOD_S)


async def _bound_logs(node: LocalNode, troubles: local_nodes.Troubles) -> None:
    for name in node.supervisor.names:
        with troubles.told(f"the log of {name} could not be kept and begun anew"):
            await asyncio.to_thread(local_nodes.bound_log, node.config.folder.log(name))


def _tell(event: Event, print_line: Callable[[str], None]) -> None:
    if event.kind == "exited":
        print_line(f"{event.program} {'ended' if event.detail.startswith('exit code 0') else 'died'} ({event.detail})")


def _announce(node: LocalNode, print_line: Callable[[str], None]) -> None:
    for site in node.config.sites:
        system = node.system(site)
        print_line(f"site {site.id} is up: " + ", ".join(f"{name} {url}" for name, url in system.urls.items()))
        print_line(f"  console: {system.urls[CONSOLE]}/, where people log in with a token")
        print_line(f"  token in {system.token_file}; operate it from another terminal: fognav status")


def require_free_ports(node: LocalNode) -> None:
    """Raise `FailedError` if another program listens already where one of these shall."""
    for name, (address, number) in node.listening.items():
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address, number))
            except OSError as error:
                raise FailedError(
                    f"{name} can't listen on {address} port {number}: {error.strerror}. End the program that does, or "
                    "choose other ports (FOGNAV_MQTT_PORT, FOGNAV_REDIS_PORT, FOGNAV_ZENOH_PORT, "
                    "FOGNAV_AGGREGATOR_PORT, FOGNAV_MAP_PORT, FOGNAV_PLANNER_PORT, FOGNAV_CONSOLE_PORT)"
                ) from error
