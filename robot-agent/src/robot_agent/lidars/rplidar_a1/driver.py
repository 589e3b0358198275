"""The RPLidar A1 as a lidar: stop, ask for its health, scan; again after silence or a bad answer."""

from __future__ import annotations

from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from robot_agent.hardware import LaserScan, LidarEvents, LidarFactory, LidarTraits, SerialSettings
from robot_agent.lidars.rplidar_a1 import protocol as rplidar

STOP_S: Final = 0.05
"""Time between a stop and the next request; the device wants 1 ms, and its last bytes need to arrive."""
ANSWER_S: Final = 1.0
SILENT_S: Final = 1.0
RESET_S: Final = 2.0


class RplidarA1Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`range_max_m`: beyond it a return is not believed (early A1 see 6 m far, later ones 12 m)."""

    range_max_m: Annotated[float, Meta(ge=1.0, le=rplidar.RANGE_MAX_M)] = rplidar.RANGE_MAX_M


class RplidarA1Driver:
    """One conversation with the scanner; see `robot_agent.hardware.LidarDriver`."""

    # The motor of an A1 runs while DTR is cleared.
    serial = SerialSettings(rplidar.BAUD, dtr=False)
    stop_command = rplidar.stop()

    def __init__(self, options: RplidarA1Options | None = None) -> None:
        range_max_m = (options or RplidarA1Options()).range_max_m
        self.traits = LidarTraits(range_min_m=rplidar.RANGE_MIN_M, range_max_m=range_max_m, scan_period_s=1 / 5.5)
        self._parser = rplidar.Parser()
        self._assembler = rplidar.ScanAssembler()
        self._phase: Literal["closed", "stopping", "asking", "scanning", "resetting"] = "closed"
        self._since = 0.0
        self.problem = ""

    @property
    def incomplete(self) -> int:
        """Scans that were thrown away because nodes were missing."""
        return self._assembler.incomplete

    def begin(self, now: float) -> bytes:
        """Begin (again), after the port was opened; return what to send."""
        self._parser.reset()
        self._assembler.reset()
        self.problem = ""
        return self._enter("stopping", now, rplidar.stop())

    def receive(self, data: bytes, now: float) -> LidarEvents:
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
                nodes, self._since, self.problem = True, now, ""
                scans.extend(self._assembler.feed(event, now))
        return LidarEvents(nodes, tuple(scans), answer)

    def tick(self, now: float) -> bytes:
        """Let time pass (20 Hz or more); return what to send."""
        waited = now - self._since
        if self._phase == "stopping" and waited >= STOP_S:
            return self._enter("asking", now, rplidar.get_health())
        if self._phase == "asking" and waited > ANSWER_S:
            self.problem = "the lidar does not answer; check its cable and power"
            return self._enter("stopping", now, rplidar.stop())
        if self._phase == "scanning" and waited > SILENT_S:
            self.problem = f"the lidar has sent no measurement for {SILENT_S:.0f} s; it is asked again"
            return self._enter("stopping", now, rplidar.stop())
        if self._phase == "resetting" and waited > RESET_S:
            return self._enter("stopping", now, rplidar.stop())
        return b""

    def _on_health(self, health: rplidar.Health, now: float) -> bytes:
        if health.status == rplidar.HealthStatus.ERROR:
            self.problem = f"the lidar reports error {health.error_code}; it is reset"
            return self._enter("resetting", now, rplidar.reset())
        return self._enter("scanning", now, rplidar.scan())

    def _enter(self, phase: Literal["stopping", "asking", "scanning", "resetting"], now: float, data: bytes) -> bytes:
        self._phase, self._since = phase, now
        return data


FACTORY: Final = LidarFactory(options=RplidarA1Options, make=RplidarA1Driver)
