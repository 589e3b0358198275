"""Driver of the RPLidar A1: stop, request its health, scan; restart after silence or a bad answer."""

from __future__ import annotations

from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from fog_contracts.messages import Described, Reason
from robot_agent.device_signature import SerialSettings
from robot_agent.hardware import LaserScan, LidarEvents, LidarFactory, LidarTraits
from robot_agent.lidars.rplidar_a1 import protocol as rplidar

STOP_S: Final = 0.1
"""Time between a stop and the next request; the device needs 1 ms, and its last bytes must arrive."""
ANSWER_TIMEOUT_S: Final = 1.0
SAMPLES_TIMEOUT_S: Final = 1.0
RESET_S: Final = 2.0


class RplidarA1Problem(Described):
    """Why there is no scan."""

    NO_ANSWER = "no_answer", "it does not answer"
    NO_SAMPLES = "no_samples", "it has stopped measuring"
    REPORTS_ERROR = "reports_error", "it reports an error of its own"


class RplidarA1Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An RPLidar A1."""

    range_max_m: Annotated[
        float,
        Meta(
            ge=1.0,
            le=rplidar.RANGE_MAX_M,
            description="returns beyond it are ignored (early A1 see 6 m far, later ones 12 m)",
        ),
    ] = rplidar.RANGE_MAX_M


class RplidarA1Driver:
    """Protocol of one lidar; see `robot_agent.hardware.LidarDriver`."""

    serial = SerialSettings(115200, dtr=False)
    """The motor of an A1 runs while DTR is cleared."""
    stop_command = rplidar.stop()

    def __init__(self, options: RplidarA1Options | None = None) -> None:
        range_max_m = (options or RplidarA1Options()).range_max_m
        self.traits = LidarTraits(
            range_min_m=rplidar.RANGE_MIN_M, range_max_m=range_max_m, scan_period_s=1 / 5.5, can_rest=True
        )
        self._parser = rplidar.Parser()
        self._assembler = rplidar.ScanAssembler()
        self._phase: Literal["closed", "stopping", "checking", "scanning", "resetting"] = "closed"
        self._since = 0.0
        self.problem: Reason | Literal[""] = ""

    @property
    def incomplete(self) -> int:
        """Number of scans that were discarded because nodes were missing."""
        return self._assembler.incomplete

    @property
    def corrupted(self) -> int:
        """Number of damaged capsules, and of lost boundaries of nodes or capsules."""
        return self._parser.corrupted + self._parser.resyncs

    def begin(self, now: float) -> bytes:
        """Begin (again), after the port was opened; return the bytes to send."""
        self._parser.reset()
        self._assembler.reset()
        self.problem = ""
        return self._enter("stopping", now, rplidar.stop())

    def receive(self, data: bytes, now: float) -> LidarEvents:
        """Parse bytes received from the port."""
        self._parser.receive_data(data)
        answer = b""
        scans: list[LaserScan] = []
        while (event := self._parser.next_event()) is not None:
            if isinstance(event, rplidar.Descriptor):
                # A new answer begins: earlier samples belong to another scan.
                self._assembler.reset()
            elif isinstance(event, rplidar.Health) and self._phase == "checking":
                answer = self._on_health(event, now)
            elif isinstance(event, rplidar.Nodes) and self._phase == "scanning":
                self._since, self.problem = now, ""
                scans.extend(self._assembler.feed(event, now))
        return LidarEvents(self._assembler.take_samples(), tuple(scans), answer)

    def tick(self, now: float) -> bytes:
        """Advance time (20 Hz or more); return the bytes to send."""
        waited = now - self._since
        if self._phase == "stopping" and waited >= STOP_S:
            return self._enter("checking", now, rplidar.get_health())
        if self._phase == "checking" and waited > ANSWER_TIMEOUT_S:
            sentence = "the lidar does not answer; check its cable and power"
            self.problem = Reason(RplidarA1Problem.NO_ANSWER, sentence)
            return self._enter("stopping", now, rplidar.stop())
        if self._phase == "scanning" and waited > SAMPLES_TIMEOUT_S:
            sentence = f"the lidar has sent no measurement for {SAMPLES_TIMEOUT_S:.0f} s; its scan is restarted"
            self.problem = Reason(RplidarA1Problem.NO_SAMPLES, sentence)
            return self._enter("stopping", now, rplidar.stop())
        if self._phase == "resetting" and waited > RESET_S:
            return self._enter("stopping", now, rplidar.stop())
        return b""

    def _on_health(self, health: rplidar.Health, now: float) -> bytes:
        if health.status == rplidar.HealthStatus.ERROR:
            sentence = (
                f"the lidar reports error {health.error_code}; it is reset. The cause is nearly always its supply or "
                "cable (5 V at the plug, under load), or mounting screws that are longer than 4 mm"
            )
            self.problem = Reason(RplidarA1Problem.REPORTS_ERROR, sentence)
            return self._enter("resetting", now, rplidar.reset())
        return self._enter("scanning", now, rplidar.scan())

    def _enter(self, phase: Literal["stopping", "checking", "scanning", "resetting"], now: float, data: bytes) -> bytes:
        self._phase, self._since = phase, now
        return data


FACTORY: Final = LidarFactory(options=RplidarA1Options, make=RplidarA1Driver)
