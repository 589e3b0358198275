"""Places that a second search finds, against the one that scans have left of those of the first.

A search compares candidates on a raster by one scan, and keeps the best two dozen places. Where more look alike, the
robot's own may be missing, and what later scans leave over is a wrong one. So the map is searched again with the scan
that has decided, and what is found there is weighed by the scans before it, back to the first.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final

from robot_agent.localization.hypotheses import AMBIGUOUS_LATER, Hypothesis, apart, weighed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robot_agent.localization.deskew import DeskewedScan
    from robot_agent.localization.map_fields import MapFields

_SHARE: Final = 8
"""Places weighed in one share of the work: some 5 ms."""


class Rivals:
    """A comparison in progress of the place that is left with those that the newest scan fits as well."""

    def __init__(
        self, left: Hypothesis, found: Sequence[Hypothesis], scans: Sequence[DeskewedScan], range_max: float
    ) -> None:
        """Begin; the poses belong to the newest of the scans, which come in order of time; range_max: as for a fit."""
        self._left = left
        self._open = [place for place in found if apart(place.pose, left.pose)]
        self._scans = list(reversed(scans))
        self._range_max = range_max
        self._quality: float | None = None
        """Logarithm of how well the place that is left explains the scans."""
        self._rivals: list[Hypothesis] = []

    def advance(self, fields: MapFields) -> list[Hypothesis] | None:
        """Do one share of the work; return the places that explain the scans nearly as well, once all are weighed."""
        if self._quality is None:
            self._quality = self._explained(self._left, -math.inf, fields).log_quality
        # No scan makes a place better: one that is too bad by the newest scans need not be weighed by the others.
        least = self._quality + math.log(AMBIGUOUS_LATER)
        for place in self._open[:_SHARE]:
            rival = self._explained(place, least, fields)
            if rival.log_quality >= least:
                relative = self._left.log_quality + rival.log_quality - self._quality
                self._rivals.append(Hypothesis(rival.pose, relative))
        self._open = self._open[_SHARE:]
        return None if self._open else self._rivals

    def _explained(self, place: Hypothesis, least: float, fields: MapFields) -> Hypothesis:
        """Return the place at the newest scan, weighed by all of them or until it is worse than `least`."""
        newest = now = weighed(Hypothesis(place.pose, 0.0), place.pose, self._scans[0], fields, self._range_max)
        for later, scan in itertools.pairwise(self._scans):
            if now.log_quality < least:
                break
            before = now.pose.compose(scan.odom.relative_to(later.odom))
            now = weighed(now, before, scan, fields, self._range_max)
        return Hypothesis(newest.pose, now.log_quality)
