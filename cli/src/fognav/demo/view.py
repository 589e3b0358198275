"""The demonstration in a terminal: robot, watched areas, processes and events."""

import asyncio
import math
from typing import Final

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from fog_contracts.stages import STAGES, durations_ms, hazard_to_path_ms
from fognav.demo.run import Demo
from fognav.demo.scene import Scene
from fognav_sim.drive.hazard import path_length

_PERIOD_S = 0.2
_MODE_STYLES = {
    "NORMAL": "bold green",
    "DEGRADED": "bold yellow",
    "INIT": "bold cyan",
    "HOLD": "bold yellow",
    "EGRESS": "bold magenta",
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
