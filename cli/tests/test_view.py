"""The terminal view of a demonstration."""

import io
from pathlib import Path

import pytest
from rich.console import Console

from fog_contracts.messages import AreaHazard, HazardArea
from fog_runtime.configuration.site import load_site
from fognav.demo.scene import Scene
from fognav.demo.view import render

ESTIG = Path(__file__).parents[2] / "sites" / "estig"


@pytest.mark.parametrize("width", [80, 100, 130, 200])
def test_states_of_areas_are_never_truncated(width):
    site = load_site(ESTIG)
    scene = Scene(site, "r1", 1, 1.0)
    states = dict(zip((area.id for area in site.site.areas), ("clear", "blocked", "unknown"), strict=False))
    for area in site.site.areas[:3]:
        hazard = AreaHazard(
            area=area.id, state=states[area.id], severity=0, penalty=0, since=0.0, seq=1, epoch=1, cause=""
        )
        scene.hazards[area.id] = HazardArea(hazard=hazard, polygon=area.polygon, label=area.label or "")
    console = Console(width=width, height=40, record=True, file=io.StringIO())
    console.print(render(scene, 40))
    text = console.export_text()
    for state in ("clear", "blocked", "unknown", "no state"):
        assert state in text
