"""Stills of a drive, as figures 6.1 and 6.2 of the thesis: what each robot plans by, shortly after the start."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle

from fog_contracts.costs import LETHAL
from fognav_experiments.comparison.drives import ALONE, PROFILE_OF_SETUP, ends_of, start_of
from fognav_experiments.comparison.film import WORDS
from fognav_experiments.figures import COLOURS, write_png
from fognav_experiments.lockstep import ready
from fognav_sim.drive.hazard import HazardRequest

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from matplotlib.axes import Axes

    from fog_runtime.configuration.site import LoadedSite
    from fognav_experiments.comparison.drives import RouteDraw, Setup
    from fognav_experiments.lockstep import LockstepDrive

_WAY_M: Final = 500.0


class NoStillError(ValueError):
    """A drive that did not come so far; the message says why."""


def write_stills(site: LoadedSite, drawn: RouteDraw, setups: Sequence[Setup], at_s: float, file: Path) -> None:
    """Drive a drawn route in these setups until `at_s` s after its start, and draw them above one another as PNG.

    Each shows what that robot plans by: costs (the darker, the dearer), path (red), window of its local planner (blue);
    and what is so: the blocked area (pink, where the robot was told) and the obstacle. Raises `NoStillError`.
    """
    figure = Figure(figsize=(9.0, 5.2 * len(setups)), layout="constrained")
    for axes, setup in zip(np.atleast_1d(figure.subplots(len(setups), 1)), setups, strict=True):
        run = ready(
            site, start_of(site, drawn), ends_of(site, drawn)[1], drawn.seed,
            HazardRequest(area=drawn.area, trigger_m=drawn.trigger_m),
            watched=setup not in ALONE, profile=PROFILE_OF_SETUP[setup],
        )  # fmt: skip
        while run.problem is None and run.now < run.started_at + at_s:
            run.step()
        if run.problem is not None:
            raise NoStillError(f"{setup} on run {drawn.run}, route {drawn.route.name}: {run.problem}")
        _draw(axes, run, setup, drawn)
    write_png(figure, file)


def _draw(axes: Axes, run: LockstepDrive, setup: Setup, drawn: RouteDraw) -> None:
    agent, site = run.robot.agent, run.site.site
    replica, path = agent.replica, agent.way(_WAY_M)
    assert replica.geometry is not None
    west, south, east, north = replica.geometry.bounds
    shades = np.where(replica.cost == LETHAL, 255, replica.cost // 2)
    extent = (west, east, south, north)
    axes.imshow(shades, cmap="gray_r", vmin=0, vmax=255, origin="lower", extent=extent, interpolation="nearest")
    corners = next(area.polygon for area in site.areas if area.id == drawn.area)
    if setup not in ALONE and run.hazards.get(drawn.area) == "blocked":
        axes.add_patch(Polygon(corners, facecolor="#f6a0b4", edgecolor="#b03060", alpha=0.6))
    if run.barrier is not None:
        axes.add_patch(Polygon(run.barrier.polygon, facecolor="#d02828", edgecolor="#d02828"))
    if len(path):
        axes.plot(*path.T, color="#d02828", linewidth=1.2)
    x, y, _ = run.world.pose
    half = agent.profile.window
    axes.add_patch(Rectangle((x - half, y - half), 2 * half, 2 * half, facecolor="#3b7dd8", alpha=0.35))
    axes.plot(x, y, "o", color=COLOURS[setup], markersize=5)
    for name in (drawn.route.start, drawn.route.goal):
        if (place := site.places.get(name)) is not None:
            axes.annotate(name.upper(), (place.x, place.y), weight="bold", ha="center", va="center")
    axes.set(title=f"{setup}: {WORDS[setup]}", xlabel="m", ylabel="m")
