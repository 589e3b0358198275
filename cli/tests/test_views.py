"""The views of a demonstration: the terminal, and the page in a browser."""

import asyncio
import io
import json
from collections.abc import AsyncIterator
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs
from PIL import Image
from playwright.async_api import Page, async_playwright
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
from fognav import system
from fognav.demo.options import Options
from fognav.demo.page import map_png, serve
from fognav.demo.run import Demo
from fognav.demo.scene import Scene
from fognav.demo.view import render
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


FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
]


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


def test_map_image_encodes_free_occupied_and_unknown_with_the_top_row_first(demo: Demo) -> None:
    static = demo.site.map
    with Image.open(io.BytesIO(map_png(static))) as image:
        kinds = np.asarray(image)
    assert kinds.shape == static.cells.shape
    assert set(np.unique(kinds)) == {0, 1, 2}
    column, row = static.geometry.cell(3.0, 1.5)
    assert kinds[static.geometry.height - 1 - row, column] == 0


async def test_page_serves_only_its_own_files(demo: Demo) -> None:
    async with serve(demo) as url:
        port = int(url.rstrip("/").rsplit(":", 1)[1])
        for path, status in (("/", 200), ("/app.js", 200), ("/style.css", 200), ("/map.png", 200), ("/app.py", 404)):
            assert (await asyncio.to_thread(net.request, "GET", port, path)).status == status, path
        outside = await asyncio.to_thread(net.request, "GET", port, "/..%2fapp.py")
        assert outside.status == 404


async def test_port_in_use_is_refused_with_the_remedy(demo: Demo) -> None:
    async with serve(demo) as url:
        port = int(url.rstrip("/").rsplit(":", 1)[1])
        with pytest.raises(
            WrongUseError, match=rf"port {port} \(Address already in use\): choose another with --page-"
        ):
            async with serve(demo, port):
                pass


def test_scene_is_valid_json_before_any_message() -> None:
    scene = Demo(loaded_site(), Options()).scene
    json.dumps(scene.static_view(), allow_nan=False)
    json.dumps(scene.live_view(), allow_nan=False)


def test_terminal_shows_mode_reason_hazard_and_latency(demo: Demo) -> None:
    console = Console(width=140, record=True, file=io.StringIO())
    console.print(render(demo.scene, 40))
    text = console.export_text()
    for expected in ("HOLD", "the map is 3.2 s old", "Hall <b>", "blocked", "450 ms", "504 ms", "planner", "plan 4"):
        assert expected in text


def test_terminal_and_page_mark_areas_that_no_living_aggregator_confirms(demo: Demo) -> None:
    assert demo.scene.live_view()["unconfirmed"] == []
    demo.scene.hazards["z1"] = structs.replace(demo.scene.hazards["z1"], confirmed=False)
    assert demo.scene.live_view()["unconfirmed"] == ["z1"]
    console = Console(width=140, record=True, file=io.StringIO())
    console.print(render(demo.scene, 40))
    text = console.export_text()
    assert "blocked?" in text
    assert "not confirmed" in text


@pytest.fixture
async def page(demo: Demo) -> AsyncIterator[Page]:
    chromium = system.find(system.CHROMIUM)
    if chromium is None:
        pytest.skip(f"no Chromium: {system.install_command([system.CHROMIUM])}, or ./fognav test --yes as root")
    async with serve(demo) as url, async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=str(chromium), args=FLAGS)
        opened = await browser.new_page(viewport={"width": 1200, "height": 800})
        problems: list[str] = []
        opened.on("pageerror", lambda error: problems.append(str(error)))
        opened.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
        opened.on("request", lambda r: None if r.url.startswith((url, "data:")) else problems.append(r.url))
        await opened.goto(url)
        yield opened
        await browser.close()
    assert problems == []


async def pixel(page: Page, x: float, y: float) -> list[int]:
    """Colour on the canvas at a point in metres."""
    found: list[int] = await page.evaluate(
        """([x, y]) => { const r = devicePixelRatio;
        return [...context.getImageData(Math.round(px(x) * r), Math.round(py(y) * r), 1, 1).data].slice(0, 3); }""",
        [x, y],
    )
    return found


@pytest.mark.browser
async def test_browser_shows_robot_hazard_and_latency(page: Page) -> None:
    await page.wait_for_selector("#events li")
    assert await page.inner_text("#mode") == "HOLD"
    assert await page.inner_text("#reasons") == "the map is 3.2 s old"
    assert "plan 4, 12.0 m" in await page.inner_text("#events")
    assert "504 ms" in await page.inner_text("#total")
    assert "planner" in await page.inner_text("#processes")
    await page.wait_for_function("() => latest && floorImage && !drawPending")
    free, wall, hazard, barrier = [await pixel(page, *at) for at in ((1.0, 1.0), (-1.8, 5.0), (6.3, 0.6), (7.7, 1.0))]
    assert free == [255, 255, 255]
    assert sum(wall) < 300
    assert hazard[0] > hazard[1] + 40
    assert barrier[0] > barrier[1] + 40
    assert barrier != hazard


@pytest.mark.browser
async def test_page_updates_mode_and_events(page: Page, demo: Demo) -> None:
    await page.wait_for_selector("#events li")
    state = demo.scene.state
    assert state is not None
    demo.scene.state = RobotState(
        mode="NORMAL", reasons=[], enabled=True, battery=None, goal_id="g", map_epoch=1, map_seq=2, plan_id=4
    )
    demo.scene.log_event("a new event")
    await page.wait_for_function("() => document.getElementById('mode').textContent === 'NORMAL'")
    await page.wait_for_function("() => document.getElementById('events').textContent.includes('a new event')")


@pytest.mark.browser
async def test_map_can_be_zoomed_and_fitted_again(page: Page) -> None:
    await page.wait_for_function("() => view !== null")
    before = await page.evaluate("view.scale")
    await page.mouse.move(400, 300)
    await page.mouse.wheel(0, -400)
    await page.wait_for_function("before => view.scale > before * 1.5", arg=before)
    await page.click("#fit")
    await page.wait_for_function("before => Math.abs(view.scale - before) < 1e-6", arg=before)
