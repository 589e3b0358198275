"""Messages of the sensor nodes (MQTT, JSON)."""

from typing import Annotated

from msgspec import Meta

from fog_contracts.messages.basics import AreaState, CalibrationResult, Count, Id, Message, SonarStatus


class NodeReading(Message, frozen=True, kw_only=True):
    """One measurement of a node: all its sonars once. A range that is missing is null, never 0."""

    seq: Count
    boot: Count
    uptime_ms: Count
    range_m: Annotated[list[Annotated[float, Meta(gt=0.0, le=20.0)] | None], Meta(min_length=1, max_length=8)]
    status: Annotated[list[SonarStatus], Meta(min_length=1, max_length=8)]
    state: AreaState
    rssi: Annotated[int, Meta(ge=-200, le=100)] | None = None
    fw: Annotated[str, Meta(max_length=64)] = ""

    def __post_init__(self) -> None:
        if len(self.range_m) != len(self.status):
            raise ValueError(f"range_m has {len(self.range_m)} entries but status has {len(self.status)}")


class NodeValue(Message, frozen=True, kw_only=True):
    """A measured quantity (temperature, gas, ...) that is a hazard above the aggregator's threshold."""

    seq: Count
    boot: Count
    kind: Id
    value: Annotated[float, Meta(ge=-1e9, le=1e9)]
    unit: Annotated[str, Meta(max_length=16)]


FarthestRanges = Annotated[list[Annotated[float, Meta(ge=0.0, le=20.0)]], Meta(max_length=8)]


class NodeConfig(Message, frozen=True, kw_only=True):
    """Settings of a node: per sonar the range below which an echo means `blocked`, and beyond which `unknown`.

    `range_max_m` of 0: any echo from beyond the limit is clear. The pause (ms) comes after the time that the last
    sonar's echoes need.
    """

    version: Count
    range_limit_m: Annotated[list[Annotated[float, Meta(gt=0.0, le=20.0)]], Meta(min_length=1, max_length=8)]
    range_max_m: FarthestRanges = []
    no_echo_is_clear: Annotated[list[bool], Meta(min_length=1, max_length=8)]
    pause_ms: Annotated[int, Meta(ge=10, le=60_000)] = 10


SampleCount = Annotated[int, Meta(ge=0, le=65_535)]


class NodeCalibration(Message, frozen=True, kw_only=True):
    """What a node has learned on command; told to `keep` it, the node goes by it until another configuration comes.

    Per sonar: how it ended, the settings with what it learned, and the pulse (us, 0: none) by which its board says "no
    echo".
    Of so many `samples` of free space after its limit was learned (0: none was), as the node's filter lets them
    through, so many were `false_echoes`, from nearer than that limit, and so many had no echo.
    """

    boot: Count
    config_version: Count
    result: Annotated[list[CalibrationResult], Meta(min_length=1, max_length=8)]
    range_limit_m: Annotated[list[Annotated[float, Meta(gt=0.0, le=20.0)]], Meta(min_length=1, max_length=8)]
    no_echo_is_clear: Annotated[list[bool], Meta(min_length=1, max_length=8)]
    range_max_m: FarthestRanges = []
    no_echo_us: Annotated[list[Annotated[int, Meta(ge=0, le=80_000)]], Meta(min_length=1, max_length=8)]
    samples: Annotated[list[SampleCount], Meta(max_length=8)] = []
    false_echoes: Annotated[list[SampleCount], Meta(max_length=8)] = []
    no_echoes: Annotated[list[SampleCount], Meta(max_length=8)] = []


class NodeUpdate(Message, frozen=True, kw_only=True):
    """A node's next firmware: where it is, and its maker's signature (ECDSA P-256) of number, board, size, SHA-256."""

    number: Annotated[int, Meta(ge=1, le=2**31 - 1)]
    board: Id
    size: Annotated[int, Meta(ge=1, le=4_194_304)]
    sha256: Annotated[str, Meta(min_length=64, max_length=64)]
    signature: Annotated[str, Meta(min_length=16, max_length=144)]
    url: Annotated[str, Meta(min_length=8, max_length=200)]
