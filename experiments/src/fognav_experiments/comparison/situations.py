"""What the fog saves by situation: drives that meet the same obstacle on the same route repeat one another. Pure.

The thesis's draws choose among a few corridors, so that hundreds of drives know a few obstacles only. How much is saved
differs between these obstacles far more than between their drives: a mean over all drives, and an interval around it,
say how often which of them was drawn. So each is told by itself.
"""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, Final

from msgspec import UNSET

from fognav_experiments.comparison.drives import route_ends
from fognav_experiments.figures import FEWEST_CLUSTERS, Block, Heading, Paragraph, Table, spread

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

    from fognav_experiments.comparison.drives import Setup
    from fognav_experiments.comparison.limits import Saving
    from fognav_experiments.comparison.records import Record

Drives = dict["Setup", "Record"]
"""The drives of a run's route, by setup."""
NOTHING_M: Final = 1.0
"""What is saved below this is no detour that a warning spared, but another line round the same corner."""
_APPEARS: Final = {"before": "before the start", "under way": "under way"}


def situations(pairs: Sequence[Drives]) -> list[tuple[str, ...]]:
    """Return of each pair which situation it is of."""
    return [next(iter(drives.values())).situation for drives in pairs]


LATE_S: Final = 2.0


def begun_late(record: Record) -> float:
    """Return how much later (s) a robot began to drive than it should have, in drives that did not wait for it."""
    return 0.0 if record.ready is True or record.setup == "fog" else LATE_S


def saved(drives: Drives, before: Setup, after: Setup) -> tuple[float, float]:
    """Return by how many metres and seconds `after` is better than `before`."""
    one, other = drives[before], drives[after]
    return one.distance_m - other.distance_m, (one.time_s or 0.0) - (other.time_s or 0.0)


def by_situation(pairs: Sequence[Drives], met: Sequence[Drives], before: Setup, after: Setup) -> list[Block]:
    """Return what `after` saves against `before` in each situation, and on how many of these that rests.

    `met`: those of the pairs in which the obstacle stood in the way of a robot that did not know of it.
    """
    if not pairs:
        return []
    barred = [id(drives) for drives in met]
    groups: dict[tuple[str, str, str], list[Drives]] = defaultdict(list)
    drawn = any(record.ends is not UNSET for drives in pairs for record in drives.values())
    for drives in pairs:
        record = next(iter(drives.values()))
        place = ("", "met" if id(drives) in barred else "not met") if drawn else (record.route, record.area)
        groups[*place, record.moment].append(drives)
    rows = []
    for key, chosen in sorted(groups.items()):
        metres, seconds = zip(*(saved(drives, before, after) for drives in chosen), strict=True)
        route, area, moment = key
        rows.append([
            route_ends(route) if route else "drawn", area, _APPEARS.get(moment, moment), str(len(chosen)),
            str(sum(id(drives) in barred for drives in chosen)), spread(metres), spread(seconds),
        ])  # fmt: skip
    header = ["route", "obstacle" if drawn else "blocked", "appears", "drives", "obstacle met", "saved, m", "saved, s"]
    return [
        Heading(f"What `{after}` saves against `{before}`, by situation"),
        Paragraph(_words(pairs, met, before, after, drawn=drawn)),
        Table(header, rows),
    ]


def _words(pairs: Sequence[Drives], met: Sequence[Drives], before: Setup, after: Setup, *, drawn: bool) -> str:
    known, barred = len(set(situations(pairs))), len(set(situations(met)))
    nothing = sum(abs(saved(drives, before, after)[0]) < NOTHING_M for drives in pairs)
    kind = "each draw of stops, area and moment is one" if drawn else "a route, and the area that is blocked on it"
    words = (
        f"Median, with the least and the most in brackets. The {len(pairs)} drives of each setup know {known} "
        f"situations ({kind}); {barred} of these met a robot that did not know of the obstacle, in {len(met)} drives. "
        f"In {nothing} drives less than {NOTHING_M:g} m was saved or lost. "
    )
    if known < FEWEST_CLUSTERS:
        return words + (
            f"Drives of one situation repeat one another, so means over all drives have no confidence interval: that "
            f"would need {FEWEST_CLUSTERS} situations at least. They say how often each was drawn, too."
        )
    return words + (
        "Drives of one situation repeat one another: confidence intervals count situations, not drives"
        + ("." if barred >= FEWEST_CLUSTERS else f", and there is none below {FEWEST_CLUSTERS}.")
    )


WORSE_M: Final = 0.3
WORSE_S: Final = 3.0
"""A robot that is told of an obstacle is worse off if it drives so much farther, or longer, than one on its own."""


def worse(pairs: Sequence[Drives], setups: Sequence[Setup], savings: Mapping[tuple[int, str], Saving]) -> list[Block]:
    """Return the drives in which a warned robot was worse off than one on its own, with what its records say of why."""
    rows = []
    after: Setup
    for after in ("fog", "full"):
        for drives in pairs if {"default", after} <= {*setups} else ():
            metres, seconds = saved(drives, "default", after)
            seconds += begun_late(drives[after]) - begun_late(drives["default"])
            if metres > -WORSE_M and seconds > -WORSE_S:
                continue
            record = drives[after]
            allowed = savings.get((record.run, record.route))
            rows.append([
                record.name, record.area, _APPEARS.get(record.moment, record.moment),
                f"{0.0 - round(metres, 1):.1f}", f"{0.0 - round(seconds, 1):.1f}",
                "-" if allowed is None else f"{allowed.saved_m:.1f}", cause(drives["default"], record),
            ])  # fmt: skip
    heading = Heading("Where a warned robot was worse off")
    any_late = any(begun_late(record) for drives in pairs for record in drives.values())
    limits = f"{WORSE_M:g} m or {WORSE_S:g} s"
    if not rows:
        return [heading, Paragraph(f"In no drive was `fog` or `full` worse than `default` by {limits}.")]
    return [
        heading,
        Paragraph(
            f"All drives in which `fog` or `full` was worse than `default` by at least {limits}. Why is what the "
            "records tell: another way, holds, slow driving (DEGRADED: where a robot can't rely on what it knows, it "
            "drives at half its speed at most), or neither. Where the map allows to save nothing, a warning can only "
            "cost." + (f" Times are less the {LATE_S:g} s that a robot on its own began late." if any_late else "")
        ),
        Table(["drive", "blocked", "appears", "farther, m", "longer, s", "the map allows to save, m", "why"], rows),
    ]


def cause(alone: Record, warned: Record) -> str:
    """Return in words in what a warned robot's drive differs from that of one on its own."""
    found = [f"{stop}" for stop in warned.stops]
    if alone.route_areas != warned.route_areas:
        ways = (", ".join(record.route_areas) or "no watched area" for record in (warned, alone))
        found.append("another way: through {}, not {}".format(*ways))
    if (holds := _under_way(warned, "HOLD") - _under_way(alone, "HOLD")) > 0:
        found.append(f"held under way {holds} time{'s' * (holds != 1)} more")
    slower = warned.modes.get("DEGRADED", 0) - alone.modes.get("DEGRADED", 0)
    if slower > 0:
        found.append(f"was DEGRADED, and slow, {slower} time{'s' * (slower != 1)} more")
    return "; ".join(found) or "the same way by another line"


def _under_way(record: Record, mode: str) -> int:
    """Return how often a robot was in a mode after its start: one that was not waited for began in HOLD."""
    began_so = mode == "HOLD" and record.ready is not True and record.setup != "fog"
    return record.modes.get(mode, 0) - began_so


def values(pairs: Collection[Drives], setup: Setup, value: Callable[[Record], float]) -> list[float]:
    """Return a quantity of a setup's drives."""
    return [value(drives[setup]) for drives in pairs]
