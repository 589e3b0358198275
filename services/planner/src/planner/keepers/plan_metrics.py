"""Exports what the core counts: plans, refusals, avoided searches, shared bounds, and the memory of its fields."""

from __future__ import annotations

from typing import TYPE_CHECKING, get_args

from prometheus_client import Counter, Gauge

from fog_contracts.messages import PlanCode
from fog_runtime import metrics
from planner.replanning.mission import ReplanReason
from planner.replanning.replanner import AvoidReason

if TYPE_CHECKING:
    from planner.core import PlannerCore

PLANS = Counter("fognav_plans_total", "Replans, by reason", ["reason"])
REFUSALS = Counter("fognav_plan_refusals_total", "Replans that ended in a refusal, by Nav2's code", ["code"])
AVOIDED = Counter(
    "fognav_plans_avoided_total",
    "Path searches that were not needed, by reason: a change was far from the path, lowered no cost for a refused"
    " robot, or left the goal out of reach",
    ["reason"],
)
DETOURS = Counter(
    "fognav_plan_shared_bounds_total", "Bounds of the way round a closure, computed once for several robots' searches"
)
ROBOTS = Gauge("fognav_planner_robots", "Robots with a mission")
FIELD_BYTES = Gauge("fognav_planner_goal_fields_bytes", "Memory of the distance fields of all goals")


class PlanMetrics:
    """Adds to the counters what the core has counted since the last update."""

    def __init__(self) -> None:
        """Export all labels from now on, with 0: a rate needs a value from before the first event."""
        self._exported: dict[tuple[int, object], int] = {}
        metrics.expect_stages(["plan"])
        for counter, labels in ((PLANS, ReplanReason), (REFUSALS, PlanCode), (AVOIDED, AvoidReason)):
            for label in get_args(labels):
                if label != 0:  # the code of success
                    counter.labels(str(label))

    def update(self, core: PlannerCore, robots: int) -> None:
        """Export the core's counts; `robots`: how many have a mission."""
        ROBOTS.set(robots)
        FIELD_BYTES.set(core.fields_bytes)
        replanner = core.replanner
        self._count(DETOURS, id(DETOURS), None, replanner.detours.computed)
        for counter, values in ((PLANS, replanner.plans), (REFUSALS, replanner.refusals), (AVOIDED, replanner.avoided)):
            for label, count in dict(values).items():
                self._count(counter.labels(str(label)), id(counter), label, count)

    def _count(self, counter: Counter, kind: int, label: object, count: int) -> None:
        counter.inc(count - self._exported.get((kind, label), 0))
        self._exported[kind, label] = count
