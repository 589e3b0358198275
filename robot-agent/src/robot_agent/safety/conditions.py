"""The conditions that restrict the robot, in one table: when each holds, its level, and what it tells people.

Pure: values in, values out. The gate (`robot_agent.safety.gate`) turns the findings of one step into a mode.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import msgspec

from fog_contracts.messages import Reason, ReasonCode
from robot_agent.hardware import NO_FRESH_COMMAND, ON_CHARGER

if TYPE_CHECKING:
    from collections.abc import Callable

    from robot_agent.config import SafetyConfig

Localization = Literal["good", "weak", "lost", "none"]
Request = Literal["enable", "disable", "reset", "egress", "dock", "undock", "back_off", "turn", "advance", "teleop"]


class Level(IntEnum):
    """How restrictive a finding is."""

    NORMAL = 0
    DEGRADED = 1
    HOLD = 2
    PROTECTIVE_STOP = 3
    FAULT = 4


class SafetyInputs(msgspec.Struct, frozen=True, kw_only=True):
    """Inputs of one step; ages in s by the robot's own monotonic clock, infinite for what was never received.

    map_age: since the map copy was last confirmed to be the newest version. map_gap: for how long deltas have been
    missing, 0 when none are. plan_age: since the planner's last message about the goal. released_remaining: m of
    released path ahead. path_problem: why the path must not be driven. inside_blocked: the blocked area or zone that
    the robot is in, `inside_watched` if sensors alone block it; blocked_ahead: the one on the way of an advance that
    runs or is asked for, both by a pose that is good or weak; near_blocked: the one that it may be in, ahead, by how
    uncertain the pose is. position_sigma: standard deviation (m) of the position in its least certain direction.
    maneuver_remaining: m to the end of the maneuver that runs, rad of a turn, infinite while not known.
    maneuver_problem: what keeps the robot from getting there. dock_problem: why the base must not drive into its dock
    by itself. caution: a reason to drive slowly here.
    guardian_lost: why there is no link to the guardian.
    base_fault: the guardian's fault, latched there unless it is `base_fault_passing`, which ends with its cause.
    base_stopped: why the guardian keeps the wheels at zero. wheels_differ: it counts by other ones than the agent.
    bumped: the fault that it has latched is a bump.
    docked_for: s for which the robot has been on its dock, None off it. late_age: since this computer last ran the
    agent too late, by `late_by`. resting: why the lidar stands still on purpose, or is being started. blind_behind: why
    a robot that shall drive back would not move. hand_over: why nobody drives it by hand any more, None while somebody
    does.
    """

    map_loaded: bool = False
    map_age: float = math.inf
    map_gap: float = 0.0
    localization: Localization = "none"
    localization_detail: str = ""
    lidar_age: float = math.inf
    scan_age: float = math.inf
    identical_scans: int = 1
    empty_scans: int = 0
    base_age: float = math.inf
    guardian_lost: str | None = None
    base_fault: str | None = None
    base_fault_passing: bool = False
    base_stopped: str | None = None
    wheels_differ: bool = False
    bumped: bool = False
    docked_for: float | None = None
    bumper: bool = False
    cliff: bool = False
    wheel_drop: bool = False
    mission: bool = False
    plan_age: float = 0.0
    released_remaining: float = 0.0
    path_problem: Reason | None = None
    inside_blocked: str | None = None
    inside_watched: bool = False
    blocked_ahead: str | None = None
    near_blocked: str | None = None
    position_sigma: float = 0.0
    maneuver_remaining: float = math.inf
    maneuver_problem: str | None = None
    dock_problem: Reason | None = None
    blind_behind: Reason | None = None
    caution: Reason | None = None
    resting: str | None = None
    hand_over: str | None = None
    late_age: float = math.inf
    late_by: float = 0.0
    request: Request | None = None


class Finding(NamedTuple):
    """One reason to restrict the robot: the level, the reason, and whether an operator must enable it again.

    `about_map`: the plan that the robot has may rest on another map, and must be followed by a newer one. `late`: the
    delay of this computer explains it, so that it says nothing about the robot's devices. `rest`: the robot rests on
    purpose, for as long as it likes.
    """

    level: Level
    reason: Reason
    operator: bool = False
    about_map: bool = False
    late: bool = False
    rest: bool = False


def _never(_: SafetyInputs) -> bool:
    return False


def _always(_: SafetyInputs) -> bool:
    return True


class Condition(NamedTuple):
    """One row of the table; `holds` gets inputs and limits, `sentence` gets the inputs. The rest as in `Finding`.

    `code`: unless the sentence brings its own. `by_delay`: whether a computer that ran late explains it. `passes`:
    whether it needs no operator, because what it rests on ends by itself.

    An age that is no number fails every comparison with its limit, so it counts as too old.
    """

    code: ReasonCode
    level: Level
    holds: Callable[[SafetyInputs, SafetyConfig], bool]
    sentence: Callable[[SafetyInputs], str]
    operator: bool = False
    about_map: bool = False
    by_delay: Callable[[SafetyInputs], bool] = _never
    passes: Callable[[SafetyInputs], bool] = _never
    rest: bool = False


def _seconds(age: float) -> str:
    return "as long as the agent runs" if math.isinf(age) else f"{age:.1f} s"


def _detail(inputs: SafetyInputs) -> str:
    return f": {inputs.localization_detail}" if inputs.localization_detail else ""


def _planner_silent(inputs: SafetyInputs, config: SafetyConfig) -> bool:
    return inputs.mission and not inputs.plan_age <= config.plan_late


def _guardian_heard(inputs: SafetyInputs, config: SafetyConfig) -> bool:
    return inputs.guardian_lost is None and inputs.base_age <= config.base_lost


def _held(inputs: SafetyInputs) -> bool:
    # A resting robot holds anyhow, and its base may sleep; on its dock it rests, too.
    return inputs.base_stopped is not None and inputs.resting is None and not _rests_on_dock(inputs)


def _rests_on_dock(inputs: SafetyInputs) -> bool:
    return inputs.docked_for is not None and inputs.base_stopped in {None, ON_CHARGER}


CONDITIONS: Final[tuple[Condition, ...]] = (
    # --- base and guardian ---
    Condition(
        ReasonCode.BASE_FAULT, Level.FAULT, lambda i, _: i.base_fault is not None, lambda i: f"base: {i.base_fault}"
    ),
    # The dock itself may press it (ADR 35), and no word but "undock" moves the robot there.
    Condition(
        ReasonCode.BUMPER,
        Level.FAULT,
        lambda i, _: i.bumper and i.docked_for is None,
        lambda _: "the bumper is pressed",
    ),
    Condition(ReasonCode.CLIFF, Level.FAULT, lambda i, _: i.cliff, lambda _: "a cliff sensor sees no floor"),
    Condition(ReasonCode.WHEEL_DROP, Level.FAULT, lambda i, _: i.wheel_drop, lambda _: "a wheel has dropped"),
    Condition(
        ReasonCode.GUARDIAN_LOST,
        Level.PROTECTIVE_STOP,
        lambda i, _: i.guardian_lost is not None,
        lambda i: f"the guardian is not connected: {i.guardian_lost}",
    ),
    Condition(
        ReasonCode.GUARDIAN_SILENT,
        Level.PROTECTIVE_STOP,
        lambda i, c: i.guardian_lost is None and not _guardian_heard(i, c),
        lambda i: f"no message from the guardian for {_seconds(i.base_age)}",
        by_delay=_always,
    ),
    Condition(
        ReasonCode.WHEELS_HELD,
        Level.PROTECTIVE_STOP,
        lambda i, c: _guardian_heard(i, c) and _held(i),
        lambda i: f"the guardian holds the wheels: {i.base_stopped}",
        by_delay=lambda i: i.base_stopped == NO_FRESH_COMMAND,
    ),
    Condition(
        ReasonCode.WHEELS_DIFFER,
        Level.PROTECTIVE_STOP,
        lambda i, _: i.wheels_differ,
        lambda _: (
            "the guardian counts with other wheels than the agent: restart both "
            "(systemctl restart fognav-watchdog fognav-agent)"
        ),
    ),
    Condition(
        ReasonCode.ON_DOCK,
        Level.HOLD,
        lambda i, _: _rests_on_dock(i),
        lambda i: (
            "the robot is on its dock: a goal or `fognav robot undock` takes it off"
            if i.blind_behind is None
            else f"the robot can't leave its dock: {i.blind_behind}"
        ),
        rest=True,
    ),
    # --- lidar ---
    Condition(
        ReasonCode.LIDAR_SILENT,
        Level.PROTECTIVE_STOP,
        lambda i, c: i.resting is None and not i.lidar_age <= c.lidar_lost,
        lambda i: f"the lidar has been silent for {_seconds(i.lidar_age)}",
        by_delay=_always,
    ),
    Condition(
        ReasonCode.SCAN_MISSING,
        Level.PROTECTIVE_STOP,
        lambda i, c: i.resting is None and not i.scan_age <= c.scan_lost,
        lambda i: f"no complete scan of the lidar for {_seconds(i.scan_age)}",
        by_delay=_always,
    ),
    Condition(
        ReasonCode.LIDAR_REPEATS,
        Level.PROTECTIVE_STOP,
        lambda i, c: i.resting is None and i.identical_scans >= c.identical_scans,
        lambda i: f"the lidar repeats itself: {i.identical_scans - 1} scans in a row equal earlier ones",
    ),
    # Without a map nothing tells a covered lidar from open space: the stop field would find nothing in the way.
    Condition(
        ReasonCode.LIDAR_EMPTY,
        Level.PROTECTIVE_STOP,
        lambda i, c: i.resting is None and i.empty_scans >= c.empty_scans,
        lambda i: f"the lidar turns and sees nothing: {i.empty_scans} scans in a row have hardly a return",
    ),
    Condition(ReasonCode.AT_REST, Level.HOLD, lambda i, _: i.resting is not None, lambda i: str(i.resting), rest=True),
    # --- pose ---
    Condition(
        ReasonCode.POSE_UNKNOWN,
        Level.PROTECTIVE_STOP,
        lambda i, _: i.localization == "none",
        lambda i: f"the pose is not known yet{_detail(i)}",
        operator=True,
    ),
    Condition(
        ReasonCode.POSE_LOST,
        Level.PROTECTIVE_STOP,
        lambda i, _: i.localization == "lost",
        lambda i: f"the pose is lost{_detail(i)}",
        operator=True,
    ),
    Condition(
        ReasonCode.POSE_UNCERTAIN,
        Level.DEGRADED,
        lambda i, _: i.localization == "weak",
        lambda i: f"the pose is uncertain{_detail(i)}",
    ),
    Condition(
        ReasonCode.POSITION_WIDE,
        Level.HOLD,
        lambda i, c: i.localization == "weak" and i.position_sigma > c.position_sigma_max,
        lambda i: (
            f"the robot may be {2.0 * i.position_sigma:.1f} m from where it believes to be: "
            "give it its pose, or let it turn where it sees more"
        ),
    ),
    Condition(
        ReasonCode.MAY_BE_BLOCKED,
        Level.HOLD,
        lambda i, _: i.mission and i.near_blocked is not None,
        lambda i: (
            f"the robot may already be in {i.near_blocked}: "
            f"it may be {2.0 * i.position_sigma:.1f} m farther than it believes"
        ),
    ),
    Condition(
        ReasonCode.IN_BLOCKED,
        Level.PROTECTIVE_STOP,
        lambda i, _: i.inside_blocked is not None,
        lambda i: f"the robot is in {i.inside_blocked}",
        operator=True,
        passes=lambda i: i.inside_watched,
    ),
    # --- map ---
    Condition(
        ReasonCode.MAP_MISSING,
        Level.HOLD,
        lambda i, _: not i.map_loaded,
        lambda _: "no map was received yet",
        about_map=True,
    ),
    Condition(
        ReasonCode.MAP_OLD,
        Level.HOLD,
        lambda i, c: i.map_loaded and not i.map_age <= c.map_lost,
        lambda i: f"the map is {_seconds(i.map_age)} old",
        about_map=True,
    ),
    Condition(
        ReasonCode.MAP_LATE,
        Level.DEGRADED,
        lambda i, c: i.map_loaded and c.map_late < i.map_age <= c.map_lost,
        lambda i: f"the map is {_seconds(i.map_age)} old",
    ),
    Condition(
        ReasonCode.MAP_GAP,
        Level.HOLD,
        lambda i, c: not i.map_gap <= c.gap_lost,
        lambda i: f"changes of the map have been missing for {_seconds(i.map_gap)}",
        about_map=True,
    ),
    # --- plan ---
    Condition(
        ReasonCode.AREA_UNKNOWN,
        Level.DEGRADED,
        lambda i, _: i.caution is not None,
        lambda i: i.caution or "",
    ),
    Condition(
        ReasonCode.PATH_BLOCKED,
        Level.HOLD,
        lambda i, _: i.mission and i.path_problem is not None,
        lambda i: i.path_problem or "",
    ),
    Condition(
        ReasonCode.PLANNER_LATE,
        Level.DEGRADED,
        lambda i, c: _planner_silent(i, c) and i.released_remaining > c.released_end,
        lambda i: f"the planner has been silent for {_seconds(i.plan_age)}",
    ),
    Condition(
        ReasonCode.PLANNER_LOST,
        Level.HOLD,
        lambda i, c: _planner_silent(i, c) and not i.released_remaining > c.released_end,
        lambda i: f"the planner has been silent for {_seconds(i.plan_age)} and no released path is left",
    ),
)
"""Every condition that restricts the robot; the most restrictive one that holds wins."""


def collect_findings(inputs: SafetyInputs, config: SafetyConfig) -> list[Finding]:
    """Return every finding that restricts the robot, in the table's order."""
    return [_finding(condition, inputs, config) for condition in CONDITIONS if condition.holds(inputs, config)]


def _finding(condition: Condition, inputs: SafetyInputs, config: SafetyConfig) -> Finding:
    late = inputs.late_age <= config.late_explains and condition.by_delay(inputs)
    cause = f"; this computer was {inputs.late_by:.1f} s late" if late else ""
    sentence = condition.sentence(inputs)
    code = sentence.code if isinstance(sentence, Reason) else condition.code
    return Finding(
        condition.level,
        Reason(code, sentence + cause),
        condition.operator and not condition.passes(inputs),
        condition.about_map,
        late,
        condition.rest,
    )
