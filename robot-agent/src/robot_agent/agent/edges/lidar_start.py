"""Begins the lidar's scan while the rest of the agent is still being loaded, which takes about a second.

A lidar takes as long: its port is listened to before anything is written, its motor starts, and its first whole scan
needs two turns of the head. The motor waits for the driver, the last that may refuse a setting. Whatever fails here is
left to the lidar's edge, which opens the port again, and says why.
"""

from __future__ import annotations

import asyncio
import threading
from concurrent.futures import Future
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from typing import TYPE_CHECKING, Final, NamedTuple, Self

from fog_runtime import logs
from robot_agent.device_signature import LISTEN_S
from robot_agent.port_names import PortNameError
from robot_agent.serial_port import Port, PortLost, open_port, refuse_speed

if TYPE_CHECKING:
    from collections.abc import Callable

    from fog_runtime.clock import Clock
    from robot_agent.device_signature import LineCheck, SerialSettings
    from robot_agent.hardware import LidarDriver

_log = logs.get("lidar")

_PERIOD_S: Final = 0.02
ANSWER_S: Final = 0.1
"""A device that is asked what it is has answered within this time."""


def set_motor(port: Port, serial: SerialSettings, *, on: bool) -> None:
    """Let the lidar's motor turn, or stand still, as far as it has a line for that; raises `PortLost`."""
    if serial.dtr is not None:
        port.set_line("dtr", on=serial.dtr is on)


async def wrong_device(port: Port, check: LineCheck, clock: Clock) -> str | None:
    """Listen before anything is written; return the sentence for another device on this port. Raises `PortLost`."""
    until = clock.now() + LISTEN_S
    while not check.settled and clock.now() < until:
        await clock.sleep(_PERIOD_S)
        check.feed(port.read_available())
    if not check.silent:
        return check.problem
    for name, other in check.questions:
        port.write(other.question)
        await clock.sleep(ANSWER_S)
        if (problem := check.answer(name, port.read_available())) is not None:
            return problem
    return None


class LidarStart:
    """A scan that a thread begins: `begin` once the driver is loaded, then `take` the port; a context manager.

    Until then the thread reads the port as the stream of wheel commands does later, and nobody gets the scans.
    """

    def __init__(self, path: str, serial: SerialSettings, check: Callable[[], LineCheck], clock: Clock) -> None:
        """Take over `serial` and `check` as the lidar's edge has them of the driver, which uses the same clock."""
        self._path = path
        self._serial = serial
        self._check = check
        self._clock = clock
        self._driver: Future[LidarDriver] = Future()
        self._port: Port | None = None
        self._taken = threading.Event()
        self._thread = threading.Thread(target=self._run, name="lidar start", daemon=True)

    def begin(self, driver: LidarDriver) -> None:
        """Let the scan begin as soon as the port was listened to; the driver belongs to this object until `take`.

        A driver whose options want other serial settings than its signature's gets no scan: the edge opens the port.
        """
        if driver.serial == self._serial:
            self._driver.set_result(driver)
        else:
            self._driver.cancel()

    def take(self) -> Port | None:
        """Return the port, on which the driver's scan has begun; None if it has not.

        Call it after `begin`; it blocks for 0.3 s of the clock at most, and for what the port needs to write.
        Whoever takes it closes it, and ends the scan before.
        """
        self._taken.set()
        self._thread.join()
        return self._port

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Wait for the thread, and end a scan that nobody has taken over."""
        self._driver.cancel()
        port = self.take()
        if port is None or port.fileno() < 0:
            return
        with port, suppress(PortLost):
            port.write(self._driver.result().stop_command)
            set_motor(port, self._serial, on=False)

    def _run(self) -> None:
        try:
            with suppress(PortLost, PortNameError, asyncio.CancelledError):
                asyncio.run(self._scan())
        except Exception as error:  # noqa: BLE001  # the edge begins anew, and fails where this is no accident
            _log.error("lidar_start_failed", error=error, port=self._path)

    async def _scan(self) -> None:
        with ExitStack() as contexts:
            port = contexts.enter_context(open_port(self._path, self._serial.baud))
            if refuse_speed(self._clock.speed, port.device) is not None:
                return
            port.discard_input()
            if await wrong_device(port, self._check(), self._clock) is not None:
                return
            driver = await asyncio.wrap_future(self._driver)
            set_motor(port, self._serial, on=True)
            contexts.callback(self._stop_motor, port)
            port.write(driver.begin(self._clock.now()))
            while not self._taken.is_set():
                await self._clock.sleep(_PERIOD_S)
                now = self._clock.now()
                if reply := driver.receive(port.read_available(), now).data + driver.tick(now):
                    port.write(reply)
            self._port = port
            contexts.pop_all()

    def _stop_motor(self, port: Port) -> None:
        with suppress(PortLost):
            set_motor(port, self._serial, on=False)


def lidar_start(
    path: str, serial: SerialSettings | None, check: Callable[[], LineCheck], clock: Clock
) -> AbstractContextManager[LidarStart | None]:
    """Return the start of a lidar's scan; of None where its driver must be loaded to know the serial settings."""
    return nullcontext() if serial is None else LidarStart(path, serial, check, clock)


class LidarParts(NamedTuple):
    """The robot's lidar: its port, its driver, the check of what is on the port, and its scan's start, if any."""

    port: str
    driver: LidarDriver
    check: Callable[[], LineCheck]
    start: LidarStart | None
