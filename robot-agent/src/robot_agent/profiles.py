"""Profiles of navigation: what a robot computes itself, and what it gets from the fog.

`fog` is Fognav as it is meant to be used. What it is compared with, from the same code and kernels, comes with
`fognav-experiments`: `default` is a robot on its own with the thesis's rates, `full` the setup
of the thesis, on its own too, but with the fog's hazards and the rates that these allow (ADR 26). Their package
registers them by name among the entry points `fognav.profiles`; `robot_agent.registry` finds them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Protocol

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from fog_contracts.handlers import Moment
    from fog_contracts.messages import PointXY, ProfileName, Refusal, RobotGoal, RobotPath
    from fog_contracts.replica import Replica
    from fog_contracts.shapes import Spans
    from robot_agent.config import MotionConfig
    from robot_agent.localization.localizer import Localizer
    from robot_agent.localization.pose import Pose2
    from robot_agent.motion.path_follower import PathFollower

ENTRY_POINTS: Final = "fognav.profiles"


class ProfileError(ValueError):
    """There is no such profile, or it is unusable; the message names the remedy."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """The result of a search `by` a planner: corner points (m, frame `map`), or why there is no path."""

    by: object
    goal: RobotGoal
    points: list[PointXY]
    refusal: Refusal | None = None

    @property
    def length(self) -> float:
        """Length of the path, m."""
        return sum(math.dist(a, b) for a, b in zip(self.points, self.points[1:], strict=False))


class Search(Protocol):
    """A search for a path that is due."""

    def run(self) -> Found:
        """Search, on any thread, while nobody updates the planner."""


class OwnPlanner(Protocol):
    """Plans on the robot: keeps a costmap of its own and says when to search. Times are s of the monotonic clock."""

    plans: int
    """Number of the plan that the robot made last, by this planner or one before."""

    @property
    def replica(self) -> Replica:
        """The costmap, in the form of the fog's."""

    def age(self, now: float) -> float:
        """Return the time (s) since the costmap was last up to date."""

    def update(
        self, localizer: Localizer, closed: Mapping[str, Spans], impassable: NDArray[np.float64], now: float
    ) -> bool:
        """Update the costmap if that is due; return whether it was.

        closed: the places that the fog closes. impassable: (n, 2) m, frame `map`: a place that the robot could not
        pass.
        """

    def search(self, goal: RobotGoal, pose: Pose2, follower: PathFollower | None, now: float) -> Search | None:
        """Return the search for a path from the robot's pose to its goal if one is due, else None."""

    def searched(self, found: Found) -> bool:
        """Return whether it was this planner that found it."""

    def path(self, found: Found, follower: PathFollower | None, at: Moment) -> RobotPath | None:
        """Return the path to follow from now on, or the refusal; None if the present path is kept."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Profile:
    """One way to navigate; times in s, lengths in m.

    planner: makes the planner of a robot that plans for itself, of a map, the body's inscribed radius and the number of
    the last plan. hazards: watched areas and no-go zones of the fog count. window: half the width of the local window.
    horizon: how long arcs of the dynamic window are.
    """

    name: ProfileName
    planner: Callable[[Replica, float, int], OwnPlanner] | None
    hazards: bool
    control_period: float
    window: float
    horizon: float

    @property
    def onboard(self) -> bool:
        """Whether the robot plans its paths itself, on a costmap of its own."""
        return self.planner is not None

    def motion(self, config: MotionConfig) -> MotionConfig:
        """Return the configuration of path following with this profile's window, rate and horizon."""
        arcs = replace(config.arcs, sim_time=self.horizon, period=self.control_period)
        return replace(config, arcs=arcs, window=self.window)


FOG: Final = Profile(name="fog", planner=None, hazards=True, control_period=0.2, window=2.0, horizon=1.5)

FindProfile = Callable[["ProfileName"], Profile]
"""Returns the profile of a name; raises `ProfileError`."""


def fog_only(name: ProfileName) -> Profile:
    """Return the profile of the fog, the only one of a robot that is told of no others; raises `ProfileError`."""
    if name != FOG.name:
        raise ProfileError(f"this robot knows no profile {name}: use {FOG.name}")
    return FOG
