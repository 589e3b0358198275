"""Robots in the console, in a real Chromium: stopped, sent, enabled, taken out of service, and why they stand."""

import asyncio
import json
import re
from types import SimpleNamespace

import pytest
from console_stream import PHONE, VIEWS, WIDE, ConsoleStream, robot_pose, robot_state
from msgspec import to_builtins
from playwright.async_api import expect

from fog_contracts.messages import CircleShape, PlanReply, Zone

pytestmark = [pytest.mark.browser, pytest.mark.drive]


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
        async with asyncio.timeout(30):
            while len(stream.asked("POST")) < number:  # noqa: ASYNC110  # the page says the same of each
                await asyncio.sleep(0.05)
        await expect(page.locator(".said")).to_have_text("r1 stops.")
        assert stream.asked("POST") == ["POST robots/r1/stop"] * number
    assert len(places) == 1
    stream.requests.clear()
    await page.keyboard.press("Shift+F9")
    async with asyncio.timeout(30):
        while len(stream.asked("POST")) < 2:  # noqa: ASYNC110  # the page says it for the last one only
            await asyncio.sleep(0.05)
    assert sorted(stream.asked("POST")) == ["POST robots/r1/stop", "POST robots/r2/stop"]


async def test_stop_that_fails_says_so_and_what_to_do(console: SimpleNamespace, stream: ConsoleStream) -> None:
    stream.answers["POST robots/r1/stop"] = (504, {"type": "urn:fognav:command_lost", "detail": "r1 does not answer."})
    page = await console.open()
    await page.keyboard.press("F9")
    await expect(page.locator(".said.failed")).to_have_text("r1 was not stopped: r1 does not answer. Stop it by hand.")


async def test_stop_of_all_lists_each_robot_that_was_not_stopped_until_it_is_or_somebody_has_seen_to_it(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    lost = {"type": "urn:fognav:command_lost", "detail": "It does not answer."}
    stream.answers["POST robots/r1/stop"] = stream.answers["POST robots/r2/stop"] = (504, lost)
    stream.tell("pose", "r3", robot_pose(20.0, 26.0, 0.0))
    stream.robot("r3", robot_state())
    page = await console.open()
    button = page.get_by_role("button", name="Stop r1")
    place = await button.bounding_box()
    await page.get_by_role("button", name="Stop all").click()
    rows = page.get_by_role("alert").get_by_role("listitem")
    await expect(rows).to_have_count(2)
    for number, robot in enumerate(("r1", "r2")):
        await expect(rows.nth(number)).to_contain_text(f"{robot} was not stopped: It does not answer. Stop it by hand.")
    assert await button.bounding_box() == place
    del stream.answers["POST robots/r1/stop"]
    await button.click()
    await expect(page.locator(".said")).to_have_text("r1 stops.")
    await expect(rows).to_have_count(1)
    stream.robot("r2", robot_state("HOLD", enabled=False))
    await expect(rows).to_have_count(0)
    stream.answers["POST robots/r1/stop"] = (504, lost)
    await page.keyboard.press("F9")
    await expect(rows).to_have_count(1)
    await page.get_by_role("button", name="I have seen to it").click()
    await expect(rows).to_have_count(0)


async def test_stop_stays_for_the_chosen_robot_while_a_server_that_starts_anew_tells_of_no_robot(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    page = await console.open("robots")
    await page.locator(".card", has_text="r2").first.click()
    await expect(page.get_by_role("button", name="Stop r2")).to_be_enabled()
    for name in ("r1", "r2"):
        del stream.log["robot", name], stream.log["pose", name]
    stream.run, stream.unready = "second", True
    stream.cut()
    await expect(page.locator(".robot-body")).to_have_count(0)
    stream.robot("r1", robot_state())
    await expect(page.locator(".card", has_text="r1").first).to_contain_text("driving")
    await page.get_by_role("button", name="Stop r2").click()
    await expect(page.locator(".said")).to_have_text("r2 stops.")
    await page.reload()  # what was known before is known to a page that loads anew
    await expect(page.locator(".card", has_text="r1").first).to_contain_text("driving")
    await page.keyboard.press("Shift+F9")
    async with asyncio.timeout(30):
        while len(stream.asked("POST")) < 3:  # noqa: ASYNC110  # the page says it for the last one only
            await asyncio.sleep(0.05)
    assert sorted(stream.asked("POST")) == ["POST robots/r1/stop", *["POST robots/r2/stop"] * 2]
    stream.unready = False
    stream.cut()
    await expect(page.locator(".card", has_text="r2")).to_have_count(0)
    await expect(page.get_by_role("button", name="Stop r1")).to_be_enabled()


async def test_stop_works_in_each_of_six_tabs_of_a_browser(console: SimpleNamespace, stream: ConsoleStream) -> None:
    pages = [await console.open()]
    for _ in range(5):
        # As a browser tells a tab that another one covers: this one takes all tabs for visible.
        await pages[-1].evaluate(
            """() => {
                Object.defineProperty(document, 'hidden', { configurable: true, get: () => window.covered });
                window.covered = true;
                document.dispatchEvent(new Event('visibilitychange'));
            }"""
        )
        pages.append(await pages[0].context.new_page())
        await pages[-1].goto(f"{console.url}#/robots")
        await expect(pages[-1].get_by_text("Live", exact=True)).to_be_visible()
    for page in (pages[-1], pages[0]):
        await page.keyboard.press("F9")
        await expect(page.locator(".said")).to_have_text("r1 stops.")
    await pages[0].evaluate("() => { window.covered = false; document.dispatchEvent(new Event('visibilitychange')) }")
    async with asyncio.timeout(60):
        while len(stream.resumed_from) == len(pages):  # noqa: ASYNC110  # its answer is a stream, which never ends
            await asyncio.sleep(0.05)
    assert (stream.resumed_from[-1] or "").startswith("first-"), "a tab that is seen again goes on where it was"


async def test_stop_works_in_each_of_seven_windows_in_sight_of_which_five_are_live(console: SimpleNamespace) -> None:
    pages = [await console.open()]
    for _ in range(6):
        pages.append(await pages[0].context.new_page())
        await pages[-1].goto(f"{console.url}#/robots")
        await expect(pages[-1].get_by_role("status").first).to_have_text(re.compile("Live|Five windows"))
    assert [await page.get_by_text("Live", exact=True).count() for page in pages] == [1] * 5 + [0] * 2
    for page in (pages[-1], pages[0]):
        await page.keyboard.press("F9")
        await expect(page.locator(".said")).to_have_text("r1 stops.")
    for page in pages[:2]:
        await page.close()
    for page in pages[5:]:
        await expect(page.get_by_text("Live", exact=True)).to_be_visible()


async def test_robot_tells_who_has_stopped_it_until_somebody_enables_it(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    def record(number: int, kind: str, who: str, action: str) -> None:
        entry = {"at": 1000.0 + number, "who": who, "action": action, "kind": kind, "id": "r1", "entry": str(number)}
        stream.say("record", str(number), {**entry, "before": None, "after": None})

    waits = robot_state("HOLD", enabled=False, reasons=["waiting for an operator to enable"], codes=["not_enabled"])
    record(1, "stop", "rui", "stop")
    record(2, "robot", "ana", "enable")
    stream.robot("r1", waits)
    page = await console.open("robots")
    await expect(page.locator(".lead")).to_have_text("waiting for an operator to enable. Enable it.")
    record(3, "stop", "stop from 192.168.7.9", "stop")
    record(4, "stop", "ana", "stop")
    await expect(page.locator(".lead")).to_have_text(re.compile(r"^Stopped at .* \(ana\)\. Enable it\.$"))


async def test_robot_is_sent_home_by_one_press_and_its_message_goes_when_it_has_another_goal(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    start = {"x": 5.0, "y": 25.4, "theta": 1.57}  # where the place a is
    stream.robot("r1", robot_state(), start=start)
    stream.answers["PUT robots/r1/goal"] = (200, {"goal_id": "home"})
    page = await console.open("robots")
    await expect(page.get_by_role("button", name="To the dock")).to_have_count(0)
    await page.get_by_role("button", name="Send home").click()
    await expect(page.locator(".said")).to_have_text("r1 drives to A, west entrance.")
    assert stream.requests[-1] == ("PUT robots/r1/goal", {"place": "a"})
    await expect(page.locator(".said")).to_be_empty()
    stream.robot("r1", robot_state(), start=start, dock=start)
    await page.get_by_role("button", name="To the dock").click()
    assert stream.requests[-1] == ("POST robots/r1/commands", {"kind": "dock"})
    await expect(page.get_by_role("button", name="Send home")).to_have_count(0)


async def test_enable_asks_first_and_a_refusal_is_said(console: SimpleNamespace, stream: ConsoleStream) -> None:
    stream.robot("r1", robot_state("HOLD", enabled=False, reasons=["not enabled"], codes=["not_enabled"]))
    refusal = {"type": "urn:fognav:command_refused", "status": 409, "detail": "a fault must be reset first"}
    stream.answers["POST robots/r1/commands"] = (409, refusal)
    page = await console.open("robots")
    await expect(page.locator(".lead")).to_have_text("not enabled. Enable it.")
    await page.get_by_role("button", name="Enable", exact=True).click()
    await page.keyboard.press("Escape")
    assert stream.asked("POST") == []
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


async def test_service_panel_does_what_it_said_when_it_opened_or_nothing(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    page = await console.open("robots")
    form = page.get_by_role("form", name="Service of r1")
    await page.get_by_role("button", name="Take out of service").click()
    await form.get_by_label("Reason").fill("worn wheel")
    out = {"id": "1", "reason": "flat", "by": "rui", "since": 1.0, "until": None}
    stream.robot("r1", robot_state(), out_of_service=out)
    await expect(form.get_by_role("alert")).to_contain_text("Somebody was faster. Out of service: flat (rui).")
    await expect(form.get_by_role("button", name="Take out of service")).to_be_disabled()
    await form.get_by_label("Reason").press("Enter")
    await form.get_by_role("button", name="Cancel").click()
    await page.get_by_role("button", name="Put back into service").click()
    back = form.get_by_role("button", name="Put back into service")
    await expect(back).to_be_enabled()
    stream.robot("r1", robot_state())
    await expect(form.get_by_role("alert")).to_have_text("Somebody was faster. r1 is in service.")
    await expect(back).to_be_disabled()
    assert not [name for name, _ in stream.requests if name.endswith("out-of-service")]


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


async def test_goal_by_click_shows_its_path_before_it_is_sent(console: SimpleNamespace, stream: ConsoleStream) -> None:
    path = PlanReply(points=[(10.0, 26.0), (30.0, 26.0)], length=20.0)
    stream.answers["POST plan"] = (200, to_builtins(path))
    page = await console.open("robots")
    await page.get_by_role("button", name="Send to a goal").click()
    await page.locator(".floor").click(position={"x": 400, "y": 300})
    await expect(page.get_by_text("The path is 20.0 m long.")).to_be_visible()
    assert stream.asked("PUT") == []
    await page.get_by_role("button", name="Send", exact=True).click()
    await expect(page.locator(".said")).to_contain_text("r1 drives to")
    name, body = stream.requests[-1]
    assert name == "PUT robots/r1/goal"
    assert body["pose"]["theta"] is None


async def test_click_on_a_robot_or_zone_chooses_it_but_gives_a_goal_while_one_is_asked_for(
    console: SimpleNamespace, stream: ConsoleStream
) -> None:
    path = PlanReply(points=[(10.0, 26.0), (15.0, 26.0)], length=5.0)
    stream.answers["POST plan"] = (200, to_builtins(path))
    zone = Zone(id="wet", kind="BLOCKED", shape=CircleShape(centre=(15.0, 26.0), radius=3.0), version=1, reason="wet")
    stream.tell("zone", "wet", {**to_builtins(zone), "active": True})
    page = await console.open("robots")
    other = page.locator(".robot-body", has_text="r2").locator(".front")
    await page.get_by_role("button", name="Send to a goal").click()
    await expect(page.locator(".floor.picking")).to_be_visible()
    box = await other.bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    for beside in (0, 16):  # on the robot, and on the zone around it
        async with page.expect_response("**/plan"):
            await page.mouse.click(x + beside, y)
        await expect(page.get_by_text("The path is 5.0 m long.")).to_be_visible()
    await expect(page.get_by_role("button", name="Stop r1")).to_be_visible()
    await page.get_by_role("button", name="Cancel", exact=True).click()
    await expect(page.locator(".floor.picking")).to_have_count(0)
    await page.mouse.click(x, y)
    await expect(page.get_by_role("button", name="Stop r2")).to_be_visible()
    await page.mouse.click(x + 16, y)
    await expect(page.locator("[data-view=zones]")).to_be_visible()


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
    clicked = [await form.get_by_label(name).input_value() for name in ("x (m)", "y (m)")]
    assert clicked[0] != dragged
    await page.mouse.click(x + 20, y)
    await expect(form.get_by_label("Heading (°)")).to_have_value("180")
    assert [await form.get_by_label(name).input_value() for name in ("x (m)", "y (m)")] == clicked
    await form.get_by_role("button", name="Set").click()
    await expect(page.locator(".said")).to_contain_text("r1 looks for its position there")
    command = stream.requests[-1][1]
    assert command["kind"] == "initial_pose"
    assert [command["pose"][name] for name in ("x", "y")] == [float(each) for each in clicked], (
        "where the first click was"
    )
