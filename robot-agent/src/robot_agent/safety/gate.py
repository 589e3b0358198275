"""The safety gate: which mode the robot is in and what its wheels may do, decided on the robot alone.

`step` is a pure state machine, called 20 times a second and with each operator's request. Its findings come from the
table in `robot_agent.safety.conditions`; the most restrictive one wins. Escalation is immediate. A level is left only
when no finding has demanded it during the last 2 s. Messages from the fog can only ever add findings, so they can slow
or stop the robot but not speed it up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

import msgspec
from msgspec.structs import replace

from fog_contracts.messages import Mode, Reason, ReasonCode, RefusalCode
from robot_agent.config import SafetyConfig
from robot_agent.safety import maneuver
from robot_agent.safety.conditions import Finding, Level, SafetyInputs, collect_findings
from robot_agent.safety.maneuver import RULES, Maneuver, because

if TYPE_CHECKING:
    from robot_agent.safety.maneuver import ManeuverKind

MODE_OF: Final[dict[Level, Mode]] = {
    Level.NORMAL: "NORMAL",
    Level.DEGRADED: "DEGRADED",
    Level.HOLD: "HOLD",
    Level.PROTECTIVE_STOP: "PROTECTIVE_STOP",
    Level.FAULT: "FAULT",
}
STOPPED_MODES: Final[frozenset[Mode]] = frozenset({"INIT", "HOLD", "PROTECTIVE_STOP", "FAULT"})
"""Modes in which no wheel turns (in HOLD after a ramp). EGRESS, DOCK and TELEOP drive slowly."""
IMMEDIATE_STOP_MODES: Final[frozenset[Mode]] = frozenset({"INIT", "PROTECTIVE_STOP", "FAULT"})
MANEUVERS: Final[frozenset[Mode]] = frozenset({"EGRESS", "DOCK", "TELEOP"})
_NEVER: Final = -math.inf
_PLAN_AWAITED: Final = Reason(ReasonCode.PLAN_AWAITED, "waiting for a plan on the fresh map")
_NOT_ENABLED: Final = Reason(ReasonCode.NOT_ENABLED, "waiting for an operator to enable")


class SafetyState(msgspec.Struct, frozen=True):
    """State that the gate keeps from step to step; the default is that of a robot that was just switched on."""

    mode: Mode = "INIT"
    enabled: bool = False
    last_demanded: tuple[float, ...] = (_NEVER,) * len(Level)
    """Per level, when a finding last demanded at least it."""
    map_held_at: float = _NEVER
    """When the map was last a reason to hold: a path must be newer than that."""
    stopped_since: float = math.inf
    stops: tuple[float, ...] = ()
    """When protective stops began that count towards a fault."""
    answered: str | None = None
    """The base's fault that a reset has answered, until the guardian has carried the reset out."""
    late_stops: int = 0
    """Number of protective stops that a delay of the robot's computer explains: they count towards nothing."""
    excused: bool = False
    """Whether the last protective stop is one of these, so far."""
    latched: tuple[Finding, ...] = ()
    """Findings that stay until an operator acts: faults until a reset, the others until an enable."""
    reasons: tuple[Reason, ...] = (Reason(ReasonCode.JUST_STARTED, "just started"),)
    last_reasons: tuple[str, ...] = ()
    """Reasons of the last escalation, reported during the 2 s before the mode is relaxed."""
    maneuver: Maneuver | None = None
    maneuver_end: str = ""
    """Why the last maneuver ended, until the robot is enabled; empty without one, and after one that was done."""

    @property
    def awaits_operator(self) -> bool:
        """Whether the robot does not drive before an operator enables or resets it."""
        return self.maneuver is None and (self.mode in {"INIT", "FAULT"} or bool(self.latched))


@dataclass(frozen=True, slots=True)
class SafetyOutputs:
    """Mode, its reasons, the cap on speed (m/s), and how a moving robot comes to rest.

    `refusal`: why the operator's request was refused (None when it was accepted, or when there was none).
    """

    mode: Mode
    reasons: tuple[Reason, ...]
    cap: float
    stop: Literal["none", "ramp", "immediate"]
    changed: bool
    refusal: Reason | None

    @property
    def mission_may_drive(self) -> bool:
        """Whether the robot may follow the planner's path: not while it is stopped or on a maneuver."""
        return self.stop == "none" and self.mode not in MANEUVERS


def step(
    state: SafetyState, inputs: SafetyInputs, now: float, config: SafetyConfig | None = None
) -> tuple[SafetyState, SafetyOutputs]:
    """Evaluate the inputs at `now` (s, monotonic, never going back); return the new state and the outputs.

    Modes and their conditions: docs/safety.md, guided by ISO 3691-4 without claiming
    conformity.
    """
    config, before = config or SafetyConfig(), state.mode
    findings = collect_findings(_relevant(state, inputs), config)
    if not findings and _goes_on(state, inputs, now, config):
        # Nearly all steps of a robot that drives: all but the time stays as it is.
        new = replace(state, last_demanded=(now, *state.last_demanded[1:]))
        return new, _outputs(new, before, None, config)
    if state.answered is not None and inputs.base_fault != state.answered:
        state = replace(state, answered=None)
    map_held_at = state.map_held_at
    if any(finding.about_map for finding in findings):
        map_held_at = now
    elif inputs.mission and now - inputs.plan_age <= map_held_at:
        findings.append(Finding(Level.HOLD, _PLAN_AWAITED))

    demanded = max((finding.level for finding in findings), default=Level.NORMAL)
    last_demanded = tuple(
        now if demanded >= level else last for level, last in zip(Level, state.last_demanded, strict=True)
    )
    state = replace(state, last_demanded=last_demanded, map_held_at=map_held_at)
    state, refusal = _apply_request(state, inputs, findings, now, config)

    if state.mode == "FAULT":
        new = state
    elif state.maneuver is not None:
        new = _maneuver(state, state.maneuver, inputs, now, config)
    elif not state.enabled:
        worst = tuple(finding.reason for finding in findings if finding.level == demanded)
        faults = _lasting_faults(state, inputs, findings, config)
        new = replace(
            state,
            mode="FAULT" if faults else "INIT",
            stops=(),
            latched=faults,
            stopped_since=math.inf,
            last_reasons=worst or state.last_reasons,
        )
    elif _may_undock(state, inputs, findings, now, config):
        new = replace(state, mode="DOCK", maneuver=Maneuver(now, math.inf, now, "undock"))
    else:
        new = _advance(state, findings, demanded, now, config)
    new = replace(new, reasons=_reasons(new, findings))
    return new, _outputs(new, before, refusal, config)


def _goes_on(state: SafetyState, inputs: SafetyInputs, now: float, config: SafetyConfig) -> bool:
    """Return whether a step without findings changes nothing: the robot is in NORMAL, and nothing is still to end."""
    if state.mode != "NORMAL" or not state.enabled or state.maneuver is not None or inputs.request is not None:
        return False
    if state.latched or state.stops or state.reasons or state.stopped_since != math.inf:
        return False
    if inputs.docked_for is not None or (inputs.mission and now - inputs.plan_age <= state.map_held_at):
        return False
    return not any(now - last < config.relax_after for last in state.last_demanded[1:])


def _lasting_faults(
    state: SafetyState, inputs: SafetyInputs, findings: list[Finding], config: SafetyConfig
) -> tuple[Finding, ...]:
    """Return the faults that a robot latches while it is not enabled, so that people see them, and what they must do.

    The base's fault does not count that ends by itself, nor one whose reset is on its way to the guardian.
    """
    if inputs.base_fault is not None and (inputs.base_fault_passing or inputs.base_fault == state.answered):
        findings = collect_findings(replace(inputs, base_fault=None), config)
    return tuple(finding for finding in findings if finding.level == Level.FAULT)


def _relevant(state: SafetyState, inputs: SafetyInputs) -> SafetyInputs:
    """Return the inputs that count: all of them, unless a maneuver runs."""
    return inputs if state.maneuver is None else RULES[state.maneuver.kind].relevant(inputs)


def _may_undock(
    state: SafetyState, inputs: SafetyInputs, findings: list[Finding], now: float, config: SafetyConfig
) -> bool:
    """Return whether an enabled robot leaves its dock for its mission: it would drive, were it not on its dock."""
    if inputs.docked_for is None or inputs.resting is not None or not inputs.mission or state.latched:
        return False
    if inputs.docked_for < config.dock_settled:  # a single wrong frame must not make it back away
        return False
    if _is_recent(Level.PROTECTIVE_STOP, state.last_demanded[Level.PROTECTIVE_STOP], now, config):
        return False
    stops = [finding for finding in findings if finding.level >= Level.HOLD and not finding.rest]
    if stops or not inputs.released_remaining > config.released_end:
        return False
    return isinstance(maneuver.begin("undock", inputs, now, config), Maneuver)


def _apply_request(
    state: SafetyState, inputs: SafetyInputs, findings: list[Finding], now: float, config: SafetyConfig
) -> tuple[SafetyState, Reason | None]:
    match inputs.request:
        case None:
            return state, None
        case "disable":
            return _interrupted(replace(state, enabled=False)), None
        case "reset":
            return _reset(state, inputs, config)
        case "egress" | "dock" | "undock" | "back_off" | "turn" | "advance" | "teleop" as kind:
            return _begin(kind, state, inputs, now, config)
    return _enable(state, inputs, findings)


def _reset(state: SafetyState, inputs: SafetyInputs, config: SafetyConfig) -> tuple[SafetyState, Reason | None]:
    if state.mode != "FAULT" and inputs.base_fault is None:
        return state, Reason(RefusalCode.NO_FAULT, f"there is no fault to reset: the mode is {state.mode}")
    # The guardian latches the base's own faults, and checks their causes again when it is reset.
    causes = collect_findings(replace(inputs, base_fault=None), config)
    present = [finding.reason for finding in causes if finding.level == Level.FAULT]
    if present:
        return state, because(RefusalCode.CAUSE_REMAINS, "the cause is still there", present)
    reset = replace(state, mode="INIT", enabled=False, latched=(), stops=(), maneuver=None, answered=inputs.base_fault)
    if state.maneuver is not None:
        name = RULES[state.maneuver.kind].name
        reset = replace(reset, maneuver_end=f"{name} ended: base: {inputs.base_fault}")
    return reset, None


def _begin(
    kind: ManeuverKind, state: SafetyState, inputs: SafetyInputs, now: float, config: SafetyConfig
) -> tuple[SafetyState, Reason | None]:
    rules = RULES[kind]
    if state.mode == "FAULT" and kind != "back_off":
        return state, _latched_fault(state)
    if state.maneuver is not None:
        doing = RULES[state.maneuver.kind].doing
        return state, Reason(RefusalCode.MANEUVER_RUNS, f"the robot makes a maneuver already: {doing}")
    if rules.needs_enable and (not state.enabled or state.latched):
        return state, Reason(ReasonCode.NOT_ENABLED, "the robot must be enabled for that")
    begun = maneuver.begin(kind, inputs, now, config)
    if not isinstance(begun, Maneuver):
        return state, begun
    # The bump stays latched while the robot backs off from it. What else is latched has to be answered by an operator,
    # so that the robot is disabled after any other maneuver.
    latched = state.latched if kind == "back_off" else ()
    enabled = state.enabled and rules.stays_enabled and not state.latched
    return replace(state, mode=rules.mode, enabled=enabled, latched=latched, maneuver=begun), None


def _interrupted(state: SafetyState) -> SafetyState:
    """Return the state without its maneuver: a robot that backed off has its fault still."""
    if state.maneuver is None:
        return state
    faults = tuple(finding for finding in state.latched if finding.level == Level.FAULT)
    return replace(state, mode="FAULT" if faults else "INIT", maneuver=None, latched=faults)


def _latched_fault(state: SafetyState) -> Reason:
    latched = [finding.reason for finding in state.latched]
    return because(RefusalCode.FAULT_LATCHED, "a fault is latched, reset it first", latched)


def _enable(state: SafetyState, inputs: SafetyInputs, findings: list[Finding]) -> tuple[SafetyState, Reason | None]:
    if state.mode == "FAULT":
        return state, _latched_fault(state)
    if state.maneuver is not None:
        doing = RULES[state.maneuver.kind].doing
        return state, Reason(RefusalCode.MANEUVER_RUNS, f"wait, or disable the robot: {doing}")
    limit = min((finding.level for finding in state.latched), default=Level.PROTECTIVE_STOP)
    if not inputs.map_loaded:
        limit = Level.HOLD
    present = [finding.reason for finding in findings if finding.level >= limit]
    if present:
        return state, because(RefusalCode.CAUSE_REMAINS, "the cause is still there", present)
    return replace(state, enabled=True, latched=(), stopped_since=math.inf, maneuver_end=""), None


def _maneuver(
    state: SafetyState, running: Maneuver, inputs: SafetyInputs, now: float, config: SafetyConfig
) -> SafetyState:
    """Go on with a maneuver, which waits until the lidar runs, or end it: in FAULT, INIT, or enabled as before."""
    rules = RULES[running.kind]
    findings = collect_findings(rules.relevant(inputs), config)
    result = maneuver.proceed(running, inputs, findings, now, config)
    if isinstance(result, Maneuver):
        mode: Mode = rules.mode if inputs.resting is None else "INIT"
        return replace(state, mode=mode, stopped_since=math.inf, maneuver=result)
    faults = tuple(finding for finding in findings if finding.level == Level.FAULT)
    if faults:
        state = replace(state, latched=faults, last_reasons=tuple(fault.reason for fault in faults))
    ended = _interrupted(state)
    if result.done and state.enabled:
        return replace(ended, mode="HOLD", last_reasons=(rules.doing,), maneuver_end="")
    # What holds a robot for a second must not leave one with an empty battery in front of its dock, or one with a
    # mission on it: it holds, and what needs an operator on any drive does so from the next step on.
    enabled = state.enabled and (rules.if_ended or (rules.stays_enabled and result.stopped)) and not faults
    sentence = f"{rules.name} ended: {result.reason}"
    if enabled:
        ended = replace(ended, mode="HOLD", last_reasons=(sentence,))
    return replace(ended, enabled=enabled, maneuver_end=sentence)


def _advance(
    state: SafetyState, findings: list[Finding], demanded: Level, now: float, config: SafetyConfig
) -> SafetyState:
    """Move an enabled robot, not in FAULT, to the mode that the findings of the last 2 s demand."""
    latched = state.latched
    known = {finding.reason for finding in latched}
    needing = [Finding(f.level, f.reason, operator=True) for f in findings if f.operator and f.reason not in known]
    if needing and not any(finding.level >= Level.PROTECTIVE_STOP for finding in latched):
        latched = (*latched, *needing)

    state = _count_stop(state, findings, demanded, now, config)
    stops = state.stops
    faults = tuple(finding for finding in findings if finding.level == Level.FAULT)
    if not faults and len(stops) >= config.stops_to_fault:
        causes = "; ".join(finding.reason for finding in findings if finding.level == Level.PROTECTIVE_STOP)
        sentence = f"{len(stops)} protective stops within {config.stops_within:.0f} s, the last because: {causes}"
        faults = (Finding(Level.FAULT, Reason(ReasonCode.STOPS_REPEATED, sentence)),)
    if faults:
        fault_reasons = tuple(finding.reason for finding in faults)
        return replace(
            state, mode="FAULT", latched=faults, stops=stops, stopped_since=math.inf, last_reasons=fault_reasons
        )

    recent = max(
        level for level, last in zip(Level, state.last_demanded, strict=True) if _is_recent(level, last, now, config)
    )
    latch = max((finding.level for finding in latched), default=Level.NORMAL)
    # A fault that was reset a moment ago still counts during 2 s, but only its latch keeps the mode FAULT.
    level = min(max(recent, latch), Level.PROTECTIVE_STOP)
    stopped_since = state.stopped_since
    if level < Level.HOLD or any(finding.rest for finding in findings):
        stopped_since = math.inf
    elif stopped_since == math.inf:
        stopped_since = now
    if level == Level.HOLD and latch < Level.HOLD and now - stopped_since >= config.hold_needs_operator_after:
        causes = "; ".join(state.last_reasons) or "unknown"
        held = (
            f"stopped for more than {config.hold_needs_operator_after:.0f} s, an operator must enable again ({causes})"
        )
        latched = (*latched, Finding(Level.HOLD, Reason(ReasonCode.HELD_TOO_LONG, held), operator=True))
    worst = tuple(finding.reason for finding in findings if finding.level == demanded)
    return replace(
        state,
        mode=MODE_OF[level],
        latched=latched,
        stops=stops,
        stopped_since=stopped_since,
        last_reasons=worst if demanded >= level and worst else state.last_reasons,
    )


def _count_stop(
    state: SafetyState, findings: list[Finding], demanded: Level, now: float, config: SafetyConfig
) -> SafetyState:
    """Count a protective stop when it begins; one that a delay explains, as soon as it outlasts the explanation."""
    stops = tuple(stop for stop in state.stops if now - stop < config.stops_within)
    begins = state.mode not in {"INIT", "PROTECTIVE_STOP", "FAULT"}
    goes_on = state.excused and state.mode == "PROTECTIVE_STOP"
    if demanded < Level.PROTECTIVE_STOP or not (begins or goes_on):
        return replace(state, stops=stops)
    if all(finding.late for finding in findings if finding.level >= Level.PROTECTIVE_STOP):
        return replace(state, stops=stops, late_stops=state.late_stops + begins, excused=True)
    return replace(state, stops=(*stops, now), excused=False)


def _is_recent(level: Level, last_demanded: float, now: float, config: SafetyConfig) -> bool:
    return level == Level.NORMAL or now - last_demanded < config.relax_after


def _reasons(state: SafetyState, findings: list[Finding]) -> tuple[Reason, ...]:
    """Return why the mode is what it is, the most restrictive reason first."""
    current = [finding.reason for finding in sorted(findings, key=lambda f: f.level, reverse=True)]
    if state.mode == "FAULT":
        latched = [finding.reason for finding in state.latched]
        return (*latched, *(reason for reason in current if reason not in latched))
    if state.maneuver is not None:
        waits = "as soon as its lidar runs: " if state.mode == "INIT" else ""
        return (*current, Reason(ReasonCode.MANEUVER, waits + RULES[state.maneuver.kind].doing))
    ended = (Reason(ReasonCode.MANEUVER_ENDED, state.maneuver_end),) if state.maneuver_end else ()
    if state.mode == "INIT":
        return (*current, *ended, _NOT_ENABLED)
    latched = [
        Reason(f.reason.code, f"{f.reason} (an operator must enable again)")
        for f in state.latched
        if f.reason not in current
    ]
    # One that is on its dock still tells why; why a docking ended, the wish for the dock tells.
    reasons = (*current, *latched, *(ended if any(finding.rest for finding in findings) else ()))
    if not reasons and state.mode != "NORMAL":
        over = "over, waiting until healthy for 2 s"
        return tuple(Reason(ReasonCode.RECOVERING, f"{over}: {reason}") for reason in state.last_reasons)
    return reasons


def _outputs(state: SafetyState, before: Mode, refusal: Reason | None, config: SafetyConfig) -> SafetyOutputs:
    caps: dict[Mode, float] = {"NORMAL": config.speed_normal, "DEGRADED": config.speed_degraded}
    if state.maneuver is not None and state.mode in MANEUVERS:
        caps[state.mode] = RULES[state.maneuver.kind].cap(config)
    stop: Literal["none", "ramp", "immediate"] = "none"
    if state.mode in STOPPED_MODES:
        stop = "immediate" if state.mode in IMMEDIATE_STOP_MODES else "ramp"
    return SafetyOutputs(
        mode=state.mode,
        reasons=state.reasons,
        cap=caps.get(state.mode, 0.0),
        stop=stop,
        changed=state.mode != before,
        refusal=refusal,
    )


def limit_wheels(  # noqa: PLR0913  # the gate knows nothing of the motion's settings
    requested: tuple[float, float],
    last: tuple[float, float],
    outputs: SafetyOutputs,
    dt: float,
    *,
    acceleration: float,
    wheel_speed: float,
    config: SafetyConfig | None = None,
) -> tuple[float, float]:
    """Return the wheel speeds (left, right; m/s) that may be streamed now, `dt` s after `last` was.

    Stopped modes bring the wheels to rest, at once or along a straight ramp that ends within `config.ramp` s whatever
    the speed; the ratio of the wheels is kept, so the robot brakes along its arc. Driving modes cap the robot's speed,
    then each wheel's speed and rate of change; never does a wheel speed up while the other limits apply.
    """
    config = config or SafetyConfig()
    if outputs.stop == "immediate":
        return 0.0, 0.0
    if outputs.stop == "ramp":
        return ramp_down(last, dt, wheel_speed / config.ramp)
    left, right = requested
    if not (math.isfinite(left) and math.isfinite(right)):
        return ramp_down(last, dt, wheel_speed / config.ramp)
    target = capped(requested, outputs.cap, wheel_speed)
    change = acceleration * max(dt, 0.0)
    largest = max(abs(target[0] - last[0]), abs(target[1] - last[1]))
    if largest <= change:
        return target
    share = change / largest
    return last[0] + (target[0] - last[0]) * share, last[1] + (target[1] - last[1]) * share


def capped(requested: tuple[float, float], cap: float, wheel_speed: float) -> tuple[float, float]:
    """Return wheel speeds (m/s) of the same arc whose mean is at most `cap`, and none faster than `wheel_speed`."""
    left, right = requested
    scale = 1.0
    centre = 0.5 * abs(left + right)
    if centre > cap:
        scale = cap / centre
    fastest = max(abs(left), abs(right)) * scale
    if fastest > wheel_speed:
        scale *= wheel_speed / fastest
    return left * scale, right * scale


def ramp_down(last: tuple[float, float], dt: float, deceleration: float) -> tuple[float, float]:
    """Return wheel speeds (m/s) on the way from `last` to rest, the faster wheel slowing by `deceleration` (m/s2)."""
    fastest = max(abs(last[0]), abs(last[1]))
    slowed = fastest - deceleration * max(dt, 0.0)
    if slowed <= 1e-9:
        return 0.0, 0.0
    return last[0] * slowed / fastest, last[1] * slowed / fastest
