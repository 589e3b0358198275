"""Which robots drive by a map that contains a change, and since when; which not yet. Pure.

A change is on the map from one version on (epoch and seq), and each robot's state names the version that it uses.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from fog_contracts.messages import Message

if TYPE_CHECKING:
    from collections.abc import Iterator

    from fog_contracts.handlers import Moment
    from fog_contracts.messages import RobotState
    from fog_contracts.replica import Version

ChangeKind = Literal["zone", "hazard"]

MAX_CHANGES: Final = 7_000
"""Changes that are remembered, the latest of each zone and area: those of all zones, and some of removed ones."""
FORGOTTEN_S: Final = 3600.0
"""A robot that was silent for so long is not waited for any more."""
_VERSIONS: Final = 512
"""Versions that are remembered of each robot: a change that is older than all of them has been applied at the first."""


class RobotApplied(Message, frozen=True, kw_only=True):
    """Whether a robot uses a map with the change, `since` when (s since the epoch), or since when that is awaited.

    `age_s` is the time since its last message: nobody knows what a silent robot uses now.
    """

    robot: str
    applied: bool
    since: float
    map_epoch: int
    map_seq: int
    age_s: float


class AppliedChange(Message, frozen=True, kw_only=True):
    """The latest change of a zone or of an area's hazard, and the map version that it is in from `at` on.

    `state`: active, inactive or removed for zones, else the hazard's.
    """

    kind: ChangeKind
    id: str
    state: str
    at: float
    epoch: int
    seq: int
    robots: list[RobotApplied]


class _Mark(NamedTuple):
    state: str
    at: float
    version: tuple[int, int]


class _Robot:
    def __init__(self) -> None:
        self.versions: deque[tuple[int, int]] = deque(maxlen=_VERSIONS)
        self.stamps: deque[float] = deque(maxlen=_VERSIONS)
        self.heard = 0.0


class Applied:
    """The latest changes, and the map versions that robots have reported."""

    def __init__(self) -> None:
        self._marks: dict[tuple[ChangeKind, str], _Mark] = {}
        self._robots: dict[str, _Robot] = {}

    def changed(self, kind: ChangeKind, name: str, state: str, version: Version, stamp: float) -> None:
        """Note that a change is completely on the map from this version on."""
        self._marks.pop((kind, name), None)
        self._marks[kind, name] = _Mark(state, stamp, (version.epoch, version.seq))
        if len(self._marks) > MAX_CHANGES:
            del self._marks[next(iter(self._marks))]

    def restart(self, version: Version) -> None:
        """Note that robots get the map anew, with another epoch: they have no change before they have it."""
        self._marks = {key: mark._replace(version=(version.epoch, version.seq)) for key, mark in self._marks.items()}

    def heard(self, robot: str, state: RobotState, at: Moment) -> None:
        """Note the version that a robot uses; forget robots that have been silent for long."""
        known = self._robots.get(robot)
        if known is None:
            self._robots = {n: r for n, r in self._robots.items() if at.now - r.heard <= FORGOTTEN_S}
            known = self._robots[robot] = _Robot()
        known.heard, version = at.now, (state.map_epoch, state.map_seq)
        if known.versions and version < known.versions[-1]:  # it has started again
            known.versions.clear()
            known.stamps.clear()
        if not known.versions or version != known.versions[-1]:
            known.versions.append(version)
            known.stamps.append(at.stamp)

    def changes(self, now: float, kind: ChangeKind | None = None, name: str | None = None) -> Iterator[AppliedChange]:
        """Yield the latest changes, newest first: all, of a kind, or of one record."""
        for (of, record), mark in reversed(self._marks.items()):
            if kind in (None, of) and name in (None, record):
                epoch, seq = mark.version
                robots = [_described(name_, robot, mark, now) for name_, robot in sorted(self._robots.items())]
                yield AppliedChange(
                    kind=of, id=record, state=mark.state, at=mark.at, epoch=epoch, seq=seq, robots=robots
                )


def _described(name: str, robot: _Robot, mark: _Mark, now: float) -> RobotApplied:
    first = bisect_left(robot.versions, mark.version)
    applied = first < len(robot.versions)
    epoch, seq = robot.versions[-1]
    return RobotApplied(
        robot=name,
        applied=applied,
        since=max(mark.at, robot.stamps[first]) if applied else mark.at,
        map_epoch=epoch,
        map_seq=seq,
        age_s=round(max(0.0, now - robot.heard), 3),
    )
