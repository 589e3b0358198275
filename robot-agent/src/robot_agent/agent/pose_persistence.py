"""How the robot gets its pose after a start, and which poses it stores for the next start."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import msgspec

from robot_agent.localization.odometry import integrate, wheel_travel
from robot_agent.localization.pose import SavedPose

if TYPE_CHECKING:
    from fog_contracts.messages import Mode
    from fog_contracts.site import RobotSite
    from robot_agent.guardian.link import BaseFeedback
    from robot_agent.hardware import DriveTrain
    from robot_agent.localization.localizer import Localizer
    from robot_agent.localization.map_fields import MapFields

SEARCH_AGAIN_S: Final = 15.0
"""Least time between the beginnings of two global searches."""
_MOVED_M: Final = 0.02
_TURNED_RAD: Final = 0.03
_MOVED_DRIVING_M: Final = 0.5
_TURNED_DRIVING_RAD: Final = 0.4
"""Of a robot that moves only a pose this far from the stored one is stored: a restart finds it from there."""
_SIGMA_CHANGED: Final = 0.05
_FOLLOWED_M: Final = 1.5
"""The wheels of a robot whose agent died have turned so far at most since its pose was stored: it is told to stand."""
_START_SIGMA_M: Final = 0.25
_START_SIGMA_RAD: Final = 0.15
"""Standard deviations of a robot that was put on its start pose by hand."""


class PosePersistence:
    """Starts the localizer from a stored pose or by a global search, and selects the poses to store."""

    def __init__(self, localizer: Localizer, drive_train: DriveTrain) -> None:
        self._localizer = localizer
        self._drive_train = drive_train
        self._pending: SavedPose | None = None
        """A stored pose to start at as soon as the map of its site is loaded."""
        self._searched_at = -math.inf
        self._stored: SavedPose | None = None
        self._restored: SavedPose | None = None
        """The stored pose that was started at, until the base's first feedback."""
        self._feedback: BaseFeedback | None = None
        """The newest of the base."""

    def on_base(self, feedback: BaseFeedback) -> None:
        """Handle feedback of the base: the first tells whether a guardian has watched the robot since it was stored."""
        self._feedback = feedback
        restored, self._restored = self._restored, None
        if restored is not None and (followed := _followed(restored, feedback, self._drive_train)) is not None:
            self._localizer.follow_saved(followed)

    def restore(self, saved: SavedPose, site: str) -> None:
        """Start at a stored pose, at once if the map of its site is loaded already; the next scans verify it."""
        if site == saved.site:
            self._start(saved)
        else:
            self._pending = saved

    def load_map(self, site: str, fields: MapFields) -> None:
        """Load the static map of a site into the localizer."""
        self._localizer.load_map(fields)
        pending, self._pending = self._pending, None
        if pending is not None and pending.site == site:
            self._start(pending)

    def _start(self, saved: SavedPose) -> None:
        self._localizer.restore(saved)
        self._restored = saved
        if self._feedback is not None:
            self.on_base(self._feedback)

    def search(self, mode: Mode, now: float, *, at_rest: bool) -> bool:
        """Begin a global search when there is no pose; return whether one began.

        Only a robot searches that stays where it is: at rest, and not enabled. One with a fault knows its place by the
        time it is reset.
        """
        localizer = self._localizer
        if localizer.status != "none" or localizer.searching or localizer.pose(now) is not None:
            return False
        if mode not in ("INIT", "FAULT") or not at_rest or now - self._searched_at <= SEARCH_AGAIN_S:
            return False
        if not localizer.global_localization():
            return False
        self._searched_at = now
        return True

    def to_store(self, site: str, now: float) -> SavedPose | None:
        """Return the pose if it is trusted and differs from the one returned last, which counts as stored.

        Storage of a small computer wears out, so a pose that hardly differs is not written, unless another guardian
        watches the robot now.
        """
        pose = self._localizer.save(site, now) if site else None
        if pose is None:
            return None
        if (feedback := self._feedback) is not None:
            base = feedback.seq, feedback.odometry.left_m, feedback.odometry.right_m
            pose = msgspec.structs.replace(pose, base=base, guardian=feedback.guardian)
        moves = self._localizer.twist() != (0.0, 0.0)
        if self._stored is not None and not _differs(pose, self._stored, moves=moves):
            return None
        self._stored = pose
        return pose


def start_pose(site: str, robot: RobotSite) -> SavedPose:
    """Return the site's start pose, to be restored when no pose was stored."""
    start = robot.start
    return SavedPose(
        site=site, x=start.x, y=start.y, theta=start.theta, sigma_xy=_START_SIGMA_M, sigma_theta=_START_SIGMA_RAD
    )


def _followed(saved: SavedPose, feedback: BaseFeedback, drive: DriveTrain) -> SavedPose | None:
    """Return where the wheels have taken the robot since its pose was stored, as if along one arc.

    While it turns in place, what was stored a second ago may look the other way. None unless its guardian still lives,
    has seen no wheel drop, and the wheels have hardly turned.
    """
    if saved.base is None or feedback.fault is not None or not saved.guardian or saved.guardian != feedback.guardian:
        return None
    seq, *stored = saved.base
    now = feedback.odometry.left_m, feedback.odometry.right_m
    rolled = [wheel_travel(new, old, drive.travel_wrap_m) for new, old in zip(now, stored, strict=True)]
    if feedback.seq <= seq or max(map(abs, rolled)) >= _FOLLOWED_M:
        return None
    left, right = (share * way for share, way in zip(drive.shares, rolled, strict=True))
    x, y, theta = integrate(saved.x, saved.y, saved.theta, left, right, drive.axle_m)
    return msgspec.structs.replace(saved, x=x, y=y, theta=theta)


def _differs(new: SavedPose, old: SavedPose, *, moves: bool) -> bool:
    return (
        math.hypot(new.x - old.x, new.y - old.y) > (_MOVED_DRIVING_M if moves else _MOVED_M)
        or abs(math.remainder(new.theta - old.theta, math.tau)) > (_TURNED_DRIVING_RAD if moves else _TURNED_RAD)
        or abs(new.sigma_xy - old.sigma_xy) > _SIGMA_CHANGED
        or abs(new.sigma_theta - old.sigma_theta) > _SIGMA_CHANGED
        or new.guardian != old.guardian
    )
