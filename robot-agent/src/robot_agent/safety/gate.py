"""The safety gate: which mode the robot is in and what its wheels may do, decided on the robot alone.

`step` is a pure state machine, called 20 times a second and with each operator's request. Every input is a source's
age, value or complaint; the most restrictive finding wins. Escalation is immediate. A level is left only when nothing
has asked for it during the last 2 s. What the fog says can only ever add findings, so it can slow or stop the robot
but not speed it up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from robot_agent.config import SafetyConfig

if TYPE_CHECKING:
    from fog_contracts.messages import Mode

Localization = Literal["good", "weak", "lost", "none"]
Request = Literal["enable", "disable", "reset"]


class Level(IntEnum):
    """How restrictive a finding is."""

    NORMAL = 0
    DEGRADED = 1
    HOLD = 2
    PROTECTIVE_STOP = 3
    FAULT = 4


MODE_OF: Final[dict[Level, Mode]] = {
    Level.NORMAL: "NORMAL",
    Level.DEGRADED: "DEGRADED",
    Level.HOLD: "HOLD",
    Level.PROTECTIVE_STOP: "PROTECTIVE_STOP",
    Level.FAULT: "FAULT",
}
STANDING: Final[frozenset[Mode]] = frozenset({"INIT", "HOLD", "PROTECTIVE_STOP", "FAULT"})
"""Modes that let no wheel turn (HOLD after its ramp). EGRESS and DOCK drive slowly; nothing enters them yet."""
STOP_AT_ONCE: Final[frozenset[Mode]] = frozenset({"INIT", "PROTECTIVE_STOP", "FAULT"})
_NEVER: Final = -math.inf


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetyInputs:
    """What the gate judges; ages in s by the robot's own monotonic clock, infinite for what never came.

    map_age: since the map copy was last confirmed to be the newest version. map_gap: for how long deltas have been
    missing, 0 when none are. plan_age: since the planner last spoke of the goal. released_left: m of released path
    ahead. path_problem: why the path must not be driven. inside_blocked: the blocked zone that the robot stands in.
    caution: a reason to be slow here. base_silent: the link to the guardian broke, in words.
    """

    map_loaded: bool = False
    map_age: float = math.inf
    map_gap: float = 0.0
    localization: Localization = "none"
    localization_detail: str = ""
    lidar_node_age: float = math.inf
    turn_age: float = math.inf
    identical_turns: int = 1
    base_age: float = math.inf
    base_silent: str | None = None
    base_fault: str | None = None
    base_stopped: str | None = None
    bumper: bool = False
    cliff: bool = False
    wheel_drop: bool = False
    mission: bool = False
    plan_age: float = 0.0
    released_left: float = 0.0
    path_problem: str | None = None
    inside_blocked: str | None = None
    caution: str | None = None
    request: Request | None = None


class Finding(NamedTuple):
    """One reason to be careful: how much, in words, and whether a person must look before it is over."""

    level: Level
    reason: str
    operator: bool = False


@dataclass(frozen=True, slots=True)
class SafetyState:
    """Everything that the gate remembers; a new one is a robot that was just switched on."""

    mode: Mode = "INIT"
    enabled: bool = False
    asked: tuple[float, ...] = (_NEVER,) * len(Level)
    """Per level, when a finding last asked for at least it."""
    map_held: float = _NEVER
    """When the map last was a reason to hold: a path must be newer than that."""
    standing_since: float = math.inf
    stops: tuple[float, ...] = ()
    latched: tuple[Finding, ...] = ()
    """What stays until an operator acts: faults until reset, the others until enable."""
    reasons: tuple[str, ...] = field(default=("just started",))
    last_words: tuple[str, ...] = ()
    """Reasons of the last escalation, told while the robot waits out its 2 s."""


@dataclass(frozen=True, slots=True)
class SafetyOutputs:
    """The verdict: mode, why, the cap on speed (m/s), and how a moving robot comes to rest.

    `refusal`: why the request was not followed (None when it was, or when there was none).
    """

    mode: Mode
    reasons: tuple[str, ...]
    cap: float
    stop: Literal["none", "ramp", "now"]
    changed: bool
    refusal: str | None


def judge(inputs: SafetyInputs, config: SafetyConfig) -> list[Finding]:
    """Return every reason to be careful, in no particular order."""
    found: list[Finding] = []
    found.extend(_judge_base(inputs, config))
    found.extend(_judge_lidar(inputs, config))
    found.extend(_judge_pose(inputs))
    found.extend(_judge_map(inputs, config))
    found.extend(_judge_plan(inputs, config))
    return found


def _judge_base(inputs: SafetyInputs, config: SafetyConfig) -> list[Finding]:
    found: list[Finding] = []
    if inputs.base_fault is not None:
        found.append(Finding(Level.FAULT, f"base: {inputs.base_fault}"))
    if inputs.bumper:
        found.append(Finding(Level.FAULT, "the bumper is pressed"))
    if inputs.cliff:
        found.append(Finding(Level.FAULT, "a cliff sensor sees no floor"))
    if inputs.wheel_drop:
        found.append(Finding(Level.FAULT, "a wheel has dropped"))
    if inputs.base_silent is not None:
        found.append(Finding(Level.PROTECTIVE_STOP, f"the guardian is not there: {inputs.base_silent}"))
    elif not inputs.base_age <= config.base_lost:
        found.append(Finding(Level.PROTECTIVE_STOP, f"no word from the guardian for {_seconds(inputs.base_age)}"))
    elif inputs.base_stopped is not None:
        found.append(Finding(Level.PROTECTIVE_STOP, f"the guardian holds the wheels: {inputs.base_stopped}"))
    return found


def _judge_lidar(inputs: SafetyInputs, config: SafetyConfig) -> list[Finding]:
    found: list[Finding] = []
    if not inputs.lidar_node_age <= config.lidar_node_lost:
        found.append(Finding(Level.PROTECTIVE_STOP, f"the lidar has been silent for {_seconds(inputs.lidar_node_age)}"))
    if not inputs.turn_age <= config.turn_lost:
        found.append(Finding(Level.PROTECTIVE_STOP, f"no complete turn of the lidar for {_seconds(inputs.turn_age)}"))
    if inputs.identical_turns >= config.identical_turns:
        found.append(
            Finding(Level.PROTECTIVE_STOP, f"the lidar repeats itself: {inputs.identical_turns} identical turns")
        )
    return found


def _judge_pose(inputs: SafetyInputs) -> list[Finding]:
    detail = f": {inputs.localization_detail}" if inputs.localization_detail else ""
    found: list[Finding] = []
    if inputs.localization == "none":
        found.append(Finding(Level.PROTECTIVE_STOP, f"the pose is not known yet{detail}", operator=True))
    elif inputs.localization == "lost":
        found.append(Finding(Level.PROTECTIVE_STOP, f"the pose is lost{detail}", operator=True))
    elif inputs.localization == "weak":
        found.append(Finding(Level.DEGRADED, f"the pose is uncertain{detail}"))
    if inputs.inside_blocked is not None:
        found.append(Finding(Level.PROTECTIVE_STOP, f"the robot stands in {inputs.inside_blocked}", operator=True))
    return found


def _judge_map(inputs: SafetyInputs, config: SafetyConfig) -> list[Finding]:
    found: list[Finding] = []
    if not inputs.map_loaded:
        found.append(Finding(Level.HOLD, "no map was received yet"))
    elif not inputs.map_age <= config.map_lost:
        found.append(Finding(Level.HOLD, f"the map is {_seconds(inputs.map_age)} old"))
    elif not inputs.map_age <= config.map_late:
        found.append(Finding(Level.DEGRADED, f"the map is {_seconds(inputs.map_age)} old"))
    if not inputs.map_gap <= config.gap_lost:
        found.append(Finding(Level.HOLD, f"changes of the map have been missing for {_seconds(inputs.map_gap)}"))
    return found


def _judge_plan(inputs: SafetyInputs, config: SafetyConfig) -> list[Finding]:
    found: list[Finding] = []
    if inputs.caution is not None:
        found.append(Finding(Level.DEGRADED, inputs.caution))
    if not inputs.mission:
        return found
    if inputs.path_problem is not None:
        found.append(Finding(Level.HOLD, inputs.path_problem))
    if not inputs.plan_age <= config.plan_late:
        silent = f"the planner has been silent for {_seconds(inputs.plan_age)}"
        if inputs.released_left > config.released_end:
            found.append(Finding(Level.DEGRADED, silent))
        else:
            found.append(Finding(Level.HOLD, f"{silent} and no released path is left"))
    return found


def step(
    state: SafetyState, inputs: SafetyInputs, now: float, config: SafetyConfig | None = None
) -> tuple[SafetyState, SafetyOutputs]:
    """Judge the inputs at `now` (s, monotonic, never going back); return the new state and the verdict.

    Modes and their conditions: the table of modes in docs/architecture.md, guided by ISO 3691-4 without claiming
    conformity.
    """
    config = config or SafetyConfig()
    findings = judge(inputs, config)
    map_held = state.map_held
    if any(finding.level == Level.HOLD for finding in _judge_map(inputs, config)):
        map_held = now
    elif inputs.mission and now - inputs.plan_age <= map_held:
        findings.append(Finding(Level.HOLD, "waiting for a plan on the fresh map"))

    demanded = max((finding.level for finding in findings), default=Level.NORMAL)
    asked = tuple(now if demanded >= level else last for level, last in zip(Level, state.asked, strict=True))
    state = replace(state, asked=asked, map_held=map_held)
    state, refusal = _follow_request(state, inputs, findings, config)

    mode = state.mode
    if mode == "FAULT":
        new = state
    elif not state.enabled:
        worst = tuple(finding.reason for finding in findings if finding.level == demanded)
        new = replace(
            state,
            mode="INIT",
            stops=(),
            latched=(),
            standing_since=math.inf,
            last_words=worst or state.last_words,
        )
    else:
        new = _advance(state, findings, demanded, now, config)
    new = replace(new, reasons=_reasons(new, findings))
    return new, _verdict(new, mode, refusal, config)


def _follow_request(
    state: SafetyState, inputs: SafetyInputs, findings: list[Finding], config: SafetyConfig
) -> tuple[SafetyState, str | None]:
    if inputs.request is None:
        return state, None
    if inputs.request == "disable":
        return replace(state, enabled=False), None
    if inputs.request == "reset":
        if state.mode != "FAULT" and inputs.base_fault is None:
            return state, f"there is no fault to reset: the mode is {state.mode}"
        # The base's own fault is latched by the guardian, which judges its cause again when it is told to reset.
        causes = judge(replace(inputs, base_fault=None), config)
        present = [finding.reason for finding in causes if finding.level == Level.FAULT]
        if present:
            return state, f"the cause is still there: {'; '.join(present)}"
        return replace(state, mode="INIT", enabled=False, latched=(), stops=()), None
    return _enable(state, inputs, findings)


def _enable(state: SafetyState, inputs: SafetyInputs, findings: list[Finding]) -> tuple[SafetyState, str | None]:
    if state.mode == "FAULT":
        return state, f"a fault is latched, reset it first: {'; '.join(f.reason for f in state.latched)}"
    bar = min((finding.level for finding in state.latched), default=Level.PROTECTIVE_STOP)
    if not inputs.map_loaded:
        bar = Level.HOLD
    present = [finding.reason for finding in findings if finding.level >= bar]
    if present:
        return state, f"the cause is still there: {'; '.join(present)}"
    return replace(state, enabled=True, latched=()), None


def _advance(
    state: SafetyState, findings: list[Finding], demanded: Level, now: float, config: SafetyConfig
) -> SafetyState:
    """Move an enabled robot, not in FAULT, to the mode that the last 2 s ask for."""
    latched = state.latched
    known = {finding.reason for finding in latched}
    needing = [Finding(f.level, f.reason, operator=True) for f in findings if f.operator and f.reason not in known]
    if needing and not any(finding.level >= Level.PROTECTIVE_STOP for finding in latched):
        latched = (*latched, *needing)

    stops = tuple(at for at in state.stops if now - at < config.stops_within)
    if demanded >= Level.PROTECTIVE_STOP and state.mode not in {"INIT", "PROTECTIVE_STOP", "FAULT"}:
        stops = (*stops, now)
    faults = tuple(finding for finding in findings if finding.level == Level.FAULT)
    if not faults and len(stops) >= config.stops_to_fault:
        causes = "; ".join(finding.reason for finding in findings if finding.level == Level.PROTECTIVE_STOP)
        faults = (
            Finding(
                Level.FAULT,
                f"{len(stops)} protective stops within {config.stops_within:.0f} s, the last because: {causes}",
            ),
        )
    if faults:
        words = tuple(finding.reason for finding in faults)
        return replace(state, mode="FAULT", latched=faults, stops=stops, standing_since=math.inf, last_words=words)

    recent = max(level for level, at in zip(Level, state.asked, strict=True) if _is_recent(level, at, now, config))
    latch = max((finding.level for finding in latched), default=Level.NORMAL)
    # A fault that was reset a moment ago still echoes in the last 2 s; the latch is what keeps FAULT, not the echo.
    level = min(max(recent, latch), Level.PROTECTIVE_STOP)
    standing_since = state.standing_since
    if level < Level.HOLD:
        standing_since = math.inf
    elif standing_since == math.inf:
        standing_since = now
    if level == Level.HOLD and latch < Level.HOLD and now - standing_since >= config.hold_operator_after:
        why = "; ".join(state.last_words) or "unknown"
        held = f"standing for more than {config.hold_operator_after:.0f} s, an operator must enable again ({why})"
        latched = (*latched, Finding(Level.HOLD, held, operator=True))
    worst = tuple(finding.reason for finding in findings if finding.level == demanded)
    return replace(
        state,
        mode=MODE_OF[level],
        latched=latched,
        stops=stops,
        standing_since=standing_since,
        last_words=worst if demanded >= level and worst else state.last_words,
    )


def _is_recent(level: Level, at: float, now: float, config: SafetyConfig) -> bool:
    return level == Level.NORMAL or now - at < config.relax_after


def _reasons(state: SafetyState, findings: list[Finding]) -> tuple[str, ...]:
    """Say in words why the mode is what it is, the worst first."""
    now_true = [finding.reason for finding in sorted(findings, key=lambda f: f.level, reverse=True)]
    if state.mode == "FAULT":
        latched = [finding.reason for finding in state.latched]
        return (*latched, *(reason for reason in now_true if reason not in latched))
    if state.mode == "INIT":
        return (*now_true, "waiting for an operator to enable")
    latched = [f"{f.reason} (an operator must enable again)" for f in state.latched if f.reason not in now_true]
    said = (*now_true, *latched)
    if not said and state.mode != "NORMAL":
        return tuple(f"over, waiting until healthy for 2 s: {reason}" for reason in state.last_words)
    return said


def _verdict(state: SafetyState, before: Mode, refusal: str | None, config: SafetyConfig) -> SafetyOutputs:
    caps: dict[Mode, float] = {
        "NORMAL": config.speed_normal,
        "DEGRADED": config.speed_degraded,
        "EGRESS": config.speed_egress,
        "DOCK": config.speed_egress,
    }
    stop: Literal["none", "ramp", "now"] = "none"
    if state.mode in STANDING:
        stop = "now" if state.mode in STOP_AT_ONCE else "ramp"
    return SafetyOutputs(
        mode=state.mode,
        reasons=state.reasons,
        cap=caps.get(state.mode, 0.0),
        stop=stop,
        changed=state.mode != before,
        refusal=refusal,
    )


def limit_wheels(
    wanted: tuple[float, float],
    last: tuple[float, float],
    verdict: SafetyOutputs,
    dt: float,
    *,
    acceleration: float,
    wheel_speed: float,
    config: SafetyConfig | None = None,
) -> tuple[float, float]:
    """Return the wheel speeds (left, right; m/s) that may be streamed now, `dt` s after `last` was.

    Standing modes bring the wheels to rest, at once or along a straight ramp that ends within `config.ramp` s whatever
    the speed; the ratio of the wheels is kept, so the robot brakes along its arc. Driving modes cap the robot's speed,
    then each wheel's speed and rate of change; never does a wheel speed up while the other limits apply.
    """
    config = config or SafetyConfig()
    if verdict.stop == "now":
        return 0.0, 0.0
    if verdict.stop == "ramp":
        return ramp_down(last, dt, wheel_speed / config.ramp)
    left, right = wanted
    if not (math.isfinite(left) and math.isfinite(right)):
        return ramp_down(last, dt, wheel_speed / config.ramp)
    scale = 1.0
    centre = 0.5 * abs(left + right)
    if centre > verdict.cap:
        scale = verdict.cap / centre
    fastest = max(abs(left), abs(right)) * scale
    if fastest > wheel_speed:
        scale *= wheel_speed / fastest
    target = left * scale, right * scale
    change = acceleration * max(dt, 0.0)
    biggest = max(abs(target[0] - last[0]), abs(target[1] - last[1]))
    if biggest <= change:
        return target
    share = change / biggest
    return last[0] + (target[0] - last[0]) * share, last[1] + (target[1] - last[1]) * share


def ramp_down(last: tuple[float, float], dt: float, deceleration: float) -> tuple[float, float]:
    """Return wheel speeds (m/s) on the way from `last` to rest, the faster wheel slowing by `deceleration` (m/s2)."""
    fastest = max(abs(last[0]), abs(last[1]))
    left_over = fastest - deceleration * max(dt, 0.0)
    if left_over <= 1e-9:
        return 0.0, 0.0
    return last[0] * left_over / fastest, last[1] * left_over / fastest


def _seconds(age: float) -> str:
    return "as long as it runs" if math.isinf(age) else f"{age:.1f} s"
