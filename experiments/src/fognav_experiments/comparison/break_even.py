"""When a warning costs more than it saves: obstacles that go away again, and false alarms. An analytic model. Pure.

What goes into it was measured: of each route and blocked area the times of a robot that was warned before it started,
of one that was not, and of drives on the same route in which nothing was in the way. A warned robot makes its detour
at once, and keeps to it.
"""

from __future__ import annotations

from collections import defaultdict
from statistics import median
from typing import TYPE_CHECKING, Final, NamedTuple

from fognav_experiments import figures
from fognav_experiments.comparison.drives import route_ends
from fognav_experiments.comparison.situations import begun_late
from fognav_experiments.figures import Block, Heading, Paragraph, Picture, Table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fognav_experiments.comparison.situations import Drives

DAY_S: Final = 86_400.0
MOST_A_DAY: Final = 10
LASTING_S: Final = (10.0, 60.0, 600.0)
"""How long a false alarm closes its corridor."""
_LEAST_S: Final = 3.0
"""A detour or a saving below this is another line round a corner."""


class Case(NamedTuple):
    """A route and an area: times (s) of a free way, and of a warned and an unwarned robot with the area blocked."""

    route: str
    area: str
    free_s: float
    warned_s: float
    unwarned_s: float

    @property
    def saved_s(self) -> float:
        """What a warning saves of an obstacle that stays."""
        return self.unwarned_s - self.warned_s

    @property
    def lost_s(self) -> float:
        """What the detour costs if nothing is there when the robot would have come by."""
        return self.warned_s - self.free_s

    @property
    def true_share(self) -> float:
        """Share of warnings that must be of obstacles which still stand there, for the warnings to cost nothing."""
        return self.lost_s / (self.lost_s + max(0.0, self.saved_s))

    @property
    def in_vain(self) -> bool:
        """Whether a warning saves next to nothing even of an obstacle that stays."""
        return self.saved_s < _LEAST_S

    def blocked_share(self, alarms: float, lasting_s: float) -> float:
        """Share of the time in which the corridor must really be blocked to outweigh so many false alarms a day."""
        return alarms * lasting_s / DAY_S * self.lost_s / self.saved_s


def cases(pairs: Sequence[Drives], met: Sequence[Drives]) -> list[Case]:
    """Return the cases in which a detour costs something, by route and area: also those of which no warning saves."""
    barred = {id(drives) for drives in met}
    free: dict[str, list[float]] = defaultdict(list)
    closed: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    for drives in pairs:
        alone, led = drives.get("default"), drives.get("fog")
        if alone is None or led is None or alone.time_s is None or led.time_s is None:
            continue
        if id(drives) not in barred:
            free[led.route].append(led.time_s)
        elif led.moment == "before":
            closed[led.route, led.area].append((led.time_s, alone.time_s - begun_late(alone)))
    found = [
        Case(route, area, median(free[route]), median(led for led, _ in times), median(alone for _, alone in times))
        for (route, area), times in sorted(closed.items())
        if free[route]
    ]
    return [case for case in found if case.lost_s >= _LEAST_S]


def blocks(pairs: Sequence[Drives], met: Sequence[Drives]) -> list[Block]:
    """Return the part of the report; nothing where no case was measured."""
    known = cases(pairs, met)
    if not known:
        return []
    rows = [
        [
            route_ends(case.route), case.area, f"{case.free_s:.0f}", f"{case.warned_s:.0f}", f"{case.unwarned_s:.0f}",
            f"{case.saved_s:.0f}", f"{case.lost_s:.0f}", f"{100.0 * case.true_share:.0f} %",
            *("-" if case.in_vain else f"{100.0 * case.blocked_share(1.0, lasting):.3f} %" for lasting in LASTING_S),
        ]
        for case in known
    ]  # fmt: skip
    worthwhile = [case for case in known if not case.in_vain]
    days = [float(alarms) for alarms in range(MOST_A_DAY + 1)]
    pictures = []
    if worthwhile:
        panels = {
            f"a false alarm lasts {lasting:g} s": {
                f"{route_ends(case.route)}, {case.area}": [
                    (alarms, 100.0 * case.blocked_share(alarms, lasting)) for alarms in days
                ]
                for case in worthwhile
            }
            for lasting in LASTING_S
        }
        svg = figures.svg_of(figures.curves(panels, "false alarms a day in this corridor"))
        caption = "Share of time (%) for which a corridor must be blocked: then warnings pay."
        pictures.append(Picture("break-even.svg", svg, caption))
    shown = f"Only routes are shown on which a warning saves, and its detour costs, at least {_LEAST_S:g} s."
    if len(worthwhile) < len(known):
        shown = (
            f"Only routes are shown on which its detour costs at least {_LEAST_S:g} s; where a warning saves less than "
            "that (-), it only costs."
        )
    return [
        Heading("When a warning costs more than it saves"),
        Paragraph(
            "A model, no drives: a warned robot makes its detour at once and keeps to it, even if the obstacle goes "
            "away again or never was there; one that waits first, or turns back, loses less. Its times are measured: "
            "medians of the drives in which the obstacle stood there before the start, and of those in which nothing "
            "was in the way. Warnings pay if at least the share of obstacles that is named still stands when an "
            "unwarned robot would have seen them. The last columns and the picture say for which share of the time a "
            f"corridor must really be blocked, so that warnings outweigh false alarms in it. {shown}"
        ),
        Table(
            [
                "route", "blocked", "free way, s", "warned, s", "unwarned, s", "saved if it stays, s",
                "lost if it does not, s", "must still stand",
                *(f"blocked, at 1 false alarm a day of {lasting:g} s" for lasting in LASTING_S),
            ],
            rows,
        ),
        *pictures,
    ]  # fmt: skip
