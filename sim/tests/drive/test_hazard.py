import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog_contracts.messages import SimObstacle
from fog_contracts.site import AreaSite, DemoPlan, NodeSite, Site, Sonar
from fognav_sim.barrier import KEEP_AWAY_M, BarrierError
from fognav_sim.drive.hazard import (
    HazardSchedule,
    draw_hazard,
    draw_trigger,
    entry_distance,
    is_clear_of_robot,
    remaining,
)

PATH = [(0.0, 0.0), (10.0, 0.0), (30.0, 0.0)]


def area(name: str, x: float, width: float = 3.0) -> AreaSite:
    return AreaSite(id=name, polygon=[(x, -1.0), (x + width, -1.0), (x + width, 1.0), (x, 1.0)])


def node(name: str, x: float) -> NodeSite:
    sonar = Sonar(angle=0.0, range_limit=1.7)
    return NodeSite(id=f"node-{name}", area=name, x=x + 1.5, y=0.95, theta=-math.pi / 2, sonars=[sonar])


def site(*names_and_places: tuple[str, float]) -> Site:
    areas = [area(name, x) for name, x in names_and_places]
    nodes = [node(name, x) for name, x in names_and_places]
    demo = DemoPlan(start="a", goal="b", areas=[a.id for a in areas])
    return Site(id="test", areas=areas, nodes=nodes, demo=demo)


def fill_area(area: AreaSite) -> SimObstacle:
    return SimObstacle(id="barrier", polygon=area.polygon)


def test_distance_to_an_area_is_measured_along_the_path() -> None:
    corner = [(0.0, 0.0), (4.0, 0.0), (4.0, 6.0)]
    polygon = [(3.0, 5.0), (5.0, 5.0), (5.0, 7.0), (3.0, 7.0)]
    assert entry_distance(corner, polygon) == pytest.approx(9.0, abs=0.05)


def test_area_beside_the_path_has_no_entry_distance() -> None:
    assert entry_distance(PATH, [(5.0, 2.0), (8.0, 2.0), (8.0, 4.0)]) is None


def test_area_that_no_barrier_can_close_is_refused_with_the_reason() -> None:
    def no_barrier(area: AreaSite) -> SimObstacle:
        raise BarrierError(f"area {area.id}: no barrier fits")

    with pytest.raises(BarrierError, match="z1: no barrier fits"):
        draw_hazard(site(("z1", 12.0)), PATH, 1, no_barrier)


@pytest.mark.drive
@given(seed=st.integers(0, 10_000))
def test_hazard_is_the_same_for_the_same_seed_and_appears_early_enough(seed: int) -> None:
    plan = site(("z1", 9.0), ("z2", 20.0), ("z3", 40.0))
    drawn = draw_hazard(plan, PATH, seed, fill_area)
    assert drawn == draw_hazard(plan, PATH, seed, fill_area)
    assert drawn.area.id in {"z1", "z2"}
    entry = entry_distance(PATH, drawn.area.polygon)
    assert entry is not None
    assert drawn.trigger_m <= draw_trigger(seed)
    assert 0.0 <= drawn.trigger_m <= min(8.0, entry - KEEP_AWAY_M)
    assert is_clear_of_robot(drawn, (drawn.trigger_m, 0.0))


def test_every_area_on_the_path_is_drawn_by_some_seed() -> None:
    plan = site(("z1", 9.0), ("z2", 20.0))
    assert {draw_hazard(plan, PATH, seed, fill_area).area.id for seed in range(30)} == {"z1", "z2"}


def test_path_that_crosses_no_area_is_refused_with_the_reason() -> None:
    with pytest.raises(BarrierError, match="does not cross far"):
        draw_hazard(site(("far", 60.0)), PATH, 1, fill_area)


def test_barrier_does_not_appear_near_the_robot() -> None:
    drawn = draw_hazard(site(("z1", 12.0)), PATH, 1, fill_area)
    assert not is_clear_of_robot(drawn, (9.5, 0.0))


def test_barrier_is_due_after_its_distance_but_never_near_the_robot() -> None:
    schedule = HazardSchedule(site(("z1", 12.0)), 1, fill_area)
    planned = schedule.draw(PATH)
    assert schedule.due(PATH, planned.trigger_m - 0.1, (planned.trigger_m - 0.1, 0.0)) is None
    assert schedule.due(PATH, planned.trigger_m, (9.5, 0.0)) is None
    assert schedule.due(PATH, planned.trigger_m, (planned.trigger_m, 0.0)) == planned


def test_robot_with_a_new_path_gets_a_hazard_on_that_path() -> None:
    schedule = HazardSchedule(site(("z1", 12.0), ("z2", -30.0)), 1, fill_area)
    assert schedule.draw(PATH).area.id == "z1"
    back = [(-x, y) for x, y in PATH]
    due = schedule.due(back, 9.0, (0.0, 0.0))
    assert due is not None
    assert due.area.id == "z2"
    assert schedule.planned == due


def there_and_back(x: float) -> list[tuple[float, float]]:
    """A path that passes an area around (x, 0) at 2 m, goes on, and enters it on its way back."""
    return [(0.0, 2.0), (40.0, 2.0), (40.0, 0.0), (x, 0.0)]


@pytest.mark.drive
@given(seed=st.integers(0, 10_000))
def test_barrier_appears_before_the_last_place_that_is_away_from_its_area(seed: int) -> None:
    plan = site(("z1", 6.0))
    drawn = draw_hazard(plan, there_and_back(0.0), seed, fill_area)
    place = remaining(there_and_back(0.0), drawn.trigger_m)[0]
    assert is_clear_of_robot(drawn, place)
    assert entry_distance(remaining(there_and_back(0.0), drawn.trigger_m), drawn.area.polygon) is not None


def test_path_that_is_near_its_area_from_the_start_is_refused_with_the_reason() -> None:
    with pytest.raises(BarrierError, match="never is far enough"):
        draw_hazard(site(("z1", 6.0)), [(5.0, -3.5), (5.0, -2.0), (7.0, -2.0), (7.0, 0.0)], 1, fill_area)


def test_what_is_left_of_a_path_begins_after_what_was_driven() -> None:
    assert remaining(PATH, 4.0) == [(4.0, 0.0), (10.0, 0.0), (30.0, 0.0)]
    assert remaining(PATH, 12.0) == [(12.0, 0.0), (30.0, 0.0)]
    assert remaining(PATH, 40.0) == [(30.0, 0.0)]


def test_area_behind_the_robot_is_not_blocked() -> None:
    schedule = HazardSchedule(site(("z1", 12.0)), 1, fill_area)
    planned = schedule.draw(PATH)
    behind = remaining(PATH, 20.0)
    assert is_clear_of_robot(planned, (20.0, 0.0))
    with pytest.raises(BarrierError, match="does not cross z1"):
        schedule.due(behind, 20.0, (20.0, 0.0))
