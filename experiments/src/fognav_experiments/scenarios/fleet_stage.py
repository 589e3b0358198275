"""Plays a scenario with several robots in lockstep: each has a goal of its own, and the others in its way."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import msgspec

from fog_contracts.messages import Pose
from fog_contracts.site import RobotSite
from fognav_experiments.cpu import CpuMeter
from fognav_experiments.fleet import Fleet, Mission

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_runtime.configuration.site import LoadedSite
    from fognav_experiments.fleet import Vehicle
    from fognav_experiments.scenarios.description import Scenario


class FleetResult(msgspec.Struct, frozen=True, kw_only=True):
    """How the drives of a fleet went, from the moment when all robots got their goals.

    `distance_m`: of all robots together; `time_s`: until the last one arrived, None if not all did; `arrived`: how many
    did. `gap_m`: smallest distance between two robots' rims. `plans`: paths that the planner gave, `planner_percent`:
    share of one core (%) that it took, per second of the simulated clock.
    """

    contacts: int
    reason: str
    distance_m: float
    time_s: float | None
    arrived: int
    gap_m: float
    plans: int
    planner_percent: float


class _Ending(NamedTuple):
    """How the drives ended, in the scenarios' words, and why."""

    kind: str
    reason: str


def play_fleet(scenario: Scenario, site: LoadedSite) -> tuple[FleetResult, str]:
    """Drive all robots of a scenario; return the result, and how it ended as the scenarios' outcomes name it."""
    cpu = CpuMeter()
    fleet = Fleet(site, _missions(scenario, site), scenario.seed, cpu)
    problem = fleet.warm_up()
    cpu.seconds.clear()
    begun = fleet.now
    if problem is None:
        fleet.start()
        while fleet.now - begun < scenario.seconds and any(vehicle.outcome is None for vehicle in fleet.vehicles):
            fleet.step()
    ended = _ended(fleet.vehicles) if problem is None else _Ending("stopped", problem)
    seconds = fleet.now - begun
    drives = [vehicle.drive for vehicle in fleet.vehicles if vehicle.drive is not None]
    result = FleetResult(
        contacts=sum(vehicle.world.contacts for vehicle in fleet.vehicles),
        reason="every robot stands at its goal" if ended is None else ended.reason,
        distance_m=round(sum(vehicle.driven_m for vehicle in fleet.vehicles), 2),
        time_s=round(seconds, 2) if ended is None else None,
        arrived=sum(_arrived(vehicle) for vehicle in fleet.vehicles),
        gap_m=round(fleet.least_gap_m, 3),
        plans=sum(drive.evaluation.plans for drive in drives),
        planner_percent=round(100.0 * cpu.seconds["planner"] / max(seconds, 1e-9), 2),
    )
    return result, "reached" if ended is None else ended.kind


def _missions(scenario: Scenario, site: LoadedSite) -> list[Mission]:
    """Return the robots like the site's first one, with their goals: the scenario's own and the others."""
    wanted = [(scenario.start, scenario.goal), *((other.start, other.goal) for other in scenario.others)]
    like = site.site.robots[0]
    return [
        Mission(
            RobotSite(id=f"r{number}", start=Pose(x=x, y=y, theta=theta), radius=like.radius, height=like.height), goal
        )
        for number, ((x, y, theta), goal) in enumerate(wanted, start=1)
    ]


def _arrived(vehicle: Vehicle) -> bool:
    return vehicle.outcome is not None and vehicle.outcome.kind == "reached"


def _ended(vehicles: Sequence[Vehicle]) -> _Ending | None:
    """Return None if every robot has arrived, else how the first one that has not ended its drive, or still drives."""
    for vehicle in vehicles:
        if not _arrived(vehicle):
            x, y, _ = vehicle.world.pose
            state = vehicle.state
            mode = "" if state is None else f" in {state.mode} ({'; '.join(state.reasons)})"
            if vehicle.outcome is None:
                return _Ending("driving", f"robot {vehicle.id} is at ({x:.1f}, {y:.1f}){mode}")
            return _Ending(vehicle.outcome.kind, f"robot {vehicle.id}: {vehicle.outcome.reason}")
    return None
