"""The modules of the planner's core, each on its own."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ring_map import LEFT, RIGHT, UPPER, Box, RingMap, goal, pose

from fog_contracts import channels as ch
from fog_contracts.costs import DEFAULT_INFLATION, INSCRIBED
from fog_contracts.geometry import lengths_along
from fog_contracts.grid import GridGeometry
from fog_contracts.handlers import Moment
from fog_contracts.messages import (
    MAX_CELLS,
    MapDelta,
    PlanRefusal,
    PointXY,
    RectangleShape,
    Refusal,
    Trace,
    Zone,
    ZoneSet,
)
from fog_contracts.replica import Version
from fog_contracts.shapes import rasterize_shape
from fog_kernels.astar import Planner
from fog_kernels.inflation import inflate, inflation_table
from fog_kernels.lines import line_cost
from planner.config import PlannerConfig
from planner.field_jobs import FieldJob
from planner.heuristics import GoalFields
from planner.missions import Mission, Plan
from planner.path_search import PathSearch, Route, SearchResult, find_egress
from planner.planning_map import CostChange, MapTracker, PlanningMap
from planner.refusals import refuse
from planner.regions import BlockedRegions, Region, Regions
from planner.replanner import distance_to_change, is_kept, reason_from_pose, remaining_cost

CONFIG = PlannerConfig()
TRACE = Trace(area="z1", epoch=1, seq=5)
NOW = Moment(100.0, 5000.0)


def make_tracker(ring_map: RingMap) -> MapTracker:
    tracker = MapTracker(DEFAULT_INFLATION, grace_s=0.5, max_age_s=1.0, standing_s=60.0)
    tracker.load(ring_map.master.snapshot(), 0.0)
    return tracker


def current(tracker: MapTracker) -> PlanningMap:
    assert tracker.current is not None
    return tracker.current


def plan(*corners: PointXY, progress: float = 0.0) -> Plan:
    route = Route(np.array(corners), 0.1)
    return Plan(1, route, None, [], planned_from=corners[0], progress=progress)


def straight(plan_with_route: Plan) -> Route:
    assert plan_with_route.route is not None
    return plan_with_route.route


def change(box: Box, *, decreased: bool = False) -> CostChange:
    window = RingMap().geometry.window_around(*box[:2], box[2] - 1e-6, box[3] - 1e-6)
    cells = np.ones((window.height, window.width), dtype=np.bool_)
    return CostChange(window, cells, cells & decreased, [TRACE])


# --- A route ---


def test_robot_is_looked_for_near_its_progress_and_on_the_whole_route_where_it_has_no_such_part() -> None:
    route = Route(np.array(((0.0, 0.0), (10.0, 0.0), (10.0, 1.0), (0.0, 1.0))), 0.1)
    assert route.nearest(3.0, 0.9) == pytest.approx((18.0, 0.1))
    assert route.nearest(3.0, 0.9, after=2.0, window=5.0) == pytest.approx((3.0, 0.9))
    assert route.nearest(3.0, 0.9, after=4.0, window=5.0) == pytest.approx((3.5, math.hypot(0.5, 0.9)))
    assert route.nearest(3.0, 0.0, after=30.0, window=5.0) == pytest.approx((3.0, 0.0))


@settings(deadline=None)
@given(
    st.lists(st.tuples(*2 * [st.floats(-0.9, 2.9).map(lambda value: round(value, 2))]), min_size=2, max_size=6),
    st.floats(-1.0, 15.0), st.integers(0, 1), st.integers(0, 2**16),
)  # fmt: skip
def test_cost_of_a_route_is_that_of_the_lines_that_remain(
    corners: list[PointXY], along: float, escape_lines: int, seed: int
) -> None:
    geometry = GridGeometry(40, 40, 0.1, -1.0, -1.0)
    costmap = np.random.default_rng(seed).choice(
        np.array((0, 30, 252, 254), np.uint8), (40, 40), p=(0.6, 0.2, 0.19, 0.01)
    )
    route = Route(np.array(corners), 0.1, escape_lines)
    begin = max(along, float(lengths_along(route.corners)[escape_lines]))
    places = geometry.grid_coordinates(route.remaining(begin)).tolist()
    expected = sum(line_cost(costmap, *first, *second) for first, second in pairwise(places))
    assert route.cost(costmap, geometry, along) == expected


def test_route_without_length_is_as_near_as_its_only_point() -> None:
    assert Route(np.array(((1.0, 2.0), (1.0, 2.0))), 0.1).nearest(4.0, 6.0) == (0.0, 5.0)


# --- The map ---


# --- Path monitor ---


@pytest.mark.parametrize(("side", "affected"), [(0.6, True), (1.0, False)])
def test_change_beside_the_path_affects_it_within_the_corridor(side: float, affected: bool) -> None:  # noqa: FBT001  # a parameter of pytest
    along = plan((1.0, 1.0), (9.0, 1.0))
    planning_map = current(make_tracker(RingMap()))
    beside = change((4.0, 1.0 + side, 4.2, 1.2 + side))
    distance = distance_to_change(along, straight(along), beside, planning_map, CONFIG.corridor_half_width)
    assert math.isfinite(distance) == affected


def test_change_behind_the_robot_does_not_affect_its_path() -> None:
    planning_map = current(make_tracker(RingMap()))
    behind = change((2.0, 0.9, 2.2, 1.1))
    for progress, affected in ((0.0, True), (3.0, False)):
        driven = plan((1.0, 1.0), (9.0, 1.0), progress=progress)
        distance = distance_to_change(driven, straight(driven), behind, planning_map, CONFIG.corridor_half_width)
        assert math.isfinite(distance) == affected


def test_refused_robot_is_replanned_once_it_has_moved() -> None:
    refused = Plan(1, None, refuse(208, PlanRefusal.CUT_OFF, "cut"), [], planned_from=(1.0, 1.0))
    assert reason_from_pose(refused, pose(1.9, 1.0), CONFIG) is None
    assert reason_from_pose(refused, pose(2.1, 1.0), CONFIG) == "refused"


# --- Replan policy ---


def found(cost: float = math.inf, refusal: Refusal | None = None) -> SearchResult:
    return SearchResult(None, lambda: cost, refusal)


def test_path_is_kept_unless_another_saves_the_share_that_the_reason_requires() -> None:
    planning_map = current(make_tracker(RingMap()))
    kept = plan((1.0, 1.0), (9.0, 1.0))
    cost = straight(kept).cost(planning_map.cost, planning_map.geometry)

    def keeps(share: float, reason: str) -> bool:
        return is_kept(kept, found(cost * share), reason, cost, CONFIG)

    assert keeps(0.98, "map")
    assert not keeps(0.96, "map")
    assert keeps(0.91, "clearing")
    assert not keeps(0.89, "clearing")
    assert not keeps(1.0, "goal")
    assert not keeps(1.0, "off_path")


def test_blocked_path_is_replaced_and_a_refusal_is_kept_while_it_is_the_same() -> None:
    planning_map = current(make_tracker(RingMap()))
    through_the_wall = plan((1.0, 6.0), (19.0, 6.0))
    assert not is_kept(through_the_wall, found(1e9), "map", remaining_cost(through_the_wall, planning_map), CONFIG)
    refused = Plan(1, None, refuse(208, PlanRefusal.CUT_OFF, "cut by z1"), [], planned_from=LEFT)
    assert is_kept(refused, found(refusal=refuse(208, PlanRefusal.CUT_OFF, "cut by z1")), "map", math.inf, CONFIG)
    assert not is_kept(refused, found(refusal=refuse(208, PlanRefusal.CUT_OFF, "cut by z2")), "map", math.inf, CONFIG)
    assert not is_kept(refused, found(100.0), "map", math.inf, CONFIG)


# --- Mission ---


def test_traces_are_stamped_when_the_path_is_first_published_and_never_again() -> None:
    mission = Mission()
    mission.begin(goal(*RIGHT), any_heading=False)
    mission.plan = plan(LEFT, (1.0, 9.0))
    mission.plan.traces = [TRACE]
    paths = [mission.due_path(Moment(now, 5000.0 + now), CONFIG, 7, Version(1, 2, 3)) for now in (1.0, 2.0)]
    assert [path.traces[0].plan_published for path in paths if path] == [5001.0, 5001.0]


# --- Goal fields ---

BOUND = np.zeros((12, 20), dtype=np.uint8)


def run(fields: GoalFields, job: FieldJob) -> None:
    job.run()
    fields.add(job)


def test_fields_guide_on_until_the_risen_costs_have_theirs_and_one_over_the_walls_guides_after_a_fall() -> None:
    fields = GoalFields(10_000)
    fields.set_bounds(BOUND, BOUND)
    (job,) = fields.jobs([(3, 3)])
    run(fields, job)
    before = fields.guide((3, 3))
    risen = BOUND.copy()
    risen[2:9, 10] = 254
    fields.set_bounds(BOUND, risen)
    assert fields.guide((3, 3)) is before
    (job,) = fields.jobs([(3, 3)])
    run(fields, job)
    after = fields.guide((3, 3))
    assert after is not None
    assert before is not None
    behind = np.array([5 * 20 + 15])
    assert after.costs(behind) > before.costs(behind)
    assert fields.jobs([(3, 3)]) == []
    fields.set_bounds(BOUND, BOUND.copy())
    fallback = fields.guide((3, 3))
    assert fallback is not None
    assert fallback.costs(behind) == before.costs(behind)
    planner = Planner(20, 12)
    assert planner.plan(BOUND, (15, 5), (3, 3), field=fallback).cost == planner.plan(BOUND, (15, 5), (3, 3)).cost
    assert [again.goal for again in fields.jobs([(3, 3)])] == [(3, 3)]


def test_standing_costs_rise_after_a_minute_fall_at_once_and_never_rise_above_a_fall_again() -> None:
    ring_map = RingMap()
    tracker = make_tracker(ring_map)
    tracker.settle(0.0)
    assert current(tracker).standing is current(tracker).lower_bound

    def change(deltas: list[MapDelta], now: float) -> bool:
        """Apply deltas; return whether the standing costs hold the zone a minute later."""
        for delta in deltas:
            tracker.on_delta(delta, now)
        assert np.all((current(tracker).standing <= current(tracker).cost) | (current(tracker).cost >= INSCRIBED))
        tracker.settle(now + 50.0)
        tracker.settle(now + 110.0)
        column, row = ring_map.geometry.cell(10.0, 11.0)
        return bool(current(tracker).standing[row, column] == 254)

    assert change(ring_map.put("zone", UPPER), 100.0)
    assert not change(ring_map.clear("zone"), 300.0)
    assert not change(ring_map.put("zone", UPPER), 500.0)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 2), st.booleans(), st.integers(0, 90)), max_size=20))
def test_standing_costs_never_exceed_the_map_whatever_comes_and_goes(steps: list[tuple[int, bool, int]]) -> None:
    ring_map = RingMap()
    tracker = make_tracker(ring_map)
    now = 0.0
    for number, put, seconds in steps:
        name, box = f"z{number}", (4.0 + 4 * number, 9.0, 9.0 + 4 * number, 11.5)
        deltas = ring_map.put(name, box) if put else ring_map.clear(name) if name in ring_map.areas else []
        now += seconds
        for delta in deltas:
            tracker.on_delta(delta, now)
        tracker.settle(now)
        planning_map = current(tracker)
        free = planning_map.cost < INSCRIBED
        assert np.all(planning_map.standing[free] <= planning_map.cost[free])
        assert np.all(planning_map.lower_bound[free] <= planning_map.standing[free])


def test_field_over_an_outdated_lower_bound_is_not_computed_and_dropped() -> None:
    fields = GoalFields(10_000)
    fields.set_bounds(BOUND, BOUND)
    (job, late) = fields.jobs([(3, 3), (4, 4)])
    job.run()
    floor = BOUND.copy()
    fields.set_bounds(floor, floor)
    fields.add(job)
    run(fields, late)
    assert late.field is None
    assert fields.size == 0


def test_every_goal_has_a_field_within_the_bound_of_memory_and_a_goal_in_a_wall_gets_none() -> None:
    fields = GoalFields(2 * 1024)  # half of it for patterns: one, where a field has two
    walled = BOUND.copy()
    walled[5, 5] = 254
    fields.set_bounds(walled, walled)
    assert fields.jobs([(5, 5)]) == []
    (first,) = fields.jobs([(1, 1)])
    run(fields, first)
    assert fields.size == 4 * BOUND.size
    goals = [(1, 1), *((x, 2) for x in range(2, 14))]
    for job in fields.jobs(goals):
        run(fields, job)
        assert fields.size <= 2 * 1024
    assert all(fields.guide(goal) is not None for goal in goals)
    assert fields.fields.keys() == set(goals)


def test_fields_of_goals_that_ended_make_room_for_new_ones() -> None:
    rng = np.random.default_rng(2)
    bound = rng.integers(0, 253, (64, 64)).astype(np.uint8)  # no tile is like another
    fields = GoalFields(2 * 24 * 1024)  # patterns of one field and a half
    fields.set_bounds(bound, bound)
    for goal_cell in ((1, 1), (60, 2), (30, 60)):
        (job,) = fields.jobs([goal_cell])
        run(fields, job)
        assert fields.exact.keys() == {goal_cell}
        assert fields.size <= 2 * 24 * 1024


def test_origins_get_fields_one_after_another_once_the_goals_have_theirs_and_only_as_long_as_they_fit() -> None:
    fields = GoalFields(30_000)
    fields.set_bounds(BOUND, BOUND)
    (job,) = fields.jobs([(3, 3)], [(4, 4), (5, 5)])
    assert fields.jobs([(3, 3)], [(4, 4), (5, 5)]) == []
    run(fields, job)
    for cell in ((4, 4), (5, 5)):
        (job,) = fields.jobs([(3, 3)], [(4, 4), (5, 5)])
        assert job.goal == cell
        run(fields, job)
    assert fields.exact.keys() == {(3, 3), (4, 4), (5, 5)}
    rng = np.random.default_rng(2)
    bound = rng.integers(0, 253, (64, 64)).astype(np.uint8)  # no tile is like another
    fields = GoalFields(2 * 24 * 1024)  # patterns of one field and a half
    fields.set_bounds(bound, bound)
    for _ in range(2):
        for job in fields.jobs([(1, 1)], [(60, 2)]):
            run(fields, job)
    assert fields.jobs([(1, 1)], [(60, 2)]) == []
    assert fields.exact.keys() == {(1, 1)}


def test_landmarks_are_added_while_no_goal_waits_and_begin_anew_when_a_cost_falls_below_the_floor() -> None:
    fields = GoalFields(10_000, landmark_capacity=10_000)
    fields.set_bounds(BOUND, BOUND)
    (goal_job,) = fields.jobs([(3, 3)])
    assert fields.landmark_jobs() == []
    run(fields, goal_job)
    known = fields.landmarks
    assert known is not None
    while jobs := fields.landmark_jobs():
        assert fields.landmark_jobs() == []
        jobs[0].run()
        fields.add_landmark(jobs[0])
    assert known.is_complete
    assert known.fields
    fields.set_bounds(BOUND, BOUND + 1)
    assert fields.landmarks is known
    floor = BOUND.copy()
    fields.set_bounds(floor, floor)
    assert fields.landmarks is not None
    assert not fields.landmarks.fields


def test_planner_goes_on_without_landmarks_after_their_search_has_failed() -> None:
    fields = GoalFields(10_000, landmark_capacity=10_000)
    fields.set_bounds(BOUND + 1, BOUND + 1)
    (failed,) = fields.landmark_jobs()
    fields.add_landmark(failed)
    assert fields.landmark_jobs() == [], "it would fail again and again"
    fields.set_bounds(BOUND, BOUND)
    assert len(fields.landmark_jobs()) == 1, "another floor"


# --- Regions, search, egress ---


def sources(ring_map: RingMap, *names: str) -> BlockedRegions:
    known = BlockedRegions()
    for name in names:
        known.handlers()[ch.HAZARD]({"area": name}, ring_map.hazard_area(name), NOW)
    return known


def on(ring_map: RingMap, known: BlockedRegions) -> list[Region]:
    return Regions(DEFAULT_INFLATION).on(current(make_tracker(ring_map)), known.sources)


def zone_set(zones: list[Zone], *active: str) -> ZoneSet:
    return ZoneSet(epoch=1, seq=1, zones=zones, active=list(active))


def test_zone_in_force_that_is_not_on_the_map_yet_is_not_on() -> None:
    ring_map = RingMap()
    known = BlockedRegions()
    shape = RectangleShape(corner=(9.5, 10.5), opposite=(10.5, 11.5))
    known.handlers()[ch.ZONES]({}, zone_set([Zone(id="wet", kind="BLOCKED", shape=shape)], "wet"), NOW)
    assert on(ring_map, known) == []


def nothing(_x: float, _y: float, _margin: float) -> bool:
    return False


def test_search_beyond_its_limit_of_expansions_is_refused() -> None:
    ring_map = RingMap()
    search = PathSearch(PlannerConfig(max_expansions=10), ring_map.geometry)
    result = search.find(current(make_tracker(ring_map)), nothing, LEFT, RIGHT)
    assert result.refusal
    assert result.refusal.code == 207


@settings(max_examples=60, deadline=None)
@given(
    start=st.tuples(st.floats(0.4, 1.6), st.floats(0.4, 11.6)),
    end=st.tuples(st.floats(18.4, 19.6), st.floats(0.4, 11.6)),
)
def test_path_begins_and_ends_at_the_exact_points_and_its_cost_is_finite(start: PointXY, end: PointXY) -> None:
    planning_map = current(make_tracker(RingMap()))
    result = PathSearch(CONFIG, planning_map.geometry).find(planning_map, nothing, start, end)
    assert result.route is not None
    assert math.hypot(*(result.route.points[0] - start)) <= 0.08
    assert math.hypot(*(result.route.points[-1] - end)) <= 0.08
    assert math.isfinite(result.cost)


def test_egress_is_found_however_large_the_blocked_area_is() -> None:
    # 30 x 30 m at 5 cm: a search of 100 m2, as before, ends inside.
    geometry = GridGeometry(800, 800, 0.05, 0.0, 0.0)
    shape = RectangleShape(corner=(2.0, 2.0), opposite=(38.0, 38.0))
    zone = Zone(id="hall", kind="BLOCKED", shape=shape)
    window, mask = rasterize_shape(shape, geometry)
    raw = np.zeros(geometry.shape, np.uint8)
    raw[window.rows, window.columns][mask] = 254
    cost = inflate(raw, inflation_table(0.05, DEFAULT_INFLATION))
    static = np.zeros(geometry.shape, np.uint8)
    planning_map = PlanningMap(geometry, Version(1, 1, 1), cost, static, static, static)
    regions = Regions(DEFAULT_INFLATION).on(planning_map, [zone])
    out = find_egress(planning_map, regions, (18.0, 20.0), CONFIG, Planner(800, 800))
    assert out.route is not None
    x, y = out.route.corners[-1]
    column, row = geometry.cell(float(x), float(y))
    assert cost[row, column] < 253
    assert x < 2.0
    assert out.route.length == pytest.approx(16.2, abs=0.3)


def test_limit_of_a_search_lets_it_expand_every_cell_of_the_largest_map() -> None:
    assert PlannerConfig().max_expansions >= MAX_CELLS
