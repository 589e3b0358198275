"""Finding a robot that does not know where it is: a search of the whole map, then the places that it left."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple

from robot_agent.localization.global_search import GlobalSearch
from robot_agent.localization.hypotheses import apart
from robot_agent.localization.pose import Pose2  # noqa: TC001  # a named tuple's fields are read at run time
from robot_agent.localization.rivals import Rivals

if TYPE_CHECKING:
    from robot_agent.config import LocalizationConfig
    from robot_agent.localization.deskew import DeskewedScan
    from robot_agent.localization.hypotheses import Hypotheses, Hypothesis, Near
    from robot_agent.localization.map_fields import MapFields

_POINTS_MIN: Final = 10
_SCANS_MAX: Final = 12
"""Scans that are kept, to weigh by them what a second search finds."""
_SEARCH_EVERY_S: Final = 10.0
"""Least time between the end of a search without any place and the next one, ..."""
_SEARCH_EVERY_M: Final = 0.5
_SEARCH_EVERY_RAD: Final = 0.5
"""... unless the robot has moved this far since: somebody may stand in its view no more."""

_CHECKING: Final = "one place is left: the whole map is searched for others that fit as well"


class Outcome(NamedTuple):
    """The pose in `map` that was found, when the odometry said `odom`; or None, and why.

    beaten: near places that the scans confirm, and that explain them much worse all the same. by_one_scan: no other
    place was ever in question.
    """

    pose: Pose2 | None
    odom: Pose2
    detail: str = ""
    beaten: tuple[Pose2, ...] = ()
    by_one_scan: bool = False


class Relocalization:
    """A search of the whole map, and the hypotheses that later scans decide between."""

    def __init__(self, config: LocalizationConfig) -> None:
        self._config = config
        self._search: GlobalSearch | None = None
        self._hypotheses: Hypotheses | None = None
        self._scans: deque[DeskewedScan] = deque(maxlen=_SCANS_MAX)
        """The scans by which the hypotheses are weighed."""
        self._rivals: Rivals | None = None
        self._confirmed = False
        """Whether what the hypotheses decided for was compared with what a further search found."""
        self._again_at = -math.inf
        self._failed_at: Pose2 | None = None
        """Odometry at which the last search ended without any place."""
        self.verifies = False
        """Whether this only looks for places like that of a pose that fits; else the robot is lost until it ends."""

    @property
    def active(self) -> bool:
        """Whether there is a search in progress, or places between which it did not decide."""
        return self._search is not None or self._hypotheses is not None

    @property
    def searching(self) -> bool:
        """Whether a search is in progress, or what it found is being compared."""
        return self._search is not None or self._rivals is not None

    @property
    def places(self) -> list[Hypothesis]:
        """The places between which the scans do not decide, best first."""
        return self._hypotheses.contenders if self._hypotheses is not None else []

    def may_begin(self, now: float, odom: Pose2 | None = None) -> bool:
        """Whether the last search without success is long enough ago, or the robot at `odom` has moved since."""
        if now >= self._again_at:
            return True
        if odom is None or self._failed_at is None:
            return False
        step = odom.relative_to(self._failed_at)
        return math.hypot(step.x, step.y) >= _SEARCH_EVERY_M or abs(step.theta) >= _SEARCH_EVERY_RAD

    def cancel(self) -> None:
        """End the search and forget all places."""
        self._search = self._hypotheses = self._rivals = None

    def begin(self, scan: DeskewedScan, fields: MapFields, near: Near | None = None, *, verifies: bool = False) -> bool:
        """Begin a search with a scan; False if the map has no free place, or the scan too few points.

        near: where the robot may have come to by itself, since its pose was good last.
        """
        if not len(fields.free_places) or len(scan.points) < _POINTS_MIN:
            return False
        self.cancel()
        self.verifies = verifies
        self._scans.clear()
        self._scans.append(scan)
        self._search_with(scan, fields, near)
        return True

    def advance(self, fields: MapFields) -> None:
        """Do one share of the search, or of the comparison of what it found."""
        if self._search is not None:
            found = self._search.advance(fields)
            if found is not None:
                self._search = None
                self._on_found(found)
        elif self._rivals is not None and self._hypotheses is not None:
            rivals = self._rivals.advance(fields)
            if rivals is not None:
                self._rivals = None
                self._join(self._hypotheses, rivals)

    def on_scan(self, scan: DeskewedScan, fields: MapFields, near: Near | None = None, *, shaken: bool = False) -> None:
        """Do one share of the search, and weigh the places by the scan; `near` as for a search that begins.

        shaken: whether the robot was moved otherwise than its wheels say.
        """
        hypotheses = self._hypotheses
        if self.searching:
            self.advance(fields)
        if hypotheses is None or self._rivals is not None:
            return
        if self._confirmed and hypotheses.decided is not None:
            # This share has confirmed a place, which the outcome tells now. Weighed by one scan more, it would have to
            # be confirmed anew, and a robot that moves on would be found only once it stands still.
            return
        if not hypotheses.add(scan, fields, self._config.range_max):
            return
        if not hypotheses.places or (shaken and hypotheses.best.misfits):
            # The places were followed by wheels that the robot did not follow.
            self.begin(scan, fields, near, verifies=self.verifies)
            return
        self._scans.append(scan)
        self._confirmed = False
        if self.searching or hypotheses.best.misfits:
            return
        if hypotheses.decided is not None or not hypotheses.complete:
            self._search_with(scan, fields)

    def _search_with(self, scan: DeskewedScan, fields: MapFields, near: Near | None = None) -> None:
        self._search = GlobalSearch(fields, scan.beams(self._config.beams), scan.odom, self._config.range_max, near)

    def _on_found(self, found: Hypotheses) -> None:
        known = self._hypotheses
        if known is None:
            self._hypotheses, self._confirmed = found, True
        elif known.places and any(scan.odom == found.odom for scan in self._scans):
            known.complete |= found.complete
            self._rivals = Rivals(known.best, found, self._scans, self._config.range_max)

    def _join(self, known: Hypotheses, rivals: list[Hypothesis]) -> None:
        """Add what a further search found. One that has decided is to be confirmed by the next, with another scan."""
        before = known.decided
        known.join(rivals)
        after = known.decided
        self._confirmed = before is not None and after is not None and not apart(before, after)

    def outcome(self, now: float) -> Outcome | None:
        """Return what is known now; None while the first search is in progress or nothing was searched."""
        hypotheses = self._hypotheses
        if hypotheses is None:
            return None
        if not hypotheses.places:
            self._again_at, self._failed_at = now + _SEARCH_EVERY_S, hypotheses.odom
            self.cancel()
            return Outcome(None, hypotheses.odom, "the scan fits no place of the map: give the initial pose")
        found = hypotheses.decided
        if found is None:
            return Outcome(None, hypotheses.odom, _undecided(len(hypotheses.contenders)))
        if not self._confirmed:
            return Outcome(None, hypotheses.odom, _CHECKING if self.searching else _undecided(1))
        self.cancel()
        beaten = tuple(place.pose for place in hypotheses.places if place.near)
        return Outcome(found, hypotheses.odom, beaten=beaten, by_one_scan=hypotheses.scans == 1)


def _undecided(contenders: int) -> str:
    """Return why the scans do not decide; a single place has just been found, or been contradicted by one."""
    alike = f"{contenders} places of the map look like this one"
    why = alike if contenders > 1 else "the last scan does not confirm the only place of the map that is left"
    return f"{why}: let the robot turn or advance (`fognav robot turn`), or give the initial pose"
