"""The site on which real processes drive a route of an experiment."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fog_runtime.configuration.site import load_site
from fognav_experiments.comparison import runner
from fognav_experiments.comparison.drives import draw
from fognav_experiments.comparison.live_drive import write_route

ESTIG = Path(__file__).parents[2] / "sites" / "estig"


def test_a_route_s_site_is_the_same_but_for_the_start_of_the_robot_and_the_demonstration(tmp_path):
    site = load_site(ESTIG)
    drawn = draw(runner.read_spec(site, ESTIG), 1, 2)[1]
    write_route(site, drawn, tmp_path)
    written = load_site(tmp_path)
    assert np.array_equal(written.map.cells, site.map.cells)
    assert written.map.geometry == site.map.geometry
    assert (written.site.areas, written.site.nodes) == (site.site.areas, site.site.nodes)
    assert written.site.places == site.site.places
    start, origin = written.site.robots[0].start, site.site.places[drawn.route.start]
    assert (start.x, start.y, start.theta) == (origin.x, origin.y, drawn.theta)
    assert (written.site.demo.goal, written.site.demo.areas) == (drawn.route.goal, [drawn.area])
