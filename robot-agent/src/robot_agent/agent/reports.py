"""What the robot publishes, and when: pose at 10 Hz, standing at 2.5 Hz, state on change and at 1 Hz, as obstacles are.

An obstacle that bars its way is published at once.
"""

from __future__ import annotations

import math
import re
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from fog_contracts import channels as ch
from fog_contracts.handlers import Publication
from fog_contracts.messages import LoopHealth, Pose, Reason, ReasonCode, RobotPose, RobotState

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fog_contracts.handlers import Moment
    from fog_contracts.messages import Message, ProfileName, RobotObstacles, Trace
    from fog_contracts.replica import Version
    from robot_agent.agent.mission import Mission
    from robot_agent.agent.power import Docking
    from robot_agent.config import AgentConfig
    from robot_agent.guardian.link import BaseFeedback
    from robot_agent.hardware import BaseStatus
    from robot_agent.localization.hypotheses import Hypothesis
    from robot_agent.localization.localizer import Localizer
    from robot_agent.motion.local_planner import Decision
    from robot_agent.safety.gate import SafetyState

_STEP: Final = 0.05
"""The announced charge is rounded down to steps of this size."""


def power_warnings(status: BaseStatus | None, low: float) -> list[Reason]:
    """Return the reasons for which somebody should look after the battery; `low`: charge (of 1) that is too little."""
    if status is None:
        return []
    state = status.power.charging if status.power is not None else None
    warnings: list[Reason] = []
    if state == "fault":
        sentence = "the charger reports a fault: the battery does not charge"
        warnings.append(Reason(ReasonCode.CHARGER_FAULT, sentence))
    if status.battery is not None and status.battery < low and not status.charging:
        percent = round(100 * _STEP * math.floor(status.battery / _STEP + 1e-9))
        sentence = f"the battery is low ({percent} %): take the robot to its charger"
        warnings.append(Reason(ReasonCode.BATTERY_LOW, sentence))
    return warnings


_VARIANCE_MIN: Final = np.diag((1e-4, 1e-4, 1e-4))
_SPEED_LIMIT: Final = 10.0
_REASON_LIMIT: Final = 500
_PLACES_MAX: Final = 8


def robot_pose(localizer: Localizer, config: AgentConfig, at: Moment) -> RobotPose | None:
    """Return the pose at a moment with its covariance and the measured twist; None while it is unknown."""
    pose = localizer.pose(at.now)
    if pose is None:
        return None
    v, w = localizer.twist()
    covariance = localizer.covariance() + _VARIANCE_MIN
    return RobotPose(
        x=pose.x,
        y=pose.y,
        theta=pose.theta,
        covariance=covariance.ravel().tolist(),
        v=min(max(v, -_SPEED_LIMIT), _SPEED_LIMIT),
        w=min(max(w, -_SPEED_LIMIT), _SPEED_LIMIT),
        radius=config.radius,
        height=config.height,
        stamp=at.stamp,
        localized=localizer.status in {"good", "weak"},
        clock=at.now,
    )


def robot_state(  # noqa: PLR0913  # a message gathers from all parts of the agent
    safety: SafetyState,
    mission: Mission,
    version: Version | None,
    feedback: BaseFeedback | None,
    *,
    hindrances: list[Reason],
    battery_low: float,
    traces: list[Trace],
    loop: LoopHealth,
    epochs: dict[str, int],
    boot: str,
    profile: ProfileName,
    docking: Docking,
    hypotheses: Sequence[Hypothesis],
    at: Moment,
) -> RobotState:
    """Return mode, reasons, goal, path, map version and the `epochs` received of each service.

    `hindrances` are reasons besides the safety gate's, and so is a charge below `battery_low` (of 1); `boot` is the id
    of this run of the agent, `docking` its wish for the dock, `hypotheses` where it may be, best first.
    """
    path = mission.path
    warnings = power_warnings(feedback.status if feedback else None, battery_low)
    if docking.ordered:
        warnings.append(Reason(ReasonCode.DOCKING, "on its way to its dock"))
    elif docking.given_up:
        warnings.append(Reason(ReasonCode.DOCKING_GIVEN_UP, f"docking given up: {docking.given_up}"))
    reasons = (*safety.reasons, *hindrances, *warnings)
    return RobotState(
        mode=safety.mode,
        reasons=[reason[:_REASON_LIMIT] for reason in reasons],
        codes=[reason.code for reason in reasons],
        awaits_operator=safety.awaits_operator,
        base_fault=feedback.fault_code if feedback else "",
        enabled=safety.enabled,
        battery=feedback.status.battery if feedback else None,
        goal_id=mission.goal_id,
        map_epoch=version.epoch if version else 0,
        map_seq=version.seq if version else 0,
        plan_id=path.plan_id if path else None,
        planner_epoch=path.planner_epoch if path else None,
        goal_reached=mission.reached,
        goal_distance=mission.follower.remaining if mission.follower else None,
        loop=msgspec.structs.replace(loop, late_stops=safety.late_stops),
        traces=list(traces),
        stamp=at.stamp,
        epochs=epochs,
        boot=boot,
        profile=profile,
        clock=at.now,
        power=feedback.status.power if feedback else None,
        proximity=list(feedback.status.proximity) if feedback else [],
        docked=feedback is not None and feedback.status.docked,
        wants_dock=docking.wants_goal(mission),
        places=[Pose(x=one.pose.x, y=one.pose.y, theta=one.pose.theta) for one in hypotheses[:_PLACES_MAX]],
    )


def hindrances(mission: Mission | None, decision: Decision | None, limited: Reason | None) -> list[Reason]:
    """Return why a robot makes little progress to its goal; `limited`: why it is stopped.

    mission: None while the robot must not drive or has no goal: then there is nothing to report.
    """
    if mission is None:
        return []
    found = [] if limited is None else [limited]
    if decision is not None and decision.hindrance is not None:
        found.append(decision.hindrance)
    if mission.follower is None:
        found.append(Reason(ReasonCode.PATH_AWAITED, "waiting for a path"))
    return found


POSE_S: Final = ch.ROBOT_POSE.period_s
STANDING_POSE_S: Final = ch.ROBOT_POSE.idle_period_s
"""Period of the same pose again: others use it for long enough that one message may be lost, and another late."""
STATE_S: Final = ch.ROBOT_STATE.period_s
OBSTACLES_S: Final = ch.ROBOT_OBSTACLES.period_s
_SLACK_S: Final = 0.05
"""A message is published up to this much before it is due: ticks are not exactly 0.1 s apart."""
_NUMBER: Final = re.compile(r"[\d.]+")


class PublishingPolicy:
    """Selects at each tick (s, monotonic) what is published."""

    def __init__(self, robot: str) -> None:
        self._ids = {"robot": robot}
        self._pose_due = self._standing_due = self._state_at = self._obstacles_at = -math.inf
        self._content: object = None

    def due(
        self,
        pose: Callable[[], RobotPose | None],
        state: RobotState,
        obstacles: Callable[[], RobotObstacles | None],
        now: float,
        *,
        barred: bool = False,
        standing: bool = False,
    ) -> list[Publication]:
        """Return the publications that are due; `pose` and `obstacles` are called only when they are due.

        `barred`: an obstacle on the path ahead must be reported at once. `standing`: the robot knows where it is, and
        neither moves nor is about to. Its pose is published at once when it begins to move, and with each change of its
        state: it may just have found out that it is elsewhere.
        """
        messages: list[tuple[ch.Channel, Message]] = []
        content = _content(state)
        changed = content != self._content
        due = self._pose_due
        if standing:
            due = now if changed else self._standing_due
        if now >= due - _SLACK_S and (found := pose()) is not None:
            # Counted from when it was due, so that uneven ticks keep the rate.
            begun = max(due, now - _SLACK_S)
            self._pose_due, self._standing_due = begun + POSE_S, begun + STANDING_POSE_S
            messages.append((ch.ROBOT_POSE, found))
        if changed or now - self._state_at >= STATE_S - _SLACK_S:
            self._content, self._state_at = content, now
            messages.append((ch.ROBOT_STATE, state))
        if barred or now - self._obstacles_at >= OBSTACLES_S - _SLACK_S:
            self._obstacles_at = now
            report = obstacles()
            if report is not None:
                messages.append((ch.ROBOT_OBSTACLES, report))
        return [Publication(channel, message, self._ids) for channel, message in messages]


def _content(state: RobotState) -> object:
    """Return the part of a state whose change is published at once: all but continuously changing numbers."""
    return (
        state.mode,
        state.enabled,
        state.goal_id,
        state.goal_reached,
        state.plan_id,
        state.planner_epoch,
        state.map_epoch,
        state.map_seq,
        len(state.traces),
        tuple(map(_without_numbers, state.reasons)),
    )


@lru_cache(maxsize=64)
def _without_numbers(reason: str) -> str:
    return _NUMBER.sub("", reason)
