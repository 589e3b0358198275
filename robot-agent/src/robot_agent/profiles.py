"""Profiles of navigation: what a robot computes itself, and what it gets from the fog.

`fog` is Fognav as it is meant to be used. The other two are what it is compared with, from the same code and kernels:
`default` is a robot on its own with the usual rates of the ROS navigation stack, `full` the setup of the thesis, on its
own too, but with the fog's hazards and the rates that these allow (docs/adr/0026).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from fog_contracts.messages import ProfileName
    from robot_agent.config import MotionConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Profile:
    """One way to navigate; times in s, lengths in m.

    onboard: the robot plans its paths itself, on a costmap of its own whose layers are updated every `layers_period`.
    hazards: watched areas and no-go zones of the fog are on that costmap. planning_period: a path is searched from
    scratch this often; None: only for a new goal, and when the path is blocked. window: half the width of the local
    window. horizon: how long arcs of the dynamic window are.
    """

    name: ProfileName
    onboard: bool
    hazards: bool
    planning_period: float | None
    layers_period: float
    control_period: float
    window: float
    horizon: float

    def motion(self, config: MotionConfig) -> MotionConfig:
        """Return the configuration of path following with this profile's window, rate and horizon."""
        arcs = replace(config.arcs, sim_time=self.horizon, period=self.control_period)
        return replace(config, arcs=arcs, window=self.window)


FOG: Final = Profile(
    name="fog",
    onboard=False,
    hazards=True,
    planning_period=None,
    layers_period=0.5,
    control_period=0.2,
    window=2.0,
    horizon=1.5,
)
FULL: Final = replace(FOG, name="full", onboard=True)
DEFAULT: Final = Profile(
    name="default",
    onboard=True,
    hazards=False,
    planning_period=0.1,
    layers_period=0.5,
    control_period=0.1,
    window=3.0,
    horizon=1.7,
)
PROFILES: Final[dict[ProfileName, Profile]] = {profile.name: profile for profile in (DEFAULT, FULL, FOG)}
