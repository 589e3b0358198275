"""The lidar edge: owns the port, runs the lidar's driver on it, and reopens it whenever it is lost.

The stream of wheel commands reads the port, 20 times a second: its safety gate sees the newest samples, some 100 at a
time cost a small computer far less than each alone, and the process is not woken for them.

A lidar takes as long to begin as the rest of the agent to load, about a second: its port is listened to before anything
is written, its motor starts, and its first whole scan needs two turns of the head. So the edge runs before there is a
core, and reads the port itself until somebody wants the samples.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from fog_contracts.messages import Described, Reason
from fog_runtime import logs
from fog_runtime.configuration.settings import SettingsError
from robot_agent.device_signature import LISTEN_S
from robot_agent.serial_port import Port, PortLost, PortNameError, open_port, refuse_speed

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fog_runtime.clock import Clock
    from robot_agent.agent.edges.guardian_client import GuardianClient
    from robot_agent.device_signature import LineCheck, SerialSettings
    from robot_agent.hardware import LaserScan, LidarDriver, LidarSamples

_log = logs.get("lidar")

REOPEN_S: Final = 1.0
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


class PortProblem(Described):
    """Why nothing is heard of a lidar's driver yet."""

    PORT_CLOSED = "port_closed", "its port can't be opened, or was lost"
    WRONG_DEVICE = "wrong_device", "another device speaks on its port"


class LidarEdge:
    """Keeps a scan running on one port; `poll` reads it, on the loop's thread."""

    def __init__(
        self,
        path: str,
        driver: LidarDriver,
        clock: Clock,
        on_samples: Callable[[LidarSamples, float], object] | None = None,
        *,
        check: Callable[[], LineCheck] | None = None,
    ) -> None:
        """`check` makes a fresh check for each opening of the port."""
        self.on_samples = on_samples
        """Called with the newest samples by `poll`. Until it is set, the edge reads the port itself, for nobody."""
        self.traits = driver.traits
        self._path = path
        self._driver = driver
        self._clock = clock
        self._check = check
        self._last_logged = ""
        self._resting = False
        self._port: Port | None = None
        self._lost: asyncio.Future[None] | None = None
        self._fetched = b""
        self.problem: Reason | Literal[""] = Reason(PortProblem.PORT_CLOSED, "the lidar's port was not opened yet")

    async def run(self) -> None:
        """Open the port, scan, and start over when it is lost, until cancelled.

        Raises:
            SettingsError: when the port's name is refused, or the clock's speed is a simulation's and the port real.

        """
        while True:
            try:
                with open_port(self._path, self._driver.serial.baud) as port:
                    if (refusal := refuse_speed(self._clock.speed, port.device)) is not None:
                        raise SettingsError(refusal)
                    _log.info("port_open", path=self._path)
                    if await self._begin(port):
                        await self._scan(port)
            except PortLost as error:
                self._report(Reason(PortProblem.PORT_CLOSED, str(error)))
            except PortNameError as error:
                raise SettingsError(f"lidar.port: {error}") from error
            await self._clock.sleep(REOPEN_S)

    async def _begin(self, port: Port) -> bool:
        """Begin a scan on an open port; False for another device on it. Raises `PortLost`."""
        set_motor(port, self._driver.serial, on=True)
        port.discard_input()
        if self._check is not None and (problem := await wrong_device(port, self._check(), self._clock)) is not None:
            self._report(Reason(PortProblem.WRONG_DEVICE, problem))
            return False
        port.write(self._driver.begin(self._clock.now()))
        return True

    async def _scan(self, port: Port) -> None:
        """Let `poll` use a port, on which a scan has begun, until it is lost; raises `PortLost`."""
        driver = self._driver
        self._resting, self._fetched = False, b""
        self._port, self._lost = port, asyncio.get_running_loop().create_future()
        try:
            while self.on_samples is None and not self._lost.done():
                self.poll(self._clock.now())
                await self._clock.sleep(_PERIOD_S)
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
            if events.samples is not None and self.on_samples is not None:
                self.on_samples(events.samples, now)
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

    def _report(self, problem: Reason | Literal[""]) -> None:
        self.problem = problem
        if problem and problem != self._last_logged:
            _log.warning("lidar_problem", problem=problem.code, reason=str(problem))
        self._last_logged = problem


class Devices(NamedTuple):
    """The edges of base and lidar, and the tasks that run them since before the rest of the agent was loaded."""

    guardian: GuardianClient
    lidar: LidarEdge
    tasks: Sequence[asyncio.Task[None]]
