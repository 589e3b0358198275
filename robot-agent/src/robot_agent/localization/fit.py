"""How well a scan fits the static map at a pose, and how far the pose can be trusted because of it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.localization.map_fields import MapFields
    from robot_agent.localization.pose import Pose2
    from robot_agent.safety.gate import Localization

_NEAR_M: Final = 0.25
"""A beam that ends this near to a wall of the map agrees with it."""
_SHALLOW_M: Final = 0.40
"""Range difference from which a beam is called short or long."""
_DOUBT: Final = 0.2
"""Share of contradicting beams from which the pose is doubted."""
_DOUBT_AT_FIRST: Final = 0.08
"""The same for a pose that has not proved itself yet: corridors look alike, a wrong one may fit by nine tenths."""
_DOUBTED_SCANS: Final = 25
"""As many scans in a row (some 4.5 s) with doubt and the pose is lost, however the rest fits."""


@dataclass(frozen=True, slots=True)
class Fit:
    """How a scan fits the map at a pose, as shares of the beams.

    agree: end at a wall of the map, of those that tell something. explained: the same, of all. contradict: share of
    agreeing and overlong beams that look through a wall, which no unknown object can cause. informative: number of
    beams that met the map or should have, as opposed to unknown things before it.
    """

    agree: float
    explained: float
    contradict: float
    informative: int


def evaluate_fit(fields: MapFields, pose: Pose2, points: NDArray[np.float64], range_max: float) -> Fit:
    """Compare points (n, 2; m, frame `base`) seen at a pose in `map` with what the static map would show there.

    `range_max`: m, the lidar's rated range.
    """
    seen = pose.transform(points)
    near = fields.wall_distances(seen) <= _NEAR_M
    offset_x, offset_y = seen[:, 0] - pose.x, seen[:, 1] - pose.y
    ranges = np.hypot(offset_x, offset_y)
    expected = fields.ranges(pose.x, pose.y, np.arctan2(offset_y, offset_x), range_max + 1.0)
    agree = near & (np.abs(ranges - expected) < 3.0 * _SHALLOW_M)
    # Grazing beams end near a wall yet far from where the ray first meets one: they tell nothing.
    long = ~near & (ranges > expected + _SHALLOW_M)
    short = ~near & (ranges < expected - _SHALLOW_M)
    n_agree, n_long, n_short = int(agree.sum()), int(long.sum()), int(short.sum())
    informative = n_agree + n_long
    return Fit(
        agree=n_agree / max(informative + n_short, 1),
        explained=n_agree / max(len(points), 1),
        contradict=n_long / informative if informative else 1.0,
        informative=informative,
    )


class FitMonitor:
    """Status of the pose with hysteresis, from the fits of the last scans."""

    def __init__(self) -> None:
        self.status: Localization = "none"
        """How far the pose can be trusted."""
        self.detail = "no pose was given yet"
        """Why, in words; empty when good."""
        self.trial_failed = False
        """Whether the newest scan ended a trial without success."""
        self._recent: deque[Localization] = deque(maxlen=9)
        self._doubted = 0
        self._proven = False
        self._trial_scans = 0

    def begin(self, detail: str, trial_scans: int = 0) -> None:
        """Begin with a pose from outside; with a trial it has to prove itself within so many scans."""
        self.restart()
        self.status, self.detail = "none", detail
        self._trial_scans = trial_scans

    def restart(self) -> None:
        """Forget the fits of another pose; the status stays until new ones change it."""
        self._recent.clear()
        self._doubted = 0
        self._proven = False

    def begin_search(self) -> None:
        """Note that there is no pose while the whole map is searched; a lost one stays lost."""
        self.detail = "searching the whole map"
        if self.status != "lost":
            self.status = "none"

    def lose(self, detail: str) -> None:
        """Note that there is no pose, and why."""
        self.status, self.detail = "lost", detail

    def add(self, fit: Fit, sigma_xy: float, sigma_theta: float) -> None:
        """Add the fit of the newest scan, with the pose's standard deviations (m, rad)."""
        grade, why = grade_fit(fit, sigma_xy, sigma_theta)
        if grade == "good" and not self._proven and fit.contradict > _DOUBT_AT_FIRST:
            grade, why = "weak", _contradicted(fit)
        self._doubted = self._doubted + 1 if fit.contradict > _DOUBT else 0
        if self._doubted >= _DOUBTED_SCANS:
            grade = "lost"
        self._recent.append(grade)
        before = self.status
        self.status, self.detail = self._settled(why)
        if before == "none" and not self._trial_scans and self._is_steadily_weak(fit):
            self.status = "weak"
        self._count_trial()

    def _settled(self, why: str) -> tuple[Localization, str]:
        """Return the status and its reason after the newest grade, whose reason is `why`."""
        recent = list(self._recent)
        # A single bad scan (somebody leans over the lidar) is no loss: five of the last nine are.
        if recent.count("lost") >= 5 or self._doubted >= _DOUBTED_SCANS:
            return "lost", why or self.detail
        if recent[-2:] == ["good", "good"]:
            self._proven = True
            return "good", ""
        if self.status in {"none", "lost"}:
            return self.status, why or self.detail
        if len(recent) >= 3 and "good" not in recent[-3:]:
            return "weak", why
        return self.status, self.detail

    def _is_steadily_weak(self, fit: Fit) -> bool:
        return fit.contradict <= _DOUBT and list(self._recent)[-4:] == ["weak"] * 4

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


def grade_fit(fit: Fit, sigma_xy: float, sigma_theta: float) -> tuple[Localization, str]:
    """Grade a pose by one scan and its standard deviations (m, rad); return the grade and why, in words."""
    # On maps and random poses, a right pose is contradicted by 0.1 at most, also in a crowd; a wrong one by 0.3 in the
    # median, and then few beams agree.
    if fit.contradict > 0.45 or (fit.contradict > _DOUBT and fit.agree < 0.4):
        return "lost", _contradicted(fit)
    if sigma_xy > 1.0:
        return "lost", f"the position is uncertain by {sigma_xy:.1f} m"
    if fit.contradict > _DOUBT:
        return "weak", _contradicted(fit)
    if fit.informative < 8:
        return "weak", "too few beams reach a wall of the map"
    if sigma_xy > 0.35 or sigma_theta > 0.3:
        return "weak", f"the pose is uncertain by {sigma_xy:.2f} m and {sigma_theta:.2f} rad"
    return "good", ""


def _contradicted(fit: Fit) -> str:
    return f"{fit.contradict:.0%} of the beams look through walls of the map"
