"""Recorded logs of a robot with a planar lidar: scans with odometry, and reference poses where the log has them.

Formats: JSON lines (one object with `odom`, `ref` and `ranges` per scan after one with `meta`, gzipped or not), CARMEN
(`FLASER` messages; see the CARMEN toolkit's message formats), rosbag2 (`bags`), and logs of Fognav's own
robots. `mapping` makes maps of them.
"""

from __future__ import annotations

import gzip
import json
import math
import zlib
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import IO, TYPE_CHECKING, Final, cast, get_args

import msgspec
import numpy as np

from fog_runtime.record import RecordError, read_entries
from fognav.output import WrongUseError
from fognav_experiments.lidar_logs import Format, Selection
from fognav_experiments.lidar_logs.bags import is_bag, read_bag
from robot_agent.agent.recording.input_log import ENTRY_OF_TOPIC, BaseReceived, ScanReceived, Started
from robot_agent.agent.recording.log_scans import LogScans
from robot_agent.localization.pose import Pose2

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from robot_agent.agent.recording.log_scans import RobotScan

_CODE_SHARE: Final = 0.98
"""Readings above this share of the largest one are the device's code for "no return", ..."""
_CODE_READINGS: Final = 0.001
"""... if they are at least this share of all readings."""
_SAME_M: Final = 1e-3
_LEAP_PERIODS: Final = 60.0
_LEAP_M: Final = 1.0
_LEAP_M_S: Final = 5.0
"""Odometry that goes on by more at once, and faster, has leapt: no robot in a building does."""
_LEAPS: Final = 10
_LEAPS_SHARE: Final = 0.02
_FIELD_OF_VIEW: Final = math.pi
_GZIP: Final = b"\x1f\x8b"


@dataclass(frozen=True, slots=True, eq=False)
class LogScan:
    """One scan of a log: stamp (s, increasing), `odom` and `reference` poses (m, rad), ranges (n; m, nan: no return).

    angles: (n,) rad in the lidar's frame. The reference is None where the log has none. stretch: how many breaks of the
    odometry lie before it.
    """

    stamp: float
    odom: Pose2
    reference: Pose2 | None
    angles: NDArray[np.float64]
    ranges: NDArray[np.float64]
    stretch: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class LidarLog:
    """The scans of a log in order of time.

    odometry_measured: False if the log's odometry is its reference, so that it has no error of its own. stamps_mended:
    how many stamps went back, repeated or leapt, and were replaced.
    """

    scans: tuple[LogScan, ...]
    odometry_measured: bool
    stamps_mended: int = 0

    def select(self, selection: Selection) -> tuple[LogScan, ...]:
        """Return all scans, or those with odd or even numbers, counted from 0."""
        first, step = {"all": (0, 1), "odd": (1, 2), "even": (0, 2)}[selection]
        return self.scans[first::step]


def read_log(path: Path, log_format: Format = "auto") -> LidarLog:
    """Read a log; raises `WrongUseError` with file, line and remedy when it can't be used."""
    if log_format not in get_args(Format):
        raise WrongUseError(f"the format must be one of {', '.join(get_args(Format))}, not {log_format!r}")
    if not path.exists():
        raise WrongUseError(f"there is no file {path}. Name a log, or the folder of a recording of ROS 2")
    if log_format == "fognav" or (log_format == "auto" and is_robot_log(path)):
        scans = [
            LogScan(scan.stamp, scan.odom, None, scan.angles, scan.ranges, scan.stretch)
            for scan in read_robot_log(path)
        ]
        if not scans:
            raise WrongUseError(f"{path} has no scan of a lidar whose wheels were read. Log an agent that drives")
        return _finished(scans, coded=False, leaps=False)  # of a monotonic clock
    if log_format == "rosbag2" or (log_format == "auto" and is_bag(path)):
        return _finished([LogScan(*scan) for scan in read_bag(path)], coded=False)  # they say which returns count
    first = next(_lines(path), (0, ""))[1]
    found = log_format if log_format != "auto" else ("jsonl" if first.lstrip().startswith("{") else "carmen")
    reader = _carmen_scan if found == "carmen" else _JsonScans()
    scans = list(_scans(path, reader))
    if not scans:
        raise WrongUseError(f"{path} has no scan in the format {found}. Name another file or --format")
    return _finished(scans)


def _opened(path: Path) -> IO[bytes]:
    with path.open("rb") as file:
        packed = file.read(2) == _GZIP
    return cast("IO[bytes]", gzip.open(path, "rb") if packed else path.open("rb"))


def _scans(path: Path, reader: Callable[[str], LogScan | None]) -> Iterator[LogScan]:
    for number, line in _lines(path):
        try:
            scan = reader(line)
        except (ValueError, KeyError, IndexError, TypeError, OverflowError) as error:
            message = f"{path}, line {number}: {type(error).__name__}: {error}. Correct or remove the line"
            raise WrongUseError(message) from error
        if scan is not None:
            yield scan


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the lines with their numbers, from 1; raises `WrongUseError` where the file is damaged or cut off."""
    number = 1
    try:
        with _opened(path) as file:
            # Decoded one by one: a text file would fail up to 8 KiB before the damaged line.
            for line in file:
                yield number, line.decode()
                number += 1
    except (OSError, UnicodeDecodeError, EOFError, zlib.error) as error:
        message = f"{path}, line {number}: can't be read as a log: {error}. Name a whole .jsonl.gz or CARMEN file"
        raise WrongUseError(message) from error


def _pose(values: Sequence[float] | Sequence[str]) -> Pose2:
    x, y, theta = (float(value) for value in values)
    if not all(map(math.isfinite, (x, y, theta))):
        raise ValueError(f"a pose must be finite, not {list(values)}")
    return Pose2(x, y, theta)


@lru_cache(maxsize=8)
def beam_angles(count: int, field_of_view: float = _FIELD_OF_VIEW) -> NDArray[np.float64]:
    """Return the angles (rad) of `count` beams over a field of view, symmetric if odd, else without the last one.

    The array is shared by all scans, so that a long log fits into memory: it must not be written to.
    """
    if count < 2:
        raise ValueError(f"a scan must have two beams or more, not {count}")
    step = field_of_view / (count - 1 if count % 2 else count)
    return np.arange(count, dtype=np.float64) * step - field_of_view / 2.0


class _JsonScans:
    """Reads JSON lines; the first one may carry the field of view and the code for "no return"."""

    def __init__(self) -> None:
        self._field_of_view = _FIELD_OF_VIEW

    def __call__(self, line: str) -> LogScan | None:
        if not line.strip():
            return None
        values = json.loads(line)
        if not isinstance(values, dict):
            raise ValueError("a line must be a JSON object")  # noqa: TRY004  # of a file's text, not of an argument
        if "ranges" not in values:
            self._field_of_view = math.radians(float(values.get("fov_deg", math.degrees(self._field_of_view))))
            return None
        ranges = np.array([math.nan if value is None else float(value) for value in values["ranges"]])
        reference = _pose(values["ref"]) if values.get("ref") is not None else None
        angles = beam_angles(len(ranges), self._field_of_view)
        return LogScan(float(values["t"]), _pose(values["odom"]), reference, angles, ranges)


def _carmen_scan(line: str) -> LogScan | None:
    words = line.split()
    if not words or words[0] != "FLASER":
        return None
    count = int(words[1])
    if count < 1 or len(words) < count + 9:
        raise ValueError(f"FLASER with {count} ranges must have {count + 9} fields or more, not {len(words)}")
    ranges = np.array([float(word) for word in words[2 : count + 2]])
    laser, odom = _pose(words[count + 2 : count + 5]), _pose(words[count + 5 : count + 8])
    return LogScan(float(words[count + 8]), odom, laser, beam_angles(count), ranges)


def _finished(scans: list[LogScan], *, coded: bool = True, leaps: bool = True) -> LidarLog:
    """Remove codes for "no return", if ranges are coded, make the stamps increase, and tell odometry from reference.

    The list is emptied as it goes: a long log need not fit into memory twice. leaps: whether stamps that leap far ahead
    are wrong, rather than a pause of the log. Those after a leap leap along.
    """
    code = _no_return_code(scans) if coded else math.inf
    offset = before_leap = -scans[0].stamp
    last = -math.inf
    finished: list[LogScan] = []
    stamps = [scan.stamp for scan in scans]
    steady, mended = _median_period(scans), 0
    most = _LEAP_PERIODS * steady if leaps else math.inf
    scans.reverse()
    while scans:
        scan = scans.pop()
        stamp = scan.stamp + offset
        if finished and not last < stamp < last + most and last < scan.stamp + before_leap < last + most:
            offset = before_leap  # a single stamp leapt
            stamp = scan.stamp + offset
        if finished and not last < stamp < last + most:
            if stamp > last:
                before_leap, offset = offset, offset + last + steady - stamp
            stamp, mended = last + steady, mended + 1  # constant, coarse, wrapped or leaping stamps
        last = stamp
        ranges = np.where((scan.ranges > 0.0) & (scan.ranges < code), scan.ranges, math.nan)
        finished.append(replace(scan, stamp=stamp, ranges=ranges))
    moved = [scan for scan in finished if scan.reference is not None and _offset(scan) != _offset(finished[0])]
    if finished[0].reference is not None and not any(_differs(finished[0], scan) for scan in moved):
        return LidarLog(tuple(finished), odometry_measured=False, stamps_mended=mended)
    return LidarLog(tuple(_without_leaps(stamps, finished)), odometry_measured=True, stamps_mended=mended)


def _without_leaps(stamps: list[float], finished: list[LogScan]) -> Iterator[LogScan]:
    """Yield scans whose odometry goes on where it has leapt: a break of it, over which the robot hardly moved.

    By the stamps (s) of the log itself: mended ones do not tell how long a pause was. Raises `WrongUseError` where it
    leaps all the time.
    """
    shift: Pose2 | None = None
    breaks = 0
    before, told, odom = stamps[0], finished[0].odom, finished[0].odom
    for stamp, scan in zip(stamps, finished, strict=True):
        far, passed = math.hypot(*scan.odom.relative_to(told)[:2]), stamp - before
        if far > _LEAP_M and 0.0 < passed < far / _LEAP_M_S:
            shift, breaks = odom.compose(Pose2(0.0, 0.0, 0.0).relative_to(scan.odom)), breaks + 1
            if breaks > max(_LEAPS, _LEAPS_SHARE * len(stamps)):
                raise WrongUseError(
                    f"the odometry goes faster than {_LEAP_M_S:g} m/s again and again, as by {far:.1f} m in "
                    f"{passed:.2f} s: is it in metres, and are the stamps in seconds?"
                )
        odom = scan.odom if shift is None else shift.compose(scan.odom)
        before, told = stamp, scan.odom
        yield scan if shift is None else replace(scan, odom=odom, stretch=scan.stretch + breaks)


def _offset(scan: LogScan) -> Pose2:
    assert scan.reference is not None
    return scan.reference.relative_to(scan.odom)


def _differs(first: LogScan, scan: LogScan) -> bool:
    """Whether the reference lies elsewhere, as seen from the odometry, than in the first scan."""
    return max(map(abs, _offset(scan).relative_to(_offset(first)))) > _SAME_M


def _no_return_code(scans: list[LogScan]) -> float:
    largest, finite = -math.inf, 0
    for scan in scans:
        seen = scan.ranges[np.isfinite(scan.ranges)]
        largest, finite = max(largest, float(seen.max(initial=-math.inf))), finite + len(seen)
    if not finite:
        return math.inf
    limit = _CODE_SHARE * largest
    coded = sum(int((np.isfinite(scan.ranges) & (scan.ranges > limit)).sum()) for scan in scans)
    return limit if coded / finite > _CODE_READINGS else math.inf


def _median_period(scans: list[LogScan]) -> float:
    periods = np.diff([scan.stamp for scan in scans])
    periods = periods[(periods > 0.0) & (periods < 60.0)]
    return float(np.median(periods)) if len(periods) else 1.0


# --- logs of Fognav's own robots: what `fognav map record` or an agent with `FOGNAV_INPUT_LOG` wrote ------------------


def is_robot_log(path: Path) -> bool:
    """Whether a file may be a log of Fognav: a recording without the description that ROS 2 puts beside its own."""
    return path.suffix == ".mcap" and path.is_file() and not (path.parent / "metadata.yaml").exists()


def read_robot_log(path: Path) -> Iterator[RobotScan]:
    """Yield the scans of an agent's log; raises `WrongUseError` where it is none or damaged."""
    scans = LogScans()
    try:
        for _, topic, data in read_entries(path):
            kind = ENTRY_OF_TOPIC.get(topic)
            if kind in {Started, BaseReceived, ScanReceived}:
                scan = scans.take(msgspec.json.decode(data, type=kind))
                if scan is not None:
                    yield scan
    except (RecordError, msgspec.DecodeError) as error:
        raise WrongUseError(f"{error}. Name the file that `fognav map record` wrote") from error
