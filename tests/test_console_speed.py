"""What ten robots at 10 Hz cost a browser: scripting and painting for a frame, by the renderer's thread time."""

import asyncio
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from console_stream import FLAGS, TOKEN, ConsoleStream, robot_pose, robot_state, serve
from playwright.async_api import CDPSession, async_playwright, expect

from fog_runtime.configuration.site import load_site
from fognav import console_page, system

pytestmark = [pytest.mark.browser, pytest.mark.drive]

ROOT = Path(__file__).parents[1]
ROBOTS, RATE_HZ, SECONDS = 10, 10.0, 12.0


@pytest.fixture(scope="module", autouse=True)
def page_is_built() -> None:
    if system.find(system.CHROMIUM) is None:
        pytest.skip(f"no Chromium: {system.install_command([system.CHROMIUM])}, or ./fognav test --yes as root")
    console_page.build(ROOT)


async def drive(stream: ConsoleStream) -> None:
    """Let the robots drive in circles, each with a path, obstacles, and changes of the costmap under it."""
    step = 0
    while True:
        for number in range(ROBOTS):
            angle = step / RATE_HZ / 3.0 + number
            x, y = 12.0 + 7.0 * number + 2.0 * math.cos(angle), 26.0 + 2.0 * math.sin(angle)
            stream.tell("pose", f"r{number}", robot_pose(x, y, angle + math.pi / 2))
            if step % 5 == number % 5:
                points = [[x + 0.05 * each, y + 0.6] for each in range(40)]
                stream.tell("obstacles", f"r{number}", {"points": points, "stamp": 0.0})
            if step % 10 == number:
                stream.robot(f"r{number}", robot_state(goal_distance=float(step)))
                corners = [[x, y], *([x + each, y + (each % 2)] for each in range(1, 30))]
                stream.tell("path", f"r{number}", {"points": corners, "released_length": 8.0, "plan_id": step})
        if step % 10 == 0:
            stream.tile(128 * (step // 10 % 12), 512, np.full((128, 128), step % 250, dtype=np.uint8))
        step += 1
        await asyncio.sleep(1.0 / RATE_HZ)


async def trace(session: CDPSession, seconds: float) -> list[Mapping[str, object]]:
    events: list[Mapping[str, object]] = []
    complete = asyncio.Event()
    session.on("Tracing.dataCollected", lambda data: events.extend(data["value"]))
    session.on("Tracing.tracingComplete", lambda _: complete.set())
    categories = "toplevel,devtools.timeline,__metadata"
    await session.send("Tracing.start", {"categories": categories, "transferMode": "ReportEvents"})
    await asyncio.sleep(seconds)
    await session.send("Tracing.end")
    await asyncio.wait_for(complete.wait(), 60)
    return events


def frame_times(events: Sequence[Mapping[str, object]]) -> list[float]:
    """Thread time (ms) that the page's main thread used from one frame to the next, of the process that draws most."""
    mains = {
        (e["pid"], e["tid"]) for e in events if e["name"] == "thread_name" and e["args"]["name"] == "CrRendererMain"
    }
    best: list[float] = []
    for main in mains:
        own = [e for e in events if (e["pid"], e["tid"]) == main and e["ph"] == "X"]
        tasks = [(e["ts"], e.get("tdur", 0)) for e in own if e["name"].endswith("RunTask")]
        frames = sorted(e["ts"] for e in own if e["name"] in ("Commit", "Paint", "Layerize"))
        starts = [at for at, before in zip(frames, [-math.inf, *frames], strict=False) if at - before > 8_000]
        edges = np.array(starts)
        if len(edges) < 2:
            continue
        used = np.zeros(len(edges) + 1)
        for at, spent in tasks:
            used[np.searchsorted(edges, at)] += spent / 1000.0
        if len(edges) > len(best):
            best = list(used[1:-1])
    return best


@pytest.mark.parametrize("slower", [1, 6], ids=["as-it-is", "six-fold-throttled"])
async def test_frames_with_ten_robots_at_10_hz_are_drawn_and_say_what_they_cost(slower: int) -> None:
    stream = ConsoleStream(load_site(ROOT / "sites" / "estig"))
    async with serve(stream) as url, async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=str(system.find(system.CHROMIUM)), args=FLAGS)
        page = await browser.new_page(viewport={"width": 1440, "height": 900})
        session = await page.context.new_cdp_session(page)
        driving = asyncio.create_task(drive(stream))
        await page.goto(f"{url}#login={TOKEN}")
        await expect(page.get_by_text("Live", exact=True)).to_be_visible()
        await asyncio.sleep(2.0)
        await session.send("Emulation.setCPUThrottlingRate", {"rate": slower})
        events = await trace(session, SECONDS)
        driving.cancel()
        await browser.close()
    times = frame_times(events)
    p50, p95 = np.percentile(times, [50, 95])
    cost = f"{len(times)} frames in {SECONDS:.0f} s, {slower}-fold slower: median {p50:.1f} ms, p95 {p95:.1f} ms"
    print(cost)  # noqa: T201  # what it is for: pytest -s
    assert len(times) > SECONDS * RATE_HZ / 3.0
