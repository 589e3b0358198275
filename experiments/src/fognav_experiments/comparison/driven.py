"""What every record of a drive says, wherever it was driven: in lockstep, by real processes, on a real robot. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec

from fog_contracts.messages import ProfileName  # read at run time, when a file is decoded

if TYPE_CHECKING:
    from fognav_experiments.comparison.draws import RouteDraw
    from fognav_sim.drive.drive import DriveSummary


class DrivenRoute(msgspec.Struct, frozen=True, kw_only=True):
    """A drawn route that a setup drove; lengths in m, times in s of the system's clock.

    `area`: what was blocked. `version`, `commit`: of the program; the latter is empty where it is not known, or is the
    one that the folder was begun with.
    """

    setup: ProfileName
    run: int
    route: str
    seed: int
    area: str
    outcome: str
    success: bool
    distance_m: float
    time_s: float | None
    version: str = ""
    commit: str = ""


class ComparedDrive(DrivenRoute, frozen=True, kw_only=True):
    """One drive of a comparison of setups.

    `moment`, `trigger_m`: when the area was to be blocked, by the distance driven. `paths`: paths that the robot
    followed; `modes`: how often it entered each of its modes; `stops`: its protective stops and faults; `route_areas`:
    the watched areas that it crossed, in order. `load`: the machine's load average at the end.
    """

    moment: str
    trigger_m: float
    reason: str
    paths: int
    stops: list[str]
    route_areas: list[str]
    modes: dict[str, int] = {}
    min_clearance_m: float | None = None
    load: float = 0.0


def facts(kind: type[ComparedDrive], drawn: RouteDraw, setup: ProfileName, summary: DriveSummary) -> dict[str, Any]:
    """Return the fields of a record of this `kind` that the draw and a drive's summary tell."""
    told = {name: getattr(summary, name) for name in kind.__struct_fields__ if name in summary.__struct_fields__}
    of_draw = {name: getattr(drawn, name) for name in ("run", "seed", "area", "moment", "trigger_m")}
    return told | of_draw | {"route": drawn.route.name, "setup": setup}


def route_ends(name: str) -> str:
    """Return a route's two ends in words, by its name, which is both in one."""
    half = len(name) // 2
    return f"{name[:half].upper()} to {name[half:].upper()}"


def drive_name(run: int, route: str, setup: str, cpu_quota: float | None = None, speed: float = 1.0) -> str:
    """Return the name of a drive's record; without a quota and in real time the same as that in lockstep."""
    quota = "" if cpu_quota is None else f"-quota{cpu_quota:g}"
    return f"{run:04}-{route}-{setup}{quota}" + ("" if speed == 1.0 else f"-speed{speed:g}")
