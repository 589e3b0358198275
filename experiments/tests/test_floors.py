"""The experiments on recorded floors fit the maps that they name, and leave a way whatever is blocked."""

from __future__ import annotations

import shutil
from pathlib import Path

import msgspec
import pytest

from fog_contracts.geometry import distance_to_polygon
from fog_runtime.configuration.maps import load_map, save_map
from fog_runtime.configuration.site import load_site
from fognav_experiments.comparison import runner
from fognav_experiments.comparison.drives import draw
from fognav_experiments.comparison.limits import RouteGeometry
from fognav_sim.barrier import KEEP_AWAY_M

FLOORS = Path(__file__).parents[1] / "floors"
MAPS = {
    "intel": "intel_bwi/intel.yaml",
    "stata": "mit/stata_basement.yaml",
    "utexas": "utexas/2.yaml",
}


def test_each_floor_is_one_whose_map_is_known():
    assert {folder.name for folder in FLOORS.iterdir() if folder.is_dir()} == MAPS.keys()


@pytest.mark.parametrize("name", MAPS)
def test_a_floor_fits_its_map_and_every_blocked_area_leaves_a_way(name, maps_dir, tmp_path):
    save_map(tmp_path / "map", load_map(maps_dir / MAPS[name]))
    for file in (FLOORS / name).glob("*.toml"):
        shutil.copy(file, tmp_path)
    site = load_site(tmp_path)
    spec = runner.read_spec(site, tmp_path)
    geometry, drawn = RouteGeometry(site), draw(spec, 1, 1)[0]
    for route in spec.routes:
        for area in route.areas:
            blocked = msgspec.structs.replace(drawn, route=route, area=area, moment="before", trigger_m=0.0)
            saving = geometry.saving(blocked)
            # It is the floor's, wherever in the area a barrier stands: a gap of 0.30 m once looked like a way.
            elsewhere = [geometry.saving(msgspec.structs.replace(blocked, seed=seed)).saved_m for seed in (1, 2, 3)]
            assert max(elsewhere) - min(elsewhere) < 1.0, f"{name}, {route.name}, {area}: {elsewhere}"
            assert saving is not None, f"{name}, {route.name}: no way is left when {area} is blocked"
            start, polygon = site.site.places[route.start], next(a.polygon for a in site.site.areas if a.id == area)
            beside_start = distance_to_polygon(polygon, start.x, start.y) < KEEP_AWAY_M  # where nothing appears
            assert saving.met != beside_start, f"{name}, {route.name}: {area} is not on the way"
