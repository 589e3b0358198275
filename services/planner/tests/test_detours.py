"""Bounds that searches share: who computes them, for whom, and that paths cost what they cost without."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from msgspec import structs
from ring_map import Box, RingMap, goal, pose

from fog_contracts import channels as ch
from fog_contracts.handlers import Moment
from fog_kernels.astar import Planner
from fog_kernels.steps import SEALED
from planner.config import PlannerConfig
from planner.core import PlannerCore
from planner.heuristics import DeadEndsJob, Detours, GoalFields
from planner.missions import SwitchLimiter
from planner.path_search import PathSearch

if TYPE_CHECKING:
    from fog_kernels.guides import Detour

WALLS = ((2.0, 2.0, 18.0, 5.0), (2.0, 7.0, 18.0, 10.0))
"""Leave three corridors from left to right."""
ROOM_WALLS = (
    WALLS[0], (2.0, 7.0, 7.0, 10.0), (13.0, 7.0, 18.0, 10.0), (7.0, 9.7, 13.0, 10.0), (7.0, 7.0, 9.3, 7.3),
    (10.3, 7.0, 13.0, 7.3),
)  # fmt: skip
"""The same, with a room in the upper wall, whose door leads to the middle corridor."""
MIDDLE = (14.0, 5.0, 15.0, 7.0)
AT = Moment(1.0, 1.0)


class Fleet:
    """Robots in the middle corridor, with goals on the right."""

    def __init__(self, robots: int, detour_searches: int = 3, walls: tuple[Box, ...] = WALLS) -> None:
        self.map = RingMap(walls=walls)
        self.core = PlannerCore(1, PlannerConfig(quick_expansions=200, detour_searches=detour_searches))
        self.core.load(self.map.master.snapshot(), 0.0)
        for number in range(robots):
            robot = f"r{number}"
            thin = structs.replace(pose(4.0 + 1.2 * number, 6.0), radius=0.01)  # so that none is in another one's way
            self.core.handlers()[ch.ROBOT_POSE]({"robot": robot}, thin, AT)
            self.core.set_goal(robot, goal(19.0, 4.0 + 0.5 * number, f"g{number}"))
        self.core.handlers()[ch.MAP_HEARTBEAT]({}, self.map.master.heartbeat(0.0), AT)
        self.first_jobs = self.core.jobs(AT)
        self.memory = np.empty(0, np.int32)
        """What was made for the first bound, when its dead ends were searched."""
        for job in self.first_jobs:
            job.run()
            if isinstance(job, DeadEndsJob) and job.memory is not None:
                self.memory = job.memory
            self.core.add(job, AT.now)
        self.core.tick(AT)

    def change(self, *, blocked: bool) -> list[str]:
        """Block the middle corridor, or clear it; return the robots in the order of their searches."""
        deltas = self.map.put("middle", MIDDLE) if blocked else self.map.clear("middle")
        for delta in deltas:
            self.core.handlers()[ch.MAP_DELTA]({}, delta, AT)
        return list(self.core.plan(AT))

    def costs(self) -> list[float]:
        """Return the costs of the planned paths."""
        found = []
        for _, mission in self.core.missions.active():
            assert mission.plan is not None
            assert mission.plan.route is not None
            found.append(mission.plan.route.cost(self.map.cost(), self.map.geometry))
        return found


def test_searches_behind_one_closure_share_a_bound_and_cost_what_they_cost_alone() -> None:
    fleet, alone = Fleet(6), Fleet(6, detour_searches=100)
    for each in (fleet, alone):
        assert len(each.change(blocked=True)) == 6
    assert fleet.core.replanner.detours.computed == 1
    assert alone.core.replanner.detours.computed == 0
    assert fleet.costs() == pytest.approx(alone.costs(), rel=0.02)  # straightened within 1 % of the optimum


def test_ways_are_compared_with_moved_corners_however_many_wait() -> None:
    fleet, alone = Fleet(6), Fleet(6, detour_searches=100)
    for each in (fleet, alone):
        each.change(blocked=True)
        for _, mission in each.core.missions.active():
            mission.switches = SwitchLimiter()  # as after a while
        assert len(each.change(blocked=False)) == 6
    assert fleet.costs() == pytest.approx(alone.costs(), rel=1e-6)


def test_bound_is_forgotten_when_a_cost_falls() -> None:
    fleet = Fleet(6)
    fleet.change(blocked=True)
    geometry = fleet.map.geometry
    trip = geometry.cell(10.0, 6.0), geometry.cell(19.0, 5.0)
    assert fleet.core.replanner.detours.guide(*trip) is not None
    fleet.change(blocked=False)
    assert fleet.core.replanner.detours.guide(*trip) is None


def test_bound_leaves_out_rooms_and_is_forgotten_when_one_of_their_doors_is_raised() -> None:
    fleet = Fleet(6, walls=ROOM_WALLS)
    fleet.change(blocked=True)
    geometry, detours = fleet.map.geometry, fleet.core.replanner.detours
    trip = geometry.cell(10.0, 6.0), geometry.cell(19.0, 5.0)
    known = detours.guide(*trip)
    assert known is not None
    column, row = geometry.cell(11.0, 9.3)
    assert known.costs[row, column] == SEALED
    assert detours.guide((column, row), trip[1]) is None
    for place, is_known in (((11.0, 8.5, 11.2, 8.7), True), ((9.4, 7.1, 9.6, 7.3), False)):
        for delta in fleet.map.put("small", place):
            fleet.core.handlers()[ch.MAP_DELTA]({}, delta, AT)
        assert (detours.guide(*trip) is known) == is_known


def test_dead_ends_of_outdated_costs_are_not_used() -> None:
    fields = GoalFields(10**6)
    costs = RingMap(walls=ROOM_WALLS).cost()
    fields.set_bounds(costs, costs)
    detours = Detours(fields)
    (outdated,) = detours.jobs()
    assert detours.jobs() == []
    fields.set_bounds(costs, costs.copy())
    (current,) = detours.jobs()
    for job in (current, outdated):
        job.run()
        detours.add(job)
    assert detours.dead_ends is current.found
    fields.set_bounds(costs, costs.copy())
    assert detours.dead_ends is None


def compute(fleet: Fleet) -> Detour:
    """Return a new bound for the fleet's robots."""
    geometry, detours, view = fleet.map.geometry, fleet.core.replanner.detours, fleet.core.view()
    assert view is not None
    trips = [(geometry.cell(4.0 + 1.2 * number, 6.0), geometry.cell(19.0, 4.0 + 0.5 * number)) for number in range(6)]
    detours.compute(view.planning_map, Planner(geometry.width, geometry.height), trips)
    found = detours.guide(*trips[0])
    assert found is not None
    return found


def test_first_bound_takes_the_memory_that_was_made_with_the_dead_ends() -> None:
    fleet = Fleet(6)
    assert fleet.memory.size == fleet.map.cost().size
    fleet.change(blocked=True)
    geometry = fleet.map.geometry
    known = fleet.core.replanner.detours.guide(geometry.cell(10.0, 6.0), geometry.cell(19.0, 5.0))
    assert known is not None
    assert np.shares_memory(known.costs, fleet.memory)


def test_bound_in_the_memory_of_a_forgotten_one_has_nothing_left_of_it() -> None:
    fleet = Fleet(6, detour_searches=100)
    fleet.change(blocked=True)
    forgotten = compute(fleet)
    expected = forgotten.costs.copy()
    forgotten.costs[:] += 1  # where it is not cleaned, it would be another bound
    fleet.core.replanner.detours.clear()
    found = compute(fleet)
    assert np.shares_memory(found.costs, forgotten.costs)
    assert np.array_equal(found.costs, expected)


def test_bounds_that_hold_share_no_memory() -> None:
    fleet = Fleet(6, detour_searches=100)
    fleet.change(blocked=True)
    first = compute(fleet)
    expected = first.costs.copy()
    second = compute(fleet)
    assert second is not first
    assert not np.shares_memory(first.costs, second.costs)
    assert np.array_equal(first.costs, expected)


def test_few_robots_have_no_dead_ends_searched() -> None:
    fleet = Fleet(3)
    assert not any(isinstance(job, DeadEndsJob) for job in fleet.first_jobs)
    assert any(isinstance(job, DeadEndsJob) for job in Fleet(4).first_jobs)


def test_robot_nearest_to_the_danger_is_searched_first_and_refused_ones_last() -> None:
    fleet = Fleet(3)
    for delta in fleet.map.put("goal", (18.5, 3.5, 19.5, 4.2)):  # around the goal of the first robot
        fleet.core.handlers()[ch.MAP_DELTA]({}, delta, AT)
    list(fleet.core.plan(AT))
    refused = fleet.core.missions.of("r0").plan
    assert refused is not None
    assert refused.refusal is not None
    fleet.core.missions.of("r0").request_replan("refused", [])
    assert fleet.change(blocked=True) == ["r2", "r1", "r0"]


@pytest.mark.parametrize("seed", range(8))
def test_paths_guided_by_a_shared_bound_are_as_short_as_those_of_a_full_search(seed: int) -> None:
    rng = np.random.default_rng(seed)
    fleet = Fleet(6, walls=ROOM_WALLS if seed % 2 else WALLS)
    x, y = rng.uniform(3.0, 16.0), rng.uniform(1.0, 9.0)
    for delta in fleet.map.put("any", (x, y, x + rng.uniform(0.5, 3.0), y + rng.uniform(0.5, 3.0))):
        fleet.core.handlers()[ch.MAP_DELTA]({}, delta, AT)
    fleet.change(blocked=True)
    geometry, cost = fleet.map.geometry, fleet.map.cost()
    search = PathSearch(PlannerConfig(), geometry)
    for _, mission in fleet.core.missions.active():
        assert mission.pose is not None
        assert mission.target is not None
        assert mission.plan is not None
        start = geometry.cell(mission.pose.x, mission.pose.y)
        found = search.planner.plan(cost, start, geometry.cell(mission.target.x, mission.target.y))
        route = mission.plan.route
        assert math.isinf(found.cost) == (route is None)
        if route is not None:
            # Ends are exact points instead of cells, and the hysteresis keeps a path that costs up to 3 % more.
            assert route.cost(cost, geometry) <= 1.05 * found.cost + 200.0
