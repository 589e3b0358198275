"""Places that a further search finds, against the best of those that the searches before have found.

A search compares candidates on a raster by one scan, and keeps the best two dozen places. Where more look alike, the
robot's own may be missing, and what later scans leave over is a wrong one. So the map is searched again with a later
scan, and what is found there is weighed by all scans that counted, from that one to the newest and back to the first.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final

from robot_agent.localization.hypotheses import AMBIGUOUS_LATER, Hypotheses, Hypothesis, apart, weighed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robot_agent.localization.deskew import DeskewedScan
    from robot_agent.localization.map_fields import MapFields

_SHARE: Final = 8
"""Places weighed in one share of the work: some 5 ms."""


class Rivals:
    """A comparison in progress of the best place with those that a further search has found."""

    def __init__(self, best: Hypothesis, found: Hypotheses, scans: Sequence[DeskewedScan], range_max: float) -> None:
        """Begin; the scans come in order of time, one of them is what was searched with; range_max: as for a fit.

        The best place belongs to the newest scan.
        """
        self._best = best
        self._open = found.places
        self._scans = list(scans)
        self._searched = next(number for number, scan in enumerate(scans) if scan.odom == found.odom)
        self._range_max = range_max
        self._quality: float | None = None
        """Logarithm of how well the best place explains the scans."""
        self._rivals: list[Hypothesis] = []

    def advance(self, fields: MapFields) -> list[Hypothesis] | None:
        """Do one share of the work; return the places that explain the scans nearly as well, once all are weighed."""
        if self._quality is None:
            self._quality = self._explained(self._best, len(self._scans) - 1, -math.inf, fields).log_quality
        # No scan makes a place better: one that is too bad by some of the scans need not be weighed by the others.
        least = self._quality + math.log(AMBIGUOUS_LATER)
        for place in self._open[:_SHARE]:
            rival = self._explained(place, self._searched, least, fields)
            if rival.log_quality >= least and apart(rival.pose, self._best.pose):
                relative = self._best.log_quality + rival.log_quality - self._quality
                self._rivals.append(Hypothesis(rival.pose, relative))
        self._open = self._open[_SHARE:]
        return None if self._open else self._rivals

    def _explained(self, place: Hypothesis, number: int, least: float, fields: MapFields) -> Hypothesis:
        """Return a place that belongs to a scan at the newest one, weighed by all or until it is worse than `least`."""
        first = weighed(Hypothesis(place.pose, 0.0), place.pose, self._scans[number], fields, self._range_max)
        newest = self._followed(first, self._scans[number:], least, fields)
        back = Hypothesis(first.pose, newest.log_quality)
        oldest = self._followed(back, self._scans[number::-1], least, fields)
        return Hypothesis(newest.pose, oldest.log_quality)

    def _followed(
        self, place: Hypothesis, scans: Sequence[DeskewedScan], least: float, fields: MapFields
    ) -> Hypothesis:
        """Return a place that belongs to the first scan at the last one, weighed by those that follow the first."""
        for before, scan in itertools.pairwise(scans):
            if place.log_quality < least:
                break
            pose = place.pose.compose(scan.odom.relative_to(before.odom))
            place = weighed(place, pose, scan, fields, self._range_max)
        return place
