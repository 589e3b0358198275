"""The last word on every wheel command: the stop field over what the lidar has just seen, and what it did not see."""

from __future__ import annotations

from typing import TYPE_CHECKING

from robot_agent.agent.sensing.lidar_view import LidarView
from robot_agent.agent.sensing.near_points import NearPoints
from robot_agent.safety.stop_field import StopField

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from fog_contracts.replica import Replica
    from robot_agent.config import AgentConfig
    from robot_agent.hardware import LaserScan, LidarSamples
    from robot_agent.localization.localizer import Localizer
    from robot_agent.safety.stop_field import Wheels


class MotionGuard:
    """Limits the wheel speeds of whoever commands, mission or operator, by what the lidar sees."""

    def __init__(self, config: AgentConfig, localizer: Localizer) -> None:
        self._localizer = localizer
        self._drive = config.drive_train
        self._view = LidarView(config.localization, config.visibility)
        self._field = StopField(config.footprint, config.drive_train, config.stop_field)
        lidar = config.localization
        # A point may come nearer while it is remembered, and the lidar need not be in the middle.
        reach = self._field.reach + abs(lidar.lidar_x) + abs(lidar.lidar_y)
        reach += config.stop_field.memory * config.drive_train.wheel_speed_max_m_s
        self._points = NearPoints(lidar, reach, config.stop_field.memory, config.footprint)
        self.reason: str | None = None
        """Why the last command is zero although another one was requested; else None."""
        self.unseeing = False
        """Whether that is because the lidar does not see enough, and not because it sees an obstacle."""

    def on_samples(self, samples: LidarSamples) -> None:
        """Handle the lidar's newest samples."""
        self._points.add(samples)

    def on_scan(self, scan: LaserScan, replica: Replica) -> None:
        """Handle a whole scan, after the localizer has."""
        self._view.on_scan(scan, self._localizer.scan_pose(), replica)

    def limit(self, wheels: Wheels, now: float) -> Wheels:
        """Return the wheel speeds (m/s) that may be commanded at `now` (s, monotonic) instead of these."""
        if wheels == (0.0, 0.0):
            # Nothing to limit; the points wait until they are needed.
            self.reason, self.unseeing = None, False
            return wheels
        points = self._points.seen_from(self._localizer, now)
        seen = self._field.limit(wheels, points)
        unseen = self._view.visibility.limit(seen.wheels, self._drive.twist(*seen.wheels))
        self.reason = seen.reason or unseen.reason
        self.unseeing = seen.reason is None and unseen.reason is not None
        if unseen.wheels == seen.wheels:
            return seen.wheels
        # Of an arc, sight may leave only the turn, and a body that is not round needs room for it.
        left = self._field.limit(unseen.wheels, points)
        self.reason = self.reason or left.reason
        return left.wheels

    def blindness(self, wheels: Wheels) -> str | None:
        """Return why the robot would not move at these wheel speeds (m/s), as it sees too little there; else None."""
        return self._view.visibility.limit(wheels, self._drive.twist(*wheels)).reason

    def hazard(
        self, wheels: Wheels, keep: Callable[[NDArray[np.float64]], NDArray[np.float64]], now: float
    ) -> str | None:
        """Return why a robot that nobody slows down must not go on at these wheel speeds (m/s); None when it may.

        keep: returns those of the points (n, 2; m) in `base` that count.
        """
        points = keep(self._points.seen_from(self._localizer, now))
        if self._field.limit(wheels, points).zone != "free":
            return "the lidar sees an obstacle near the robot's way"
        if self._view.visibility.limit(wheels, self._drive.twist(*wheels)).zone == "free":
            return None
        return "the lidar does not see enough of the robot's way"
