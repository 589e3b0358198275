"""Takes demo-page.png: the console of a demo whose robot drives around the barrier.

Run: python docs/images/take_demo_page.py, on a machine with nothing else to do. It takes two minutes, and prints the
latency that the picture shows, which README.md tells.
"""

import subprocess
import sys
from pathlib import Path
from typing import Final

from playwright.sync_api import sync_playwright

from fognav import checkout, console_page, system

PICTURE: Final = Path(__file__).with_name("demo-page.png")
SIZE: Final = {"width": 1280, "height": 860}
AROUND: Final = """() => document.querySelector("main .lead")?.textContent === "driving around the barrier"
    && parseFloat(document.querySelector("main .facts dd").textContent) > 29"""
DRIVE_S: Final = 300


def main() -> None:
    """Run a demo, and take the picture once the robot is in the free corridor."""
    if (chromium := system.find(system.CHROMIUM)) is None:
        raise SystemExit(f"no Chromium: {system.install_command([system.CHROMIUM])}")
    console_page.build(checkout.root())
    command = [sys.executable, "-m", "fognav", "demo", "--seed", "1"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as demo, sync_playwright() as playwright:
        try:
            address = next(line.split()[-1] for line in demo.stderr or () if "watch the demo at" in line)
            browser = playwright.chromium.launch(executable_path=str(chromium), args=["--no-sandbox"])
            page = browser.new_page(viewport=SIZE)
            page.goto(address)
            page.wait_for_selector(".floor", timeout=DRIVE_S * 1000)
            page.evaluate("location.hash = '#/scenario'")
            page.wait_for_function(AROUND, timeout=DRIVE_S * 1000)
            page.screenshot(path=PICTURE)
            print(f"{PICTURE}: {page.inner_text('#total')}")
        finally:
            demo.terminate()


if __name__ == "__main__":
    main()
