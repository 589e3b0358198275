"""`fognav bench pipeline`: with a small load no reading is lost, and hazards reach the map."""

import pytest

from fog_runtime.configuration.site import load_site
from fognav_experiments.bench import pipeline


def test_site_of_the_benchmark_is_valid_and_one_area_has_most_nodes(tmp_path):
    pipeline.write_nodes(tmp_path, 400)
    site = load_site(tmp_path).site
    sizes = sorted(len(definition.nodes) for definition in site.definitions())
    assert (sum(sizes), sizes[-1], sizes[-2]) == (400, 130, 4)


@pytest.mark.live
async def test_no_reading_of_a_small_load_is_lost_and_hazards_reach_the_map(tmp_path):
    phases: list[str] = []
    figures = await pipeline.measure(tmp_path, nodes=12, rate=20.0, robots=2, seconds=5.0, on_phase=phases.append)
    assert len(phases) == 3
    assert figures["sent"] >= 1200
    assert figures["lost"] == 0
    assert figures["hazards"] >= 1
    assert 0 < figures["confirmed_to_delta_p50_ms"] <= figures["confirmed_to_delta_p99_ms"]
    assert figures["confirmed_to_delta_p50_ms"] < figures["reading_to_delta_p50_ms"]
    assert figures["aggregator_us_per_reading"] > 0
