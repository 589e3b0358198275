"""The console in a real Chromium: what it shows, whom it stops, how it reconnects, and whether everybody can use it."""

import asyncio
import base64
import json
from collections.abc import AsyncIterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from console_stream import TOKEN, ConsoleStream, robot_pose, robot_state, serve
from msgspec import to_builtins
from playwright.async_api import Page, async_playwright, expect

from fog_contracts.grid import StaticMap
from fog_contracts.messages import (
    Alert,
    AreaDefinition,
    AreaHazard,
    CircleShape,
    Place,
    PlanReply,
    PolygonShape,
    Trace,
    Zone,
)
from fog_runtime.configuration.maps import save_map
from fog_runtime.configuration.site import load_site
from fognav import console_page, system
from map_service.map_check import MapUpload, Task, check

pytestmark = [pytest.mark.browser, pytest.mark.drive]

ROOT = Path(__file__).parents[1]
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--disable-background-networking"]
HOSTILE = "<script>alert(1)</script>\u202eevil" + "x" * 10_000
PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
WIDE = {"viewport": {"width": 1440, "height": 900}}
VIEWS = ("map", "zones", "robots", "sensors", "timeline")
AXE = ROOT / "console/node_modules/axe-core/axe.min.js"


@pytest.fixture(scope="module", autouse=True)
def page_is_built() -> None:
    if system.find(system.CHROMIUM) is None:
        pytest.skip(f"no Chromium: {system.install_command([system.CHROMIUM])}, or ./fognav test --yes as root")
    console_page.build(ROOT)


@pytest.fixture
async def stream() -> ConsoleStream:
    stream = ConsoleStream(load_site(ROOT / "sites" / "estig"))
    for number, name in enumerate(("r1", "r2")):
        stream.tell("pose", name, robot_pose(10.0 + 5 * number, 26.0, 0.0))
        stream.robot(name, robot_state())
    return stream


@pytest.fixture
async def console(stream: ConsoleStream) -> AsyncIterator[SimpleNamespace]:
    """Opens the console in contexts of one browser; the test fails for an error in any page, or a request elsewhere."""
    problems: list[str] = []
    async with serve(stream) as url, async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=str(system.find(system.CHROMIUM)), args=FLAGS)

        async def opened(view: str = "map", **context: object) -> Page:
            page = await (await browser.new_context(**{**WIDE, "locale": "en-GB", **context})).new_page()
            page.on("pageerror", lambda error: problems.append(str(error)))
            page.on("request", lambda r: None if r.url.startswith((url, "data:", "blob:")) else problems.append(r.url))
            await page.goto(f"{url}#login={TOKEN}")
            await expect(page.get_by_text("Live", exact=True)).to_be_visible()
            await page.evaluate("view => { location.hash = `#/${view}` }", view)
            return page

        yield SimpleNamespace(open=opened, url=url, browser=browser)
        await browser.close()
    assert problems == []


def requests(stream: ConsoleStream, method: str) -> list[str]:
    return [name for name, _ in stream.requests if name.startswith(method) and not name.endswith("session")]


async def test_one_time_login_leaves_no_trace_in_the_address(console: SimpleNamespace) -> None:
    page = await console.open()
    assert TOKEN not in page.url
    assert TOKEN not in json.dumps(await page.evaluate("[history.state, {...localStorage}, {...sessionStorage}]"))
    # Nor one that is opened where the page is shown already, as a code may be: nothing is loaded anew then.
    await page.evaluate("location.hash = '#login=another'")
    await page.wait_for_url(f"{console.url}#/map")
    await expect(page.get_by_text("Live", exact=True)).to_be_visible()


async def test_page_that_is_shown_keeps_its_login(console: SimpleNamespace, stream: ConsoleStream) -> None:
    page = await console.browser.new_page()
    await page.clock.install()
    await page.goto(f"{console.url}#login={TOKEN}")
    await expect(page.get_by_text("Live", exact=True)).to_be_visible()
    asked = [name for name, _ in stream.requests].count("GET session")
    async with page.expect_response(lambda answer: answer.url.endswith("/session")):
        await page.clock.fast_forward(3_600_000)
    assert [name for name, _ in stream.requests].count("GET session") == asked + 1


@pytest.mark.smoke
async def test_person_logs_in_by_token_and_out_again(console: SimpleNamespace) -> None:
    page = await console.browser.new_page()
    await page.goto(console.url)
    await page.get_by_label("Token").fill("wrong")
    await page.keyboard.press("Enter")
    await expect(page.get_by_role("alert")).to_contain_text("Nobody has this token")
    await page.get_by_label("Token").fill(TOKEN)
    await page.keyboard.press("Enter")
    await expect(page.get_by_text("Live", exact=True)).to_be_visible()
    await page.get_by_text("Settings").click()
    await page.get_by_role("button", name="Log out").click()
    await expect(page.get_by_label("Token")).to_be_visible()
    # A robot that was known can be stopped by who is not logged in.
    await expect(page.get_by_role("button", name="Stop all")).to_be_enabled()


@pytest.mark.parametrize("device", [WIDE, PHONE], ids=["wide", "phone"])
async def test_stop_is_on_every_view_at_the_same_place_and_needs_one_press(
    console: SimpleNamespace, stream: ConsoleStream, device: dict[str, object]
) -> None:
    page = await console.open(**device)
    places = set()
    for number, view in enumerate(VIEWS, 1):
        await page.evaluate("view => { location.hash = `#/${view}` }", view)
        await expect(page.locator(f"[data-view={view}]")).to_be_visible()
        button = page.get_by_role("button", name="Stop r1")
        places.add(json.dumps(await button.bounding_box()))
        await button.click()
        await expect(page.locator(".said")).to_have_text("r1 stops.")
        assert requests(stream, "POST") == ["POST robots/r1/stop"] * number
    assert len(places) == 1
    stream.requests.clear()
    await page.keyboard.press("Shift+F9")
    async with asyncio.timeout(30):
        while len(requests(stream, "POST")) < 2:  # noqa: ASYNC110  # the page says it for the last one only
            await asyncio.sleep(0.05)
    assert sorted(requests(stream, "POST")) == ["POST robots/r1/stop", "POST robots/r2/stop"]


async def test_stop_that_fails_says_so_and_what_to_do(console: SimpleNamespace, stream: ConsoleStream) -> None:
    stream.answers["POST robots/r1/stop"] = (504, {"type": "urn:fognav:command_lost", "detail": "r1 does not answer."})
    page = await console.open()
    await page.keyboard.press("F9")
    await expect(page.locator(".said.failed")).to_have_text("r1 was not stopped: r1 does not answer. Stop it by hand.")


async def test_enable_asks_first_and_a_refusal_is_said(console: SimpleNamespace, stream: ConsoleStream) -> None:
    stream.robot("r1", robot_state("HOLD", enabled=False, reasons=["not enabled"], codes=["not_enabled"]))
    refusal = {"type": "urn:fognav:command_refused", "status": 409, "detail": "a fault must be reset first"}
    stream.answers["POST robots/r1/commands"] = (409, refusal)
    page = await console.open("robots")
    await expect(page.locator(".lead")).to_have_text("not enabled. Enable it.")
    await page.get_by_role("button", name="Enable", exact=True).click()
    await page.keyboard.press("Escape")
    assert requests(stream, "POST") == []
    await page.get_by_role("button", name="Enable", exact=True).click()
    await page.get_by_role("button", name="Stop r1").click()  # while the question stands there
    await expect(page.locator(".said")).to_have_text("r1 stops.")
    await page.get_by_role("button", name="Cancel", exact=True).click()
    await page.get_by_role("button", name="Enable", exact=True).click()
    await page.get_by_role("button", name="Yes, Enable").click()
    await expect(page.locator(".said.failed")).to_contain_text("a fault must be reset first")
    assert stream.requests[-1] == ("POST robots/r1/commands", {"kind": "enable"})


async def test_robot_is_taken_out_of_service_and_put_back_and_says_why_it_gets_no_goal(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    page = await console.open("robots")
    await page.get_by_role("button", name="Take out of service").click()
    form = page.get_by_role("form", name="Service of r1")
    await form.get_by_label("Reason").fill("worn wheel")
    await form.get_by_role("button", name="1.0 h").or_(form.get_by_role("button", name="60 min")).click()
    await form.get_by_role("button", name="Take out of service").click()
    await expect(page.locator(".said")).to_have_text("r1 is out of service.")
    assert stream.requests[-1] == ("PUT robots/r1/out-of-service", {"reason": "worn wheel", "ttl_s": 3600})
    out = {"id": "1", "reason": "worn wheel", "by": "ana", "since": 1.0, "until": None}
    stream.robot("r1", robot_state(), out_of_service=out)
    says = "Out of service: worn wheel (ana). Put it back into service, then send it."
    await expect(page.locator(".lead")).to_have_text(says)
    await expect(page.get_by_role("button", name="Send to a goal")).to_be_disabled()
    stream.robot("r1", robot_state("FAULT", reasons=["bumper"], codes=["bumper"]), out_of_service=out)
    await expect(page.locator(".lead")).to_contain_text("bumper")
    await expect(page.get_by_text(says, exact=True)).to_be_visible()
    await page.get_by_role("button", name="Put back into service").click()
    await page.get_by_role("form", name="Service of r1").get_by_role("button", name="Put back into service").click()
    await expect(page.locator(".said")).to_have_text("r1 is in service.")
    assert stream.requests[-1] == ("DELETE robots/r1/out-of-service", None)


async def test_robot_shows_cpu_beside_that_of_one_that_drives_alone_and_its_wifi(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    def vitals(stamp: float, agent: float, wifi: float | None) -> dict[str, object]:
        return {
            "stamp": stamp, "cpu": {"agent": agent, "guardian": 1.0}, "wifi_dbm": wifi, "battery": 0.7
        }  # fmt: skip

    stream.answers["GET vitals/r1"] = (200, [vitals(1000.0 + 2 * n, 3.0, -50.0) for n in range(30)])
    page = await console.open("robots")
    stream.tell("vitals", "r1", vitals(1060.0, 4.2, -61.0))
    shown = page.get_by_role("region", name="Its computer, the last ten minutes")
    await expect(shown.get_by_text("5.2 %")).to_be_visible()
    await expect(shown.get_by_text("-61 dBm")).to_be_visible()
    await expect(shown.get_by_text("Dashed: 7.4 % of a core, what a robot took that drove alone")).to_be_visible()
    await expect(shown.get_by_role("img", name="4.0 % to 5.2 %")).to_be_visible()
    line = await shown.locator("svg path:not(.baseline)").first.get_attribute("d")
    assert line.count("L") == 30, "one line through what was kept and what came"
    assert await shown.locator("path.baseline").count() == 1
    stream.tell("vitals", "r2", vitals(1060.0, 2.0, None))
    await expect(page.get_by_role("button", name="r2")).to_contain_text("CPU 3.0 % · no Wi-Fi")


async def test_what_is_typed_stays_while_others_change_things_and_counts_when_the_field_is_left(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    circle = CircleShape(centre=(5.0, 6.0), radius=1.0)
    zone = to_builtins(Zone(id="wet", kind="BLOCKED", shape=circle, version=1, reason="wet floor"))
    stream.tell("zone", "wet", {**zone, "active": True})
    page = await console.open("zones")
    await page.get_by_role("button", name="Edit wet").click()
    for version, (label, typed) in enumerate((("Reason", "paint"), ("Radius (m)", "2.5")), 2):
        await page.get_by_label(label).press("Control+a")
        await page.keyboard.type(typed)
        # Somebody else's change draws the form anew, and is told in it.
        stream.tell("zone", "wet", {**zone, "version": version, "author": f"anna{version}", "active": True})
        await expect(page.get_by_text(f"anna{version} has changed this zone meanwhile.")).to_be_visible()
        await expect(page.get_by_label(label)).to_have_value(typed)
    stream.answers["PUT zones/wet"] = (200, {**zone, "version": 4})
    await page.get_by_role("button", name="Save").click()
    await expect(page.locator(".said")).to_contain_text("is saved")
    _, body = next(request for request in stream.requests if request[0] == "PUT zones/wet")
    assert (body["reason"], body["shape"]["radius"]) == ("paint", 2.5)


async def test_goal_by_click_shows_its_path_before_it_is_sent(console: SimpleNamespace, stream: ConsoleStream) -> None:
    path = PlanReply(points=[(10.0, 26.0), (30.0, 26.0)], length=20.0)
    stream.answers["POST plan"] = (200, to_builtins(path))
    page = await console.open("robots")
    await page.get_by_role("button", name="Send to a goal").click()
    await page.locator(".floor").click(position={"x": 400, "y": 300})
    await expect(page.get_by_text("The path is 20.0 m long.")).to_be_visible()
    assert requests(stream, "PUT") == []
    await page.get_by_role("button", name="Send", exact=True).click()
    await expect(page.locator(".said")).to_contain_text("r1 drives to")
    name, body = stream.requests[-1]
    assert name == "PUT robots/r1/goal"
    assert body["pose"]["theta"] is None


async def test_pose_is_given_by_a_drag_or_by_two_clicks(console: SimpleNamespace, stream: ConsoleStream) -> None:
    page = await console.open("robots")
    await page.get_by_role("button", name="Say where it is").click()
    form = page.get_by_role("form", name="Where r1 stands")
    box = await page.locator(".floor").bounding_box()
    assert box is not None
    x, y = box["x"] + 300, box["y"] + 300
    await page.mouse.move(x, y)
    await page.mouse.down()
    await page.mouse.move(x, y - 60, steps=3)
    await page.mouse.up()
    await expect(form.get_by_label("Heading (°)")).to_have_value("90")
    dragged = await form.get_by_label("x (m)").input_value()
    await page.mouse.click(x + 100, y)
    await expect(form.get_by_text("Now click where it looks.")).to_be_visible()
    await page.mouse.click(x + 20, y)
    await expect(form.get_by_label("Heading (°)")).to_have_value("180")
    assert await form.get_by_label("x (m)").input_value() != dragged
    await form.get_by_role("button", name="Set").click()
    await expect(page.locator(".said")).to_contain_text("r1 knows its position")
    assert stream.requests[-1][1]["kind"] == "initial_pose"


async def test_tile_changes_its_cells_of_the_costmap_and_no_others(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    page = await console.open()
    geometry = stream.site.map.geometry
    hashes = """() => Promise.all([...document.querySelectorAll('.leaflet-costs-pane canvas')].map(async canvas => {
        const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext('2d');
        copy.drawImage(canvas, 0, 0);
        return copy.getImageData(0, 0, canvas.width, canvas.height).data.reduce((sum, byte) => (sum * 31 + byte) % 1e9);
    }))"""
    await page.wait_for_function("() => document.querySelectorAll('.leaflet-costs-pane canvas').length === 12")
    await page.wait_for_timeout(1000)  # the tiles of the beginning are drawn within some frames
    before = await page.evaluate(hashes)
    cells = np.full((16, 16), 254, dtype=np.uint8)
    cells[0, 15] = 0  # the lower right corner of the map becomes free
    stream.tile(geometry.width - 16, 0, cells)
    await page.wait_for_function(
        f"async before => (await ({hashes})()).join() !== before", arg=",".join(map(str, before))
    )
    assert sum(old != new for old, new in zip(before, await page.evaluate(hashes), strict=True)) == 1


async def test_page_goes_on_where_a_broken_connection_ended(console: SimpleNamespace, stream: ConsoleStream) -> None:
    page = await console.open()
    stream.cut()
    stream.hazard("z2", "blocked")
    await expect(page.locator("main")).to_contain_text("blocked since")
    assert stream.resumed_from[0] is None
    assert (stream.resumed_from[-1] or "").startswith("first-")
    # Another run of the server knows other things, and the page forgets what it had.
    stream.run = "second"
    stream.log.pop(("robot", "r2"))
    stream.log.pop(("pose", "r2"))
    stream.cut()
    await expect(page.get_by_role("button", name="Choose r2")).to_have_count(0)


async def test_what_is_older_than_two_seconds_is_grey_and_says_so(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    page = await console.open()
    stream.silent = True
    await expect(page.get_by_text("What you see is old.")).to_be_visible()
    await expect(page.locator("button.robot.stale").first).to_contain_text("No word for more than 2 s")
    grey = "() => getComputedStyle(document.querySelector('.stage')).filter.includes('grayscale')"
    assert await page.evaluate(grey)
    stream.silent = False
    stream.tell("pose", "r1", robot_pose(1.0, 1.0, 0.0))
    await expect(page.get_by_text("Live", exact=True)).to_be_visible()
    assert not await page.evaluate(grey)


async def test_hostile_names_are_text_everywhere(console: SimpleNamespace, stream: ConsoleStream) -> None:
    stream.tell("zone", HOSTILE, _zone(HOSTILE, HOSTILE))
    stream.robot(HOSTILE, robot_state("HOLD", reasons=[HOSTILE], codes=["x"]))
    stream.tell("place", HOSTILE, {"x": 12.0, "y": 30.0, "theta": None, "label": HOSTILE})
    definition = AreaDefinition(id="z1", label=HOSTILE, polygon=[(10.0, 25.0), (14.0, 25.0), (14.0, 28.0)])
    hazard = AreaHazard(area="z1", state="blocked", severity=0, penalty=0, since=1.0, seq=1, epoch=1, cause=HOSTILE)
    override = {"state": "blocked", "until": 4e9, "by": HOSTILE, "reason": HOSTILE}
    stream.tell("area", "z1", {"definition": definition, "hazard": hazard, "withheld": False, "override": override})
    node = stream.log["node", "n1"][2]["value"]
    stream.tell("node", "n1", {**node, "reason": HOSTILE, "online": False})
    alert = Alert(id=HOSTILE, kind="node-unknown", area="z1", reason=HOSTILE, since=1.0, raised=2.0)
    stream.tell("alert", HOSTILE, alert)
    entry = {"at": 1.0, "who": HOSTILE, "id": HOSTILE, "before": None, "after": {"id": HOSTILE, "reason": HOSTILE}}
    kinds = ("zone", "place", "override", "mission", "robot", "stop", "set", "hazard", "fault", "alert")
    stream.answers["GET timeline"] = (
        200, [{**entry, "kind": kind, "action": "put", "text": HOSTILE, "entry": f"{kind}-1"} for kind in kinds],
    )  # fmt: skip
    for device in (WIDE, PHONE):
        page = await console.open(**device)
        for view in VIEWS:
            await page.evaluate("view => { location.hash = `#/${view}` }", view)
            await expect(page.locator(f"[data-view={view}]")).to_be_visible()
            if view == "timeline":
                await expect(page.locator("ol.timeline > li")).to_have_count(len(kinds))
            assert await page.evaluate("document.querySelectorAll('main script, main img[src=x]').length") == 0
            assert await page.evaluate("document.querySelectorAll('script').length") == 1
            assert await page.evaluate("document.documentElement.scrollWidth <= innerWidth")
            await expect(page.get_by_role("button", name="Stop all")).to_be_in_viewport(ratio=1.0)


def _zone(name: str, reason: str) -> dict[str, object]:
    shape = PolygonShape(points=[(10.0, 25.0), (14.0, 25.0), (14.0, 28.0)])
    return {**to_builtins(Zone(id="z", kind="BLOCKED", shape=shape)), "id": name, "reason": reason, "active": True}


@pytest.mark.parametrize("device", [WIDE, PHONE], ids=["wide", "phone"])
@pytest.mark.parametrize("scheme", ["light", "dark"])
async def test_every_view_keeps_the_rules_of_wcag_that_a_program_can_check(
    console: SimpleNamespace, stream: ConsoleStream, device: dict[str, object], scheme: str
) -> None:
    stream.role = "admin"
    stream.answers["GET map/state"] = 200, {"name": "0" * 16, "version": 1, "back": True}
    stream.tell("zone", "wet", _zone("wet", "wet floor"))
    stream.hazard("z2", "blocked")
    traces = [Trace(area="z2", epoch=1, seq=1, first_reading=1.0, confirmed=1.5)]
    stream.robot("r1", robot_state("FAULT", reasons=["bumper pressed"], codes=["bumper"], traces=traces))
    dry_run = {"map_epoch": 1, "map_seq": 1, "robots": [], "cut_off": [], "connected": [], "unfinished": []}
    stream.answers["POST dry-run"] = (200, dry_run)
    page = await console.open(**device, color_scheme=scheme, reduced_motion="reduce", bypass_csp=True)
    found = []
    for view in VIEWS:
        await page.evaluate("view => { location.hash = `#/${view}` }", view)
        await expect(page.locator(f"[data-view={view}]")).to_be_visible()
        if view == "robots":
            await page.get_by_role("button", name="Send to a goal").click()
        elif view == "map":
            await page.get_by_text("Another map").click()
        found += await violations(page, view)
        if view == "zones":
            await page.get_by_role("button", name="Corridor").click()
            await page.get_by_role("button", name="Put it in the middle").click()
            found += await violations(page, "a zone that is drawn")
        elif view == "sensors":
            await page.get_by_role("link", name="Middle corridor").first.click()
            found += await violations(page, "an area")
            await page.get_by_role("button", name="Place", exact=True).click()
            found += await violations(page, "an area that is placed")
    await page.get_by_text("Settings").click()
    found += await violations(page, "settings")
    assert found == []


async def violations(page: Page, where: str) -> list[str]:
    await page.evaluate(AXE.read_text("utf-8"))
    tags = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
    result = await page.evaluate("tags => axe.run({ runOnly: { type: 'tag', values: tags } })", tags)
    return [
        f"{where}: {each['id']}: {each['nodes'][0]['html'][:120]} {each['nodes'][0]['failureSummary'][:300]}"
        for each in result["violations"]
    ]


async def test_administrator_sees_what_would_lie_in_a_wall_before_another_map_is_in_force(
    console: SimpleNamespace, stream: ConsoleStream, tmp_path: Path
) -> None:
    stream.role = "admin"
    stream.answers["GET map/state"] = 200, {"name": None, "version": 0, "back": False}

    def another(*, at: tuple[float, float]) -> str:
        """Write a map with one more wall, and let it be looked at as by the map-service; return the preview's id."""
        static = stream.site.map
        cells, window = static.cells.copy(), static.geometry.window_around(at[0] - 1, at[1] - 0.5, at[0] + 1, at[1])
        cells[window.rows, window.columns] = 254
        save_map(tmp_path / "new", StaticMap(static.geometry, cells), image="png")
        upload = MapUpload(yaml=(tmp_path / "new.yaml").read_text(), image=(tmp_path / "new.png").read_bytes())
        report = check(
            Task(
                root=str(tmp_path), site_dir=str(ROOT / "sites" / "estig"), site="estig", upload=upload, zones=[],
                places={"sofa": Place(x=10.0, y=26.0)}, poses={}, goals={},
            )
        )  # fmt: skip
        refused = any(one.refused for one in report.findings)
        preview = f"{report.name}-0-0123456789ab"
        about = {"id": preview, "accepted": False, "refused": refused, "robots": True}
        stream.answers["POST map/preview"] = 200, {**to_builtins(report), **about}
        picture = (tmp_path / "estig" / f"{report.name}-changes.png").read_bytes()
        stream.answers[f"GET map/previews/{preview}.png"] = 200, picture
        return preview

    page = await console.open()
    await page.get_by_text("Another map").click()
    await page.get_by_role("button", name="Look at it").click()
    await expect(page.get_by_role("alert")).to_have_text("Choose both files.")
    another(at=(59.0, 44.0))  # place b
    await page.get_by_label("YAML file").set_input_files(tmp_path / "new.yaml")
    await page.get_by_label("Picture").set_input_files(tmp_path / "new.png")
    await page.get_by_role("button", name="Look at it").click()
    preview = page.get_by_role("region", name="What the map would change")
    await expect(preview.get_by_role("listitem").filter(has_text="Place b")).to_contain_text("must be moved first")
    await expect(page.locator("path.finding")).not_to_have_count(0)
    await expect(preview.get_by_role("button", name="Put it into force")).to_be_disabled()
    sent = next(body for name, body in stream.requests if name == "POST map/preview")
    assert base64.b64decode(sent["upload"]["image"]) == (tmp_path / "new.png").read_bytes()

    seen = another(at=(10.0, 26.0))
    await page.get_by_label("YAML file").set_input_files(tmp_path / "new.yaml")
    await page.get_by_label("Picture").set_input_files(tmp_path / "new.png")
    await page.get_by_role("button", name="Look at it").click()
    await expect(preview.get_by_role("listitem").filter(has_text="sofa")).to_contain_text("lies in a wall")
    await preview.get_by_label("I have seen what does not fit").check()
    stream.answers["PUT map"] = 200, {"name": seen[:16], "version": 1, "back": True}
    await preview.get_by_role("button", name="Put it into force").click()
    await expect(page.get_by_text("The services start anew")).to_be_visible()
    assert [body for name, body in stream.requests if name == "PUT map"] == [{"preview": seen, "accept": True}]


async def test_area_that_somebody_has_changed_meanwhile_is_shown_in_both_versions(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    page = await console.open("sensors")
    await page.get_by_role("link", name="Upper corridor").first.click()
    await page.get_by_role("button", name="Place", exact=True).click()
    await page.get_by_label("Label").fill("my name")
    area = next(each for each in stream.site.site.areas if each.label == "Upper corridor")
    path = f"areas/{area.id}"
    changed = {"type": "urn:fognav:area_changed", "title": "changed", "status": 412, "detail": "read it again"}
    stream.answers[f"PUT {path}"] = 412, changed
    definition = AreaDefinition(id=area.id, label="their name", polygon=area.polygon, version=7)
    theirs = {"definition": to_builtins(definition), "hazard": None, "withheld": False, "override": None}
    stream.answers[f"GET {path}"] = 200, theirs
    entry = {"at": 1.0, "who": "rui", "action": "replace", "kind": "area", "id": area.id, "entry": "1-1.area"}
    stream.answers["GET audit"] = 200, [{**entry, "before": None, "after": None}]
    await page.get_by_role("button", name="Save", exact=True).click()
    both = page.get_by_role("alertdialog")
    await expect(both.get_by_role("row", name="Label")).to_have_text("Labelmy nametheir name")
    await expect(both.get_by_role("columnheader", name="Of rui")).to_be_visible()
    stream.answers[f"PUT {path}"] = 200, theirs["definition"]
    await both.get_by_role("button", name="Save mine").click()
    await expect(page.get_by_role("alertdialog")).to_have_count(0)
    assert [body["label"] for name, body in stream.requests if name == f"PUT {path}"] == ["my name", "my name"]


async def test_operator_sets_the_times_of_a_set_of_zones_and_mutes_a_source(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    night = {"id": "night", "name": "", "enabled": True, "schedule": None, "version": 3, "on": True, "zones": ["wet"]}
    door = {"id": "door", "label": "", "muted": False, "version": 0, "zones": [], "refused": 0, "problem": ""}
    stream.answers |= {"GET zone-sets": (200, [night]), "GET zone-sources": (200, [door])}
    page = await console.open("zones")
    times = page.get_by_role("region", name="Sets of zones").get_by_role("group")
    await times.get_by_text("Times", exact=True).click()
    await page.get_by_role("button", name="Add a weekly schedule").click()
    await page.get_by_label("from").fill("22:00")
    await page.get_by_label("to", exact=True).fill("06:00")
    await page.get_by_role("button", name="Save", exact=True).click()
    await expect(page.get_by_text("The times of the set night are saved.")).to_be_visible()
    await page.get_by_role("button", name="Mute door").click()
    await expect(page.get_by_text("door is muted")).to_be_visible()
    sent = {name: body for name, body in stream.requests if name.startswith("PUT")}
    assert sent["PUT zone-sources/door"] == {"muted": True}
    (window,) = sent["PUT zone-sets/night"]["schedule"]["times"]
    assert (window["begin"], window["end"]) == ("22:00", "06:00")
