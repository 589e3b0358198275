"""The console of a running demo, on a phone: it follows the robot, stops it, says why it stands, and sends it on."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from playwright.sync_api import expect, sync_playwright

from fog_supervisor import child
from fognav import console_page, system

pytestmark = [pytest.mark.live, pytest.mark.browser, pytest.mark.drive, pytest.mark.timeout(900)]

ROOT = Path(__file__).parents[2]
START_MS, WAIT_MS = 300_000.0, 120_000.0
"""A busy machine may be ten times slower."""


def test_operator_stops_a_robot_sees_why_it_stands_and_sends_it_on_from_a_phone(tmp_path: Path) -> None:
    if (chromium := system.find(system.CHROMIUM)) is None:
        pytest.skip(f"no Chromium: {system.install_command([system.CHROMIUM])}, or ./fognav test --yes as root")
    console_page.build(ROOT)
    runtime = tmp_path / "runtime"
    runtime.mkdir(mode=0o700)
    command = child.command(sys.executable, "-m", "fognav", "demo", "--no-hazard")
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(runtime)}
    with (
        subprocess.Popen(command, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True) as demo,
        sync_playwright() as playwright,
    ):
        try:
            assert demo.stderr is not None
            address = next(line.split()[-1] for line in demo.stderr if "watch the demo at" in line)
            browser = playwright.chromium.launch(executable_path=str(chromium), args=["--no-sandbox", "--disable-gpu"])
            page = browser.new_page(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
            problems: list[str] = []
            page.on("pageerror", lambda error: problems.append(str(error)))
            page.goto(address)
            robot = page.locator("button.robot")
            expect(robot.locator(".badge")).to_have_text("driving", timeout=START_MS)
            assert "login" not in page.url
            expect(page.locator(".leaflet-costs-pane canvas").first).to_be_attached()
            # Somebody else's goal ends the demo's drive: from then on the system is theirs, nobody enables the robot.
            page.evaluate("location.hash = '#/robots'")
            page.get_by_role("button", name="Send to a goal").tap()
            page.get_by_label("Place").select_option("d")
            expect(page.get_by_text(re.compile(r"The path is [0-9.]+ m long"))).to_be_visible(timeout=WAIT_MS)
            page.get_by_role("button", name="Send", exact=True).tap()
            expect(page.locator(".said")).to_contain_text("drives to D", timeout=WAIT_MS)
            page.get_by_role("link", name="Scenario").tap()
            expect(page.locator("main .lead")).to_contain_text("somebody sent the robot elsewhere", timeout=WAIT_MS)
            page.get_by_role("button", name=re.compile("^Stop r1")).tap()
            expect(page.locator(".said")).to_have_text("r1 stops.", timeout=WAIT_MS)
            page.get_by_role("link", name="Robots").tap()
            expect(page.locator("main .lead")).to_contain_text("Enable it.", timeout=WAIT_MS)
            page.get_by_role("button", name="Enable", exact=True).tap()
            page.get_by_role("button", name="Yes, Enable").tap()
            expect(page.locator(".facts dd").first).to_have_text("driving", timeout=WAIT_MS)
            assert problems == []
        finally:
            demo.terminate()
            demo.communicate(timeout=60)
