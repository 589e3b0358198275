"""Chooses between the current plan and a search's result."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from planner.config import PlannerConfig
    from planner.mission import Plan, ReplanReason
    from planner.path_search import SearchResult
    from planner.planning_map import PlanningMap


def is_kept(
    plan: Plan, found: SearchResult, reason: ReplanReason, planning_map: PlanningMap, config: PlannerConfig
) -> bool:
    """Whether the current plan is kept: the same refusal, or a passable path that is not clearly worse."""
    if found.refusal is not None:
        return plan.refusal == found.refusal
    if plan.route is None or reason in ("goal", "off_path"):
        return False
    remaining = plan.route.cost(planning_map.cost, planning_map.geometry, plan.progress)
    share = config.min_saving if reason == "clearing" else config.hysteresis
    return not math.isinf(remaining) and found.cost >= (1.0 - share) * remaining
