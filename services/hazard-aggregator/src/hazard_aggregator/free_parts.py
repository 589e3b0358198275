"""Which sonars show that a part of a blocked area is free: those that hear the far wall, steadily and now. Pure.

An echo that is missing shows nothing: what is soft or slanted gives none. Nor does an echo from behind the far wall.
Only the wall's own, between `range_limit` and `range_max` as calibrated, has passed all that is before it. So a sonar
without a `range_max`, and one that is clear without an echo, show nothing here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

from fog_contracts.geometry import contains_point
from fog_contracts.messages import NodeCode

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from fog_contracts.geometry import Point
    from fog_contracts.messages import AreaDefinition, AreaState, Reason
    from fog_contracts.site import NodeSite
    from hazard_aggregator.debounce import SonarSample

FREE_AFTER_S: Final = 5.0
"""A sonar must have heard nothing but the far wall for so long: after each other echo the time begins anew."""
FRESH_S: Final = 2.0
"""Its last echo of the wall is no older; a node that sees no change speaks once a second."""
HELD_S: Final = 20.0
"""So long a robot that drives along its cone, and is all that it hears, ends nothing: 3 m at the slow speed."""
FEWEST_SONARS: Final = 2
"""Of those that look into the area: a lone one may be wrong. Of light, whose beam is narrow, one is enough."""
_STEP_M: Final = 0.1

FreeSonars = frozenset[tuple[str, int]]
"""Sonars by node and index."""
Cones = dict[str, list[list["Point"]]]
"""What each sonar of a node sees, as outlines."""


@dataclass(slots=True)
class _Heard:
    since: float = math.inf
    """Since when it has heard nothing but the far wall, and robots."""
    wall_at: float = -math.inf
    robot_at: float = -math.inf
    near: bool = False
    """Whether it heard something nearer that is no robot when it last heard anything else than one."""


class FarWall:
    """What the sonars of one node heard last; times of the receiver's clock (s)."""

    def __init__(self, site: NodeSite | None) -> None:
        self._sonars = [] if site is None else site.sonars
        self._heard = [_Heard() for _ in self._sonars]

    def on_reading(self, samples: Iterable[SonarSample] | None, taken_at: float) -> frozenset[int]:
        """Note what a reading shows, None: no measurement of its own; return the sonars that show their cones free.

        One whose sonars can't be told apart, or contradict it, shows nothing.
        """
        if samples is not None:
            self._note(list(samples), taken_at)
        return self.free(taken_at)

    def _note(self, found: list[SonarSample], taken_at: float) -> None:
        if len(found) != len(self._sonars):
            self._heard = [_Heard() for _ in self._sonars]
            return
        for sample, sonar, heard in zip(found, self._sonars, self._heard, strict=True):
            if sample.explained:
                heard.robot_at = taken_at
                continue
            heard.near = sample.state == "blocked"
            measured = sample.range_m
            hears_wall = sample.state == "clear" and measured is not None and sonar.range_max is not None
            if not hears_wall:
                heard.since, heard.wall_at = math.inf, -math.inf
                continue
            if heard.since == math.inf or not _is_fresh(heard, taken_at):
                heard.since = taken_at
            heard.wall_at = taken_at

    def free(self, now: float) -> frozenset[int]:
        """Return the sonars that show their cones free now."""
        return frozenset(
            index
            for index, heard in enumerate(self._heard)
            if heard.wall_at - heard.since >= FREE_AFTER_S and _is_fresh(heard, now)
        )

    @property
    def near(self) -> list[int]:
        """The sonars that hear something near that is no robot."""
        return [index for index, heard in enumerate(self._heard) if heard.near]


def _is_fresh(heard: _Heard, now: float) -> bool:
    held = heard.robot_at if heard.robot_at - heard.wall_at <= HELD_S else -math.inf
    return now - max(heard.wall_at, held) <= FRESH_S


class Watcher(Protocol):
    """What watches an area (`node_state.NodeState`)."""

    site: NodeSite | None
    state: AreaState
    reason: Reason
    free: frozenset[int]
    far_wall: FarWall

    @property
    def penalty(self) -> int | None:
        """The cost of the area while it is blocked; None: impassable."""


def free_sonars(
    definition: AreaDefinition, nodes: Mapping[str, Watcher], before: FreeSonars, cones: Cones
) -> FreeSonars:
    """Return the sonars that show parts of a blocked area free; none in any doubt.

    Where another sonar hears something near, along its axis, one may have heard the wall past that thing.

    All that watches the area must be known, and each node that is blocked must see something now: else the obstacle may
    be anywhere. A sonar that shows nothing any more counts at once; others are added only when none is lost, so that
    each change is either a danger or a relief. `before`: those of the last time, none if the area was not blocked then.
    """
    if definition.free_width is None:
        return frozenset()
    free: set[tuple[str, int]] = set()
    near: list[list[Point]] = []
    for name, node in nodes.items():
        if node.site is None or node.penalty is not None or not _is_known(node):
            return frozenset()
        if node.state == "blocked" and not node.far_wall.near:
            return frozenset()
        free.update((name, index) for index in node.free)
        near += [cones[name][index] for index in node.far_wall.near if name in cones]
    axes = {each: _axis(nodes[each[0]].site, each[1], cones) for each in free}
    area = [definition.polygon]
    found = frozenset(each for each, axis in axes.items() if _meets(axis, area) and not _meets(axis, near))
    return enough(found & before if before - found else found, nodes)


def _axis(site: NodeSite | None, sonar: int, cones: Cones) -> list[Point]:
    """Return points along the middle of what a sonar sees, 0.1 m apart; none of one whose cone is not known."""
    if site is None or site.id not in cones:
        return []
    theta = site.theta + site.sonars[sonar].angle
    reach = max(math.dist((site.x, site.y), corner) for corner in cones[site.id][sonar])
    steps = [_STEP_M * step for step in range(1, int(reach / _STEP_M) + 1)]
    return [(site.x + step * math.cos(theta), site.y + step * math.sin(theta)) for step in steps]


def _meets(line: Iterable[Point], outlines: Sequence[Sequence[Point]]) -> bool:
    return any(contains_point(outline, x, y) for x, y in line for outline in outlines)


def _is_known(node: Watcher) -> bool:
    return node.state != "unknown" or (node.reason.code == NodeCode.ROBOT_STAYS and bool(node.free))


def enough(free: FreeSonars, nodes: Mapping[str, Watcher]) -> FreeSonars:
    """Return the sonars if they are enough to show anything, else none."""
    sites = [(nodes[name].site, index) for name, index in free]
    exact = any(site is not None and site.sonars[index].time_of_flight for site, index in sites)
    return free if exact or len(free) >= FEWEST_SONARS else frozenset()


def outlines(free: FreeSonars, cones: Cones) -> list[list[Point]]:
    """Return what these sonars see; nothing of a node whose cones are not known."""
    return [cones[name][index] for name, index in sorted(free) if name in cones]
