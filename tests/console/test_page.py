"""The console's page in a real Chromium: logins, what is old, how it reconnects, and whether everybody can use it."""

import asyncio
import json
import re
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from console_stream import PHONE, TOKEN, VIEWS, WIDE, ConsoleStream, robot_pose, robot_state, schedule
from msgspec import to_builtins
from playwright.async_api import Page, expect

from fog_contracts.messages import Alert, AreaDefinition, AreaHazard, PolygonShape, Trace, Zone

HOSTILE = "<script>alert(1)</script>\u202eevil" + "x" * 10_000
AXE = Path(__file__).parents[2] / "console/node_modules/axe-core/axe.min.js"
pytestmark = [pytest.mark.browser, pytest.mark.drive]


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


async def test_logout_that_fails_says_so_and_leaves_the_console_open(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    page = await console.open("robots")
    stream.answers["DELETE session"] = (502, {"type": "urn:fognav:service_away", "detail": "The console is busy."})
    await page.get_by_text("Settings").click()
    await page.get_by_role("button", name="Log out").click()
    says = page.get_by_role("alertdialog")
    await expect(says).to_have_text("You are still logged in: The console is busy.Close")
    await expect(page.get_by_text("Live", exact=True)).to_be_visible()
    await says.get_by_role("button", name="Close").click()
    await expect(says).to_have_count(0)
    # A session that is over already needs no end.
    stream.answers["DELETE session"] = (401, {"type": "urn:fognav:token_missing", "detail": "log in first"})
    await page.get_by_role("button", name="Log out").click()
    await expect(page.get_by_label("Token")).to_be_visible()


async def test_who_logs_out_leaves_neither_draft_nor_undo_nor_view_to_the_next_person(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    page = await console.open("zones")
    zone = {"id": "wet", "kind": "BLOCKED", "shape": {"type": "circle", "centre": [10.0, 26.0], "radius": 0.5}}
    zone |= {"reason": "wet", "author": "ana", "enabled": True, "active": True, "version": 1, "sets": []}
    zone |= dict.fromkeys(("source", "schedule", "factor", "speed", "starts_at", "expires_at"))
    stream.tell("zone", "wet", zone)
    await page.get_by_role("button", name="Delete wet").click()
    await expect(page.locator(".undo")).to_be_visible()
    await page.get_by_role("button", name="Edit wet").click()
    await expect(page.locator("form.zone-form")).to_be_visible()
    await page.get_by_text("Settings").click()
    await page.get_by_role("button", name="Log out").click()
    await expect(page.get_by_label("Token")).to_be_visible()
    assert page.url.endswith("#/map")
    for stream.role in ("viewer", "operator"):
        await page.get_by_label("Token").fill(TOKEN)
        await page.keyboard.press("Enter")
        await expect(page.get_by_text("Live", exact=True)).to_be_visible()
        await page.evaluate("location.hash = '#/zones/+draft'")
        await expect(page.get_by_role("link", name="wet")).to_be_visible()
        await expect(page.locator("form.zone-form")).to_have_count(0)
        await expect(page.locator(".undo")).to_have_count(0)
        await expect(page.get_by_text("is not saved yet")).to_have_count(0)
        await page.get_by_text("Settings").click()
        await page.get_by_role("button", name="Log out").click()


async def test_viewer_who_logs_in_where_a_session_has_ended_sees_no_edit_form(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    page = await console.open("zones")
    await page.get_by_role("button", name="Circle").click()
    await expect(page.locator("form.zone-form")).to_be_visible()
    await page.context.clear_cookies()
    stream.cut()
    await expect(page.get_by_text("The login has ended")).to_be_visible()
    stream.role = "viewer"
    await page.get_by_label("Token").fill(TOKEN)
    await page.keyboard.press("Enter")
    await expect(page.get_by_text("Live", exact=True)).to_be_visible()
    await expect(page.get_by_role("heading", name="Zones", exact=True)).to_be_visible()
    await expect(page.locator("form.zone-form")).to_have_count(0)


async def test_area_is_green_only_while_the_map_confirms_it_and_a_silent_node_grows_older(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    clear = {"state": "clear", "penalty": 0, "confirmed": True}
    stream.hazard("z1", "clear", on_map=clear)
    page = await console.open("map")
    name = next(each.label for each in stream.site.site.areas if each.id == "z1")
    row = page.locator("main li.row", has=page.get_by_text(name, exact=True))
    await expect(row.locator(".swatch.clear")).to_have_count(1)
    greens = len(stream.site.site.areas)
    await expect(page.locator("path.shape.area.clear")).to_have_count(greens)
    for unsure in (None, {**clear, "confirmed": False}, {**clear, "state": "unknown"}):
        stream.hazard("z1", "clear", on_map=unsure)
        await expect(row).to_contain_text("unknown (not confirmed)")
        await expect(row.locator(".swatch.unknown")).to_have_count(1)
        await expect(page.locator("path.shape.area.clear")).to_have_count(greens - 1)
        await expect(page.locator("path.shape.area.unknown")).to_have_count(1)
        stream.hazard("z1", "clear", on_map=clear)
        await expect(row).not_to_contain_text("not confirmed")
        await expect(page.locator("path.shape.area.clear")).to_have_count(greens)
    await page.evaluate("location.hash = '#/sensors'")
    node = page.locator("main li.node").first
    await expect(node).to_contain_text(re.compile(r"[3-9] s ago"))
    # However late the page was opened.
    stream.tell("node", "n1", {**stream.log["node", "n1"][2]["value"], "heard": time.time() - 600, "age_s": 0.1})
    stream.cut()
    await expect(page.locator("main li.node", has_text="n1").first).to_contain_text("10 min ago")


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
    async with asyncio.timeout(60):
        while (after := await page.evaluate(hashes)) == before:
            pass
    assert sum(old != new for old, new in zip(before, after, strict=True)) == 1


async def test_labels_that_would_lie_over_more_important_ones_are_hidden(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    for number in range(4):
        stream.tell("place", f"p{number}", {"x": 12.0, "y": 26.5, "theta": None, "label": f"Place {number}"})
    stream.tell("zone", "wet", _zone("wet", "wet floor"))
    page = await console.open(**PHONE)
    shown = page.locator(".label:not(.covered)")
    await expect(shown.filter(has_text="wet")).to_have_count(1)
    overlapping = """labels => labels.filter((a, i) => labels.slice(i + 1).some(b => {
        const [p, q] = [a.getBoundingClientRect(), b.getBoundingClientRect()];
        return p.left < q.right && q.left < p.right && p.top < q.bottom && q.top < p.bottom;
    })).length"""
    assert await shown.evaluate_all(overlapping) == 0
    for _ in range(6):
        await page.get_by_role("button", name="Zoom in").click()
    assert await shown.evaluate_all(overlapping) == 0
    await expect(page.locator(".label.covered")).not_to_have_count(0)


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
    await expect(page.locator("button.robot", has_text="r2")).to_have_count(0)


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
    late = schedule(HOSTILE, begin=None, robot=HOSTILE, waits=HOSTILE)
    stream.answers["GET schedules"] = (200, [late])
    told = {"codes": [HOSTILE], "decided_by": HOSTILE, "overridden": False}
    entry = {
        **told,
        "at": 1.0,
        "who": HOSTILE,
        "id": HOSTILE,
        "before": None,
        "after": {"id": HOSTILE, "reason": HOSTILE},
    }
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
    stream.answers["GET schedules"] = (200, [schedule("post", begin=4e9, waits="r2 is busy")])
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
        elif view == "schedules":
            await page.get_by_role("button", name="Edit schedule post").click()
            await expect(page.get_by_role("form")).to_be_visible()
            found += await violations(page, "a schedule")
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
