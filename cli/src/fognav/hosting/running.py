"""Runs a fog node on this machine in the foreground, until a signal."""

import asyncio
import contextlib
import socket
from collections.abc import Callable, Iterator
from functools import partial
from typing import Final

from fog_runtime import machine
from fog_runtime.machine import ServiceManager
from fog_supervisor.supervisor import Event
from fognav.hosting import log_files
from fognav.hosting.lock_changes import LockChanges
from fognav.hosting.node import LocalNode, NodeConfig
from fognav.operate.registry import Registration
from fognav.output import FailedError

READY_S: Final = 180.0
"""Real seconds for each group of programs to become ready: a Raspberry Pi after a cold boot is slow."""
PERIOD_S: Final = 1.0
"""Between two rounds of bookkeeping."""


class Troubles:
    """Bookkeeping that fails without ending the fog node: each trouble is printed once, until it is over."""

    def __init__(self, print_line: Callable[[str], None]) -> None:
        self._print_line = print_line
        self._lasting: set[str] = set()

    @contextlib.contextmanager
    def told(self, trouble: str) -> Iterator[None]:
        """Print the trouble, if an `OSError` or `FailedError` leaves this context for the first time in a row."""
        try:
            yield
        except (OSError, FailedError) as error:
            if trouble not in self._lasting:
                self._lasting.add(trouble)
                self._print_line(f"{trouble}: {error}")
        else:
            self._lasting.discard(trouble)


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
                changes = node.lock_changes()  # before the start: programs may have read what changes during it
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
    node: LocalNode, registrations: list[Registration], changes: LockChanges, print_line: Callable[[str], None]
) -> None:
    """Keep the register and the service manager informed, and the logs bounded; robots need none of that to drive."""
    manager = ServiceManager()
    manager.ready()
    troubles = Troubles(print_line)
    while True:
        with troubles.told("changed credentials are not in force"):
            if (changed := await changes.round()) is not None:
                print_line(f"credentials have changed: {changed} uses the new ones")
        for site, each in zip(node.config.sites, registrations, strict=True):
            with troubles.told(f"the entry of site {site.id} in the register is not current"):
                each.update()
        for name in node.supervisor.names:
            with troubles.told(f"the log of {name} could not be kept and begun anew"):
                await asyncio.to_thread(log_files.bound, node.config.folder.log(name))
        manager.alive()
        await asyncio.sleep(PERIOD_S)


def _tell(event: Event, print_line: Callable[[str], None]) -> None:
    if event.kind == "exited":
        print_line(f"{event.program} died ({event.detail})")


def _announce(node: LocalNode, print_line: Callable[[str], None]) -> None:
    for site in node.config.sites:
        system = node.system(site)
        print_line(f"site {site.id} is up: " + ", ".join(f"{name} {url}" for name, url in system.urls.items()))
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
                    "FOGNAV_AGGREGATOR_PORT, FOGNAV_MAP_PORT, FOGNAV_PLANNER_PORT)"
                ) from error
