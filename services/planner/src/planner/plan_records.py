"""What was published and counted, recorded for logs, metrics and the API once there is time for it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, get_args

from prometheus_client import Counter, Gauge

from fog_contracts.messages import BlockedWay, PlanCode, RobotPath, RobotRelease
from fog_runtime import logs, metrics
from planner.leases.standstills import Kind
from planner.missions import ReplanReason
from planner.replanner import AvoidReason

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.handlers import Publication
    from planner.core import PlannerCore

MOST_UNRECORDED: Final = 1000
UNRECORDED_S: Final = 0.5
"""After so many publications, or so long, they are recorded although searches are left."""

_log = logs.get("planner")


class PathRecord:
    """Each robot's last path. The core's thread adds publications, the event loop takes them over between cycles."""

    def __init__(self) -> None:
        self.paths: dict[str, RobotPath] = {}
        """Each robot's last path or refusal, as last released."""
        self._sent: list[Publication] = []
        """What was published and is not recorded yet ..."""
        self._unrecorded_since = 0.0
        """... and when the first of it was."""

    def add(self, publications: Sequence[Publication], now: float) -> None:
        """Note what was published; `now` is any monotonic time (s)."""
        if publications and not self._sent:
            self._unrecorded_since = now
        self._sent += publications

    def is_due(self, now: float) -> bool:
        """Whether what was published is to be recorded although searches are left: it is much, or a while ago."""
        late = bool(self._sent) and now - self._unrecorded_since >= UNRECORDED_S
        return late or len(self._sent) >= MOST_UNRECORDED

    def take_over(self, most: int) -> bool:
        """Record the oldest of what was added, `most` publications at most; return whether others are left."""
        sent, self._sent = self._sent[:most], self._sent[most:]
        for publication in sent:
            message = publication.message
            if isinstance(message, RobotPath):
                self._record_path(publication.ids["robot"], message)
            elif isinstance(message, RobotRelease):
                self._record_release(publication.ids["robot"], message)
        return bool(self._sent)

    def _record_path(self, robot: str, path: RobotPath) -> None:
        """Record what the API shows, and report a plan when it is first published, a refusal when it changes."""
        before = self.paths.get(robot)
        self.paths[robot] = path
        _log_choice(robot, path.blocked_way, None if before is None else before.blocked_way)
        if before is not None and (before.plan_id, before.refusal) == (path.plan_id, path.refusal):
            return
        if before is None or before.plan_id != path.plan_id:
            for trace in path.traces:
                metrics.observe_trace(trace, ["plan"])
        if path.refusal is not None:
            refusal = path.refusal
            _log.warning("plan_refused", robot=robot, plan=path.plan_id, refusal=refusal.kind, reason=refusal.reason)
        else:
            _log.info("plan_published", robot=robot, plan=path.plan_id, corners=len(path.points), map_seq=path.map_seq,
                      hazards=[trace.area for trace in path.traces])  # fmt: skip

    def _record_release(self, robot: str, release: RobotRelease) -> None:
        if (path := self.paths.get(robot)) is not None:
            self.paths[robot] = path.after(release)


def _log_choice(robot: str, way: BlockedWay | None, before: BlockedWay | None) -> None:
    """Log that a robot waits, or goes round, when it did not before."""
    if way is None or (before is not None and (before.choice, before.causes) == (way.choice, way.causes)):
        return
    _log.info("way_blocked", robot=robot, choice=way.choice, causes=[cause.id for cause in way.causes],
              expected_s=way.expected_s, detour_s=way.detour_s, reason=way.reason)  # fmt: skip


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
ROOM = Counter("fognav_planner_room_made_total", "Paths by which a robot made room for another one, by kind", ["kind"])
WAITING = Gauge("fognav_planner_robots_waiting", "Robots with a path that wait for another robot")
LEASED = Gauge("fognav_planner_leased_m", "Path ahead of all robots that is leased to them")
FIELD_BYTES = Gauge("fognav_planner_goal_fields_bytes", "Memory of the distance fields of all goals")


class PlanMetrics:
    """Adds to the counters what the core has counted since the last update."""

    def __init__(self) -> None:
        """Export all labels from now on, with 0: a rate needs a value from before the first event."""
        self._exported: dict[tuple[int, object], int] = {}
        metrics.expect_stages(["plan"])
        for counter, labels in ((PLANS, ReplanReason), (REFUSALS, PlanCode), (AVOIDED, AvoidReason), (ROOM, Kind)):
            for label in get_args(labels):
                if label != 0:  # the code of success
                    counter.labels(str(label))

    def update(self, core: PlannerCore, robots: int) -> None:
        """Export the core's counts; `robots`: how many have a mission."""
        ROBOTS.set(robots)
        FIELD_BYTES.set(core.fields_bytes)
        waiting, leased = core.leases.figures()
        WAITING.set(waiting)
        LEASED.set(leased)
        replanner = core.replanner
        self._count(DETOURS, id(DETOURS), None, replanner.detours.computed)
        counts = (PLANS, replanner.plans), (REFUSALS, replanner.refusals), (AVOIDED, replanner.avoided)
        for counter, values in (*counts, (ROOM, core.leases.made)):
            for label, count in dict(values).items():
                self._count(counter.labels(str(label)), id(counter), label, count)

    def _count(self, counter: Counter, kind: int, label: object, count: int) -> None:
        counter.inc(count - self._exported.get((kind, label), 0))
        self._exported[kind, label] = count
