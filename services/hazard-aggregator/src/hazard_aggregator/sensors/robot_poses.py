"""The latest pose of each robot, as long as it is fresh: it may explain echoes. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fog_contracts.channels import ROBOT_POSE

if TYPE_CHECKING:
    from collections.abc import Iterator

    from fog_contracts.messages import RobotPose


class RobotPoses:
    """Poses with the times (s, monotonic) at which they arrived."""

    def __init__(self) -> None:
        self._poses: dict[str, tuple[float, RobotPose]] = {}

    def add(self, robot: str, pose: RobotPose, now: float) -> None:
        """Record a robot's pose."""
        self._poses[robot] = (now, pose)

    def fresh(self, now: float) -> Iterator[tuple[str, RobotPose]]:
        """Yield the fresh poses of localized robots."""
        for robot, (received, pose) in self._poses.items():
            if now - received <= ROBOT_POSE.max_age_s and pose.localized:
                yield robot, pose

    def forget_old(self, now: float) -> None:
        """Discard poses that are not fresh any more."""
        self._poses = {robot: entry for robot, entry in self._poses.items() if now - entry[0] <= ROBOT_POSE.max_age_s}
