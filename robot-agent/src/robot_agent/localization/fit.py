"""How well a scan fits the map at a pose, the status that follows, and doubt in a pose that scans fit."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from fog_kernels.scans import Tolerances

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from robot_agent.localization.map_fields import MapFields
    from robot_agent.localization.pose import Pose2, Uncertainty
    from robot_agent.safety.conditions import Localization

_NEAR_M: Final = 0.25
"""A beam that ends this near to a wall of the map agrees with it."""
_RANGE_TOLERANCE_M: Final = 0.40
"""Range difference from which a beam counts as short or long."""
_ON_WALL_M: Final = 0.12
_ON_WALL_CELLS: Final = 1.5
_ON_WALL_SHARE: Final = 0.03
"""An agreeing beam of a right pose ends this near to the wall: farther ones are blurred. A map draws its walls no finer
than its cells; ranges of a small lidar are wrong by up to 2 % (RPLidar A1, data sheet: 1 to 2.5 %), and a heading that
is off by 1.3 degrees, as a right one may be, moves the ends of the beams by as much."""
_CONTRADICTION_LIMIT: Final = 0.2
"""Share of contradicting beams above which a pose is wrong, or the map."""
_CONTRADICTION_CLEAR: Final = 0.04
_AGREEMENT_CLEAR: Final = 0.4
"""A pose may be good if no more beams contradict and no fewer agree than this. On recorded floors, 1 % of the scans at
right poses, some in a crowd, fail here, and 97 % of those at wrong poses."""
_CONTRADICTION_PROVEN: Final = 0.12
_AGREEMENT_PROVEN: Final = 0.8
"""One that was good before may also stay so within these limits: a door was opened, yet the rest is as it was."""
_CONTRADICTION_DOORS: Final = 0.35
"""Share that passes through walls of the map beside one or two doors that were opened since it was made."""
_BLURRED_LIMIT: Final = 0.15
"""Share of blurred beams above which a pose is not good: 0.2 % of those at right poses, half of the wrong ones that the
limits above let through. 0.1 would slow a robot down on an empty floor."""
_BLURRED_DOUBT: Final = 0.3
"""Share of blurred beams above which a pose is in doubt."""
_INFORMATIVE_LEAST: Final = 8
"""Fewer beams that reach the map tell nothing about the pose: somebody stands around the robot."""
_GOOD_ALONG_M: Final = 0.35
_GOOD_ACROSS_M: Final = 0.2
_GOOD_HEADING_RAD: Final = 0.2
"""Standard deviations up to which a pose may be good."""
_LOST_ACROSS_M: Final = 1.0
"""Across its least certain direction a pose must be more certain than this; along a plain corridor it need not be."""
_SHAKEN_SCANS: Final = 2
"""So many of the last nine scans that fit nowhere near the pose tell that the robot moved otherwise than its wheels."""
_CONTRADICTED_SCANS_LIMIT: Final = 25
"""After this many contradicted scans in a row (some 4.5 s) the pose is lost, however the rest fits."""


@dataclass(frozen=True, slots=True)
class Fit:
    """How a scan fits the map at a pose, as shares of the beams.

    agree: end at a wall of the map, of the informative and short ones. explained: the same, of all. contradict: share
    of agreeing and overlong beams that pass through a wall, which no unknown object can cause: 0 where all end before
    one. informative: number of beams that reached the map, as opposed to those that ended at unknown objects before it.
    blurred: share of the agreeing beams that end beside their wall rather than on it, as they do at a place that only
    resembles the true one.
    """

    agree: float
    explained: float
    contradict: float
    informative: int
    blurred: float = 0.0


NO_FIT: Final = Fit(agree=0.0, explained=0.0, contradict=1.0, informative=0)
"""Of no scan: it shows nothing."""


def evaluate_fit(fields: MapFields, pose: Pose2, points: NDArray[np.float64], range_max: float) -> Fit:
    """Compare points (n, 2; m, frame `base`) measured at a pose in `map` with the ranges of the static map there.

    `range_max`: m, the lidar's rated range.
    """
    on_wall = max(_ON_WALL_M, _ON_WALL_CELLS * fields.geometry.resolution)
    tolerances = Tolerances(_NEAR_M, on_wall, _RANGE_TOLERANCE_M, _ON_WALL_SHARE)
    beams = fields.compared(pose, points, range_max + 1.0, tolerances)
    informative = beams.agree + beams.long
    return Fit(
        agree=beams.agree / max(informative + beams.short, 1),
        explained=beams.agree / max(len(points), 1),
        contradict=beams.long / informative if informative else float(not beams.short),
        informative=informative,
        blurred=beams.beside / beams.agree if beams.agree else 0.0,
    )


class FitMonitor:
    """Status of the pose with hysteresis, from the fits of the last scans."""

    def __init__(self) -> None:
        self.status: Localization = "none"
        """Status of the pose."""
        self.detail = "no pose has been given yet"
        """Reason of the status; empty when good."""
        self.trial_failed = False
        """Whether the newest scan ended a trial without success."""
        self._recent: deque[Localization] = deque(maxlen=9)
        self._contradicted = 0
        self._proven = False
        self._trial_scans = 0

    @property
    def shaken(self) -> bool:
        """Whether some of the last scans show that the robot was turned or moved by something other than its wheels."""
        return self._recent.count("lost") >= _SHAKEN_SCANS

    @property
    def on_trial(self) -> bool:
        """Whether the pose must become good soon."""
        return self._trial_scans > 0

    def begin(self, detail: str, trial_scans: int = 0) -> None:
        """Begin with a given pose; with a trial it must become good within so many scans."""
        self.restart()
        self.status, self.detail = "none", detail
        self._trial_scans = trial_scans

    def restart(self) -> None:
        """Forget the fits of another pose; the status stays until new ones change it."""
        self._recent.clear()
        self._contradicted = 0
        self._proven = False

    def begin_search(self) -> None:
        """Set the status for a global search: none, or still lost."""
        self.detail = "searching the whole map"
        if self.status != "lost":
            self.status = "none"

    def begin_found(self) -> None:
        """Begin at the place that a search has found; the status stays until scans prove the place."""
        self.restart()
        self.detail = "the robot's place was found: the next scans have to prove it"

    def lose(self, detail: str) -> None:
        """Set the status to lost, with its reason."""
        self.status, self.detail = "lost", detail

    def doubt(self, detail: str) -> None:
        """Let a good pose be weak until scans prove it again."""
        self.restart()
        if self.status == "good":
            self.status = "weak"
        self.detail = detail

    def add(self, fit: Fit, spread: Uncertainty, *, doubt: str = "", kept: bool = False) -> None:
        """Add the fit of the newest scan, with the pose's standard deviations.

        A pose in `doubt` is at most weak; one that is `kept` is not lost however many scans contradict it.
        """
        grade, reason = grade_fit(fit, spread, proven=self._proven)
        if grade == "good" and doubt:
            grade, reason = "weak", doubt
        contradicted = fit.contradict > _CONTRADICTION_LIMIT and not kept
        self._contradicted = self._contradicted + 1 if contradicted else 0
        if self._contradicted >= _CONTRADICTED_SCANS_LIMIT:
            grade = "lost"
        self._recent.append(grade)
        before = self.status
        self.status, self.detail = self._next_status(reason)
        if before in {"none", "lost"} and not self._trial_scans and self._is_steadily_weak(fit):
            self.status = "weak"
        self._count_trial()

    def _next_status(self, reason: str) -> tuple[Localization, str]:
        """Return the status and its reason after the newest grade, whose reason is `reason`."""
        recent = list(self._recent)
        if recent[-1] != "good":
            self._proven = False
        # A single bad scan (a person leans over the lidar) does not lose the pose; five of the last nine do.
        if recent.count("lost") >= 5 or self._contradicted >= _CONTRADICTED_SCANS_LIMIT:
            return "lost", reason or self.detail
        if recent[-2:] == ["good", "good"]:
            self._proven = True
            return "good", ""
        if self.status in {"none", "lost"}:
            return self.status, reason or self.detail
        # Good is what the newest scan confirms: the robot may have been carried away since the one before.
        return "weak", reason or self.detail

    def _is_steadily_weak(self, fit: Fit) -> bool:
        # What stands all around a robot speaks against no place, and for none.
        told = fit.informative > 0 and fit.contradict <= _CONTRADICTION_LIMIT
        return told and list(self._recent)[-4:] == ["weak"] * 4

    def _count_trial(self) -> None:
        self.trial_failed = False
        if not self._trial_scans:
            return
        self._trial_scans -= 1
        if self.status == "good":
            self._trial_scans = 0
        elif self._trial_scans == 0 or self.status == "lost":
            self._trial_scans = 0
            self.trial_failed = True


def grade_fit(fit: Fit, spread: Uncertainty, *, proven: bool = False) -> tuple[Localization, str]:
    """Grade a pose by one scan and its standard deviations; return the grade and its reason.

    `proven`: it has been good since the last scan that was not.
    """
    # Measured on recorded floors: contradiction of a right pose is 0.13 at most, also in a crowd; that of a wrong one
    # has a median of 0.5, and few beams agree.
    if fit.contradict > 0.45 or (fit.contradict > _CONTRADICTION_LIMIT and fit.agree < 0.4):
        return "lost", _contradiction(fit)
    if spread.across > _LOST_ACROSS_M:
        return "lost", f"the position is uncertain by {spread.across:.1f} m in every direction"
    weakness = _weakness(fit, proven=proven)
    return ("weak", weakness) if weakness else _grade_spread(spread)


def _weakness(fit: Fit, *, proven: bool) -> str:
    """Return why a scan does not confirm a pose; empty if it does."""
    if fit.contradict > _CONTRADICTION_LIMIT:
        return _contradiction(fit)
    if fit.informative < _INFORMATIVE_LEAST:
        return "too few beams reach a wall of the map"
    if not _is_clear(fit, proven=proven):
        return f"{_contradiction(fit)}, and {fit.agree:.0%} end at them"
    if fit.blurred > _BLURRED_LIMIT:
        return f"{fit.blurred:.0%} of the beams end beside the walls of the map"
    return ""


def tells_place(fit: Fit) -> bool:
    """Whether most of a scan shows the place that a pose says, whatever doors are open: enough to measure a way by."""
    return fit.informative >= _INFORMATIVE_LEAST and fit.contradict <= _CONTRADICTION_LIMIT and fit.agree >= 0.7


def differs_by_doors(fit: Fit) -> bool:
    """Whether a scan shows the place of a pose sharply, but for a few beams, as one does beside an opened door."""
    enough = fit.informative >= _INFORMATIVE_LEAST and fit.agree >= _AGREEMENT_PROVEN
    return enough and fit.blurred <= _BLURRED_LIMIT


def shows_place(fit: Fit) -> bool:
    """Whether enough of a scan shows the place of a pose, and no more passes through walls than at opened doors."""
    enough = fit.informative >= _INFORMATIVE_LEAST and fit.agree >= _AGREEMENT_CLEAR
    return enough and fit.contradict <= _CONTRADICTION_DOORS


def confirms(fit: Fit) -> bool:
    """Whether a scan by itself confirms a pose, as one does that may be good."""
    return not _weakness(fit, proven=False)


def casts_doubt(fit: Fit) -> bool:
    """Whether a scan shows that the robot may be elsewhere; a right pose hardly ever has such a fit.

    A pose in doubt needs more than a good fit: it may slide to a place that resembles the true one.
    """
    if fit.informative < _INFORMATIVE_LEAST:
        return False
    return fit.contradict > _CONTRADICTION_PROVEN or fit.blurred > _BLURRED_DOUBT


def _is_clear(fit: Fit, *, proven: bool) -> bool:
    if fit.contradict <= _CONTRADICTION_CLEAR and fit.agree >= _AGREEMENT_CLEAR:
        return True
    return proven and fit.contradict <= _CONTRADICTION_PROVEN and fit.agree >= _AGREEMENT_PROVEN


def _grade_spread(spread: Uncertainty) -> tuple[Localization, str]:
    if spread.across > _GOOD_ACROSS_M or spread.heading > _GOOD_HEADING_RAD:
        return "weak", f"the pose is uncertain by {spread.along:.2f} m and {spread.heading:.2f} rad"
    if spread.along > _GOOD_ALONG_M:
        return "weak", f"the position is uncertain by {spread.along:.2f} m in one direction, as in a plain corridor"
    return "good", ""


def _contradiction(fit: Fit) -> str:
    return f"{fit.contradict:.0%} of the beams pass through walls of the map"


_VERIFIED_AFTER_M: Final = 5.0
"""A pose in doubt is verified by a search of the whole map, or by fitting for so long a drive, ..."""
_VERIFIED_AGREEMENT: Final = 0.7
"""... with this share of agreeing beams at least: half of a scan fits many corridors."""
_SUDDEN_DROP: Final = 0.13
"""A pose is suspect when the share of agreeing beams falls by more than this below its level: a robot that was carried
to a place like its own sees walls where the map has none. A person who steps before the lidar takes about as much."""
_LEVEL_GAIN: Final = 0.3
"""Weight of the newest scan in that level."""
_ACCEPTED_AFTER_M: Final = 2.0
"""After so long a drive a lower share is the level: the place is crowded, or was changed. If that share verifies no
pose, the pose is in doubt from then on: a robot that was carried away sees as much at the wrong place."""


class Doubt:
    """What speaks against a pose, by the odometry since then.

    A pose is in doubt when scans showed what no right pose shows, or when it was found again. It is suspect when fewer
    beams agree than before: something unknown stands around the robot, or it was carried away.
    """

    def __init__(self) -> None:
        self._since: Pose2 | None = None
        """Odometry at which scans last cast doubt on the pose, or it was found again; None once it is verified."""
        self._level: float | None = None
        """Share of agreeing beams that is usual here; None before the first scan of a pose."""
        self._suspect_for_m: float | None = None
        """How far the robot has driven since the pose became suspect, in however small a room."""
        self._last: Pose2 | None = None

    @property
    def reason(self) -> str:
        """Why a pose that fits is not good; empty if it may be."""
        if self._since is not None:
            return "the pose was in doubt and fits again: other places may look like this one"
        if self._suspect_for_m is not None:
            return "suddenly fewer beams end at walls of the map: something stands before them, or the robot was moved"
        return ""

    @property
    def to_verify(self) -> bool:
        """Whether the whole map is to be searched for places that look like that of the pose."""
        return self._since is not None

    def begin(self, odom: Pose2) -> None:
        """Doubt a pose from now on, because it was lost or found again."""
        self._since = odom

    def verify(self) -> None:
        """End the doubt: no other place looks like this one."""
        self._since = None

    def restart(self) -> None:
        """Forget everything of another pose."""
        self._since = self._level = self._suspect_for_m = None

    def add(self, fit: Fit, odom: Pose2, *, jumped: bool, rivalled: bool = False) -> None:
        """Add the fit of the newest scan; `jumped`: whether it moved the estimate to another place.

        `rivalled`: whether a search left other places that explain the scans as well: then no drive verifies a pose.
        """
        if self._since is not None and rivalled:
            self._since = odom
        if jumped or casts_doubt(fit) or (self._since is not None and fit.agree < _VERIFIED_AGREEMENT):
            self._since = odom
        elif self._since is not None and _driven(self._since, odom) > _VERIFIED_AFTER_M:
            self._since = None
        if self._follow_level(fit.agree, 0.0 if self._last is None else _driven(self._last, odom)):
            self._since = odom
        self._last = odom

    def _follow_level(self, agree: float, step_m: float) -> bool:
        """Follow the level by the newest scan's share; return whether the level that is new now verifies no pose."""
        if self._level is None:
            self._level = agree
        elif agree >= self._level - _SUDDEN_DROP:
            self._suspect_for_m = None
            self._level += _LEVEL_GAIN * (agree - self._level)
        elif self._suspect_for_m is None:
            self._suspect_for_m = 0.0
        elif (further := self._suspect_for_m + step_m) > _ACCEPTED_AFTER_M:
            self._level, self._suspect_for_m = agree, None
            return agree < _VERIFIED_AGREEMENT
        else:
            self._suspect_for_m = further
        return False


def _driven(since: Pose2, odom: Pose2) -> float:
    step = odom.relative_to(since)
    return math.hypot(step.x, step.y)
