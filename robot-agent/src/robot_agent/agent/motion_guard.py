"""The last word on every wheel command: the stop field over what the lidar has just seen."""

from __future__ import annotations

from typing import TYPE_CHECKING

from robot_agent.agent.near_points import NearPoints
from robot_agent.safety.stop_field import StopField

if TYPE_CHECKING:
    from robot_agent.config import AgentConfig
    from robot_agent.hardware import LidarSamples
    from robot_agent.localization.localizer import Localizer
    from robot_agent.safety.stop_field import Wheels


class MotionGuard:
    """Limits the wheel speeds of whoever commands, mission or operator, by what the lidar sees."""

    def __init__(self, config: AgentConfig, localizer: Localizer) -> None:
        self._localizer = localizer
        self._field = StopField(config.footprint, config.drive_train, config.stop_field)
        lidar = config.localization
        # A point may come nearer while it is remembered, and the lidar need not be in the middle.
        reach = self._field.reach + abs(lidar.lidar_x) + abs(lidar.lidar_y)
        reach += config.stop_field.memory * config.drive_train.wheel_speed_max_m_s
        self._points = NearPoints(lidar, reach, config.stop_field.memory)
        self.reason: str | None = None
        """Why the last command is zero although another one was requested; else None."""

    def on_samples(self, samples: LidarSamples) -> None:
        """Handle the lidar's newest samples."""
        self._points.add(samples)

    def limit(self, wheels: Wheels, now: float) -> Wheels:
        """Return the wheel speeds (m/s) that may be commanded at `now` (s, monotonic) instead of these."""
        points = self._points.seen_from(self._localizer, now)
        limited = self._field.limit(wheels, points)
        self.reason = limited.reason
        return limited.wheels
