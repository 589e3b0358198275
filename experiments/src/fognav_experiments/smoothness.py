"""How smoothly a robot drives and how exactly it arrives: `python -m fognav_experiments.smoothness --site sites/estig`.

Drives of the whole system in lockstep, without a hazard. Measured are the wheel commands, twenty a second, as the agent
sends them to the guardian, and the true pose at the end. Lengths in m, angles in rad, times in s.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from fog_contracts import channels as ch
from fog_contracts.messages import Pose, RobotGoal, RobotState
from fog_runtime.configuration.site import load_site
from fognav_experiments.rigs import System
from robot_agent.agent.core import AgentCore
from robot_agent.localization.pose import wrap

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.handlers import Ids, Moment, Publication
    from fog_contracts.site import Place
    from fog_runtime.configuration.site import LoadedSite
    from robot_agent.config import AgentConfig
    from robot_agent.guardian.link import WheelCommand

TURNING_RAD_S: Final = 0.05
"""A slower turn is no intent to turn."""
_READY_S: Final = 15.0
_SPEED_MIN_M_S: Final = 0.08
"""A drive may take as long as at this mean speed, and some time more for turning."""
_PERIOD_S: Final = 0.05
_SETTLED_STEPS: Final = 50


class Ride(msgspec.Struct, frozen=True, kw_only=True):
    """One drive.

    `reversals_per_m`: changes of sign of the angular command, slow turns left out. Acceleration (m/s2 of a wheel,
    rad/s2) and jerk (m/s3) are the commands' largest while they speed up, `lateral` is v * w.
    `arrival_m`, `arrival_rad`: true distance and heading error at rest (0 if the goal has no heading).
    """

    seed: int
    reached: bool
    contacts: int
    distance_m: float
    time_s: float
    reversals_per_m: float
    acceleration_m_s2: float
    turn_acceleration_rad_s2: float
    jerk_m_s3: float
    lateral_m_s2: float
    arrival_m: float
    arrival_rad: float


class _Recorder(AgentCore):
    """An agent that keeps its wheel commands."""

    def __init__(self, config: AgentConfig, seed: int = 0) -> None:
        super().__init__(config, seed)
        self.axle_m = config.drive_train.axle_m
        self.commands: list[tuple[float, float]] = []

    def stream(self, now: float, stamp: float) -> WheelCommand:
        """Return the wheel speeds to send now, and keep them."""
        command = super().stream(now, stamp)
        self.commands.append((command.left, command.right))
        return command


def reversals(turning: Sequence[float]) -> int:
    """Return how often angular speeds (rad/s) change their sign, those that are no intent to turn left out."""
    signs = np.sign([w for w in turning if abs(w) > TURNING_RAD_S])
    return int(np.count_nonzero(np.diff(signs)))


def ride(site: LoadedSite, start: Pose, goal: Pose, seed: int, *, any_heading: bool = False) -> Ride:
    """Drive the site's first robot from `start` to `goal`."""
    robot = msgspec.structs.replace(site.site.robots[0], start=start)
    recorders: list[_Recorder] = []

    def make(config: AgentConfig, seed: int) -> AgentCore:
        recorders.append(_Recorder(config, seed))
        return recorders[0]

    arrived = False

    def on_state(_ids: Ids, state: RobotState, _at: Moment) -> Sequence[Publication]:
        nonlocal arrived
        arrived = arrived or state.goal_reached
        return ()

    system = System(site, robot, seed, make_agent=make)
    system.bus.subscribe({ch.ROBOT_STATE: on_state})
    recorder = recorders[0]
    while recorder.safety.mode != "NORMAL" and system.now < _READY_S:
        system.step()
        if recorder.safety.mode == "INIT" and recorder.safety.reasons == ("waiting for an operator to enable",):
            system.robot.command("enable")
    begin, began, before = system.now, system.world.distance, len(recorder.commands)
    system.fog.planner.set_goal(robot.id, RobotGoal(goal_id="ride", pose=goal), any_heading=any_heading)
    longest = 30.0 + 3.0 * math.dist((start.x, start.y), (goal.x, goal.y)) / _SPEED_MIN_M_S
    settled = 0
    while settled < _SETTLED_STEPS and system.now - begin < longest:
        system.step()
        settled = settled + 1 if arrived and recorder.commands[-1] == (0.0, 0.0) else 0
    wheels = np.array(recorder.commands[before:])
    v, w = wheels.mean(axis=1), np.diff(wheels, axis=1)[:, 0] / recorder.axle_m
    speeding = np.diff(np.abs(wheels), axis=0).max(axis=1) / _PERIOD_S
    advancing = np.maximum(np.diff(np.abs(v)), 0.0) / _PERIOD_S
    driven = system.world.distance - began
    x, y, theta = system.world.pose
    return Ride(
        seed=seed,
        reached=settled >= _SETTLED_STEPS,
        contacts=system.world.contacts,
        distance_m=round(driven, 2),
        time_s=round(system.now - begin, 1),
        reversals_per_m=round(reversals(w.tolist()) / max(driven, 0.1), 3),
        acceleration_m_s2=round(float(speeding.max()), 2),
        turn_acceleration_rad_s2=round(float(np.diff(np.abs(w)).max()) / _PERIOD_S, 2),
        jerk_m_s3=round(float(np.diff(advancing).max()) / _PERIOD_S, 1),
        lateral_m_s2=round(float(np.abs(v * w).max()), 3),
        arrival_m=round(math.dist((x, y), (goal.x, goal.y)), 3),
        arrival_rad=0.0 if any_heading else round(abs(wrap(float(theta) - goal.theta)), 3),
    )


def _pose(place: Place) -> Pose:
    return Pose(x=place.x, y=place.y, theta=place.theta or 0.0)


def main(arguments: Sequence[str] | None = None) -> int:
    """Drive between two places and print one row of JSON per drive; 1 if one does not arrive exactly, or slips."""
    parser = argparse.ArgumentParser(prog="python -m fognav_experiments.smoothness", description=__doc__)
    parser.add_argument("--site", type=Path, required=True, help="folder of the site")
    parser.add_argument("--seeds", type=int, default=3, help="drives (default: 3)")
    parser.add_argument("--start", help="place to start from (default: the demo's)")
    parser.add_argument("--goal", help="place to drive to (default: the demo's)")
    given = parser.parse_args(arguments)
    site = load_site(given.site)
    demo = site.site.demo
    names = [given.start or (demo and demo.start), given.goal or (demo and demo.goal)]
    for name in names:
        if name not in site.site.places:
            parser.error(f"no place {name!r}; the site has: {', '.join(site.site.places)}")
    start, goal = (site.site.places[str(name)] for name in names)
    failed = False
    for seed in range(1, given.seeds + 1):
        row = ride(site, _pose(start), _pose(goal), seed, any_heading=goal.theta is None)
        exact = row.arrival_m <= 0.10 and row.arrival_rad <= 0.17
        failed = failed or not row.reached or row.contacts > 0 or not exact or row.lateral_m_s2 > 0.4
        sys.stdout.write(msgspec.json.encode(row).decode() + "\n")
        sys.stdout.flush()
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
