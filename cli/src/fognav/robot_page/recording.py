"""Records what a robot measures while somebody drives it, and lets a map grow beside it."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_mapping.live import LiveMap
from fog_mapping.scans import scan_of
from fog_runtime.record import Recorder
from fognav.output import FailedError
from fognav.robot_page.view import RobotView
from robot_agent.agent.local_link import Missed
from robot_agent.agent.recording.input_log import TOPIC_OF_ENTRY, BaseReceived, EntriesLost, ScanReceived, Started
from robot_agent.agent.recording.log_scans import LogScans
from robot_agent.local_client import LocalRobot, LocalRobotError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from robot_agent.agent.recording.log_scans import RobotScan

_SECURED_S: Final = 5.0
_RETRY_S: Final = 0.5
_TOLD_S: Final = 10.0
_BLURS_RAD_S: Final = 0.6
_RANGE_M: Final = 12.0
_PERIOD_S: Final = 0.2
_RECORDED: Final = (Started, BaseReceived, ScanReceived)
"""What a map is made of; of the rest a page lives."""


class Recording:
    """One file that grows; `advice` says what is wrong now."""

    def __init__(self, file: Path, *, preview: bool = True) -> None:
        """Create the file, which may not exist yet; raises `FailedError`."""
        self.file = file
        self.view = RobotView()
        self.scans = 0
        self.gaps = 0
        """How often the link broke."""
        self.breaks = 0
        """How often the wheels were not heard while they turned, or their counters jumped."""
        self.map = LiveMap() if preview else None
        self._scans = LogScans()
        self._last: RobotScan | None = None
        self._silent_s = 0.0
        self._blurred_until = self._broken_until = 0.0
        self._problem = ""
        try:
            self._recorder = Recorder(file)
        except OSError as error:
            raise FailedError(f"{file} can't be made: {error.strerror}. Name another file") from error
        self._secured_at = time.monotonic()

    @property
    def megabytes(self) -> float:
        """Size of the file."""
        return self.file.stat().st_size / 1e6

    @property
    def advice(self) -> str:
        """What who drives should know now; empty while all is well."""
        if self._problem:
            return self._problem
        if time.monotonic() < self._broken_until:
            return (
                f"the recording has a break: the wheels were not heard for {self._silent_s:.0f} s, or their counters "
                "jumped. Drive back to before it, or the map is a guess there"
            )
        if time.monotonic() < self._blurred_until:
            return "turn more slowly: half a turn in six seconds, or walls blur"
        return ""

    def run(self, socket: Path, on_news: Callable[[], object], ends: Callable[[], bool]) -> None:
        """Record until `ends`; a link that breaks is made again. Raises `FailedError` when the file can't be written.

        `on_news` is called several times a second. Whatever ends it, the file is closed and complete.
        """
        try:
            while not ends():
                try:
                    with LocalRobot(socket) as robot:
                        self._problem = ""
                        self._follow(robot, on_news, ends)
                except LocalRobotError as error:
                    if self._problem == "" and self.scans:
                        self.gaps += 1
                    self._problem = str(error)
                    on_news()
                    time.sleep(_RETRY_S)
        finally:
            self._close()

    def _follow(self, robot: LocalRobot, on_news: Callable[[], object], ends: Callable[[], bool]) -> None:
        told = 0.0
        while not ends():
            for entry in self._entries(robot):
                self._take(entry)
            if time.monotonic() - told >= _PERIOD_S:
                told = time.monotonic()
                on_news()

    def _entries(self, robot: LocalRobot) -> Iterator[object]:
        for entry in robot.entries(_PERIOD_S):
            yield entry
            if isinstance(entry, ScanReceived):
                return

    def _take(self, entry: object) -> None:
        self.view.take(entry)
        if isinstance(entry, Missed):
            entry = EntriesLost(count=entry.count)
        elif not isinstance(entry, _RECORDED):
            return
        try:
            self._recorder.write_entry(TOPIC_OF_ENTRY[type(entry)], entry, time.time_ns())
            if time.monotonic() - self._secured_at > _SECURED_S:
                self._secured_at = time.monotonic()
                self._recorder.secure()
        except OSError as error:
            raise FailedError(
                f"{self.file}: {error.strerror}. What was recorded until now can be read: make room, and record the "
                "rest into another file"
            ) from error
        scan = self._scans.take(entry)
        if scan is not None:
            self._on_scan(scan)

    def _on_scan(self, scan: RobotScan) -> None:
        self.scans += 1
        if scan.stretch > self.breaks and self._last is not None:
            self._silent_s, self._broken_until = scan.stamp - self._last.stamp, time.monotonic() + _TOLD_S
        self.breaks = scan.stretch
        if self._last is not None and scan.stamp > self._last.stamp:
            turned = abs(np.angle(np.exp(1j * (scan.odom.theta - self._last.odom.theta))))
            if turned / (scan.stamp - self._last.stamp) > _BLURS_RAD_S:
                self._blurred_until = time.monotonic() + 2.0
        self._last = scan
        if self.map is not None:
            usable = scan_of(self.scans, scan.angles, scan.ranges, scan.odom, _RANGE_M, scan.stretch)
            if usable is not None:
                self.map.add(usable)

    def _close(self) -> None:
        try:
            self._recorder.close()
        except OSError as error:  # no room for the index: what is there can be read
            self._problem = f"{self.file}: {error.strerror}"
