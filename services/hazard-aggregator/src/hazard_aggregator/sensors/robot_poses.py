"""Where the robots were at the time of an echo, by the poses that they reported: they may explain it. Pure.

Poses arrive late over Wi-Fi, and an echo does not: a pose counts from when it was estimated, by the robot's own clock,
and a robot may have moved since. Its body is that of the site, whatever it says of itself.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple

from msgspec import structs

from fog_contracts.costs import ROBOT_RADIUS
from fog_contracts.liveness import DelayEstimator
from fog_contracts.messages import Pose
from fog_contracts.site import RobotSite

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from fog_contracts.messages import RobotPose

USABLE_S: Final = 3.0
"""A pose says where its robot is for so long; one that does not hear the fog for so long stands (its safety gate)."""
HISTORY_S: Final = 10.0
"""So long poses are remembered: they may explain echoes that were there before them."""
SPEED_M_S: Final = 0.3
MAX_SPEED_M_S: Final = 0.5
"""A robot may have begun to drive at the first speed since its pose; none drives faster than the second."""
_POSES: Final = 200
_ANY_ROBOT: Final = RobotSite(id="any", start=Pose(x=0.0, y=0.0, theta=0.0), radius=ROBOT_RADIUS)


class Whereabouts(NamedTuple):
    """Where a robot was at some time: no further than `away` (m) from the position of `pose`."""

    robot: str
    pose: RobotPose
    away: float


class _Track:
    """The poses of one robot, each with the time (s, the receiver's clock) that it is of."""

    def __init__(self) -> None:
        self.poses: deque[tuple[float, RobotPose]] = deque(maxlen=_POSES)
        self._delay = DelayEstimator()
        self._clock = -math.inf

    def add(self, pose: RobotPose, now: float) -> None:
        if pose.clock < self._clock:
            self._delay = DelayEstimator()  # its computer was started again
        self._clock = pose.clock
        # One that does not tell its clock counts as timely.
        taken_at = now - self._delay.update(pose.clock, now) if pose.clock > 0.0 else now
        if not self.poses or taken_at >= self.poses[-1][0]:
            self.poses.append((taken_at, pose))


class RobotPoses:
    """The latest poses of all robots; `robots` are those of the site, any other has a body as they have by default."""

    def __init__(self, robots: Iterable[RobotSite] = ()) -> None:
        self._robots = {robot.id: robot for robot in robots}
        self._tracks: dict[str, _Track] = {}

    def add(self, robot: str, pose: RobotPose, now: float) -> None:
        """Record a robot's pose that arrives `now`."""
        body = self._robots.get(robot, _ANY_ROBOT)
        self._tracks.setdefault(robot, _Track()).add(structs.replace(pose, radius=body.radius, height=body.height), now)

    def at(self, taken_at: float, *, settled: bool = False) -> Iterator[Whereabouts]:
        """Yield where the robots were at a time, of those that were localized; if `settled`, of those with later poses.

        A robot's first pose does not tell where it was before.
        """
        for robot, track in self._tracks.items():
            before = next((entry for entry in reversed(track.poses) if entry[0] <= taken_at), None)
            after = next((entry for entry in track.poses if entry[0] > taken_at), None)
            if before is None or (settled and after is None):
                continue
            if min(abs(entry[0] - taken_at) for entry in (before, after) if entry is not None) > USABLE_S:
                continue
            known = _ahead(robot, before, taken_at) if after is None else _between(robot, before, after, taken_at)
            if known.pose.localized:
                yield known

    def forget_old(self, now: float) -> None:
        """Discard poses that explain nothing any more."""
        for track in self._tracks.values():
            while track.poses and now - track.poses[0][0] > HISTORY_S:
                track.poses.popleft()
        self._tracks = {robot: track for robot, track in self._tracks.items() if track.poses}


def _between(
    robot: str, before: tuple[float, RobotPose], after: tuple[float, RobotPose], taken_at: float
) -> Whereabouts:
    """Return where a robot was between two of its poses."""
    (began, first), (ended, second) = before, after
    share = (taken_at - began) / (ended - began)
    x, y = (1.0 - share) * first.x + share * second.x, (1.0 - share) * first.y + share * second.y
    nearest = first if share < 0.5 else second  # half-way
    away = min(share, 1.0 - share) * (ended - began) * SPEED_M_S
    return Whereabouts(robot, structs.replace(nearest, x=x, y=y), away)


def _ahead(robot: str, before: tuple[float, RobotPose], taken_at: float) -> Whereabouts:
    """Return where a robot is after its latest pose: half-way between where it was and where it drives to."""
    pose, seconds = before[1], taken_at - before[0]
    v = min(max(pose.v, -MAX_SPEED_M_S), MAX_SPEED_M_S)
    x, y = pose.x + 0.5 * v * seconds * math.cos(pose.theta), pose.y + 0.5 * v * seconds * math.sin(pose.theta)
    return Whereabouts(robot, structs.replace(pose, x=x, y=y), 0.5 * max(abs(v), SPEED_M_S) * seconds)
