"""Chooses between the current plan and a search's result, so that a robot neither dithers nor misses a better way.

A path that has become impassable is replaced at once. One that is passable is replaced only when another saves enough,
and moved to another way (not just straightened) only some time after the last such switch: hazards that come and go
move a robot at most once per `switch_dwell_s`, and ever more seldom while they continue.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from planner.reasons.refusals import TIMEOUT

if TYPE_CHECKING:
    from planner.config import PlannerConfig
    from planner.maps.planning_map import PlanningMap
    from planner.replanning.mission import Plan, ReplanReason
    from planner.replanning.switch_limiter import SwitchLimiter
    from planner.search.path_search import SearchResult


def is_kept(
    plan: Plan, found: SearchResult, reason: ReplanReason, planning_map: PlanningMap, config: PlannerConfig
) -> bool:
    """Whether the current plan is kept: the same refusal, or a passable path that is not clearly worse.

    A search that took too long says nothing about a path that is passable: the robot goes on.
    """
    if found.refusal is not None:
        if ran_out(found) and reason not in ("goal", "off_path") and not math.isinf(remaining_cost(plan, planning_map)):
            return True
        before = plan.refusal
        if before is None or found.question is None:
            return before == found.refusal
        # The current refusal may be explained already.
        return (before.code, before.nearest) == (found.refusal.code, found.refusal.nearest)
    if plan.route is None or reason in ("goal", "off_path"):
        return False
    remaining = remaining_cost(plan, planning_map)
    share = config.min_saving if reason == "clearing" else config.hysteresis
    return not math.isinf(remaining) and found.cost >= (1.0 - share) * remaining


def ran_out(found: SearchResult) -> bool:
    """Whether a search took too long, so that there may be a path all the same."""
    return found.refusal is not None and found.refusal.code == TIMEOUT


def remaining_cost(plan: Plan, planning_map: PlanningMap) -> float:
    """Return the cost of the rest of a path; infinite without one, or when it is impassable."""
    if plan.route is None:
        return math.inf
    return plan.route.cost(planning_map.cost, planning_map.geometry, plan.progress)


def is_other_way(plan: Plan, found: SearchResult, config: PlannerConfig) -> bool:
    """Whether a found path leads another way than the rest of the current one."""
    if plan.route is None or found.route is None:
        return False
    return found.route.differs_from(plan.route, plan.progress, config.max_deviation)


def must_wait(
    plan: Plan,
    found: SearchResult,
    switches: SwitchLimiter,
    now: float,
    planning_map: PlanningMap,
    config: PlannerConfig,
) -> bool:
    """Whether a better path has to wait, because it leads another way and the last switch was a moment ago."""
    if now >= switches.allowed_from(config) or math.isinf(remaining_cost(plan, planning_map)):
        return False
    return is_other_way(plan, found, config)
