"""What people change in the console, in a real Chromium: zones, sets, schedules, areas, places, the map."""

import asyncio
import base64
from pathlib import Path
from types import SimpleNamespace

import pytest
from console_stream import PHONE, TOKEN, ConsoleStream, schedule
from msgspec import to_builtins
from playwright.async_api import Route, expect

from fog_contracts.grid import StaticMap
from fog_contracts.messages import AreaDefinition, CircleShape, Place, Zone
from fog_runtime.configuration.maps import save_map
from map_service.map_check import MapUpload, Task, check

ROOT = Path(__file__).parents[2]
pytestmark = [pytest.mark.browser, pytest.mark.drive]


async def test_what_is_typed_stays_while_others_change_things_and_counts_when_the_field_is_left(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    circle = CircleShape(centre=(5.0, 6.0), radius=1.0)
    zone = to_builtins(Zone(id="wet", kind="BLOCKED", shape=circle, version=1, reason="wet floor"))
    stream.tell("zone", "wet", {**zone, "active": True})
    page = await console.open("zones")
    await page.get_by_role("button", name="Edit wet").click()
    seen = await page.locator(".leaflet-map-pane").bounding_box()
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
    stream.tell("zone", "wet", {**zone, "version": 4, "active": True})
    await expect(page.get_by_role("heading", name="wet")).to_be_visible()
    assert await page.locator(".leaflet-map-pane").bounding_box() == seen, "the map stays where the person looked"
    _, body = next(request for request in stream.requests if request[0] == "PUT zones/wet")
    assert (body["reason"], body["shape"]["radius"]) == ("paint", 2.5)


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


async def test_missions_by_the_clock_are_listed_switched_and_deleted_and_a_deletion_taken_back(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    monday = 1_795_993_200.0  # 2026-11-30, 08:00 in Tokyo
    missed = {
        "begin": monday - 604_800,
        "at": monday,
        "outcome": "missed",
        "mission": None,
        "reason": "r2 was not free",
        "code": "robot_not_heard",
    }
    post = schedule("post", begin=monday, last=missed)
    busy = {"waits": "robot r2 has another mission", "waits_code": "robot_has_mission"}
    waits = schedule("early", begin=monday + 604_800, **busy)
    stream.answers["GET schedules"] = (200, [waits, schedule("off", begin=None, enabled=False), post])
    page = await console.open("schedules")
    rows = page.locator("main li")
    await expect(rows.nth(0)).to_contain_text("Due, but: robot r2 has another mission")
    await expect(rows.nth(1)).to_contain_text("postr2next Mon, Nov 30, 08:00 (Asia/Tokyo)")
    await expect(rows.nth(1)).to_contain_text("A, west entrance → 3.0, 4.5 → upstairs: a")
    await expect(rows.nth(1)).to_contain_text("Last: Mon, Nov 23, 08:00 (Asia/Tokyo), missed: r2 was not free")
    await expect(rows.nth(2)).to_contain_text("switched off")
    stored = {name: post[name] for name in ("robot", "mission", "weekly")}

    refused = {"type": "urn:fognav:role_too_low", "detail": "ana is a viewer: this needs the role operator."}
    stream.answers["PUT schedules/post"] = (403, refused)
    await page.get_by_role("button", name="Switch off schedule post").click()
    await expect(page.locator(".said.failed")).to_have_text(
        "Schedule post is as it was: ana is a viewer: this needs the role operator."
    )
    stream.answers["PUT schedules/post"] = (200, {**post, "enabled": False})
    async with page.expect_request("**/schedules/post") as sent:
        await page.get_by_role("button", name="Switch off schedule post").press("Enter")
    assert (await sent.value).headers["if-match"] == '"7"'
    await expect(page.locator(".said.done")).to_contain_text("Schedule post is switched off.")
    assert [body for name, body in stream.requests if name == "PUT schedules/post"][-1] == {**stored, "enabled": False}

    await page.get_by_role("button", name="Delete schedule post").click()
    async with page.expect_request(lambda request: request.method == "PUT") as sent:
        await page.locator(".undo").get_by_role("button", name="Undo").click()
    assert (await sent.value).headers["if-none-match"] == "*"
    await expect(page.locator(".said")).to_contain_text("Schedule post is back.")
    await expect(page.locator(".undo")).to_have_count(0)
    assert [body for name, body in stream.requests if name == "PUT schedules/post"][-1] == {**stored, "enabled": True}
    assert stream.asked("DELETE") == ["DELETE schedules/post"]
    await page.evaluate("localStorage.setItem('fognav.language', 'pt'); location.reload()")
    await expect(rows.nth(0)).to_contain_text("Está na hora, mas: O robô tem outra missão.")
    await expect(rows.nth(1)).to_contain_text("perdida: O robô não responde.")


async def test_operator_lets_a_mission_begin_by_the_clock_by_keyboard_and_a_viewer_only_reads(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    post = schedule("post", begin=1_795_993_200.0)
    stream.answers["GET schedules"] = (200, [post])
    page = await console.open("schedules", **PHONE, timezone_id="Europe/Lisbon")
    await page.get_by_role("button", name="New schedule").press("Enter")
    await expect(page.get_by_label("Name")).to_be_focused()
    await page.keyboard.type("post")
    await page.get_by_label("Robot").select_option("r2")
    await page.get_by_role("combobox", name="Place 1").select_option("b")
    await page.get_by_role("button", name="One more place").press("Enter")
    await page.get_by_role("combobox", name="Place 2").select_option("a")
    await page.get_by_label("When every way to a place is closed").select_option("end the mission")
    await page.get_by_label("Ends at the latest after").fill("30")
    await page.get_by_label("Priority").select_option("3")
    for day in ("Mon", "Tue"):
        await page.get_by_label(day).uncheck()
    exists = {"type": "urn:fognav:schedule_changed", "detail": "read it again"}
    stream.answers["PUT schedules/post"] = (412, exists)
    await page.get_by_label("Name").press("Enter")
    await expect(page.get_by_role("alert")).to_have_text("There is a schedule post already: choose another name.")
    await page.get_by_label("Name").fill("letters")
    await page.get_by_role("button", name="Save").press("Enter")
    await expect(page.locator(".said")).to_have_text("Schedule letters is saved.")
    times = [{"days": ["wed", "thu", "fri"], "begin": "08:00", "end": "09:00"}]
    assert next(body for name, body in stream.requests if name == "PUT schedules/letters") == {
        "robot": "r2",
        "mission": {
            "stops": [{"place": "b"}, {"place": "a"}],
            "when_cut": {"do": "cancel", "limit_s": None},
            "deadline_s": 1800,
            "priority": 3,
        },
        "weekly": {"time_zone": "Europe/Lisbon", "times": times},
        "enabled": True,
    }

    # What the form does not show stays as it is.
    stream.answers["PUT schedules/post"] = (200, post)
    await page.get_by_role("button", name="Edit schedule post").click()
    await page.get_by_role("button", name="Remove place 1").click()
    await expect(page.get_by_role("combobox", name="Place 2").locator("option:checked")).to_have_text("upstairs: a")
    await page.get_by_role("button", name="Save").click()
    await expect(page.locator(".said")).to_have_text("Schedule post is saved.")
    kept = {**post["mission"], "stops": post["mission"]["stops"][1:]}
    assert [body for name, body in stream.requests if name == "PUT schedules/post"][-1]["mission"] == kept

    stream.role = "viewer"
    await page.reload()
    await expect(page.get_by_text("Your role, viewer, may look but not change this.")).to_be_visible()
    await expect(page.locator("main li")).to_contain_text("post")
    await expect(page.locator("main").get_by_role("button")).to_have_count(0)


async def test_admin_opens_a_place_to_visitors_and_prints_its_code_without_a_shell(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    stream.role = "admin"
    place = {"x": 9.0, "y": 42.6, "theta": None, "label": "C, north-west office", "public": False}
    stream.tell("place", "c", place)
    stream.answers["GET places/c"] = (200, {**place, "version": 0, "warnings": []})
    stream.answers["GET visits/places"] = (200, [{"id": "c", "label": place["label"]}])
    stream.answers["POST session/code"] = (200, {"token": "of-a-guest"})
    page = await console.open()
    places = page.get_by_role("region", name="Places")
    await places.get_by_label("for visitors: C, north-west office").click()
    await expect(page.locator(".said")).to_have_text("Visitors may choose C, north-west office.")
    assert stream.requests[-1] == ("PATCH places/c", {"public": True})
    await places.get_by_role("link", name="Codes for visitors").click()
    await expect(page.get_by_role("img", name="Code for visits from C, north-west office")).to_be_visible()


async def test_visitor_who_asks_again_reads_nothing_of_the_visit_before(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    visit = {"start": "a", "goal": "b", "state": "arrived", "end": None, "ahead": 0, "robot": "r1"}
    visit |= {"distance_m": None, "seconds": None}
    stream.role = "guest"
    stream.answers["GET visits/places"] = (200, [{"id": "a", "label": "Hall"}, {"id": "b", "label": "Lab"}])
    stream.answers["GET visits/mine"] = (200, visit)
    page = await (await console.browser.new_context(locale="en-GB")).new_page()
    await page.goto(f"{console.url}#/visit/a?login={TOKEN}")
    await page.get_by_role("button", name="New visit").click()
    held = asyncio.Event()

    async def hold(route: Route) -> None:
        await held.wait()
        await route.continue_()

    await page.route("**/api/v1/visits", hold)
    async with page.expect_request("**/api/v1/visits"):
        await page.get_by_role("button", name="Lab").click()
    # It is asked for each second: what it answers now is still the visit before.
    await page.wait_for_event("response", lambda answer: answer.url.endswith("/visits/mine"))
    await expect(page.get_by_role("heading", level=1)).to_have_text("Where do you want to go?")
    stream.answers["GET visits/mine"] = (200, {**visit, "state": "coming"})
    held.set()
    await expect(page.get_by_role("heading", level=1)).to_have_text("r1 is coming to you")
