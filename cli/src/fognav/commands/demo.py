"""Connects the demonstration with its views: the terminal, the page, or none."""

import asyncio
import contextlib
import signal
from collections.abc import Callable
from pathlib import Path

from fog_runtime import logs
from fog_runtime.configuration.site import SiteError, load_site
from fog_supervisor.supervisor import NotReadyError
from fognav.demo.options import Options
from fognav.demo.run import Demo
from fognav.demo.view import show
from fognav.output import WrongUseError, console
from fognav.page.app import serve
from fognav_sim.drive.drive import DriveOutcome

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


async def run_demo(
    folder: Path, options: Options, *, headless: bool, page_port: int, print_line: Callable[[str], None]
) -> dict[str, object]:
    """Run a demonstration on a site's folder until its outcome or a signal; return the report.

    Raises `WrongUseError` for a site that is not suitable.
    """
    logs.configure("demo", "warning", "text")
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in _SIGNALS:
        loop.add_signal_handler(number, stop.set)
    try:
        site = load_site(folder)
    except SiteError as error:
        raise WrongUseError(str(error)) from error
    in_terminal = not headless and console.is_terminal
    demo = Demo(site, options, None if in_terminal else print_line)
    try:
        async with contextlib.AsyncExitStack() as views:
            if not headless:
                demo.page_url = demo.scene.page_url = await views.enter_async_context(serve(demo, page_port))
                print_line(f"watch the demo at {demo.page_url}")
            if in_terminal:
                view = asyncio.create_task(show(demo, console))
                views.push_async_callback(_end, view)
            return await demo.run(stop)
    except (NotReadyError, TimeoutError) as error:
        print_line(str(error))
        demo.scene.outcome = DriveOutcome("stopped", str(error))
        return demo.report()


async def _end(view: asyncio.Task[None]) -> None:
    view.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await view
