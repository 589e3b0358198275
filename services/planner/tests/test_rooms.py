"""The parts of the planner's core, each by itself."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import structs
from ring_map import LEFT, LOWER, RIGHT, UPPER, Box, Map, goal, pose

from fog_contracts import channels as ch
from fog_contracts.costs import DEFAULT_INFLATION
from fog_contracts.handlers import Moment
from fog_contracts.messages import PointXY, Refusal, Trace
from fog_contracts.replica import MapError, Version
from planner.blocked_regions import BlockedRegions
from planner.config import PlannerConfig
from planner.egress import find_egress
from planner.goal_fields import GoalFields
from planner.mission import Mission, Plan
from planner.path_monitor import may_save, reason_from_change, reason_from_pose, touches_corridor
from planner.path_search import PathSearch, SearchResult
from planner.planning_map import CostChange, MapTracker, PlanningMap
from planner.refusals import refuse
from planner.replan_policy import is_kept
from planner.route import Route

CONFIG = PlannerConfig()
TRACE = Trace(area="z1", epoch=1, seq=5)
NOW = Moment(100.0, 5000.0)


def tracker(the_map: Map) -> MapTracker:
    made = MapTracker(DEFAULT_INFLATION, grace_s=0.5, max_age_s=1.0)
    made.load(the_map.master.snapshot(), 0.0)
    return made


def current(made: MapTracker) -> PlanningMap:
    assert made.current is not None
    return made.current


def plan(*corners: PointXY, progress: float = 0.0) -> Plan:
    route = Route(np.array(corners), 0.1)
    return Plan(1, route, None, [], planned_from=corners[0], progress=progress)


def straight(the_plan: Plan) -> Route:
    assert the_plan.route is not None
    return the_plan.route


def change(box: Box, *, fell: bool = False) -> CostChange:
    window = Map().geometry.window_around(*box[:2], box[2] - 1e-6, box[3] - 1e-6)
    cells = np.ones((window.height, window.width), dtype=np.bool_)
    return CostChange(window, cells, cells & fell, [TRACE])


# --- The map ---


def test_delta_tells_which_costs_changed_and_which_fell() -> None:
    the_map = Map()
    made = tracker(the_map)
    (delta,) = the_map.put("z1", UPPER, trace=TRACE)
    (rise,) = made.on_delta(delta, 1.0)
    assert rise.changed.any()
    assert not rise.fell.any()
    assert rise.traces == [TRACE]
    x, y = the_map.geometry.cell(10.0, 11.0)
    assert rise.changed[y - rise.window.y, x - rise.window.x]
    (delta,) = the_map.clear("z1")
    (fall,) = made.on_delta(delta, 1.1)
    assert np.array_equal(fall.fell, fall.changed)
    assert made.on_delta(delta, 1.2) == []


def test_map_is_fresh_only_while_heartbeats_confirm_it() -> None:
    the_map = Map()
    made = tracker(the_map)
    assert not made.is_fresh(0.0)
    made.on_heartbeat(the_map.master.heartbeat(0.0), 1.0)
    assert made.is_fresh(2.0)
    assert not made.is_fresh(2.1)


def test_lower_bound_is_replaced_when_costs_fall_below_it_and_kept_otherwise() -> None:
    the_map = Map()
    made = tracker(the_map)
    bound = current(made).lower_bound
    for delta in the_map.put("z1", UPPER):
        made.on_delta(delta, 1.0)
    assert current(made).lower_bound is bound
    the_map.static[:, :] = 0
    for delta in the_map.put("z2", LOWER):
        made.on_delta(delta, 1.0)
    planning_map = current(made)
    assert planning_map.lower_bound is not bound
    assert np.all(planning_map.lower_bound <= planning_map.cost)


def test_loading_tells_a_restart_and_a_damaged_snapshot_changes_nothing() -> None:
    the_map = Map()
    made = MapTracker(DEFAULT_INFLATION, grace_s=0.5, max_age_s=1.0)
    assert made.current is None
    assert made.load(the_map.master.snapshot(), 0.0).restarted
    assert not made.load(the_map.master.snapshot(), 0.0).restarted
    with pytest.raises(MapError):
        made.load(structs.replace(the_map.master.snapshot(), hash=1), 0.0)
    assert current(made).version == the_map.master.version
    assert made.load(Map(epoch=2).master.snapshot(), 0.0).restarted


# --- Path monitor ---


@pytest.mark.parametrize(("side", "touched"), [(0.6, True), (1.0, False)])
def test_change_beside_the_path_touches_it_within_the_corridor(side: float, touched: bool) -> None:  # noqa: FBT001  # a parameter of pytest
    along = plan((1.0, 1.0), (9.0, 1.0))
    planning_map = current(tracker(Map()))
    beside = change((4.0, 1.0 + side, 4.2, 1.2 + side))
    assert touches_corridor(along, straight(along), beside, planning_map, CONFIG.corridor) == touched


def test_change_behind_the_robot_does_not_touch_its_path() -> None:
    planning_map = current(tracker(Map()))
    behind = change((2.0, 0.9, 2.2, 1.1))
    for progress, touched in ((0.0, True), (3.0, False)):
        driven = plan((1.0, 1.0), (9.0, 1.0), progress=progress)
        assert touches_corridor(driven, straight(driven), behind, planning_map, CONFIG.corridor) == touched


def test_clearing_may_save_only_where_the_detour_over_it_could_be_shorter() -> None:
    planning_map = current(tracker(Map()))
    # Round the ring's upper side, 1 m from the walls: over the middle of the ring it would be far shorter.
    around = plan((1.0, 6.0), (1.0, 11.0), (19.0, 11.0), (19.0, 6.0))
    direct = plan((1.0, 11.0), (19.0, 11.0))
    geometry = planning_map.geometry
    middle, far = geometry.window_around(9.0, 5.5, 11.0, 6.5), geometry.window_around(9.0, 0.2, 11.0, 0.4)
    assert may_save(around, straight(around), middle, planning_map, (1.0, 6.0), CONFIG.saving)
    assert not may_save(around, straight(around), middle, planning_map, (1.0, 6.0), 0.5)
    assert not may_save(direct, straight(direct), far, planning_map, (1.0, 11.0), CONFIG.saving)


def test_each_change_gives_the_most_pressing_reason() -> None:
    planning_map = current(tracker(Map()))
    mission = Mission()
    on_path, inside = change((4.0, 0.9, 4.2, 1.1), fell=True), change((9.0, 5.5, 11.0, 6.5), fell=True)
    assert reason_from_change(mission, on_path, planning_map, CONFIG) is None
    mission.begin(goal(*RIGHT), any_heading=False)
    assert reason_from_change(mission, on_path, planning_map, CONFIG) is None
    mission.plan = plan((1.0, 6.0), (1.0, 1.0), (19.0, 1.0), (19.0, 6.0))
    assert reason_from_change(mission, on_path, planning_map, CONFIG) == "map"
    assert reason_from_change(mission, inside, planning_map, CONFIG) == "clearing"
    assert reason_from_change(mission, change((9.0, 5.5, 11.0, 6.5)), planning_map, CONFIG) is None
    mission.plan.route = None
    assert reason_from_change(mission, inside, planning_map, CONFIG) == "refused"


def test_pose_moves_progress_forward_only_and_tells_when_it_strayed() -> None:
    along = plan((1.0, 1.0), (9.0, 1.0))
    assert reason_from_pose(along, pose(3.0, 1.5), CONFIG) is None
    assert along.progress == pytest.approx(2.0)
    assert reason_from_pose(along, pose(2.8, 1.0), CONFIG) is None
    assert along.progress == pytest.approx(2.0)
    assert reason_from_pose(along, pose(3.0, 2.1), CONFIG) == "strayed"


def test_refused_robot_is_planned_again_once_it_stands_elsewhere() -> None:
    refused = Plan(1, None, refuse(208, "cut"), [], planned_from=(1.0, 1.0))
    assert reason_from_pose(refused, pose(1.9, 1.0), CONFIG) is None
    assert reason_from_pose(refused, pose(2.1, 1.0), CONFIG) == "refused"


# --- Replan policy ---


def found(cost: float = math.inf, refusal: Refusal | None = None) -> SearchResult:
    return SearchResult(None, cost, refusal)


def test_path_is_kept_unless_another_saves_the_share_that_its_reason_asks() -> None:
    planning_map = current(tracker(Map()))
    kept = plan((1.0, 1.0), (9.0, 1.0))
    cost = straight(kept).cost(planning_map.cost, planning_map.geometry)

    def keeps(share: float, reason: str) -> bool:
        return is_kept(kept, found(cost * share), reason, planning_map, CONFIG)

    assert keeps(0.98, "map")
    assert not keeps(0.96, "map")
    assert keeps(0.91, "clearing")
    assert not keeps(0.89, "clearing")
    assert not keeps(1.0, "goal")
    assert not keeps(1.0, "strayed")


def test_blocked_path_is_never_kept_and_a_refusal_only_while_it_is_the_same() -> None:
    planning_map = current(tracker(Map()))
    through_the_wall = plan((1.0, 6.0), (19.0, 6.0))
    assert not is_kept(through_the_wall, found(1e9), "map", planning_map, CONFIG)
    refused = Plan(1, None, refuse(208, "cut by z1"), [], planned_from=LEFT)
    assert is_kept(refused, found(refusal=refuse(208, "cut by z1")), "map", planning_map, CONFIG)
    assert not is_kept(refused, found(refusal=refuse(208, "cut by z2")), "map", planning_map, CONFIG)
    assert not is_kept(refused, found(100.0), "map", planning_map, CONFIG)


# --- Mission ---


def published(mission: Mission, at: Moment) -> tuple[object, object]:
    return mission.due_goal(at, CONFIG), mission.due_path(at, CONFIG, 7, Version(1, 2, 3))


def test_goal_and_path_are_published_at_once_and_again_after_their_periods() -> None:
    mission = Mission()
    assert published(mission, NOW) == (None, None)
    mission.begin(goal(*RIGHT), any_heading=True)
    mission.plan = plan(LEFT, (1.0, 9.0), (9.0, 9.0))
    told, path = mission.due_goal(NOW, CONFIG), mission.due_path(NOW, CONFIG, 7, Version(1, 2, 3))
    assert told
    assert path
    assert (told.goal_id, told.stamp) == ("g1", 5000.0)
    assert (path.planner_epoch, path.map_epoch, path.map_seq, path.goal_theta) == (7, 1, 2, None)
    assert path.released_length == pytest.approx(10.0)
    soon, later = Moment(100.4, 5000.4), Moment(101.01, 5001.01)
    assert published(mission, soon) == (None, None)
    assert all(published(mission, later))
    mission.publish_path_now()
    assert published(mission, later)[1]


def test_traces_are_stamped_when_the_path_is_first_published_and_never_again() -> None:
    mission = Mission()
    mission.begin(goal(*RIGHT), any_heading=False)
    mission.plan = plan(LEFT, (1.0, 9.0))
    mission.plan.traces = [TRACE]
    paths = [mission.due_path(Moment(now, 5000.0 + now), CONFIG, 7, Version(1, 2, 3)) for now in (1.0, 2.0)]
    assert [path.traces[0].plan_published for path in paths if path] == [5001.0, 5001.0]


def test_goal_that_is_over_is_published_without_a_pose_and_has_no_path() -> None:
    mission = Mission()
    mission.begin(goal(*RIGHT), any_heading=False)
    mission.plan = plan(LEFT, (1.0, 9.0))
    mission.end()
    told = mission.due_goal(NOW, CONFIG)
    assert told
    assert (told.goal_id, told.pose) == ("g1", None)
    assert mission.due_path(NOW, CONFIG, 7, Version(1, 2, 3)) is None
    assert mission.target is None


def test_reasons_to_replan_gather_traces_once_and_the_map_outranks_the_first() -> None:
    mission = Mission()
    mission.request_replan("clearing", [TRACE])
    mission.request_replan("refused", [TRACE])
    assert (mission.replan, mission.traces) == ("clearing", [TRACE])
    mission.request_replan("map", [structs.replace(TRACE, seq=6)])
    assert (mission.replan, len(mission.traces)) == ("map", 2)


# --- Goal fields ---

BOUND = np.zeros((12, 20), dtype=np.uint8)


def test_field_is_computed_once_per_goal_and_void_on_another_lower_bound() -> None:
    fields = GoalFields(2)
    fields.use(BOUND)
    (job,) = fields.jobs([(3, 3), (3, 3)])
    assert fields.jobs([(3, 3)]) == []
    assert fields.guide((3, 3)) is None
    job.run()
    fields.take(job)
    guide = fields.guide((3, 3))
    assert guide is not None
    assert guide.plan(BOUND, (10, 3), (3, 3)).found
    assert fields.jobs([(3, 3)]) == []
    fields.use(BOUND)
    assert fields.guide((3, 3)) is guide
    fields.use(BOUND.copy())
    assert fields.guide((3, 3)) is None
    (again,) = fields.jobs([(3, 3)])
    assert again.lower_bound is not BOUND


def test_field_that_was_computed_over_a_former_lower_bound_is_dropped() -> None:
    fields = GoalFields(2)
    fields.use(BOUND)
    (job,) = fields.jobs([(3, 3)])
    job.run()
    fields.use(BOUND.copy())
    fields.take(job)
    assert fields.guide((3, 3)) is None


def test_fields_have_room_for_so_many_goals_and_none_for_one_in_a_wall() -> None:
    fields = GoalFields(2)
    walled = BOUND.copy()
    walled[5, 5] = 254
    fields.use(walled)
    jobs = fields.jobs([(5, 5), (1, 1), (2, 2)])
    assert [job.goal for job in jobs] == [(1, 1)]
    for goals in ([(1, 1), (2, 2)], [(7, 7)]):
        for job in [*jobs, *fields.jobs(goals)]:
            job.run()
            fields.take(job)
        jobs = []
    assert fields.guide((7, 7)) is not None
    assert [fields.guide(cell) is None for cell in ((1, 1), (2, 2))].count(True) == 1


# --- Regions, search, egress ---


def regions(the_map: Map, *names: str) -> BlockedRegions:
    made = BlockedRegions(DEFAULT_INFLATION.inflation_radius)
    for name in names:
        made.handlers()[ch.HAZARD]({"area": name}, the_map.told(name), NOW)
    return made


def test_region_blocks_only_while_its_cells_are_lethal() -> None:
    the_map = Map()
    the_map.put("z1", (9.0, 10.2, 11.0, 11.8))
    known = regions(the_map, "z1")
    assert [region.cause.id for region in known.blocking(current(tracker(the_map)))] == ["z1"]
    the_map.clear("z1")
    assert known.blocking(current(tracker(the_map))) == []


@pytest.mark.parametrize(
    ("start", "end", "code"),
    [((-1.0, 6.0), RIGHT, 203), (LEFT, (30.0, 6.0), 204), ((10.0, 11.0), RIGHT, 205), (LEFT, (10.0, 11.0), 206)],
)
def test_search_refuses_what_no_path_can_serve(start: PointXY, end: PointXY, code: int) -> None:
    the_map = Map()
    the_map.put("z1", UPPER)
    planning_map = current(tracker(the_map))
    blocking = regions(the_map, "z1").blocking(planning_map)
    result = PathSearch(CONFIG, the_map.geometry, GoalFields(1)).find(planning_map, blocking, start, end)
    assert result.route is None
    assert result.refusal
    assert result.refusal.code == code


def test_search_that_takes_too_long_is_refused() -> None:
    the_map = Map()
    search = PathSearch(PlannerConfig(max_expansions=10), the_map.geometry, GoalFields(1))
    result = search.find(current(tracker(the_map)), [], LEFT, RIGHT)
    assert result.refusal
    assert result.refusal.code == 207


@settings(max_examples=60, deadline=None)
@given(
    start=st.tuples(st.floats(0.4, 1.6), st.floats(0.4, 11.6)),
    end=st.tuples(st.floats(18.4, 19.6), st.floats(0.4, 11.6)),
)
def test_path_begins_and_ends_at_the_exact_points_and_its_cost_is_finite(start: PointXY, end: PointXY) -> None:
    planning_map = current(tracker(Map()))
    result = PathSearch(CONFIG, planning_map.geometry, GoalFields(1)).find(planning_map, [], start, end)
    assert result.route is not None
    assert math.hypot(*(result.route.points[0] - start)) <= 0.08
    assert math.hypot(*(result.route.points[-1] - end)) <= 0.08
    assert math.isfinite(result.cost)


def test_egress_search_gives_up_beyond_its_limit() -> None:
    the_map = Map()
    the_map.put("z1", UPPER)
    planning_map = current(tracker(the_map))
    blocking = regions(the_map, "z1").blocking(planning_map)
    out = find_egress(planning_map, blocking, (10.0, 11.0), CONFIG)
    assert out.route is not None
    lost = find_egress(planning_map, blocking, (10.0, 11.0), PlannerConfig(egress_cells=5))
    assert lost.refusal
    assert lost.refusal.code == 205
