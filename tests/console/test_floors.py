"""All floors of a building in the console, in a real Chromium: their states and ages, and one stop for all."""

import time
from types import SimpleNamespace

import pytest
from console_stream import ConsoleStream
from playwright.async_api import expect

pytestmark = [pytest.mark.browser, pytest.mark.drive]


def floor(name: str, **changed: object) -> dict[str, object]:
    robot = {"id": "r1", "age_s": 0.3, "mode": "NORMAL", "enabled": True, "codes": []}
    view = {"site": name, "not_ready": {}, "robots": [robot], "blocked": ["hall"], "unknown": [], "stopped": False}
    entry = {"id": name, "address": f"https://{name}.local:8004", "reachable": True, "age_s": 0.4, "heard": time.time()}
    return {**entry, "trouble": "", "detail": "", "floor": view, **changed}


async def test_floors_show_their_age_and_one_press_stops_all_and_says_which_has_not_acknowledged_it(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    lost = floor("upstairs", reachable=False, age_s=74.6, trouble="silent", detail="no answer")
    stream.answers["GET floors"] = (200, [floor("estig", address="", age_s=0.0), lost])
    stops = [
        {"id": "estig", "acknowledged": True, "robots": [], "detail": ""},
        {"id": "upstairs", "acknowledged": False, "robots": [], "detail": "no answer. Its robots may go on driving"},
    ]
    stream.answers["POST floors/stop"] = (200, stops)
    page = await console.open("floors")
    here, there = (page.get_by_role("article", name=name) for name in ("estig", "upstairs"))
    await expect(here).to_contain_text("ready")
    await expect(here).to_contain_text("r1driving")
    await expect(there.locator(".stale")).to_contain_text(" s old")
    await expect(there.locator(".problem")).to_contain_text("Not reachable since")
    await page.get_by_role("button", name="Stop all floors").click()
    await expect(page.get_by_role("alert")).to_contain_text("upstairsno answer. Its robots may go on driving")
    await expect(page.locator(".said.failed")).to_have_text("Not acknowledged: upstairs. The list says what to do.")
    # What becomes of another floor changes nothing about one that has not acknowledged the stop.
    stream.answers["POST floors/stop"] = (200, stops[:1])
    await page.get_by_role("button", name="Stop estig").click()
    await expect(page.locator(".said.done")).to_have_text("All robots stop: estig.")
    await expect(page.get_by_role("alert")).to_contain_text("upstairs")
    stream.answers["POST floors/stop"] = (200, [{**stops[1], "acknowledged": True}])
    await page.get_by_role("button", name="Stop upstairs").click()
    await expect(page.locator(".said.done")).to_have_text("All robots stop: upstairs.")
    await expect(page.get_by_role("alert")).to_have_count(0)
    assert [body for name, body in stream.requests if name == "POST floors/stop"] == [
        {"floors": None}, {"floors": ["estig"]}, {"floors": ["upstairs"]},
    ]  # fmt: skip


async def test_console_of_a_single_floor_has_no_list_of_floors(console: SimpleNamespace, stream: ConsoleStream) -> None:
    stream.answers["GET floors"] = (200, [floor("estig", address="")])
    page = await console.open()
    await expect(page.get_by_role("link", name="Timeline")).to_be_visible()
    await expect(page.get_by_role("link", name="Floors")).to_have_count(0)
