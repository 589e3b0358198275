"""The views of a demonstration: the terminal, and the page in a browser."""

import asyncio
import io
import json
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from msgspec import structs
from rich.console import Console

from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.messages import (
    AreaHazard,
    HazardArea,
    Place,
    Pose,
    RobotGoal,
    RobotPath,
    RobotPose,
    RobotState,
    SimObstacle,
    SimTruth,
    Trace,
)
from fog_contracts.site import AreaSite, DemoPlan, NodeSite, RobotSite, Site, Sonar
from fog_runtime.configuration.site import LoadedSite, load_site
from fog_supervisor import net
from fognav.demo.options import Options
from fognav.demo.run import Demo
from fognav.demo.scene import Scene
from fognav.demo.view import SCENARIO, render, serve
from fognav.output import WrongUseError

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


def loaded_site() -> LoadedSite:
    geometry = GridGeometry(200, 100, 0.1, -2.0, -1.0)
    cells = np.full(geometry.shape, 254, dtype=np.uint8)
    cells[10:90, 10:190] = 0
    cells[40:60, 40:160] = 255
    area = AreaSite(id="z1", label="Hall <b>", polygon=[(6, 0.2), (9, 0.2), (9, 2.8), (6, 2.8)])
    node = NodeSite(id="n1", area="z1", x=7.5, y=2.9, theta=-1.57, sonars=[Sonar(range_limit=2.0)])
    site = Site(
        id="test",
        name="Test floor",
        places={"a": Place(x=0.0, y=1.5, label="A"), "b": Place(x=15.0, y=1.5, label="B")},
        areas=[area],
        nodes=[node],
        robots=[RobotSite(id="r1", start=Pose(x=0.0, y=1.5, theta=0.0), radius=0.17)],
        demo=DemoPlan(start="a", goal="b", areas=["z1"]),
    )
    return LoadedSite(site, StaticMap(geometry, cells), Path("/nowhere"))


@pytest.fixture
def demo() -> Demo:
    demo = Demo(loaded_site(), Options(seed=7))
    scene = demo.scene
    scene.phase = "driving"
    scene.pose = RobotPose(
        x=3.0, y=1.5, theta=0.3, covariance=[0.0] * 9, v=0.3, w=0.0, radius=0.17, height=0.35, stamp=1.0
    )
    barrier = SimObstacle(id="barrier", polygon=[(7, 0.5), (8, 0.5), (8, 2.5)])
    scene.on_truth(
        SimTruth(
            robot="r1", x=3.0, y=1.5, theta=0.3, left=0.3, right=0.3, distance=3.25, clearance=0.8, min_clearance=0.5,
            contacts=0, obstacles=[barrier],
        )
    )  # fmt: skip
    scene.state = RobotState(
        mode="HOLD", reasons=["the map is 3.2 s old"], enabled=True, battery=None, goal_id="g", map_epoch=1, map_seq=2,
        plan_id=4, goal_distance=12.0,
    )  # fmt: skip
    scene.path = RobotPath(
        plan_id=4, planner_epoch=1, goal_id="g", points=[(3.0, 1.5), (15.0, 1.5)], map_epoch=1, map_seq=2,
        released_length=12.0,
    )  # fmt: skip
    scene.goal = RobotGoal(goal_id="g", pose=Pose(x=15.0, y=1.5, theta=0.0))
    hazard = AreaHazard(
        area="z1", state="blocked", severity=2, penalty=254, since=1.0, seq=1, epoch=1, cause="5 readings in a row"
    )
    scene.hazards["z1"] = HazardArea(hazard=hazard, polygon=scene.site.site.areas[0].polygon)
    scene.trace = Trace(
        area="z1", epoch=1, seq=1, first_reading=10.0, confirmed=10.45, costmap_published=10.46, plan_published=10.5,
        path_received=10.504,
    )  # fmt: skip
    scene.usage = {"planner": (12.3, 150.0)}
    scene.log_event("planner: plan 4, 12.0 m")
    return demo


async def test_only_the_address_that_the_demo_printed_leads_to_its_console(demo: Demo) -> None:
    async with serve(demo) as url:
        address = urlsplit(url)
        assert address.port is not None

        async def get(path: str) -> net.Response:
            return await asyncio.to_thread(net.request, "GET", address.port, path)

        assert (await get("/")).status == 404
        assert (await get("/..%2fapp.py")).status == 404
        starting = await get(address.path)
        assert (starting.status, "is starting" in starting.body) == (200, True)
        demo.attempt.console_login = lambda: "http://127.0.0.1:9/#login=token&scenario"
        assert (await get(address.path)).status == 303


async def test_scenario_tells_of_the_trail_what_the_page_does_not_have(demo: Demo) -> None:
    async with serve(demo) as url:
        port = urlsplit(url).port
        assert port is not None

        async def trail(after: int) -> tuple[int, int]:
            answer = await asyncio.to_thread(net.request, "GET", port, f"{SCENARIO}?trail={after}")
            found = answer.body
            return found["trail_from"], len(found["trail"])

        assert await trail(0) == (0, 1)
        assert await trail(1) == (1, 0)
        assert await trail(7) == (0, 1)  # that of an attempt before


async def test_port_in_use_is_refused_with_the_remedy(demo: Demo) -> None:
    async with serve(demo) as url:
        port = urlsplit(url).port
        with pytest.raises(
            WrongUseError, match=rf"port {port} \(Address already in use\): choose another with --page-"
        ):
            async with serve(demo, port):
                pass


def test_scenario_is_valid_json_before_any_message() -> None:
    json.dumps(Demo(loaded_site(), Options()).scene.scenario_view(), allow_nan=False)


def test_terminal_shows_mode_reason_hazard_and_latency(demo: Demo) -> None:
    console = Console(width=140, record=True, file=io.StringIO())
    console.print(render(demo.scene, 40))
    text = console.export_text()
    for expected in ("HOLD", "the map is 3.2 s old", "Hall <b>", "blocked", "450 ms", "504 ms", "planner", "plan 4"):
        assert expected in text


def test_terminal_marks_areas_that_no_living_aggregator_confirms(demo: Demo) -> None:
    demo.scene.hazards["z1"] = structs.replace(demo.scene.hazards["z1"], confirmed=False)
    console = Console(width=140, record=True, file=io.StringIO())
    console.print(render(demo.scene, 40))
    text = console.export_text()
    assert "blocked?" in text
    assert "not confirmed" in text
