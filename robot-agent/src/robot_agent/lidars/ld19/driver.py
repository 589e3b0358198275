"""Driver of the LD19: it rotates and sends from power-on and takes no commands."""

from __future__ import annotations

from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from fog_contracts.messages import Described, Reason
from robot_agent.device_signature import SerialSettings
from robot_agent.hardware import LaserScan, LidarEvents, LidarFactory, LidarTraits
from robot_agent.lidars.ld19 import protocol

SAMPLES_TIMEOUT_S: Final = 1.0


class Ld19Problem(Described):
    """Why there is no scan."""

    NO_PACKETS = "no_packets", "no valid packet arrives"


class Ld19Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An LD19."""

    range_max_m: Annotated[
        float, Meta(ge=1.0, le=protocol.RANGE_MAX_M, description="returns beyond it are ignored")
    ] = protocol.RANGE_MAX_M
    intensity_min: Annotated[int, Meta(ge=0, le=255, description="a weaker return is ignored")] = 0


class Ld19Driver:
    """Protocol of one lidar; see `robot_agent.hardware.LidarDriver`."""

    serial = SerialSettings(230400)
    stop_command = b""

    def __init__(self, options: Ld19Options | None = None) -> None:
        chosen = options or Ld19Options()
        self.traits = LidarTraits(range_min_m=protocol.RANGE_MIN_M, range_max_m=chosen.range_max_m, scan_period_s=0.1)
        self._parser = protocol.Parser()
        self._assembler = protocol.ScanAssembler(chosen.intensity_min)
        self._samples_at = 0.0
        self.problem: Reason | Literal[""] = ""

    @property
    def corrupted(self) -> int:
        """Number of damaged packets."""
        return self._parser.corrupted

    def begin(self, now: float) -> bytes:
        """Begin (again), after the port was opened; there is nothing to send."""
        self._parser.reset()
        self._assembler.reset()
        self._samples_at, self.problem = now, ""
        return b""

    def receive(self, data: bytes, now: float) -> LidarEvents:
        """Parse bytes received from the port."""
        self._parser.receive_data(data)
        scans: list[LaserScan] = []
        while (packets := self._parser.next_event()) is not None:
            self._samples_at, self.problem = now, ""
            scans.extend(self._assembler.feed(packets, now))
        return LidarEvents(self._assembler.take_samples(), tuple(scans))

    def tick(self, now: float) -> bytes:
        """Advance time; a silent lidar is a problem, but no command can restart it."""
        if now - self._samples_at > SAMPLES_TIMEOUT_S:
            sentence = f"the lidar has sent no valid packet for {SAMPLES_TIMEOUT_S:.0f} s; check its cable and power"
            self.problem = Reason(Ld19Problem.NO_PACKETS, sentence)
        return b""


FACTORY: Final = LidarFactory(options=Ld19Options, make=Ld19Driver)
