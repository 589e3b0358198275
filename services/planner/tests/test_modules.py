"""The modules of the planner's core, each on its own."""

import math
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import structs
from ring_map import LEFT, LOWER, RIGHT, UPPER, Box, RingMap, goal, pose

from fog_contracts import channels as ch
from fog_contracts.costs import DEFAULT_INFLATION, INSCRIBED
from fog_contracts.geometry import lengths_along
from fog_contracts.grid import GridGeometry
from fog_contracts.handlers import Moment
from fog_contracts.messages import (
    MAX_CELLS,
    WEEKDAYS,
    MapDelta,
    PointXY,
    RectangleShape,
    Refusal,
    RobotRelease,
    Trace,
    WeeklySchedule,
    WeeklyTime,
    Zone,
    ZoneSet,
)
from fog_contracts.replica import MapError, Version
from fog_contracts.shapes import rasterize_shape
from fog_kernels.astar import Planner
from fog_kernels.inflation import inflate, inflation_table
from fog_kernels.lines import line_cost
from planner.config import PlannerConfig
from planner.heuristics import FieldJob, GoalFields
from planner.missions import Mission, Plan
from planner.path_search import PathSearch, Route, SearchResult, find_egress
from planner.planning_map import CostChange, MapTracker, PlanningMap
from planner.refusals import refuse
from planner.regions import BlockedRegions, Region, Regions, cover
from planner.replanner import distance_to_change, effect_of_change, is_kept, may_save, reason_from_pose

CONFIG = PlannerConfig()
TRACE = Trace(area="z1", epoch=1, seq=5)
NOW = Moment(100.0, 5000.0)
ALWAYS = WeeklySchedule(time_zone="UTC", times=[WeeklyTime(days=list(WEEKDAYS), begin="00:00", end="00:00")])
NEVER = WeeklySchedule(time_zone="UTC", times=[WeeklyTime(days=["wed"], begin="03:00", end="03:01")])
TIMES: list[dict[str, Any]] = [
    {}, {"starts_at": 10.0}, {"starts_at": 1e9}, {"expires_at": 10.0}, {"expires_at": 1e9}, {"ttl_s": 1.0},
    {"schedule": ALWAYS}, {"schedule": NEVER},
]  # fmt: skip
"""Times of zones that, by the clock of `NOW`, have come, have not, or have passed."""


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


def test_delta_reports_which_costs_changed_and_which_decreased() -> None:
    ring_map = RingMap()
    tracker = make_tracker(ring_map)
    (delta,) = ring_map.put("z1", UPPER, trace=TRACE)
    (rise,) = tracker.on_delta(delta, 1.0)
    assert rise.changed.any()
    assert not rise.decreased.any()
    assert rise.traces == [TRACE]
    x, y = ring_map.geometry.cell(10.0, 11.0)
    assert rise.changed[y - rise.window.y, x - rise.window.x]
    (delta,) = ring_map.clear("z1")
    (fall,) = tracker.on_delta(delta, 1.1)
    assert np.array_equal(fall.decreased, fall.changed)
    assert tracker.on_delta(delta, 1.2) == []


def test_map_is_fresh_only_while_heartbeats_confirm_it() -> None:
    ring_map = RingMap()
    tracker = make_tracker(ring_map)
    assert not tracker.is_fresh(0.0)
    tracker.on_heartbeat(ring_map.master.heartbeat(0.0), 1.0)
    assert tracker.is_fresh(2.0)
    assert not tracker.is_fresh(2.1)


def test_lower_bound_is_replaced_only_when_costs_fall_below_it() -> None:
    ring_map = RingMap()
    tracker = make_tracker(ring_map)
    bound = current(tracker).lower_bound
    for delta in ring_map.put("z1", UPPER):
        tracker.on_delta(delta, 1.0)
    assert current(tracker).lower_bound is bound
    ring_map.static[:, :] = 0
    for delta in ring_map.put("z2", LOWER):
        tracker.on_delta(delta, 1.0)
    planning_map = current(tracker)
    assert planning_map.lower_bound is not bound
    assert np.all(planning_map.lower_bound <= planning_map.cost)


def test_snapshot_of_a_new_epoch_is_a_restart_and_a_damaged_one_changes_nothing() -> None:
    ring_map = RingMap()
    tracker = MapTracker(DEFAULT_INFLATION, grace_s=0.5, max_age_s=1.0, standing_s=60.0)
    assert tracker.current is None
    assert tracker.load(ring_map.master.snapshot(), 0.0).restarted
    assert not tracker.load(ring_map.master.snapshot(), 0.0).restarted
    with pytest.raises(MapError):
        tracker.load(structs.replace(ring_map.master.snapshot(), hash=1), 0.0)
    assert current(tracker).version == ring_map.master.version
    assert tracker.load(RingMap(epoch=2).master.snapshot(), 0.0).restarted


# --- Path monitor ---


@pytest.mark.parametrize(("side", "affected"), [(0.6, True), (1.0, False)])
def test_change_beside_the_path_affects_it_within_the_corridor(side: float, affected: bool) -> None:  # noqa: FBT001  # a parameter of pytest
    along = plan((1.0, 1.0), (9.0, 1.0))
    planning_map = current(make_tracker(RingMap()))
    beside = change((4.0, 1.0 + side, 4.2, 1.2 + side))
    distance = distance_to_change(along, straight(along), beside, planning_map, CONFIG.corridor_half_width)
    assert math.isfinite(distance) == affected


def test_distance_to_a_change_counts_from_the_robot_along_its_path() -> None:
    planning_map = current(make_tracker(RingMap()))
    on_path = change((6.0, 0.9, 6.2, 1.1))
    for progress in (0.0, 2.0):
        driven = plan((1.0, 1.0), (9.0, 1.0), progress=progress)
        distance = distance_to_change(driven, straight(driven), on_path, planning_map, CONFIG.corridor_half_width)
        assert distance == pytest.approx(5.0 - CONFIG.corridor_half_width - progress, abs=0.2)


def test_change_behind_the_robot_does_not_affect_its_path() -> None:
    planning_map = current(make_tracker(RingMap()))
    behind = change((2.0, 0.9, 2.2, 1.1))
    for progress, affected in ((0.0, True), (3.0, False)):
        driven = plan((1.0, 1.0), (9.0, 1.0), progress=progress)
        distance = distance_to_change(driven, straight(driven), behind, planning_map, CONFIG.corridor_half_width)
        assert math.isfinite(distance) == affected


def test_clearing_may_save_only_where_a_path_through_it_could_be_shorter() -> None:
    planning_map = current(make_tracker(RingMap()))
    # Around the ring's upper side, 1 m from the walls: through the middle of the ring it would be far shorter.
    around = plan((1.0, 6.0), (1.0, 11.0), (19.0, 11.0), (19.0, 6.0))
    direct = plan((1.0, 11.0), (19.0, 11.0))
    geometry = planning_map.geometry
    middle, far = geometry.window_around(9.0, 5.5, 11.0, 6.5), geometry.window_around(9.0, 0.2, 11.0, 0.4)
    assert may_save(around, straight(around), middle, planning_map, (1.0, 6.0), CONFIG.min_saving)
    assert not may_save(around, straight(around), middle, planning_map, (1.0, 6.0), 0.5)
    assert not may_save(direct, straight(direct), far, planning_map, (1.0, 11.0), CONFIG.min_saving)


def test_change_near_the_path_is_a_stronger_reason_than_a_clearing() -> None:
    planning_map = current(make_tracker(RingMap()))
    mission = Mission()
    on_path, inside = change((4.0, 0.9, 4.2, 1.1), decreased=True), change((9.0, 5.5, 11.0, 6.5), decreased=True)

    def reason(cause: CostChange) -> str | None:
        effect = effect_of_change(mission, cause, planning_map, CONFIG)
        return effect.reason if effect else None

    assert reason(on_path) is None
    mission.begin(goal(*RIGHT), any_heading=False)
    assert reason(on_path) is None
    mission.plan = plan((1.0, 6.0), (1.0, 1.0), (19.0, 1.0), (19.0, 6.0))
    assert reason(on_path) == "map"
    assert reason(inside) == "clearing"
    assert reason(change((9.0, 5.5, 11.0, 6.5))) is None
    mission.plan.route = None
    assert reason(inside) == "refused"
    assert reason(change((9.0, 5.5, 11.0, 6.5))) is None  # what only rises opens no path


def test_pose_advances_progress_and_requests_a_replan_off_the_path() -> None:
    along = plan((1.0, 1.0), (9.0, 1.0))
    assert reason_from_pose(along, pose(3.0, 1.5), CONFIG) is None
    assert along.progress == pytest.approx(2.0)
    assert reason_from_pose(along, pose(2.8, 1.0), CONFIG) is None
    assert along.progress == pytest.approx(2.0)
    assert reason_from_pose(along, pose(3.0, 2.1), CONFIG) == "off_path"


def test_refused_robot_is_replanned_once_it_has_moved() -> None:
    refused = Plan(1, None, refuse(208, "cut"), [], planned_from=(1.0, 1.0))
    assert reason_from_pose(refused, pose(1.9, 1.0), CONFIG) is None
    assert reason_from_pose(refused, pose(2.1, 1.0), CONFIG) == "refused"


# --- Replan policy ---


def found(cost: float = math.inf, refusal: Refusal | None = None) -> SearchResult:
    return SearchResult(None, cost, refusal)


def test_path_is_kept_unless_another_saves_the_share_that_the_reason_requires() -> None:
    planning_map = current(make_tracker(RingMap()))
    kept = plan((1.0, 1.0), (9.0, 1.0))
    cost = straight(kept).cost(planning_map.cost, planning_map.geometry)

    def keeps(share: float, reason: str) -> bool:
        return is_kept(kept, found(cost * share), reason, planning_map, CONFIG)

    assert keeps(0.98, "map")
    assert not keeps(0.96, "map")
    assert keeps(0.91, "clearing")
    assert not keeps(0.89, "clearing")
    assert not keeps(1.0, "goal")
    assert not keeps(1.0, "off_path")


def test_blocked_path_is_replaced_and_a_refusal_is_kept_while_it_is_the_same() -> None:
    planning_map = current(make_tracker(RingMap()))
    through_the_wall = plan((1.0, 6.0), (19.0, 6.0))
    assert not is_kept(through_the_wall, found(1e9), "map", planning_map, CONFIG)
    refused = Plan(1, None, refuse(208, "cut by z1"), [], planned_from=LEFT)
    assert is_kept(refused, found(refusal=refuse(208, "cut by z1")), "map", planning_map, CONFIG)
    assert not is_kept(refused, found(refusal=refuse(208, "cut by z2")), "map", planning_map, CONFIG)
    assert not is_kept(refused, found(100.0), "map", planning_map, CONFIG)


# --- Mission ---


def published(mission: Mission, at: Moment) -> tuple[object, object]:
    return mission.due_goal(at, CONFIG, 7), mission.due_path(at, CONFIG, 7, Version(1, 2, 3))


def test_goal_and_path_are_published_at_once_and_again_after_their_periods() -> None:
    mission = Mission()
    assert published(mission, NOW) == (None, None)
    mission.begin(goal(*RIGHT), any_heading=True)
    mission.plan = plan(LEFT, (1.0, 9.0), (9.0, 9.0))
    sent, path = mission.due_goal(NOW, CONFIG, 7), mission.due_path(NOW, CONFIG, 7, Version(1, 2, 3))
    assert sent
    assert path
    assert (sent.goal_id, sent.stamp) == ("g1", 5000.0)
    assert (path.planner_epoch, path.map_epoch, path.map_seq, path.goal_theta) == (7, 1, 2, None)
    assert path.released_length == pytest.approx(10.0)
    soon, later = Moment(100.4, 5000.4), Moment(101.01, 5001.01)
    assert published(mission, soon) == (None, None)
    assert all(published(mission, later))
    mission.received = (7, 1)
    mission.replace_refusal(refuse(208, "cut by z1"))
    assert published(mission, later)[1], "a changed refusal is published although the robot has the plan"
    assert published(mission, Moment(109.0, 5009.0))[1] is None


def test_release_is_published_at_its_period_at_once_on_request_and_never_before_the_path() -> None:
    mission = Mission()
    mission.begin(goal(*RIGHT), any_heading=True)
    mission.plan = plan(LEFT, (1.0, 9.0), (9.0, 9.0))

    def release(now: float) -> RobotRelease | None:
        return mission.due_release(Moment(now, 5000.0 + now), CONFIG, 7, Version(1, 2, 3))

    assert release(100.0) is None
    assert mission.due_path(NOW, CONFIG, 7, Version(1, 1, 3))
    assert release(100.4) is None
    found = release(100.5)
    assert found == RobotRelease(
        plan_id=1, planner_epoch=7, released_length=pytest.approx(10.0), map_epoch=1, map_seq=2, sent=(0, 100.5)
    )
    assert release(100.9) is None
    mission.release_now()
    assert release(100.9)
    mission.end()
    assert release(102.0) is None


def test_traces_are_stamped_when_the_path_is_first_published_and_never_again() -> None:
    mission = Mission()
    mission.begin(goal(*RIGHT), any_heading=False)
    mission.plan = plan(LEFT, (1.0, 9.0))
    mission.plan.traces = [TRACE]
    paths = [mission.due_path(Moment(now, 5000.0 + now), CONFIG, 7, Version(1, 2, 3)) for now in (1.0, 2.0)]
    assert [path.traces[0].plan_published for path in paths if path] == [5001.0, 5001.0]


def test_ended_goal_is_published_without_a_pose_and_has_no_path() -> None:
    mission = Mission()
    mission.begin(goal(*RIGHT), any_heading=False)
    mission.plan = plan(LEFT, (1.0, 9.0))
    mission.end()
    sent = mission.due_goal(NOW, CONFIG, 7)
    assert sent
    assert (sent.goal_id, sent.pose) == ("g1", None)
    assert mission.due_path(NOW, CONFIG, 7, Version(1, 2, 3)) is None
    assert mission.target is None


def test_replan_requests_collect_traces_once_and_map_replaces_the_first_reason() -> None:
    mission = Mission()
    mission.request_replan("clearing", [TRACE])
    mission.request_replan("refused", [TRACE])
    assert (mission.replan, mission.traces) == ("clearing", [TRACE])
    mission.request_replan("map", [structs.replace(TRACE, seq=6)])
    assert (mission.replan, len(mission.traces)) == ("map", 2)


# --- Goal fields ---

BOUND = np.zeros((12, 20), dtype=np.uint8)


def run(fields: GoalFields, job: FieldJob) -> None:
    job.run()
    fields.add(job)


def test_field_is_computed_once_per_goal_and_discarded_with_its_lower_bound() -> None:
    fields = GoalFields(10_000)
    fields.set_bounds(BOUND, BOUND)
    (job,) = fields.jobs([(3, 3), (3, 3)])
    assert fields.jobs([(3, 3)]) == []
    assert fields.guide((3, 3)) is None
    run(fields, job)
    guide = fields.guide((3, 3))
    assert guide is not None
    assert Planner(20, 12).plan(BOUND, (10, 3), (3, 3), field=guide).found
    assert fields.jobs([(3, 3)]) == []
    fields.set_bounds(BOUND, BOUND)
    assert fields.guide((3, 3)) is guide
    floor = BOUND.copy()
    fields.set_bounds(floor, floor)
    assert fields.guide((3, 3)) is None
    (again,) = fields.jobs([(3, 3)])
    assert again.bound is not BOUND


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


# --- Regions, search, egress ---


def sources(ring_map: RingMap, *names: str) -> BlockedRegions:
    known = BlockedRegions()
    for name in names:
        known.handlers()[ch.HAZARD]({"area": name}, ring_map.hazard_area(name), NOW)
    return known


def on(ring_map: RingMap, known: BlockedRegions) -> list[Region]:
    return Regions(DEFAULT_INFLATION).on(current(make_tracker(ring_map)), known.sources)


def test_region_is_on_only_while_all_its_cells_are_lethal() -> None:
    ring_map = RingMap()
    ring_map.put("z1", (9.0, 10.2, 11.0, 11.8))
    known = sources(ring_map, "z1")
    assert [region.cause.id for region in on(ring_map, known)] == ["z1"]
    ring_map.clear("z1")
    assert on(ring_map, known) == []


def test_area_whose_cells_hold_only_a_wall_is_not_on() -> None:
    ring_map = RingMap()
    ring_map.put("z1", (5.0, 5.0, 6.0, 6.0))
    assert on(ring_map, sources(ring_map, "z1")) == []


def test_clear_area_and_disabled_zone_are_no_regions() -> None:
    ring_map = RingMap()
    ring_map.put("crates", UPPER)
    x0, y0, x1, y1 = UPPER
    shape = RectangleShape(corner=(x0, y0), opposite=(x1, y1))
    known = BlockedRegions()
    known.handlers()[ch.HAZARD]({"area": "crates"}, ring_map.hazard_area("crates", "clear"), NOW)
    zones = [
        Zone(id="off", kind="BLOCKED", shape=shape, enabled=False),
        Zone(id="slow", kind="SPEED_LIMIT", speed=0.1, shape=shape),
    ]
    known.handlers()[ch.ZONES]({}, zone_set(zones, "slow"), NOW)
    assert on(ring_map, known) == []


def zone_set(zones: list[Zone], *active: str) -> ZoneSet:
    return ZoneSet(epoch=1, seq=1, zones=zones, active=list(active))


@pytest.mark.parametrize("others", [[], ["z1"]], ids=["alone", "inside_a_hazard"])
@pytest.mark.parametrize("times", TIMES)
def test_zone_is_on_when_the_map_service_says_so_whatever_its_times(times: dict[str, Any], others: list[str]) -> None:
    ring_map = RingMap()
    ring_map.put("z1", UPPER)
    known = sources(ring_map, *others)
    inner = RectangleShape(corner=(9.5, 10.5), opposite=(10.5, 11.5))
    zones = [Zone(id="wet", kind="BLOCKED", shape=inner, **times)]
    known.handlers()[ch.ZONES]({}, zone_set(zones), NOW)
    assert [region.cause.id for region in on(ring_map, known)] == others
    known.handlers()[ch.ZONES]({}, zone_set(zones, "wet"), NOW)
    assert [region.cause.id for region in on(ring_map, known)] == [*others, "wet"]
    known.handlers()[ch.ZONES]({}, zone_set(zones), NOW)
    assert [region.cause.id for region in on(ring_map, known)] == others


def test_zone_in_force_that_is_not_on_the_map_yet_is_not_on() -> None:
    ring_map = RingMap()
    known = BlockedRegions()
    shape = RectangleShape(corner=(9.5, 10.5), opposite=(10.5, 11.5))
    known.handlers()[ch.ZONES]({}, zone_set([Zone(id="wet", kind="BLOCKED", shape=shape)], "wet"), NOW)
    assert on(ring_map, known) == []


def test_zones_are_new_only_when_they_or_those_in_force_changed() -> None:
    known = BlockedRegions()
    shape = RectangleShape(corner=(9.5, 10.5), opposite=(10.5, 11.5))
    revisions, kept = [], []
    for active in ((), ("wet",), ("wet",), (), ("wet",)):
        known.handlers()[ch.ZONES]({}, zone_set([Zone(id="wet", kind="BLOCKED", shape=shape)], *active), NOW)
        revisions.append(known.revision)
        kept += known.sources
    assert revisions == [1, 2, 2, 3, 4]
    assert len({id(zone) for zone in kept}) == 1, "zones that did not change stay the same objects"


def test_unchanged_shapes_are_not_rasterized_again() -> None:
    ring_map = RingMap()
    ring_map.put("z1", UPPER)
    ring_map.put("z2", LOWER)
    known = sources(ring_map, "z1")
    regions, planning_map = Regions(DEFAULT_INFLATION), current(make_tracker(ring_map))
    (first,) = regions.on(planning_map, known.sources)
    known.handlers()[ch.HAZARD]({"area": "z2"}, ring_map.hazard_area("z2"), NOW)
    again, _ = regions.on(planning_map, known.sources)
    assert again is first


@pytest.mark.parametrize(
    ("start", "end", "code"),
    [((-1.0, 6.0), RIGHT, 203), (LEFT, (30.0, 6.0), 204), ((10.0, 11.0), RIGHT, 205), (LEFT, (10.0, 11.0), 206)],
)
def test_search_refuses_start_and_goal_outside_the_map_or_occupied(start: PointXY, end: PointXY, code: int) -> None:
    ring_map = RingMap()
    ring_map.put("z1", UPPER)
    planning_map = current(make_tracker(ring_map))
    covers = partial(cover, sources(ring_map, "z1").sources)
    result = PathSearch(CONFIG, ring_map.geometry).find(planning_map, covers, start, end)
    assert result.route is None
    assert result.refusal
    assert result.refusal.code == code


def nothing(_x: float, _y: float, _margin: float) -> bool:
    return False


def test_search_beyond_its_limit_of_expansions_is_refused() -> None:
    ring_map = RingMap()
    search = PathSearch(PlannerConfig(max_expansions=10), ring_map.geometry)
    result = search.find(current(make_tracker(ring_map)), nothing, LEFT, RIGHT)
    assert result.refusal
    assert result.refusal.code == 207


def test_unreachable_goal_is_refused_without_a_full_search() -> None:
    ring_map = RingMap()
    ring_map.put("z1", UPPER)
    ring_map.put("z2", LOWER)
    planning_map = current(make_tracker(ring_map))
    search = PathSearch(PlannerConfig(quick_expansions=50), ring_map.geometry)
    for _ in range(2):
        result = search.find(planning_map, nothing, LEFT, RIGHT)
        assert not result.searched
        assert result.refusal
        assert result.refusal.code == 208
        assert result.question
        assert planning_map.has_components


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
