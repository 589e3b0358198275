"""When the robot's own costmap is updated, when a path is searched on it, and the search itself."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import INSCRIBED
from fog_contracts.messages import PlanRefusal, Refusal, RobotPath
from fog_kernels.astar import Planner, nearest_traversable
from fog_kernels.lines import line_cost
from fognav_experiments.onboard.costmap import OnboardCostmap
from robot_agent.motion.path_follower import first_blocked
from robot_agent.profiles import FOG, Found, Profile

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry
    from fog_contracts.handlers import Moment
    from fog_contracts.messages import PlanCode, PointXY, RobotGoal
    from fog_contracts.replica import Replica
    from fog_contracts.shapes import Spans
    from robot_agent.localization.localizer import Localizer
    from robot_agent.localization.pose import Pose2
    from robot_agent.motion.path_follower import PathFollower

    Grid = NDArray[np.uint8]

_LAYERS_PERIOD_S: Final = 0.5
"""How often the layers of the costmap are updated."""
_EXPLAINED_M: Final = 0.25
"""A lidar point this near to a wall of the floor plan is explained by it."""
_TURN_RATE: Final = 0.5
"""Above this turning rate (rad/s) nothing is marked: the residual skew would smear it."""
_SHORTER_M: Final = 0.3
"""A free path is kept unless a new one is this much shorter, so that the robot does not waver between equal ones."""
_REFUSED_RETRY_S: Final = 1.0
"""A search that found no path is repeated after this long, although nothing has changed."""
_GOAL_OCCUPIED: Final = 206
_BY_OBSTACLES: Final = frozenset({205, _GOAL_OCCUPIED, 208})
"""Refusals that obstacles may be the cause of: around the robot, at the goal, and on all ways to it."""
_ESCAPE_M: Final = 0.5
"""How far from the robot its path may begin, when it stands where its centre should not be."""
_EARLY_S: Final = 1e-6
"""Rounding of a clock must not put off what is due."""


class OnboardNavigator:
    """Keeps the robot's own costmap up to date and says when to search. Times are s of the robot's monotonic clock.

    `plans`: number of the plan that the robot made last, by this navigator or one before. `planning_period`: a path is
    searched from scratch this often; None: only for a new goal, and when the path is blocked.
    """

    def __init__(
        self, floor: Replica, inscribed_radius: float, plans: int = 0, *, planning_period: float | None = None
    ) -> None:
        self._planning_period = planning_period
        self._costmap = OnboardCostmap(floor, inscribed_radius)
        geometry = self._costmap.geometry
        self._planner = Planner(geometry.width, geometry.height)
        self._updated_at = -math.inf  # so that the places that the fog closes are on it before the first search
        self._searched_at = -math.inf
        self._searched_goal: RobotGoal | None = None
        self._refused = False
        self._doubted = False
        """Whether the present path may lead round something that has been forgotten since it was searched."""
        self.plans = plans

    @property
    def replica(self) -> Replica:
        """The robot's own costmap, in the form of the fog's."""
        return self._costmap.replica

    def age(self, now: float) -> float:
        """Return the time (s) since the costmap was last up to date."""
        return now - self._updated_at

    def update(
        self, localizer: Localizer, closed: Mapping[str, Spans], impassable: NDArray[np.float64], now: float
    ) -> bool:
        """Update the layers if that is due; return whether it was.

        closed: the places that the fog closes. impassable: (n, 2) m, frame `map`: a place that the robot could not
        pass. No planner of the fog is told of it here, and the costmap may show it as open.
        """
        if now - self._updated_at < _LAYERS_PERIOD_S - _EARLY_S:
            return False
        self._updated_at = now
        self._costmap.close(closed)
        points, seen_from = localizer.points_in_map(), localizer.scan_pose()
        trusted = localizer.status == "good" and abs(localizer.twist()[1]) <= _TURN_RATE
        if points is not None and seen_from is not None and trusted:
            self._costmap.observe(seen_from, points, localizer.wall_distance(points) > _EXPLAINED_M, impassable)
        return True

    def search(self, goal: RobotGoal, pose: Pose2, follower: PathFollower | None, now: float) -> Search | None:
        """Return the search for a path from the robot's pose to its goal if one is due, else None."""
        if not self._is_due(goal, follower, now):
            return None
        if self._is_other(goal):
            self._costmap.believe()
        self._searched_at, self._searched_goal, self._doubted = now, goal, False
        return Search(
            planner=self._planner,
            cost=self.replica.cost,
            geometry=self._costmap.geometry,
            start=(pose.x, pose.y),
            goal=goal,
        )

    def searched(self, found: Found) -> bool:
        """Return whether it was found on this costmap, not on that of a profile before."""
        return found.by is self._planner

    def path(self, found: Found, follower: PathFollower | None, at: Moment) -> RobotPath | None:
        """Return the path to follow from now on, or the refusal; None if the present path is kept.

        It is kept, too, when a refusal rests on what was only seen from far away. That is forgotten, and the next
        search, which is due at once, tells whether there is a way to go nearer.
        """
        if found.refusal is not None and self._is_doubtful(found.refusal, found.goal):
            self._refused, self._doubted = False, True
            return None
        self._refused = found.refusal is not None
        version = self.replica.version
        assert version is not None
        assert found.goal.pose is not None
        if follower is not None and found.refusal is None and self._is_as_good(follower, found):
            return None
        self.plans += 1
        return RobotPath(
            plan_id=self.plans,
            planner_epoch=0,
            goal_id=found.goal.goal_id,
            points=found.points,
            map_epoch=version.epoch,
            map_seq=version.seq,
            released_length=found.length,
            goal_theta=None if found.goal.any_heading else found.goal.pose.theta,
            refusal=found.refusal,
            stamp=at.stamp,
        )

    def _is_due(self, goal: RobotGoal, follower: PathFollower | None, now: float) -> bool:
        if self._planning_period is not None:
            return now - self._searched_at >= self._planning_period - _EARLY_S
        if self._refused:
            return now - self._searched_at >= _REFUSED_RETRY_S
        return self._doubted or self._is_other(goal) or follower is None or self._is_blocked(follower)

    def _is_other(self, goal: RobotGoal) -> bool:
        return self._searched_goal is None or self._searched_goal.goal_id != goal.goal_id

    def _is_doubtful(self, refusal: Refusal, goal: RobotGoal) -> bool:
        """Forget what was only seen from far away and may be why there is no path; return whether there was any.

        Of a goal that is occupied only what is near it: a closed corridor elsewhere is not to be driven to again.
        """
        if refusal.code not in _BY_OBSTACLES:
            return False
        assert goal.pose is not None
        return self._costmap.doubt((goal.pose.x, goal.pose.y) if refusal.code == _GOAL_OCCUPIED else None)

    def _is_as_good(self, follower: PathFollower, found: Found) -> bool:
        return follower.remaining <= found.length + _SHORTER_M and not self._is_blocked(follower)

    def _is_blocked(self, follower: PathFollower) -> bool:
        ahead = first_blocked(self.replica.cost, self._costmap.geometry, follower, known_to_planner=True)
        return ahead is not None


@dataclass(frozen=True, slots=True, kw_only=True)
class Search:
    """A search that is due: A* from scratch, with the kernel of the fog's planner.

    `run` may be called on any thread, while nobody writes the costmap.
    """

    planner: Planner
    cost: Grid
    geometry: GridGeometry
    start: PointXY
    goal: RobotGoal

    def run(self) -> Found:
        """Return the cheapest path, or a refusal."""
        assert self.goal.pose is not None
        geometry, goal = self.geometry, (self.goal.pose.x, self.goal.pose.y)
        first, last = geometry.cell(*self.start), geometry.cell(*goal)
        if not geometry.contains_cell(*first):
            return self._refused(203, PlanRefusal.START_OFF_MAP, "the robot is off its map")
        if not geometry.contains_cell(*last):
            return self._refused(204, PlanRefusal.GOAL_OFF_MAP, "the goal is off the map")
        free = nearest_traversable(self.cost, first, math.floor(_ESCAPE_M / geometry.resolution))
        if free is None:
            return self._refused(
                205, PlanRefusal.START_OBSTRUCTED, f"nothing is free within {_ESCAPE_M} m of the robot"
            )
        if self.cost[last[1], last[0]] >= INSCRIBED:
            return self._refused(206, PlanRefusal.GOAL_OBSTRUCTED, "the goal is occupied")
        found = self.planner.plan(self.cost, free, last)
        if not found.found:
            return self._refused(208, PlanRefusal.CUT_OFF, "no path leads to the goal on the robot's own map")
        return Found(by=self.planner, goal=self.goal, points=self._points(found.cells, goal))

    def _points(self, cells: NDArray[np.int32], goal: PointXY) -> list[PointXY]:
        """Return the corners of a path by cells, from the robot to the goal exactly where the lines are free."""
        corners = self.planner.shortcut(self.cost, cells) if len(cells) > 1 else np.repeat(cells, 2, axis=0)
        ends = self.geometry.grid_coordinates(np.array((self.start, goal)))
        points = self.geometry.centres(corners)
        for end, inner, exact in ((0, 1, self.start), (-1, -2, goal)):
            x, y = ends[end]
            next_x, next_y = corners[inner]
            if not math.isinf(line_cost(self.cost, float(x), float(y), float(next_x), float(next_y))):
                points[end] = exact
        return [(float(x), float(y)) for x, y in points]

    def _refused(self, code: PlanCode, kind: PlanRefusal, reason: str) -> Found:
        refusal = Refusal(code=code, kind=kind, reason=reason)
        return Found(by=self.planner, goal=self.goal, points=[], refusal=refusal)


FULL: Final = replace(FOG, name="full", planner=OnboardNavigator)
DEFAULT: Final = Profile(
    name="default",
    planner=partial(OnboardNavigator, planning_period=0.1),
    hazards=False,
    control_period=0.1,
    window=3.0,
    horizon=1.7,
)
