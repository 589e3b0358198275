"""The console's page in a real Chromium, over a stream of events that says what a test wants."""

from collections.abc import AsyncIterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from console_stream import FLAGS, TOKEN, WIDE, ConsoleStream, robot_pose, robot_state, serve
from playwright.async_api import Page, async_playwright, expect

from fog_runtime.configuration.site import load_site
from fognav import console_page, system

ROOT = Path(__file__).parents[2]


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
