"""Zones on the console's page as operators use them: a whole running system, its robot, and real browsers."""

import asyncio
import random
from collections.abc import AsyncIterator
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import pytest_asyncio
from driver import ESTIG, ROBOT, LiveSystem
from playwright.async_api import Browser, BrowserContext, Locator, Page, async_playwright, expect

from fog_runtime.configuration.site import load_site
from fog_runtime.keys import TOKENS
from fog_runtime.token_file import create_token
from fognav import console_page, system
from fognav.programs import CONSOLE

pytestmark = [pytest.mark.live, pytest.mark.browser, pytest.mark.timeout(600), pytest.mark.asyncio(loop_scope="module")]

ROOT = Path(__file__).parents[2]
AREAS = load_site(ESTIG).site.areas
PATIENCE = 8.0
"""For a machine that has other work: nothing here is measured."""
WAIT_MS = 60_000
PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
CROSSING = (52.0, 25.0, 54.0, 31.5)
"""A rectangle across the middle corridor, on the robot's way: left, bottom, right, top (m)."""
ENDS_S = 25.0
"""After so many seconds the zone ends: it is saved, applied and driven around before."""
HOSTILE = "<script>alert(1)</script><img src=x onerror=alert(2)>\u202eevil\u2066" + "x" * 440


class Operators:
    """A running system, and browsers in which people are logged in."""

    def __init__(self, live: LiveSystem, browser: Browser) -> None:
        self.live = live
        self.url = f"http://127.0.0.1:{live.stack.port(CONSOLE)}"
        self._browser = browser
        self._tokens = {name: create_token(live.stack.folder / TOKENS, name, "operator") for name in ("anna", "bruno")}
        self.contexts: list[BrowserContext] = []
        self.problems: list[str] = []

    async def page(self, name: str, address: str = "zones", **device: Any) -> Page:
        """Open the console for a person, in a browser session of their own."""
        context = await self._browser.new_context(
            **{"viewport": {"width": 1440, "height": 900}, "locale": "en-GB", **device}
        )
        self.contexts.append(context)
        page = await context.new_page()
        page.set_default_timeout(WAIT_MS)
        page.on("pageerror", lambda error: self.problems.append(str(error)))
        page.on("dialog", lambda dialog: self.problems.append(dialog.message))
        await page.goto(f"{self.url}#login={self._tokens[name]}")
        await expect(page.get_by_text("Live", exact=True)).to_be_visible()
        await show(page, address)
        return page

    async def rest(self, method: str, path: str, body: object = None) -> Any:
        """Ask the services, as a program would."""
        headers = {"Authorization": f"Bearer {self.live.stack.token}"}
        async with httpx.AsyncClient(base_url=self.url, headers=headers, timeout=60.0) as client:
            answer = await client.request(method, f"/api/v1/{path}", json=body)
        assert answer.status_code < 300, answer.text
        return answer.json() if answer.content else None

    async def zones(self) -> dict[str, Any]:
        return {zone["id"]: zone for zone in (await self.rest("GET", "zones"))["zones"]}

    async def draw(self, name: str, reason: str = "") -> None:
        """Add a zone in a corner that no path crosses."""
        shape = {"type": "rectangle", "corner": [4.0, 5.0], "opposite": [6.0, 6.0]}
        await self.rest(
            "POST", "zones", {"id": name, "kind": "PENALTY", "factor": 2.0, "shape": shape, "reason": reason}
        )


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def running(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Operators]:
    if system.find(system.CHROMIUM) is None:
        pytest.skip(f"no Chromium: {system.install_command([system.CHROMIUM])}, or ./fognav test --yes as root")
    await asyncio.to_thread(console_page.build, ROOT)
    live = LiveSystem(tmp_path_factory.mktemp("console"), patience=PATIENCE)
    async with live, async_playwright() as playwright:
        flags = ["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--disable-background-networking"]
        browser = await playwright.chromium.launch(executable_path=str(system.find(system.CHROMIUM)), args=flags)
        expect.set_options(timeout=WAIT_MS)
        yield Operators(live, browser)
        expect.set_options(timeout=None)
        await browser.close()


@pytest_asyncio.fixture(loop_scope="module")
async def operators(running: Operators) -> AsyncIterator[Operators]:
    yield running
    while running.contexts:
        await running.contexts.pop().close()
    for name in await running.zones():
        await running.rest("DELETE", f"zones/{name}")
    assert running.problems == []


async def show(page: Page, address: str) -> None:
    await page.evaluate("address => { location.hash = `#/${address}` }", address)


async def on_screen(page: Page, x: float, y: float) -> tuple[float, float]:
    """Return where a point of the floor (m) is on the screen, by two areas whose labels stand in their middles."""

    async def label(name: str) -> tuple[float, float]:
        box = await page.locator(".leaflet-tooltip.area", has_text=name).bounding_box()
        assert box is not None
        return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    (left, level), (right, _) = await label("z1"), await label("z2")
    (x1, y1), (x2, _) = (np.mean(area.polygon, axis=0) for area in AREAS if area.id in ("z1", "z2"))
    scale = (right - left) / (x2 - x1)
    return left + (x - x1) * scale, level - (y - y1) * scale


def dense(points: list[tuple[float, float]]) -> np.ndarray:
    """Return points of a line of corners, at most some centimetres apart."""
    ends = np.array(points)
    return np.concatenate([np.linspace(a, b, 200) for a, b in pairwise(ends)])


async def tab_to(page: Page, control: Locator) -> None:
    """Go to a control by the tabulator alone."""
    for _ in range(200):
        if await control.count() == 1 and await control.evaluate("element => element === document.activeElement"):
            return
        await page.keyboard.press("Tab")
    raise AssertionError(f"the tabulator does not lead to {control}")


async def test_corridor_is_closed_on_a_phone_the_robot_goes_round_and_the_zone_expires(operators: Operators) -> None:
    live = operators.live
    await operators.rest("PUT", f"robots/{ROBOT}/goal", {"place": "b"})
    await live.wait_driving()
    page = await operators.page("anna", **PHONE)
    await page.get_by_role("button", name="Rectangle").tap()
    left, bottom, right, top = CROSSING
    for corner in ((left, bottom), (right, top)):
        await page.touchscreen.tap(*await on_screen(page, *corner))
    effects = page.get_by_role("region", name="What it will do")
    await expect(effects).to_contain_text(f"{ROBOT}: ")
    await expect(effects).to_contain_text(" more (")
    await page.get_by_label("Reason").fill("wet floor")
    # The presets are longer than a test: a time of one's own.
    ends = datetime.fromtimestamp(live.clock.stamp() + ENDS_S)  # noqa: DTZ006  # the browser's own time zone
    await page.get_by_label("or at").fill(ends.strftime("%Y-%m-%dT%H:%M:%S"))
    await page.get_by_role("button", name="Save").tap()
    await expect(page.locator("dd.state")).to_contain_text("in force, ends in")
    await expect(page.get_by_text(f"applied by {ROBOT}")).to_be_visible()
    (zone,) = (await operators.zones()).values()
    assert (zone["reason"], zone["author"]) == ("wet floor", "anna")

    def goes_round() -> bool:
        points = live.scene.path.points if live.scene.path else []
        return len(points) > 1 and not any(left <= x <= right and 26.9 <= y <= 29.9 for x, y in dense(points))

    await live.until(goes_round, 30, "the robot's path leads around the zone")
    assert live.state.goal_id is not None
    await expect(page.locator("dd.state")).to_have_text("over")


async def test_two_operators_see_both_versions_and_choose_field_by_field(operators: Operators) -> None:
    await operators.draw("wet", "wet floor")
    anna, bruno = await operators.page("anna"), await operators.page("bruno")
    for page in (anna, bruno):
        await page.get_by_role("button", name="Edit wet").click()
    await anna.get_by_label("Reason").fill("paint")
    await anna.get_by_role("button", name="Save").click()
    await expect(anna.locator(".said")).to_contain_text("is saved")
    # Before bruno saves he is told already.
    await expect(bruno.get_by_text("anna has changed this zone meanwhile.")).to_be_visible()
    await bruno.get_by_role("button", name="closed").click()
    versions = bruno.get_by_role("alertdialog", name="Two versions")
    reason = versions.get_by_role("row", name="Reason")
    await bruno.get_by_role("button", name="Save").click()
    await expect(reason.get_by_role("cell")).to_have_text(["wet floor", "paint"])
    await expect(reason.get_by_role("radio").nth(1)).to_be_checked()  # bruno has not changed it
    await expect(versions.get_by_role("row", name="Effect").get_by_role("radio").nth(0)).to_be_checked()
    await versions.get_by_role("button", name="Save what is chosen").click()
    await expect(bruno.locator(".said")).to_contain_text("is saved")
    zone = (await operators.zones())["wet"]
    assert (zone["kind"], zone["reason"], zone["author"]) == ("BLOCKED", "paint", "bruno")
    # anna can't undo hers any more: it would take back bruno's, too.
    await anna.get_by_role("button", name="Undo", exact=True).click()
    await expect(anna.locator(".said.failed")).to_contain_text("bruno has changed wet since")


async def test_zone_is_drawn_moved_deleted_and_brought_back_with_the_keyboard_alone(operators: Operators) -> None:
    page = await operators.page("anna")
    await tab_to(page, page.get_by_role("button", name="Circle"))
    await page.keyboard.press("Enter")
    await tab_to(page, page.get_by_role("button", name="Put it in the middle"))
    await page.keyboard.press("Enter")
    for field, number in (("Centre x", "5"), ("Centre y", "6"), ("Radius (m)", "0.5")):
        await tab_to(page, page.get_by_label(field, exact=True))
        await page.keyboard.type(number)
    await tab_to(page, page.get_by_role("button", name="Centre, 5.00, 6.00"))
    await page.keyboard.press("ArrowRight")
    await page.keyboard.press("ArrowUp")
    await tab_to(page, page.get_by_role("button", name="Save"))
    await page.keyboard.press("Enter")
    await expect(page.locator(".said")).to_contain_text("is saved")
    ((name, zone),) = (await operators.zones()).items()
    assert zone["shape"] == {"type": "circle", "centre": [5.25, 6.25], "radius": 0.5}
    await tab_to(page, page.get_by_role("button", name="Delete"))
    await page.keyboard.press("Enter")
    await expect(page.locator(".said")).to_contain_text("is deleted")
    assert await operators.zones() == {}
    await tab_to(page, page.get_by_role("button", name="Undo", exact=True))
    await page.keyboard.press("Enter")
    await expect(page.get_by_role("link", name=name)).to_be_visible()
    assert (await operators.zones())[name]["shape"] == zone["shape"]


async def test_hostile_names_are_text_wherever_zones_are_and_come_back_as_they_were(operators: Operators) -> None:
    await operators.draw("wet", HOSTILE)
    page = await operators.page("anna", **PHONE)
    for address in ("zones", "zones/wet", "timeline"):
        await show(page, address)
        await expect(page.locator("main")).to_contain_text("wet")
        assert await page.evaluate("document.querySelectorAll('main script, main img').length") == 0
        assert await page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    await show(page, "zones/wet")
    await page.get_by_role("button", name="Edit", exact=True).tap()
    await expect(page.get_by_label("Reason")).to_have_value(HOSTILE)
    await page.get_by_role("button", name="closed").tap()
    await page.get_by_role("button", name="Save").tap()
    await expect(page.locator(".said")).to_contain_text("is saved")
    assert (await operators.zones())["wet"]["reason"] == HOSTILE


async def test_set_of_zones_is_made_filled_switched_off_and_the_switch_undone(operators: Operators) -> None:
    await operators.draw("wet")
    page = await operators.page("anna")
    await page.get_by_text("New set").click()
    sets = page.get_by_role("region", name="Sets of zones")
    await sets.get_by_label("Name").fill("cleaning")
    await sets.get_by_role("button", name="Add").click()
    await expect(sets.get_by_role("button", name="Switch off the set cleaning")).to_be_visible()
    await page.get_by_role("button", name="Edit wet").click()
    await page.get_by_text("Name, schedule, switched on").click()
    await page.get_by_label("cleaning").check()
    await page.get_by_role("button", name="Save").click()
    await expect(page.locator("dd.state")).to_have_text("in force")
    await show(page, "zones")
    await sets.get_by_role("button", name="Switch off the set cleaning").click()
    await expect(page.locator(".zone-row .state")).to_contain_text("not in force")
    await show(page, "timeline")
    await page.get_by_role("button", name="Undo Set of zones cleaning").first.click()
    await show(page, "zones")
    await expect(page.locator(".zone-row .state")).to_have_text("in force")


@pytest.mark.parametrize("seed", [0])
async def test_whatever_two_pages_do_at_the_same_time_both_show_what_the_server_has(
    operators: Operators, seed: int
) -> None:
    chance = random.Random(seed)
    pages = [await operators.page("anna"), await operators.page("bruno")]
    for name in ("one", "two"):
        await operators.draw(name)
    for page in pages:
        await expect(page.get_by_role("link", name="two")).to_be_visible()
    for _ in range(3):
        name = chance.choice(("one", "two"))
        acts = [chance.choice((edit, edit, delete)) for _ in pages]
        # Both begin with what they see now, at the same time.
        await asyncio.gather(
            *(act(page, name, f"{chance.random():.6f}") for act, page in zip(acts, pages, strict=True))
        )
        if name not in await operators.zones():
            await operators.draw(name)
        await agree(operators, pages)


async def edit(page: Page, name: str, reason: str) -> None:
    """Change a zone's reason; if somebody else was faster, save what the page proposes."""
    await page.get_by_role("button", name=f"Edit {name}").click()
    await page.get_by_label("Reason").fill(reason)
    await page.get_by_role("button", name="Save", exact=True).click()
    settled = page.locator(".said", has_text="is saved")
    again = page.get_by_role("button", name="Save what is chosen").or_(page.get_by_role("button", name="Add it again"))
    while not await settled.is_visible():
        if await again.is_visible():
            await again.click(timeout=1000)
        await page.wait_for_timeout(50)
    await show(page, "zones")


async def delete(page: Page, name: str, _reason: str) -> None:
    await page.get_by_role("button", name=f"Delete {name}").click()
    await expect(page.locator(".said")).not_to_be_empty()


async def agree(operators: Operators, pages: list[Page]) -> None:
    """Wait until both pages list what the server has."""
    has = {f"{zone['id']} {zone['reason']}".strip() for zone in (await operators.zones()).values()}
    for page in pages:
        await show(page, "zones")

        async def shown(page: Page = page) -> set[str]:
            rows = await page.locator(".zone-row").all()
            return {" ".join(await row.locator("bdi").all_inner_texts()) for row in rows}

        async with asyncio.timeout(60):
            while await shown() != has:  # noqa: ASYNC110  # the page tells nobody when it has changed
                await asyncio.sleep(0.1)
