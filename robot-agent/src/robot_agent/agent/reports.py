"""The robot's pose and state as messages."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from fog_contracts.messages import LoopHealth, Pose, Reason, ReasonCode, RobotPose, RobotState
from robot_agent.agent.power import power_warnings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.handlers import Moment
    from fog_contracts.messages import ProfileName, Trace
    from fog_contracts.replica import Version
    from robot_agent.agent.docking import Docking
    from robot_agent.agent.mission import Mission
    from robot_agent.config import AgentConfig
    from robot_agent.guardian.link import BaseFeedback
    from robot_agent.localization.hypotheses import Hypothesis
    from robot_agent.localization.localizer import Localizer
    from robot_agent.motion.local_planner import Decision
    from robot_agent.safety.gate import SafetyState

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
    if decision is not None and decision.blocked:
        found.append(decision.blocked)
    if mission.follower is None:
        found.append(Reason(ReasonCode.PATH_AWAITED, "waiting for a path"))
    return found
