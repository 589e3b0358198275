"""Maneuvers: short movements that an operator orders once, under rules of their own. Pure; used by the gate.

An egress leads a robot out of a blocked area. It suspends one condition, "inside a blocked area", follows no mission,
and ends for good with anything else that would stop the robot. Afterwards the robot waits to be enabled.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import msgspec
from msgspec.structs import replace

from robot_agent.safety.conditions import Level, collect_findings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robot_agent.config import SafetyConfig
    from robot_agent.safety.conditions import Finding, SafetyInputs


class Maneuver(msgspec.Struct, frozen=True):
    """A maneuver that runs: since when (s), the smallest distance to go so far (m), and when it last shrank (s)."""

    since: float
    best: float
    shrank_at: float


def relevant(inputs: SafetyInputs) -> SafetyInputs:
    """Return the inputs that count during an egress: it leaves a blocked area, and follows no mission."""
    return replace(inputs, inside_blocked=None, mission=False)


def begin(inputs: SafetyInputs, now: float, config: SafetyConfig) -> Maneuver | str:
    """Return an egress that begins at `now` (s, monotonic), or why there can't be one."""
    if inputs.inside_blocked is None:
        return "the robot is in no blocked area or zone: there is nothing to leave"
    findings = collect_findings(relevant(inputs), config)
    causes = [finding.reason for finding in findings if finding.level >= Level.HOLD and not finding.rest]
    if causes:
        return f"the robot must not move: {'; '.join(causes)}"
    return Maneuver(now, math.inf, now)


def proceed(
    maneuver: Maneuver, inputs: SafetyInputs, findings: Sequence[Finding], now: float, config: SafetyConfig
) -> Maneuver | str:
    """Return the egress as it goes on at `now` (s, monotonic), or why it ends.

    findings: those of the `relevant` inputs. The distance to the end of the way out must shrink steadily. The time
    counts from when the lidar runs.
    """
    stops = [finding.reason for finding in findings if finding.level >= Level.HOLD and not finding.rest]
    if stops:
        return "; ".join(stops)
    if inputs.resting is not None:
        return replace(maneuver, since=now, shrank_at=now)
    if inputs.egress_remaining <= config.egress_end:
        still = inputs.inside_blocked
        return "the robot is out" if still is None else f"the way out ends, and the robot is still in {still}"
    if now - maneuver.since >= config.egress_max:
        return f"it took longer than {config.egress_max:.0f} s"
    return _progress(maneuver, inputs, now, config)


def _progress(maneuver: Maneuver, inputs: SafetyInputs, now: float, config: SafetyConfig) -> Maneuver | str:
    remaining = inputs.egress_remaining
    if not remaining <= maneuver.best + config.egress_back:
        return "the robot moved away from the way out"
    if remaining < maneuver.best - config.egress_step:
        return Maneuver(maneuver.since, remaining, now)
    if now - maneuver.shrank_at >= config.egress_stall:
        problem = f": {inputs.egress_problem}" if inputs.egress_problem else ""
        return f"the robot came no nearer to its end for {config.egress_stall:.0f} s{problem}"
    return maneuver
