"""A visitor in a running system: scans a code, waits, follows, arrives; and an operator's stop ends the next visit."""

import asyncio
import json
from pathlib import Path
from typing import Any

import httpx
import pytest
from driver import ROBOT, LiveSystem
from playwright.async_api import Page, async_playwright, expect

from fog_runtime.keys import TOKENS
from fog_runtime.token_file import create_token
from fognav import console_page, system
from fognav.programs import CONSOLE

pytestmark = [pytest.mark.live, pytest.mark.browser, pytest.mark.timeout(600)]

ROOT = Path(__file__).parents[2]
AXE = ROOT / "console/node_modules/axe-core/axe.min.js"
WAIT_MS = 90_000
TABLET = {"viewport": {"width": 820, "height": 1180}, "has_touch": True, "locale": "en-GB"}
PLACES = {"hall": (38.5, 28.4), "lab": (41.5, 28.4)}
"""Near the robot, in its corridor."""


class Building:
    """A running system with two public places, a guest's token for codes, and an operator's console."""

    def __init__(self, live: LiveSystem) -> None:
        self.live = live
        self.url = f"http://127.0.0.1:{live.stack.port(CONSOLE)}"
        tokens = live.stack.folder / TOKENS
        self.guest, self.operator = create_token(tokens, "lobby", "guest"), create_token(tokens, "anna", "operator")
        self.problems: list[str] = []

    async def rest(self, method: str, path: str, body: object = None) -> httpx.Response:
        headers = {"Authorization": f"Bearer {self.operator}"}
        async with httpx.AsyncClient(base_url=self.url, headers=headers, timeout=60.0) as client:
            return await client.request(method, f"/api/v1/{path}", json=body)

    async def add_places(self) -> None:
        for name, (x, y) in PLACES.items():
            place = {"x": x, "y": y, "label": name.capitalize(), "public": True}
            assert (await self.rest("PUT", f"places/{name}", place)).status_code == 201

    def watch(self, page: Page) -> Page:
        page.set_default_timeout(WAIT_MS)
        page.on("pageerror", lambda error: self.problems.append(str(error)))
        return page

    async def look(self, page: Page, where: str) -> None:
        """Note what hinders people who can't see, point or read small text."""
        await page.evaluate(AXE.read_text("utf-8"))
        tags = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
        result = await page.evaluate("tags => axe.run({ runOnly: { type: 'tag', values: tags } })", tags)
        self.problems += [
            f"{where}: {found['id']}: {found['nodes'][0]['html'][:120]}" for found in result["violations"]
        ]
        small = (
            "[...document.querySelectorAll('.visit button')].filter(b => b.getBoundingClientRect().height < 44).length"
        )
        if await page.evaluate(small):
            self.problems.append(f"{where}: a button is less than 44 px high")


@pytest.mark.claim
async def test_guest_scans_waits_follows_and_arrives_and_a_stop_ends_the_next_visit(tmp_path: Path) -> None:
    if (chromium := system.find(system.CHROMIUM)) is None:
        pytest.skip(f"no Chromium: {system.install_command([system.CHROMIUM])}, or ./fognav test --yes as root")
    await asyncio.to_thread(console_page.build, ROOT)
    live = LiveSystem(tmp_path, patience=8.0)
    async with live, async_playwright() as playwright:
        flags = ["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--disable-background-networking"]
        browser = await playwright.chromium.launch(executable_path=str(chromium), args=flags)
        expect.set_options(timeout=WAIT_MS)
        building = Building(live)
        await building.add_places()
        anna = building.watch(await (await browser.new_context(locale="en-GB")).new_page())
        guest = building.watch(await (await browser.new_context(**TABLET)).new_page())
        await codes_are_made_of_a_guests_token_only(building, anna)
        await guest_is_led(building, guest)
        await guest.get_by_role("button", name="New visit").click()
        await guest_is_where_the_robot_is_and_changes_their_mind(guest)
        await guest.get_by_role("button", name="New visit").click()
        await operator_stops_the_next_visit(building, guest, anna)
        expect.set_options(timeout=None)
        await browser.close()
        assert building.problems == []


async def codes_are_made_of_a_guests_token_only(building: Building, anna: Page) -> None:
    await anna.goto(f"{building.url}#login={building.operator}")
    await anna.get_by_role("link", name="Codes for visitors").click()
    await anna.get_by_label("Token of a guest").fill(building.operator)
    await anna.get_by_role("button", name="Show the codes").click()
    await expect(anna.get_by_role("alert")).to_contain_text("This token has the role operator")
    await expect(anna.get_by_role("img")).to_have_count(0)
    await anna.get_by_label("Token of a guest").fill(building.guest)
    await anna.get_by_role("button", name="Show the codes").click()
    await expect(anna.get_by_role("img", name="Code for visits from Hall")).to_be_visible()
    await building.look(anna, "codes")
    await anna.get_by_role("link", name="Back to the console").click()


async def guest_is_led(building: Building, guest: Page) -> None:
    await building.rest("PUT", f"robots/{ROBOT}/goal", {"place": "b"})
    await guest.goto(f"{building.url}/#/visit/hall?login={building.guest}")
    title = guest.get_by_role("heading", level=1)
    await expect(title).to_have_text("Where do you want to go?")
    kept: Any = await guest.evaluate("[location.href, history.state, {...localStorage}, {...sessionStorage}]")
    assert building.guest not in json.dumps(kept)
    await expect(guest.get_by_text("You are at Hall")).to_be_visible()
    await guest.get_by_role("button", name="Português").click()
    await expect(title).to_have_text("Para onde quer ir?")
    await building.look(guest, "choice")
    await guest.get_by_role("button", name="English").click()
    await guest.get_by_role("button", name="Lab").click()
    await expect(title).to_have_text("Please wait for a robot")
    await building.look(guest, "waiting")
    assert (await building.rest("GET", f"robots/{ROBOT}/goal")).json()["place"] == "b"
    await building.rest("DELETE", f"robots/{ROBOT}/goal")
    await expect(title).to_have_text(f"{ROBOT} is coming to you")
    await expect(guest.get_by_text(" to go, about ")).to_be_visible()
    # Whoever scans again, or reloads the page, still has the visit.
    await guest.goto(f"{building.url}/#/visit/hall?login={building.guest}")
    await guest.wait_for_url(f"{building.url}/#/visit/hall")
    await guest.reload()
    await expect(title).to_have_text(f"{ROBOT} is here")
    await building.look(guest, "ready")
    await guest.get_by_role("button", name="Dark").click()
    await building.look(guest, "ready, dark")
    await guest.get_by_role("button", name="Go: I follow").click()
    await expect(title).to_have_text(f"Follow {ROBOT}")
    await building.look(guest, "leading")
    await expect(title).to_have_text("You have arrived")
    x, y = PLACES["lab"]
    assert abs(building.live.truth.x - x) + abs(building.live.truth.y - y) < 0.6
    await building.look(guest, "arrived")


async def guest_is_where_the_robot_is_and_changes_their_mind(guest: Page) -> None:
    await guest.get_by_role("button", name="I am elsewhere").click()
    await guest.get_by_role("button", name="Lab").click()
    await expect(guest.get_by_text("You are at Lab")).to_be_visible()
    await guest.get_by_role("button", name="Hall").click()
    await expect(guest.get_by_role("heading", level=1)).to_have_text(f"{ROBOT} is here")
    await guest.get_by_role("button", name="End the visit").click()
    await expect(guest.get_by_text("You have ended it.")).to_be_visible()


async def operator_sees_the_visit(building: Building, anna: Page) -> None:
    visits = anna.get_by_role("region", name="Visitors")
    await expect(visits.get_by_role("listitem")).to_contain_text("lobby")
    await building.look(anna, "visits")


async def operator_stops_the_next_visit(building: Building, guest: Page, anna: Page) -> None:
    await guest.get_by_role("button", name="A, west entrance").click()
    title = guest.get_by_role("heading", level=1)
    await expect(title).to_have_text(f"{ROBOT} is coming to you")
    await operator_sees_the_visit(building, anna)
    await building.live.stop_operator()
    await anna.get_by_role("button", name=f"Stop {ROBOT}").click()
    await expect(title).to_have_text("The visit is over")
    await expect(guest.get_by_text("The staff need the robot, or have stopped it.")).to_be_visible()
    await building.look(guest, "ended")
    assert (await building.rest("GET", f"robots/{ROBOT}/goal")).status_code == 404
