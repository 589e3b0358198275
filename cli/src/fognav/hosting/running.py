"""Runs a fog node on this machine in the foreground, until a signal."""

import asyncio
import contextlib
import socket
from collections.abc import Callable
from typing import Final

from fog_runtime import signals
from fog_runtime.service_manager import ServiceManager
from fog_supervisor.supervisor import Event
from fognav.hosting import log_files
from fognav.hosting.node import LocalNode, NodeConfig
from fognav.operate.registry import Registration
from fognav.output import FailedError

READY_S: Final = 180.0
"""Real seconds for each group of programs to become ready: a Raspberry Pi after a cold boot is slow."""
_PERIOD_S: Final = 1.0


async def run_node(config: NodeConfig, print_line: Callable[[str], None]) -> None:
    """Run a fog node until a signal, then end all its programs.

    Raises `FailedError` when a port is taken, `NotReadyError` when a program does not become ready, and as `LocalNode`.
    """
    node = LocalNode(config, lambda event: _tell(event, print_line))
    running = asyncio.current_task()
    assert running is not None
    loop, stopped = asyncio.get_running_loop(), False

    def stop() -> None:
        nonlocal stopped
        if not stopped:  # a shell repeats the kernel's hang-up
            stopped = True
            running.cancel()

    for number in signals.ending():
        loop.add_signal_handler(number, stop)
    try:
        _require_free_ports(node)
        async with node.supervisor:
            with contextlib.ExitStack() as entries:
                registrations = [_registration(node, index) for index in range(len(config.sites))]
                for each in registrations:
                    entries.enter_context(each)
                    each.update()
                await node.start(READY_S)
                _announce(node, print_line)
                await _attend(node, registrations)
    except asyncio.CancelledError:
        if not stopped:
            raise
        print_line("the fog node has ended; its data stays in " + str(config.folder.path))
    finally:
        node.remove_devices()
        for number in signals.ending():
            loop.remove_signal_handler(number)


def _registration(node: LocalNode, index: int) -> Registration:
    site = node.config.sites[index]
    return Registration(lambda: node.system(site))


async def _attend(node: LocalNode, registrations: list[Registration]) -> None:
    """Keep the register and the service manager informed, and the logs bounded."""
    manager = ServiceManager()
    manager.ready()
    while True:
        for each in registrations:
            each.update()
        for name in node.supervisor.names:
            await asyncio.to_thread(log_files.bound, node.config.folder.log(name))
        manager.alive()
        await asyncio.sleep(_PERIOD_S)


def _tell(event: Event, print_line: Callable[[str], None]) -> None:
    if event.kind == "exited":
        print_line(f"{event.program} died ({event.detail})")


def _announce(node: LocalNode, print_line: Callable[[str], None]) -> None:
    for site in node.config.sites:
        system = node.system(site)
        print_line(f"site {site.id} is up: " + ", ".join(f"{name} {url}" for name, url in system.urls.items()))
        print_line(f"  token in {system.token_file}; operate it from another terminal: fognav status")


def _require_free_ports(node: LocalNode) -> None:
    """Raise `FailedError` if another program listens already where one of these shall."""
    address = node.config.address
    for name, number in node.listening.items():
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
