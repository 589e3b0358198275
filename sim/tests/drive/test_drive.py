import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog_contracts.messages import RobotPath, RobotState, SimObstacle, SimTruth
from fog_contracts.site import AreaSite, DemoPlan, Site
from fognav_sim.barrier import BarrierError
from fognav_sim.drive.drive import Drive
from fognav_sim.drive.hazard import (
    HazardRequest,
    HazardSchedule,
    entry_distance,
    is_clear_of_robot,
    path_length,
    remaining,
)

Z1 = AreaSite(id="z1", polygon=[(12.0, -1.0), (15.0, -1.0), (15.0, 1.0), (12.0, 1.0)])
SITE = Site(id="test", areas=[Z1], nodes=[], demo=DemoPlan(start="a", goal="b", areas=["z1"]))
GOAL = (20.0, 0.0)


def truth(x: float, y: float = 0.0) -> SimTruth:
    return SimTruth(
        robot="r1", x=x, y=y, theta=0.0, left=0.0, right=0.0, distance=50.0 + x, clearance=1.0, min_clearance=0.5,
        contacts=0,
    )  # fmt: skip


def path(goal: str = "g") -> RobotPath:
    return RobotPath(
        plan_id=1, planner_epoch=1, goal_id=goal, points=[(0.0, 0.0), GOAL], map_epoch=1, map_seq=1,
        released_length=0.0,
    )  # fmt: skip


def arrived() -> RobotState:
    return RobotState(
        mode="NORMAL", reasons=[], enabled=True, battery=None, goal_id="g", map_epoch=1, map_seq=1, plan_id=1,
        goal_reached=True,
    )  # fmt: skip


def schedule() -> HazardSchedule:
    return HazardSchedule(
        SITE, 1, lambda area: SimObstacle(id="barrier", polygon=area.polygon), HazardRequest(trigger_m=3.0)
    )


def drive(*, hazard: bool = True) -> Drive:
    return Drive(
        goal=GOAL, goal_id="g", areas=SITE.areas, truth=truth(0.0), now=0.0, hazard=schedule() if hazard else None
    )


def place_barrier(tested: Drive) -> None:
    tested.on_path(path(), 1.0)
    tested.on_truth(truth(3.0))
    due = tested.hazard_due()
    assert due is not None
    tested.on_barrier_placed(due)


def succeeds(tested: Drive) -> bool:
    tested.on_truth(truth(20.0))
    tested.on_state(arrived(), 60.0)
    outcome = tested.outcome(60.0)
    assert outcome is not None
    assert outcome.kind == "reached"
    return tested.summary(outcome).success


def test_barrier_is_due_once_and_only_on_a_path_to_the_goal() -> None:
    tested = drive()
    tested.on_truth(truth(3.0))
    assert tested.hazard_due() is None
    tested.on_path(path("another"), 1.0)
    assert tested.hazard_due() is None
    place_barrier(tested)
    assert tested.hazard_due() is None
    assert tested.blocked_at_m == 3.0


def test_drive_around_its_barrier_succeeds() -> None:
    tested = drive()
    place_barrier(tested)
    tested.on_truth(truth(13.0, 4.0))
    assert succeeds(tested)


def test_drive_through_the_blocked_area_fails_although_the_goal_is_reached() -> None:
    tested = drive()
    place_barrier(tested)
    tested.on_truth(truth(13.0))
    assert not succeeds(tested)


def test_barrier_behind_the_robot_is_no_hazard_that_the_drive_has_met() -> None:
    """The followed path crossed the area, but what is left of it does not."""
    tested = drive()
    tested.on_path(path(), 1.0)
    tested.on_truth(truth(3.0))
    due = tested.hazard_due()
    assert due is not None
    for x in range(4, 20):
        tested.on_truth(truth(float(x)))
    tested.on_barrier_placed(due)
    assert not succeeds(tested)


def test_robot_that_has_driven_past_an_area_gets_no_barrier_there() -> None:
    tested = drive()
    tested.on_path(path(), 1.0)
    for x in range(20):
        tested.on_truth(truth(float(x)))
    with pytest.raises(BarrierError, match="does not cross z1"):
        tested.hazard_due()


CORNERS = st.lists(st.tuples(st.integers(-2, 8), st.integers(-3, 3)), min_size=1, max_size=8)


@given(corners=CORNERS, seed=st.integers(0, 100))
def test_barrier_appears_ahead_of_a_robot_on_any_path_and_away_from_it(
    corners: list[tuple[int, int]], seed: int
) -> None:
    """Also where the path passes beside the area, or through it, before it enters it; none only grazes its corner."""
    points = [(0.0, 0.0), *((4.0 * x, 1.9 * y) for x, y in corners), GOAL]
    hazard = HazardSchedule(SITE, seed, lambda area: SimObstacle(id="barrier", polygon=area.polygon))
    tested = Drive(goal=GOAL, goal_id="g", areas=SITE.areas, truth=truth(0.0), now=0.0, hazard=hazard)
    tested.on_path(msgspec.structs.replace(path(), points=points), 1.0)
    driven = 0.0
    try:
        while (due := tested.hazard_due()) is None:
            driven += 0.1
            x, y = remaining(points, driven)[0]
            tested.on_truth(msgspec.structs.replace(truth(x, y), distance=50.0 + driven))
            assert driven <= path_length(points), "neither a barrier nor a reason"
    except BarrierError:
        assert driven < 0.3, "a path with room for a barrier must get it"
        return
    tested.on_barrier_placed(due)
    assert is_clear_of_robot(due, remaining(points, driven)[0])
    assert entry_distance(remaining(points, driven + 0.2), Z1.polygon) is not None
    assert tested.barrier_was_ahead


def test_drive_that_never_met_its_hazard_fails() -> None:
    assert not succeeds(drive())
    assert succeeds(drive(hazard=False))


def test_longer_drive_has_more_time() -> None:
    tested = drive()
    assert tested.outcome(929.0) is None
    outcome = tested.outcome(931.0)
    assert outcome is not None
    assert outcome.kind == "timeout"  # 180 s, and 20 m at 0.08 m/s with detours up to three times as long
    assert tested.summary(outcome).time_s == 931.0
