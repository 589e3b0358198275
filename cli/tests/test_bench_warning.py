"""`fognav bench warning`: an obstacle's way from a node's echo to a robot's path, through the whole fog."""

from pathlib import Path

import pytest

from fog_contracts.messages import RobotPath, Trace
from fog_runtime.configuration.site import load_site
from fognav import checkout
from fognav.bench import warning
from fognav.bench.standing_robot import Arrived


def test_figures_name_each_stretch_and_count_what_never_arrived():
    quick, slow = warning.Warned(1.0, 1.1, 1.2, 1.205, 1.21), warning.Warned(2.0, 2.2, 2.4, 2.405, 2.41)
    row = warning.figures("evidence", [quick, None, slow])
    assert (row["warnings"], row["missed"]) == (3, 1)
    assert row["reading_to_confirmed_p50_ms"] == 150.0
    assert (row["echo_to_path_p50_ms"], row["echo_to_path_max_ms"]) == (310.0, 410.0)
    assert warning.figures("evidence", [None])["echo_to_path_max_ms"] is None


def path(at: float, *traces: Trace) -> Arrived:
    points = [(0.0, 0.0), (1.0, 0.0)]
    return Arrived(
        at,
        RobotPath(
            plan_id=1, planner_epoch=1, goal_id="g", points=points, map_epoch=1, map_seq=1, released_length=1.0,
            traces=list(traces),
        ),
    )  # fmt: skip


def test_path_that_arrives_before_the_delta_that_it_answers_waits_for_it():
    trace = Trace(area="a1", epoch=1, seq=7, first_reading=10.1, confirmed=10.2)
    paths, deltas = [path(10.31, trace)], {("a1", 1, 6): 9.0}
    assert warning.first_warning(paths, "a1", 10.0, 10.05, deltas) is None
    deltas["a1", 1, 7] = 10.32
    assert warning.first_warning(paths, "a1", 10.0, 10.05, deltas) == (10.05, 10.1, 10.2, 10.32, 10.31)


def test_path_without_a_trace_of_this_obstacle_is_no_warning():
    earlier, elsewhere = (Trace(area=a, epoch=1, seq=7, first_reading=t) for a, t in (("a1", 9.9), ("a2", 10.1)))
    deltas = {("a1", 1, 7): 10.3, ("a2", 1, 7): 10.3}
    assert warning.first_warning([path(10.4), path(10.5, earlier, elsewhere)], "a1", 10.0, 10.05, deltas) is None


@pytest.mark.live
async def test_robot_gets_a_way_around_an_obstacle_that_a_node_has_seen():
    loaded = load_site(checkout.site_folder(Path("estig")))
    row = await warning.measure(loaded, "evidence", 2, 1, lambda: None)
    assert row["missed"] == 0
    stretches = ("echo_to_reading", "reading_to_confirmed", "confirmed_to_delta", "delta_to_path")
    assert all(0 < row[f"{stretch}_p50_ms"] <= row["echo_to_path_p50_ms"] for stretch in stretches)
