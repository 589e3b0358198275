"""The views of a demonstration: in a terminal with robot, watched areas, processes and events; on a page; or none.

The page's address has a secret, because it logs in: only who reads the terminal may operate the demo.
"""

import asyncio
import contextlib
import math
import secrets
import signal
import socket
from collections.abc import AsyncIterator, Callable
from typing import Any, Final

import uvicorn
from fastapi import FastAPI, Response
from fastapi.responses import RedirectResponse
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from fog_contracts.stages import STAGES, durations_ms, hazard_to_path_ms
from fog_runtime import logs
from fog_runtime.configuration.site import LoadedSite
from fog_supervisor import net
from fog_supervisor.supervisor import NotReadyError
from fognav.demo.options import Options
from fognav.demo.run import Demo
from fognav.demo.scene import Scene
from fognav.output import WrongUseError, console
from fognav_sim.drive.drive import DriveOutcome
from fognav_sim.drive.hazard import path_length

SCENARIO: Final = "/api/v1/scenario"
"""The route of the scenario, which the console-service passes on."""
_STARTING: Final = """\
<!doctype html><html lang="en"><meta charset="utf-8"><meta http-equiv="refresh" content="1">
<link rel="icon" href="data:,"><title>Fognav</title>
<p>The demo is starting. Its console opens here in a moment.</p></html>
"""
_HEADERS: Final = {"Cache-Control": "no-store", "Referrer-Policy": "no-referrer"}


def make_app(demo: Demo, secret: str) -> FastAPI:
    """Return the application; it knows the demo's current attempt."""
    app = FastAPI(title="Fognav demo", docs_url=None, redoc_url=None, openapi_url=None)

    @app.get(SCENARIO)
    async def scenario(trail: int = 0) -> dict[str, Any]:
        return demo.scene.scenario_view(trail)

    @app.get("/{name:path}")
    async def console(name: str) -> Response:
        if not secrets.compare_digest(name.encode(), secret.encode()):
            return Response("open the address that the demo printed, as it is", 404, media_type="text/plain")
        login = demo.attempt.console_login()
        if login is None:
            return Response(_STARTING, headers=_HEADERS, media_type="text/html")
        return RedirectResponse(login, 303, _HEADERS)

    return app


@contextlib.asynccontextmanager
async def serve(demo: Demo, port: int = 0) -> AsyncIterator[str]:
    """Serve while the context is open; yields the address that leads to the console. Port 0 chooses a free port.

    Raises `WrongUseError` for a port that is not available.
    """
    chosen = port or net.free_port()
    # Bound here, because uvicorn ends the whole process if it can't bind.
    listening = socket.socket(proto=socket.IPPROTO_TCP)  # named: asyncio then sets TCP_NODELAY
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((net.LOOPBACK, chosen))
    except OSError as error:
        listening.close()
        raise WrongUseError(
            f"the page can't be served on port {chosen} ({error.strerror}): choose another with --page-port, "
            "or omit the option to use any free port"
        ) from error
    secret = secrets.token_urlsafe(16)
    config = uvicorn.Config(
        make_app(demo, secret), host=net.LOOPBACK, port=chosen, log_level="warning", access_log=False, lifespan="off"
    )
    config.timeout_graceful_shutdown = 2
    server = uvicorn.Server(config)
    # The command handles signals itself.
    server.capture_signals = contextlib.nullcontext  # type: ignore[method-assign,assignment]  # a context manager too
    task = asyncio.create_task(server.serve([listening]))
    try:
        while not server.started:
            if task.done():
                task.result()
                raise OSError(f"the page's server on port {chosen} ended during its start")
            await asyncio.sleep(0.02)
        yield f"http://{net.LOOPBACK}:{chosen}/{secret}"
    finally:
        server.should_exit = True
        await asyncio.gather(task, return_exceptions=True)


_PERIOD_S = 0.2
_MODE_STYLES = {
    "NORMAL": "bold green",
    "DEGRADED": "bold yellow",
    "INIT": "bold cyan",
    "HOLD": "bold yellow",
    "EGRESS": "bold magenta",
    "TELEOP": "bold magenta",
    "DOCK": "bold magenta",
}
_STATE_STYLES = {"blocked": "bold red", "clear": "green", "unknown": "yellow"}
_VALUE_WIDTH: Final = 8
"""Width of the longest state or time: narrow terminals truncate names, never values."""


def _pairs() -> Table:
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    return table


def _robot(scene: Scene) -> Panel:
    table = _pairs()
    state, pose, truth, path = scene.state, scene.pose, scene.truth, scene.path
    mode = state.mode if state else "no state yet"
    table.add_row("mode", Text(mode, style=_MODE_STYLES.get(mode, "bold red")))
    if state is not None:
        table.add_row("reasons", "; ".join(state.reasons[:3]) or "none")
    if pose is not None:
        table.add_row("pose", f"{pose.x:7.2f} m {pose.y:7.2f} m {math.degrees(pose.theta):6.0f}°   {pose.v:4.2f} m/s")
    if truth is not None:
        error = f"error {math.hypot(truth.x - pose.x, truth.y - pose.y):.2f} m" if pose else ""
        table.add_row("ground truth", f"{truth.x:7.2f} m {truth.y:7.2f} m   {error}")
        table.add_row("driven", f"{truth.distance:.1f} m")
        table.add_row("clearance", f"{truth.clearance:.2f} m")
    if path is not None:
        length = path_length(path.points)
        table.add_row("path", path.refusal.reason if path.refusal else f"plan {path.plan_id}, {length:.1f} m")
    if state is not None and state.goal_distance is not None:
        table.add_row("remaining", f"{state.goal_distance:.1f} m")
    return Panel(table, title=f"Robot {scene.robot}", title_align="left")


def _hazards(scene: Scene) -> Panel:
    table = Table.grid(padding=(0, 1), expand=True)
    table.add_column(style="dim", no_wrap=True, overflow="ellipsis", ratio=1)
    table.add_column(no_wrap=True, justify="right", width=_VALUE_WIDTH)
    for area in scene.site.site.areas:
        hazard = scene.hazards.get(area.id)
        state = hazard.hazard.state if hazard else "no state"
        mark = "?" if hazard is not None and not hazard.confirmed else ""
        table.add_row(area.label or area.id, Text(state + mark, style=_STATE_STYLES.get(state, "dim")))
    if any(not hazard.confirmed for hazard in scene.hazards.values()):
        table.add_row("?: not confirmed by the aggregator", "")
    trace = scene.trace
    durations = durations_ms(trace)
    if durations:
        table.add_row("", "")
        for stage in STAGES:
            table.add_row(stage, f"{durations[stage]:.0f} ms" if stage in durations else "...")
        total = hazard_to_path_ms(trace)
        if total is not None:
            table.add_row(Text("reading to path", style="bold"), Text(f"{total:.0f} ms", style="bold"))
    return Panel(table, title="Watched areas", title_align="left")


def _processes(scene: Scene) -> Panel:
    table = Table(box=None, padding=(0, 1), header_style="dim")
    table.add_column("process", no_wrap=True)
    table.add_column("CPU", justify="right")
    table.add_column("memory", justify="right")
    for name, (cpu, rss) in scene.usage.items():
        table.add_row(name, f"{cpu:.0f} %", f"{rss:.0f} MB")
    return Panel(table, title="Processes", title_align="left")


def _events(scene: Scene, lines: int) -> Panel:
    table = _pairs()
    for at, text in list(scene.events)[-lines:]:
        table.add_row(f"{at:6.1f} s", text)
    return Panel(table, title="Events", title_align="left")


def render(scene: Scene, height: int) -> RenderableType:
    """Render the scene for a terminal of `height` lines."""
    speed = f", speed {scene.speed:g}" if scene.speed != 1.0 else ""
    header = Text.assemble(
        ("Fognav ", "bold"), f"{scene.site.site.name or scene.site.site.id}, seed {scene.seed}{speed}: "
    )
    header.append(scene.phase, style="bold cyan")
    if scene.page_url:
        header.append(f"    {scene.page_url}", style="underline")
    if scene.hint:
        header.append(f"\n{scene.hint}", style="dim")
    columns = Table.grid(expand=True)
    for ratio in (5, 3, 4):
        columns.add_column(ratio=ratio)
    columns.add_row(_robot(scene), _hazards(scene), _processes(scene))
    used = 4 + bool(scene.hint) + max(len(scene.usage) + 3, len(scene.site.site.areas) + 9)
    return Group(header, columns, _events(scene, max(5, height - used)))


async def show(demo: Demo, console: Console) -> None:
    """Update the terminal until cancelled."""
    with Live(render(demo.scene, console.height), console=console, auto_refresh=False, screen=False) as live:
        try:
            while True:
                live.update(render(demo.scene, console.height), refresh=True)
                await asyncio.sleep(_PERIOD_S)
        finally:
            live.update(render(demo.scene, console.height), refresh=True)


_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


async def run_demo(
    site: LoadedSite, options: Options, *, headless: bool, page_port: int, print_line: Callable[[str], None]
) -> dict[str, object]:
    """Run a demonstration on a site until its outcome or a signal; return the report.

    Raises `WrongUseError` for a site that is not suitable.
    """
    logs.configure("demo", "warning", "text")
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in _SIGNALS:
        loop.add_signal_handler(number, stop.set)
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
