"""Logs of Fognav's own robots: what `fognav map record` or an agent with `FOGNAV_INPUT_LOG` wrote."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from fog_runtime.record import RecordError, read_entries
from fognav.output import WrongUseError
from robot_agent.agent.recording.input_log import ENTRY_OF_TOPIC, BaseReceived, ScanReceived, Started
from robot_agent.agent.recording.log_scans import LogScans

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from robot_agent.agent.recording.log_scans import RobotScan


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
