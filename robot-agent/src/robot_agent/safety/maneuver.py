"""Maneuvers: short movements under rules of their own, which an operator orders once. Pure; used by the gate.

- An egress leads a robot out of a blocked area.
- Docking: in front of its dock, the base's own program drives the robot into it.
- Undocking: straight back off the dock.
- A back-off: straight back by a few centimetres from what the robot has bumped into.
- A turn in place, or some centimetres straight ahead, of a robot that does not know its place: scans may tell it then.
- Driving by hand: an operator at the robot steers it, with or without a map, a place and a fog.

Each suspends the conditions that it is made for, and ends for good with anything else that would stop the robot. One
table, `RULES`, says what it suspends, what refuses it, and when it is over.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import msgspec
from msgspec.structs import replace

from fog_contracts.messages import Reason, ReasonCode, RefusalCode
from robot_agent.safety.conditions import Level, collect_findings

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from fog_contracts.messages import Mode
    from robot_agent.config import SafetyConfig
    from robot_agent.safety.conditions import Finding, SafetyInputs

ManeuverKind = Literal["egress", "dock", "undock", "back_off", "turn", "advance", "teleop"]


_POSE_WORDS: Final[Mapping[str, str]] = {"weak": "uncertain", "lost": "unknown", "none": "unknown"}


class Rules(NamedTuple):
    """One row of the table.

    mode: the mode meanwhile. name, doing: what it is called, and what the robot does. relevant: the inputs that count.
    refusal: why it can't begin, besides what would end it. end: why it is over, and whether it is done. longest: s that
    it may take. cap: m/s. needs_enable: only an enabled robot begins it. stays_enabled: a robot that was enabled before
    may drive on when it is done, or when what stops any drive has ended it, but no fault; if_ended: or anything else.
    """

    mode: Mode
    name: str
    doing: str
    relevant: Callable[[SafetyInputs], SafetyInputs]
    refusal: Callable[[SafetyInputs], Reason | None]
    end: Callable[[SafetyInputs, SafetyConfig], tuple[str, bool] | None]
    longest: Callable[[SafetyConfig], float]
    cap: Callable[[SafetyConfig], float]
    needs_enable: bool = False
    stays_enabled: bool = False
    if_ended: bool = False


def _relevant_to_egress(inputs: SafetyInputs) -> SafetyInputs:
    return replace(inputs, inside_blocked=None, mission=False)


def _refuses_egress(inputs: SafetyInputs) -> Reason | None:
    if inputs.inside_blocked:
        return None
    sentence = "the robot is in no blocked area or zone: there is nothing to leave"
    return Reason(RefusalCode.NOT_BLOCKED_IN, sentence)


def _egress_end(inputs: SafetyInputs, config: SafetyConfig) -> tuple[str, bool] | None:
    if not inputs.maneuver_remaining <= config.egress_end:
        return None
    still = inputs.inside_blocked
    if still is None:
        return "the robot is out", True
    return f"the way out ends, and the robot is still in {still}", False


def _relevant_to_docking(inputs: SafetyInputs) -> SafetyInputs:
    # The dock itself may press the bumper. What the guardian keeps at rest there shall rest.
    if inputs.docked_for is not None:
        return replace(inputs, mission=False, bumper=False, base_stopped=None, docked_for=None)
    return replace(inputs, mission=False)


def _refuses_docking(inputs: SafetyInputs) -> Reason | None:
    if inputs.docked_for is not None:
        return Reason(ReasonCode.ON_DOCK, "the robot is on its dock")
    return inputs.dock_problem


def _docking_end(inputs: SafetyInputs, config: SafetyConfig) -> tuple[str, bool] | None:
    if inputs.docked_for is None:
        return None if inputs.dock_problem is None else (inputs.dock_problem, False)
    # The contacts may bounce, and the base corrects its place by itself.
    return ("the robot is on its dock", True) if inputs.docked_for >= config.dock_settled else None


def _relevant_to_undocking(inputs: SafetyInputs) -> SafetyInputs:
    # On its dock the guardian lets the base drive straight back only, and holds the wheels between two of its modes.
    on_dock = inputs.docked_for is not None
    return replace(inputs, mission=False, base_stopped=None, docked_for=None, bumper=inputs.bumper and not on_dock)


def _refuses_undocking(inputs: SafetyInputs) -> Reason | None:
    if inputs.docked_for is None:
        return Reason(RefusalCode.NOT_ON_DOCK, "the robot is not on its dock")
    return inputs.blind_behind


def _straight_end(inputs: SafetyInputs, _: SafetyConfig) -> tuple[str, bool] | None:
    return ("it is done", True) if inputs.maneuver_remaining <= 0.0 else None


def _relevant_to_back_off(inputs: SafetyInputs) -> SafetyInputs:
    # A few centimetres under an operator's eyes: place, map and plan don't matter, base and lidar do.
    fault = None if inputs.bumped else inputs.base_fault
    return replace(
        inputs,
        base_fault=fault,
        bumper=False,
        base_stopped=None,
        localization="good",
        inside_blocked=None,
        map_loaded=True,
        map_age=0.0,
        map_gap=0.0,
        mission=False,
    )


def _refuses_back_off(inputs: SafetyInputs) -> Reason | None:
    if not inputs.bumped:
        sentence = "the robot has bumped into nothing: there is nothing to back off from"
        return Reason(RefusalCode.NOT_BUMPED, sentence)
    return inputs.blind_behind


def _relevant_to_looking_around(inputs: SafetyInputs) -> SafetyInputs:
    # A robot that does not know its place knows no zone, and needs no map to turn: base and lidar guard it. But an
    # uncertain pose is good enough to drive by, so that it is good enough for zones and areas, too.
    inside = inputs.inside_blocked if inputs.localization == "weak" else None
    return replace(
        inputs, localization="good", inside_blocked=inside, map_loaded=True, map_age=0.0, map_gap=0.0, mission=False
    )


def _refuses_looking_around(inputs: SafetyInputs) -> Reason | None:
    if inputs.docked_for is not None:
        return Reason(ReasonCode.ON_DOCK, "the robot is on its dock: undock it first")
    if inputs.localization == "good":
        sentence = "the robot knows where it is: there is nothing to find out"
        return Reason(RefusalCode.POSE_KNOWN, sentence)
    return _lies_ahead(inputs)


def _lies_ahead(inputs: SafetyInputs) -> Reason | None:
    """Return the reason of a blocked place on the way of an advance; None without one."""
    if inputs.blocked_ahead is None:
        return None
    return Reason(RefusalCode.BLOCKED_AHEAD, f"{inputs.blocked_ahead} is on the way ahead")


def _looking_around_end(inputs: SafetyInputs, _: SafetyConfig) -> tuple[str, bool] | None:
    if inputs.localization == "good":
        return "the robot knows where it is", True
    if (ahead := _lies_ahead(inputs)) is not None:
        return ahead, False
    if inputs.maneuver_remaining > 0.0:
        return None
    detail = f": {inputs.localization_detail}" if inputs.localization_detail else ""
    return f"it is done, and the pose is {_POSE_WORDS[inputs.localization]}{detail}", True


def _relevant_to_teleop(inputs: SafetyInputs) -> SafetyInputs:
    # Who steers sees the robot, and answers for where it goes: base, lidar and stop field guard it, in any building.
    return replace(
        inputs,
        localization="good",
        inside_blocked=None,
        near_blocked=None,
        map_loaded=True,
        map_age=0.0,
        map_gap=0.0,
        mission=False,
        caution=None,
    )


def _refuses_teleop(inputs: SafetyInputs) -> Reason | None:
    if inputs.docked_for is not None:
        return Reason(ReasonCode.ON_DOCK, "the robot is on its dock: undock it, or pull it off")
    return None


def _teleop_end(inputs: SafetyInputs, _: SafetyConfig) -> tuple[str, bool] | None:
    return None if inputs.hand_over is None else (inputs.hand_over, True)


RULES: Final[Mapping[ManeuverKind, Rules]] = {
    "egress": Rules(
        "EGRESS",
        "the egress",
        "leaving a blocked area on an operator's command",
        _relevant_to_egress,
        _refuses_egress,
        _egress_end,
        lambda c: c.egress_max,
        lambda c: c.speed_egress,
    ),
    "dock": Rules(
        "DOCK",
        "the docking",
        "the base drives into its dock by itself",
        _relevant_to_docking,
        _refuses_docking,
        _docking_end,
        lambda c: c.dock_max,
        lambda _: 0.0,
        needs_enable=True,
        stays_enabled=True,
        if_ended=True,
    ),
    "undock": Rules(
        "DOCK",
        "the undocking",
        "leaving the dock, straight back",
        _relevant_to_undocking,
        _refuses_undocking,
        _straight_end,
        lambda c: c.undock_max,
        lambda c: c.speed_egress,
        stays_enabled=True,
    ),
    "back_off": Rules(
        "EGRESS",
        "the back-off",
        "backing off from what it has bumped into, on an operator's command",
        _relevant_to_back_off,
        _refuses_back_off,
        _straight_end,
        lambda c: c.back_off_max,
        lambda c: c.speed_back_off,
    ),
    "turn": Rules(
        "EGRESS",
        "the turn",
        "turning in place on an operator's command, to find out where it is",
        _relevant_to_looking_around,
        _refuses_looking_around,
        _looking_around_end,
        lambda c: c.turn_max,
        lambda c: c.speed_egress,
    ),
    "advance": Rules(
        "EGRESS",
        "the advance",
        "driving a little ahead on an operator's command, to find out where it is",
        _relevant_to_looking_around,
        _refuses_looking_around,
        _looking_around_end,
        lambda c: c.advance_max,
        lambda c: c.speed_egress,
    ),
    "teleop": Rules(
        "TELEOP",
        "driving by hand",
        "an operator at the robot drives it by hand",
        _relevant_to_teleop,
        _refuses_teleop,
        _teleop_end,
        lambda _: float("inf"),
        lambda c: c.speed_teleop,
    ),
}
"""Every maneuver; the mode EGRESS also stands for the back-off, the turn and the advance, DOCK for both ways."""


class Maneuver(msgspec.Struct, frozen=True):
    """A maneuver that runs: since when (s), the least that was left of it (m, of a turn rad), and since when (s)."""

    since: float
    best: float
    shrank_at: float
    kind: ManeuverKind = "egress"


class End(NamedTuple):
    """Why a maneuver ended, whether it is done, and whether a condition that stops any drive has ended it."""

    reason: str
    done: bool = False
    stopped: bool = False


def begin(kind: ManeuverKind, inputs: SafetyInputs, now: float, config: SafetyConfig) -> Maneuver | Reason:
    """Return a maneuver that begins at `now` (s, monotonic), or why there can't be one."""
    rules = RULES[kind]
    refusal = rules.refusal(inputs)
    if refusal is not None:
        return refusal
    findings = collect_findings(rules.relevant(inputs), config)
    causes = [finding.reason for finding in findings if finding.level >= Level.HOLD and not finding.rest]
    if causes:
        return because(RefusalCode.MUST_NOT_MOVE, "the robot must not move", causes)
    return Maneuver(now, float("inf"), now, kind)


def because(code: RefusalCode, sentence: str, causes: Sequence[Reason]) -> Reason:
    """Return the refusal of a request that `causes` do not allow, with their sentences and identifiers."""
    return Reason(code, f"{sentence}: {'; '.join(causes)}", [cause.code for cause in causes])


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
        return End("; ".join(stops), stopped=True)
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
    if maneuver.kind in {"dock", "teleop"}:
        return maneuver  # the base's own program finds its way, and so does a person
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
