"""The newest of what the agent tells on its socket, as a page or a terminal shows it."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

import numpy as np

from fognav.output import FailedError
from robot_agent.agent.local_link import Missed
from robot_agent.agent.recording.input_log import BaseReceived, Published, ScanReceived, Started
from robot_agent.local_client import LocalRobotError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.config import AgentConfig


class RobotView:
    """The robot as far as it has told."""

    def __init__(self) -> None:
        self.config: AgentConfig | None = None
        self.state: dict[str, Any] = {}
        self.base: BaseReceived | None = None
        self.scan: ScanReceived | None = None
        self.missed = 0

    def take(self, entry: Any) -> bool:  # noqa: ANN401  # an entry, or `Missed`
        """Take an entry in; return whether it is a new scan or state."""
        match entry:
            case Started():
                self.config = entry.config
            case BaseReceived():
                self.base = entry
            case ScanReceived():
                self.scan = entry
            case Published():
                self.state = entry.message
            case Missed():
                self.missed += entry.count
        return isinstance(entry, (ScanReceived, Published))

    def points(self) -> NDArray[np.float64]:
        """Return the newest scan's returns (n, 2; m) in the robot's frame: x ahead, y to the left."""
        if self.scan is None or self.config is None:
            return np.zeros((0, 2))
        scan, lidar = self.scan.scan(), self.config.localization
        seen = (scan.ranges_m >= lidar.range_min) & (scan.ranges_m <= lidar.range_max)
        angles = scan.angles_rad[seen] + lidar.lidar_yaw
        x = lidar.lidar_x + scan.ranges_m[seen] * np.cos(angles)
        return np.stack([x, lidar.lidar_y + scan.ranges_m[seen] * np.sin(angles)], axis=1)

    def as_json(self) -> dict[str, Any]:
        """Return what a page draws."""
        status = self.base.feedback.status if self.base else None
        return {
            "mode": self.state.get("mode", ""),
            "reasons": self.state.get("reasons", []),
            "codes": self.state.get("codes", []),
            "battery": status.battery if status else None,
            "bumper": status.bumper if status else False,
            "cliff": status.cliff if status else False,
            "wheel_drop": status.wheel_drop if status else False,
            "points": np.round(self.points(), 3).tolist(),
            "footprint": [list(corner) for corner in self.config.footprint.vertices] if self.config else [],
            "missed": self.missed,
        }


class LocalRobotErrors(contextlib.AbstractContextManager[None]):
    """Turns the errors of a link to the agent into those of a command."""

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        """Raise `FailedError` for a `LocalRobotError`."""
        if isinstance(error, LocalRobotError):
            raise FailedError(str(error)) from error
