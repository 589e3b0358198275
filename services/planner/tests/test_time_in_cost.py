"""Paths cost the time that speed limits take: what a cell costs, that searches stay exact, and which way is taken."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ring_map import LEFT, RIGHT, RingMap, goal, pose

from fog_contracts import channels as ch
from fog_contracts.costs import DEFAULT_INFLATION, INSCRIBED
from fog_contracts.grid import GridGeometry, Window
from fog_contracts.handlers import Moment
from fog_contracts.replica import MasterMap
from fog_kernels.astar import Planner
from fog_kernels.inflation import inflate, inflation_table
from planner.config import PlannerConfig
from planner.core import PlannerCore
from planner.planning_map import with_time

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.messages import Layer, MapDelta
    from fog_kernels.guides import Detour, GoalField
    from planner.path_search import Route

    Grid = NDArray[np.uint8]
    Cell = tuple[int, int]

STEPS = [step for step in itertools.product((-1, 0, 1), repeat=2) if step != (0, 0)]


def test_limit_costs_the_free_cells_that_a_robot_would_drive_meanwhile_and_closes_and_opens_nothing() -> None:
    limits = np.array([0, 15, 10, 6, 1, 29, 30, 254], np.uint8)
    costs = np.array([0, 40, 100, 252, 253, 254, 255], np.uint8)
    cost, speed = np.repeat(costs[:, np.newaxis], len(limits), 1), np.repeat(limits[np.newaxis], len(costs), 0)
    timed = with_time(cost, speed).astype(int)
    weight, before = 50.0 + 0.8 * timed, 50.0 + 0.8 * cost
    assert weight[0] == pytest.approx([50.0, 100.0, 150.0, 250.0, 251.6, 51.7, 50.0, 50.0], abs=0.5)
    assert (weight - before)[1] == pytest.approx([0.0, 50.0, 100.0, 169.6, 169.6, 1.7, 0.0, 0.0], abs=0.5)
    assert (timed[4:] == cost[4:]).all()
    assert ((timed >= cost) & ((timed < INSCRIBED) == (cost < INSCRIBED))).all()


def cheapest(cost: Grid, start: Cell) -> NDArray[np.float64]:
    """Return the cost of the cheapest way from a cell to each, by relaxing all steps until none saves anything."""
    weight = np.pad(np.where(cost < INSCRIBED, np.rint(50.0 + 0.8 * cost), np.inf), 1, constant_values=np.inf)
    height, width = cost.shape
    edges = []
    for dx, dy in STEPS:
        there = np.s_[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]
        edge = (1.0 if 0 in (dx, dy) else 577 / 408) * (weight[1:-1, 1:-1] + weight[there]) / 2.0
        corners = weight[1 + dy : 1 + dy + height, 1:-1] + weight[1:-1, 1 + dx : 1 + dx + width]
        edges.append((there, np.where(np.isinf(corners), np.inf, edge)))
    found = np.full(weight.shape, np.inf)
    found[start[1] + 1, start[0] + 1] = 0.0
    inner, before = found[1:-1, 1:-1], np.zeros(cost.shape)
    while not np.array_equal(inner, before):
        before = inner.copy()
        for there, edge in edges:
            np.minimum(inner, found[there] + edge, out=inner)
    return inner


class Floor:
    """A random floor with a robot, whose speed limits and hazards change at random."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        width, height = self.rng.integers(6, 24, 2).tolist()
        self.geometry, self.now = GridGeometry(width, height, 0.1, 0.0, 0.0), 0.0
        walls = self.rng.random((height, width)) < self.rng.choice((0.0, 0.01, 0.04))
        static = np.where(walls, 254, 0).astype(np.uint8)
        self.floor = inflate(static, inflation_table(0.1, DEFAULT_INFLATION))
        self.master = MasterMap("test", self.geometry, static, self.floor, 1)
        for _ in range(self.rng.integers(3)):
            self.change()  # before the planner begins
        self.core = PlannerCore(1, PlannerConfig(standing_s=2.0))
        self.core.load(self.master.snapshot(), 0.0)
        free = np.argwhere(self.floor < INSCRIBED)
        chosen = free[self.rng.integers(len(free), size=2)][:, ::-1].tolist() if len(free) else [(0, 0), (0, 0)]
        self.start, self.goal = ((int(x), int(y)) for x, y in chosen)
        self.core.set_goal("r1", goal(*self.geometry.centre(*self.goal)))

    def change(self) -> list[MapDelta]:
        """Change limits and costs in random windows; no cost falls below the floor's."""
        changes: list[tuple[Layer, Window, Grid]] = []
        for _ in range(self.rng.integers(1, 4)):
            (x, w), (y, h) = (
                (int(low), int(high - low))
                for low, high in (
                    np.sort(self.rng.choice(side + 1, 2, replace=False)) for side in self.geometry.shape[::-1]
                )
            )
            window = Window(x, y, w, h)
            values = (0, 1, 5, 10, 15, 29, 60) if self.rng.random() < 0.5 else (0, 60, 200, 254)
            cells = np.full((h, w), self.rng.choice(values), np.uint8)
            if len(values) == 4:
                changes.append(("cost", window, np.maximum(cells, self.floor[window.rows, window.columns])))
            else:
                changes.append(("speed", window, cells))
        return self.master.write(changes, [], [])

    def step(self, deltas: list[MapDelta]) -> None:
        """Let the planner follow the map, plan, and compute all that guides its searches."""
        self.now += 1.5
        at = Moment(self.now, 1e9 + self.now)
        for delta in deltas:
            self.core.handlers()[ch.MAP_DELTA]({}, delta, at)
        self.core.handlers()[ch.MAP_HEARTBEAT]({}, self.master.heartbeat(self.now), at)
        self.core.handlers()[ch.ROBOT_POSE]({"robot": "r1"}, pose(*self.geometry.centre(*self.start)), at)
        self.core.tick(at)
        for _ in range(4):
            for job in self.core.jobs(at):
                job.run()
                self.core.add(job, self.now)

    def timed(self) -> Grid:
        """Return what each cell must cost, by the definition: a robot reaches 0.17 m each way, two cells."""
        cost, speed = self.master.layers["cost"], np.pad(self.master.layers["speed"], 2)
        speed = np.where(speed == 0, 255, speed)
        cells = []
        for row, column in np.ndindex(cost.shape):
            c, v = int(cost[row, column]), int(speed[row : row + 5, column : column + 5].min())
            cells.append(c if c >= INSCRIBED or v >= 30 else min(252, round(c + 62.5 * (30 / v - 1.0))))
        return np.array(cells, np.uint8).reshape(cost.shape)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_path_costs_what_dijkstra_finds_whatever_speeds_and_hazards_come_and_go(seed: int) -> None:
    floor = Floor(seed)
    planner = Planner(floor.geometry.width, floor.geometry.height)
    for number in range(5):
        floor.step(floor.change() if number else [])
        view = floor.core.view()
        assert view is not None
        cost = view.planning_map.cost
        assert np.array_equal(cost, floor.timed())
        if cost[floor.goal[1], floor.goal[0]] >= INSCRIBED or cost[floor.start[1], floor.start[0]] >= INSCRIBED:
            continue
        expected = float(cheapest(cost, floor.start)[floor.goal[1], floor.goal[0]])
        field, origin = view.fields.get(floor.goal), view.fields.get(floor.start)
        there, detours = (floor.start, floor.goal), floor.core.replanner.detours
        detours.compute(view.planning_map, planner, [there])
        ways: list[tuple[tuple[Cell, Cell], GoalField | None, Detour | None]] = [(there, None, None)]
        if field is not None:
            ways += [(there, field, None), (there, field, detours.guide(*there))]
        if origin is not None and (back := origin.toward(floor.start)) is not None:
            ways.append((there[::-1], back, None))
        for trip, guide, detour in ways:
            found = planner.plan(cost, *trip, 0, guide, detour, view.landmarks if guide is None else None)
            assert found.found == math.isfinite(expected)
            assert not found.found or found.cost == pytest.approx(expected, abs=1e-6)


def route_of(slow_m: float, *, time_in_cost: bool = True, late: bool = False) -> Route:
    """Return the way round the ring, whose upper, shorter half is limited to 0.1 m/s for `slow_m`.

    `late`: that happens when the robot has its path already.
    """
    ring, now = RingMap(), 0.0
    window = ring.geometry.window_around(9.0, 10.0, 9.0 + slow_m - 1e-6, 12.0)
    core = PlannerCore(1, PlannerConfig(time_in_cost=time_in_cost))
    core.set_goal("r1", goal(*RIGHT))
    core.load(ring.master.snapshot(), now)
    for begins in (not late, True):
        at = Moment(now, 1e9 + now)
        if begins:
            cells = np.full((window.height, window.width), 10, np.uint8)
            for delta in ring.master.write([("speed", window, cells)], [], []):
                core.handlers()[ch.MAP_DELTA]({}, delta, at)
        core.handlers()[ch.MAP_HEARTBEAT]({}, ring.master.heartbeat(now), at)
        core.handlers()[ch.ROBOT_POSE]({"robot": "r1"}, pose(*LEFT), at)
        core.tick(at)
    plan = core.missions.of("r1").plan
    assert plan is not None
    assert plan.route is not None
    return plan.route


@pytest.mark.parametrize("late", [False, True])
def test_slow_place_is_gone_round_only_if_that_is_quicker(*, late: bool) -> None:
    # The lower half is about 4 m longer, 13 s; a metre at 0.1 m/s costs 6.7 s.
    assert route_of(1.0, late=late).corners[:, 1].max() > 10.0, "7 s through it"
    assert route_of(4.0, late=late).corners[:, 1].max() < 10.0, "27 s through it"
    assert route_of(8.0, time_in_cost=False, late=late).corners[:, 1].max() > 10.0, "the setting is off"
