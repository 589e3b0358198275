"""The lidar edge: owns the port, runs the lidar's driver on it, and reopens it whenever it is lost.

The stream of wheel commands reads the port, 20 times a second: its safety gate sees the newest samples, some 100 at a
time cost a small computer far less than each alone, and the process is not woken for them.

A lidar takes as long to begin as the rest of the agent to load, about a second: its port is listened to before anything
is written, its motor starts, and its first whole scan needs two turns of the head. So `LidarStart` begins its scan
meanwhile. The motor waits for the driver, the last that may refuse a setting. Whatever fails there is left to the edge,
which opens the port again, and says why.
"""

from __future__ import annotations

import asyncio
import threading
from concurrent.futures import Future
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from typing import TYPE_CHECKING, Final, NamedTuple, Self

from fog_runtime import logs
from fog_runtime.configuration.settings import SettingsError
from robot_agent.device_signature import LISTEN_S
from robot_agent.serial_port import Port, PortLost, PortNameError, open_port, refuse_speed

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fog_runtime.clock import Clock
    from robot_agent.device_signature import LineCheck, SerialSettings
    from robot_agent.hardware import LaserScan, LidarDriver, LidarSamples

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


REOPEN_S: Final = 1.0


class LidarEdge:
    """Keeps a scan running on one port; `poll` reads it, on the loop's thread."""

    def __init__(
        self,
        path: str,
        driver: LidarDriver,
        clock: Clock,
        on_samples: Callable[[LidarSamples, float], object],
        *,
        check: Callable[[], LineCheck] | None = None,
        start: LidarStart | None = None,
    ) -> None:
        """`on_samples` is called with the newest samples by `poll`; `check` makes a fresh check for each opening.

        `start`: the scan that was begun with this driver while the agent was loaded.
        """
        self._path = path
        self._driver = driver
        self._clock = clock
        self._on_samples = on_samples
        self._check = check
        self._start = start
        self._last_logged = ""
        self._resting = False
        self._port: Port | None = None
        self._lost: asyncio.Future[None] | None = None
        self._fetched = b""
        self.problem = "the lidar's port was not opened yet"

    async def run(self) -> None:
        """Open the port, scan, and start over when it is lost, until cancelled.

        Raises:
            SettingsError: when the port's name is refused, or the clock's speed is a simulation's and the port real.

        """
        begun = None if self._start is None else await asyncio.to_thread(self._start.take)
        while True:
            try:
                with begun or open_port(self._path, self._driver.serial.baud) as port:
                    if (refusal := refuse_speed(self._clock.speed, port.device)) is not None:
                        raise SettingsError(refusal)
                    _log.info("port_open", path=self._path)
                    if begun is not None or await self._begin(port):
                        await self._scan(port)
            except PortLost as error:
                self._report(str(error))
            except PortNameError as error:
                raise SettingsError(f"lidar.port: {error}") from error
            begun = None
            await self._clock.sleep(REOPEN_S)

    async def _begin(self, port: Port) -> bool:
        """Begin a scan on an open port; False for another device on it. Raises `PortLost`."""
        set_motor(port, self._driver.serial, on=True)
        port.discard_input()
        if self._check is not None and (problem := await wrong_device(port, self._check(), self._clock)) is not None:
            self._report(problem)
            return False
        port.write(self._driver.begin(self._clock.now()))
        return True

    async def _scan(self, port: Port) -> None:
        """Let `poll` use a port, on which a scan has begun, until it is lost; raises `PortLost`."""
        driver = self._driver
        self._resting, self._fetched = False, b""
        self._port, self._lost = port, asyncio.get_running_loop().create_future()
        try:
            await self._lost
        finally:
            self._port = None
            # Laser and motor must not go on after an orderly end; a lost port can't be written to. The DTR line keeps
            # its state when the port is closed.
            with suppress(PortLost):
                port.write(driver.stop_command)
                set_motor(port, driver.serial, on=False)

    @property
    def corrupted(self) -> int:
        """Number of damaged packets of the lidar."""
        return self._driver.corrupted

    def fetch(self) -> None:
        """Keep what has arrived for the next `poll`: the system's own buffer holds that of a fifth of a second only."""
        if self._port is not None and not self._resting:
            try:
                self._fetched += self._port.read_available()
            except PortLost as error:
                self._end(error)

    def poll(self, now: float, *, on: bool = True) -> Sequence[LaserScan]:
        """Read what has arrived, and return the whole scans; none while the port is closed.

        Call it 20 times a second, or `fetch` in its place while nothing depends on what the lidar sees; use the scans
        only after what must not be delayed. Without `on` the lidar rests: its scan and motor are stopped, and started
        again when it is on.
        """
        port, driver = self._port, self._driver
        scans: Sequence[LaserScan] = ()
        if port is None:
            return scans
        try:
            if on is self._resting:
                self._switch(port, now, on=on)
            if self._resting:
                return scans
            data, self._fetched = self._fetched + port.read_available(), b""
            events = driver.receive(data, now)
            scans = events.scans
            if events.samples is not None:
                self._on_samples(events.samples, now)
            if reply := events.data + driver.tick(now):
                port.write(reply)
        except PortLost as error:
            self._end(error)
        self._report(driver.problem)
        return scans

    def _end(self, error: PortLost) -> None:
        """Leave it to `run` to open the port again."""
        self._port = None
        if self._lost is not None and not self._lost.done():
            self._lost.set_exception(error)

    def _switch(self, port: Port, now: float, *, on: bool) -> None:
        self._resting, self._fetched = not on, b""
        if not on:
            port.write(self._driver.stop_command)
        set_motor(port, self._driver.serial, on=on)
        if on:
            port.discard_input()
            port.write(self._driver.begin(now))

    def _report(self, problem: str) -> None:
        self.problem = problem
        if problem and problem != self._last_logged:
            _log.warning("lidar_problem", reason=problem)
        self._last_logged = problem
