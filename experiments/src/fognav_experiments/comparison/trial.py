"""One drive of the comparison in lockstep."""

from __future__ import annotations

import os
import time
from importlib.metadata import version
from typing import TYPE_CHECKING

import msgspec

from fog_contracts.bus import Bus
from fog_contracts.messages import Pose
from fog_contracts.stages import TOTAL
from fognav_experiments.comparison.driven import facts
from fognav_experiments.comparison.records import Record
from fognav_experiments.comparison.timeline import TimelineRecorder
from fognav_experiments.cpu import CpuMeter
from fognav_experiments.lockstep import run_lockstep
from fognav_sim.drive.hazard import HazardRequest

if TYPE_CHECKING:
    from fog_contracts.messages import ProfileName
    from fog_runtime.configuration.site import LoadedSite
    from fognav_experiments.comparison.draws import RouteDraw


def drive(site: LoadedSite, drawn: RouteDraw, setup: ProfileName, jobs: int = 1, commit: str = "") -> Record:
    """Drive a drawn route in a setup; the same but for CPU and wall time whenever it is repeated.

    `jobs` (drives that run at the same time on this machine) and `commit` are only recorded. Raises `BarrierError` for
    an area that no barrier closes.
    """
    places = site.site.places
    origin, goal = places[drawn.route.start], places[drawn.route.goal]
    start = Pose(x=origin.x, y=origin.y, theta=drawn.theta if origin.theta is None else origin.theta)
    cpu, bus = CpuMeter(), Bus(site.site.id)
    recorder = TimelineRecorder(bus, setup)
    begun = time.perf_counter()
    result = run_lockstep(
        site,
        start,
        goal,
        drawn.seed,
        HazardRequest(area=drawn.area, trigger_m=drawn.trigger_m),
        watched=setup != "default",
        profile=setup,
        cpu=cpu,
        bus=bus,
    )
    appears = (event.time_s for event in result.events if event.description.startswith("barrier appears"))
    total = result.stages_ms.get(TOTAL)
    return msgspec.convert(
        facts(Record, drawn, setup, result)
        | {
            "reaction_s": None if total is None else total / 1000.0,
            "cpu_s": {name: round(seconds, 4) for name, seconds in sorted(cpu.seconds.items())},
            "jobs": jobs,
            "load": round(os.getloadavg()[0], 2),
            "wall_s": round(time.perf_counter() - begun, 1),
            "version": version("fognav-experiments"),
            "commit": commit,
            "timeline": None if result.time_s is None else recorder.timeline(result.time_s, next(appears, None)),
        },
        Record,
    )
