"""The lidar edge: opens the port, talks the scanner into scanning, and starts over whenever it falls silent.

`ScanSession` is the pure half, bytes and times in, bytes and scans out; `LidarEdge` owns the port.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from fog_runtime import logs
from fog_runtime.clock import ticker
from robot_agent.lidars.rplidar_a1 import protocol as rplidar
from robot_agent.serial_port import Port, PortLost, open_port

if TYPE_CHECKING:
    from collections.abc import Callable

    from fog_runtime.clock import Clock
    from robot_agent.hardware import LaserScan

POLL_S: Final = 0.02
"""The port is read this often: some 40 nodes at a time cost a small computer far less than each alone."""
REOPEN_S: Final = 1.0
STOP_S: Final = 0.05
"""Time between a stop and the next request; the device wants 1 ms, and its last bytes need to arrive."""
ANSWER_S: Final = 1.0
SILENT_S: Final = 1.0
RESET_S: Final = 2.0

_log = logs.get("lidar")


class Received(NamedTuple):
    """What came of some bytes: whether there were measurements, the whole scans, and a request to send."""

    nodes: bool = False
    scans: tuple[LaserScan, ...] = ()
    data: bytes = b""


class ScanSession:
    """One conversation with the scanner: stop, ask for its health, scan; again after silence or a bad answer."""

    def __init__(self) -> None:
        self._parser = rplidar.Parser()
        self._assembler = rplidar.ScanAssembler()
        self._phase: Literal["closed", "stopping", "asking", "scanning", "resetting"] = "closed"
        self._since = 0.0
        self.trouble = ""
        """Why there is no scan, in words; empty while there is one."""

    @property
    def incomplete(self) -> int:
        """Scans that were thrown away because nodes were missing."""
        return self._assembler.incomplete

    def begin(self, now: float) -> bytes:
        """Begin (again), after the port was opened; return what to send."""
        self._parser.reset()
        self._assembler.reset()
        return self._enter("stopping", now, rplidar.stop())

    def receive(self, data: bytes, now: float) -> Received:
        """Take what came from the port."""
        self._parser.receive_data(data)
        nodes, answer = False, b""
        scans: list[LaserScan] = []
        while (event := self._parser.next_event()) is not None:
            if isinstance(event, rplidar.Descriptor):
                # A new answer begins: what was measured before belongs to another scan.
                self._assembler.reset()
            elif isinstance(event, rplidar.Health) and self._phase == "asking":
                answer = self._on_health(event, now)
            elif isinstance(event, rplidar.Nodes) and self._phase == "scanning":
                nodes, self._since, self.trouble = True, now, ""
                scans.extend(self._assembler.feed(event, now))
        return Received(nodes, tuple(scans), answer)

    def tick(self, now: float) -> bytes:
        """Let time pass (20 Hz or more); return what to send."""
        waited = now - self._since
        if self._phase == "stopping" and waited >= STOP_S:
            return self._enter("asking", now, rplidar.get_health())
        if self._phase == "asking" and waited > ANSWER_S:
            self.trouble = "the lidar does not answer; check its cable and power"
            return self._enter("stopping", now, rplidar.stop())
        if self._phase == "scanning" and waited > SILENT_S:
            self.trouble = f"the lidar has sent no measurement for {SILENT_S:.0f} s; it is asked again"
            return self._enter("stopping", now, rplidar.stop())
        if self._phase == "resetting" and waited > RESET_S:
            return self._enter("stopping", now, rplidar.stop())
        return b""

    def _on_health(self, health: rplidar.Health, now: float) -> bytes:
        if health.status == rplidar.HealthStatus.ERROR:
            self.trouble = f"the lidar reports error {health.error_code}; it is reset"
            return self._enter("resetting", now, rplidar.reset())
        return self._enter("scanning", now, rplidar.scan())

    def _enter(self, phase: Literal["stopping", "asking", "scanning", "resetting"], now: float, data: bytes) -> bytes:
        self._phase, self._since = phase, now
        return data


class LidarEdge:
    """Keeps a scan running on one port; the callbacks run on the loop."""

    def __init__(
        self,
        path: str,
        clock: Clock,
        on_nodes: Callable[[float], object],
        on_scan: Callable[[LaserScan, float], object],
    ) -> None:
        self._path = path
        self._clock = clock
        self._on_nodes = on_nodes
        self._on_scan = on_scan
        self._told = ""
        self.trouble = "the lidar's port was not opened yet"

    async def run(self) -> None:
        """Open the port, scan, and start over when it is lost, until cancelled."""
        while True:
            try:
                with open_port(self._path) as port:
                    _log.info("port_open", path=self._path)
                    await self._scan(port)
            except PortLost as error:
                self._tell(str(error))
            await self._clock.sleep(REOPEN_S)

    async def _scan(self, port: Port) -> None:
        session = ScanSession()
        # The motor of an A1 runs while DTR is cleared.
        port.set_dtr(on=False)
        port.discard_input()
        port.write(session.begin(self._clock.now()))
        async for now in ticker(self._clock, POLL_S):
            received = session.receive(port.read_available(), now)
            if received.nodes:
                self._on_nodes(now)
            for scan in received.scans:
                self._on_scan(scan, now)
            port.write(received.data + session.tick(now))
            self._tell(session.trouble)

    def _tell(self, trouble: str) -> None:
        self.trouble = trouble
        if trouble and trouble != self._told:
            _log.warning("lidar_trouble", reason=trouble)
        self._told = trouble
