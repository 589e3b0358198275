"""Maneuvers: short movements under rules of their own, which an operator orders once. Pure; used by the gate.

- An egress leads a robot out of a blocked area.
- Docking: in front of its dock, the base's own program drives the robot into it.
- Undocking: straight back off the dock.
- A back-off: straight back by a few centimetres from what the robot has bumped into.
- A turn in place, or some centimetres straight ahead, of a robot that does not know its place: scans may tell it then.

Each suspends the conditions that it is made for (`robot_agent.safety.maneuver_rules`), and ends for good with anything
else that would stop the robot.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import msgspec
from msgspec.structs import replace

from robot_agent.safety.conditions import Level, collect_findings
from robot_agent.safety.maneuver_rules import RULES, ManeuverKind

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robot_agent.config import SafetyConfig
    from robot_agent.safety.conditions import Finding, SafetyInputs


class Maneuver(msgspec.Struct, frozen=True):
    """A maneuver that runs: since when (s), the least that was left of it (m, of a turn rad), and since when (s)."""

    since: float
    best: float
    shrank_at: float
    kind: ManeuverKind = "egress"


class End(NamedTuple):
    """Why a maneuver ended, and whether it is done."""

    reason: str
    done: bool = False


def begin(kind: ManeuverKind, inputs: SafetyInputs, now: float, config: SafetyConfig) -> Maneuver | str:
    """Return a maneuver that begins at `now` (s, monotonic), or why there can't be one."""
    rules = RULES[kind]
    refusal = rules.refusal(inputs)
    if refusal is not None:
        return refusal
    findings = collect_findings(rules.relevant(inputs), config)
    causes = [finding.reason for finding in findings if finding.level >= Level.HOLD and not finding.rest]
    if causes:
        return f"the robot must not move: {'; '.join(causes)}"
    return Maneuver(now, float("inf"), now, kind)


def proceed(
    maneuver: Maneuver, inputs: SafetyInputs, findings: Sequence[Finding], now: float, config: SafetyConfig
) -> Maneuver | End:
    """Return the maneuver as it goes on at `now` (s, monotonic), or why it ends.

    findings: those of the relevant inputs. What is left must shrink steadily. The time counts from when the lidar
    runs.
    """
    rules = RULES[maneuver.kind]
    stops = [finding.reason for finding in findings if finding.level >= Level.HOLD and not finding.rest]
    if stops:
        return End("; ".join(stops))
    if inputs.resting is not None:
        return replace(maneuver, since=now, shrank_at=now)
    if (end := rules.end(inputs, config)) is not None:
        return End(*end)
    longest = rules.longest(config)
    if now - maneuver.since >= longest:
        return End(f"it took longer than {longest:.0f} s{_because(inputs)}")
    return _progress(maneuver, inputs, now, config)


def _progress(maneuver: Maneuver, inputs: SafetyInputs, now: float, config: SafetyConfig) -> Maneuver | End:
    remaining = inputs.maneuver_remaining
    if maneuver.kind == "dock":
        return maneuver  # the base's own program finds its way
    if not remaining <= maneuver.best + config.egress_back:
        return End(f"the robot moved away from the end of {RULES[maneuver.kind].name}")
    if remaining < maneuver.best - config.egress_step:
        return replace(maneuver, best=remaining, shrank_at=now)
    if now - maneuver.shrank_at >= config.egress_stall:
        return End(f"the robot came no nearer to its end for {config.egress_stall:.0f} s{_because(inputs)}")
    return maneuver


def _because(inputs: SafetyInputs) -> str:
    """Return the end of a sentence: what keeps the robot from getting there, or why the guardian holds its wheels."""
    problem = inputs.maneuver_problem or inputs.base_stopped
    return f": {problem}" if problem else ""
