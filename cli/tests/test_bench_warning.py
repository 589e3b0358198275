"""`fognav bench warning`: an obstacle's way from a node's echo to a robot's path, through the whole fog."""

from pathlib import Path

import pytest

from fog_runtime.configuration.site import load_site
from fognav import checkout
from fognav.bench import warning


def test_figures_name_each_stretch_and_count_what_never_arrived():
    quick, slow = warning.Warned(1.0, 1.1, 1.2, 1.205, 1.21), warning.Warned(2.0, 2.2, 2.4, 2.405, 2.41)
    row = warning.figures("evidence", [quick, None, slow])
    assert (row["warnings"], row["missed"]) == (3, 1)
    assert (row["echo_to_path_p50_ms"], row["reading_to_confirmed_p50_ms"]) == (310.0, 150.0)
    assert warning.figures("evidence", [None])["echo_to_path_p50_ms"] is None


@pytest.mark.live
async def test_robot_gets_a_way_around_an_obstacle_that_a_node_has_seen():
    loaded = load_site(checkout.site_folder(Path("estig")))
    row = await warning.measure(loaded, "evidence", 2, 1, lambda: None)
    assert row["missed"] == 0
    stretches = ("echo_to_reading", "reading_to_confirmed", "confirmed_to_delta", "delta_to_path")
    assert all(0 < row[f"{stretch}_p50_ms"] <= row["echo_to_path_p50_ms"] for stretch in stretches)
