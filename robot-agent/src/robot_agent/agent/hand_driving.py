"""Driving by hand: what an operator at the robot says, and what follows of the last of it. Pure.

The safety gate decides whether the robot may move (`robot_agent.safety.maneuver`), the stop field guards each command.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

from msgspec import Meta, Struct

from fog_contracts.messages import Code, Codes, Sentence
from robot_agent.motion.local_planner import turning_at_most, wheels

if TYPE_CHECKING:
    from robot_agent.config import AgentConfig
    from robot_agent.safety.stop_field import Wheels


Speed = Annotated[float, Meta(ge=-1.0, le=1.0)]
TurningRate = Annotated[float, Meta(ge=-10.0, le=10.0)]


class TakeOver(Struct, frozen=True, tag="take_over"):
    """Begin to drive by hand; answered."""


class HandBack(Struct, frozen=True, tag="hand_back"):
    """End driving by hand; answered. `lost`: the agent says it for a link that broke."""

    lost: bool = False


class ResetFault(Struct, frozen=True, tag="reset"):
    """Reset a latched fault, after its cause is gone; answered."""


class Steer(Struct, frozen=True, tag="steer", kw_only=True):
    """Drive at v (m/s) and turn at w (rad/s, counter-clockwise); counts for 0.15 s, zero says that nobody steers."""

    v: Speed
    w: TurningRate


class Watch(Struct, frozen=True, tag="watch"):
    """Somebody looks at the robot: it does not go to rest. The agent says it for whoever is connected."""


HandRequest = TakeOver | HandBack | ResetFault | Steer | Watch


class HandReply(Struct, frozen=True, kw_only=True):
    """Whether a request was carried out; `code` and `causes` as in `fog_contracts.messages.CommandReply`."""

    accepted: bool
    reason: Sentence
    code: Code = ""
    causes: Codes = []


class HandDriving:
    """The dead-man's switch: a speed counts for a moment, and who says nothing for long drives no more.

    `now` is s of the robot's monotonic clock.
    """

    def __init__(self, config: AgentConfig) -> None:
        self._config = config
        self._heard_at = -math.inf
        self._motion = (0.0, 0.0)
        self._over = "nobody has taken it over"

    def begin(self, now: float) -> None:
        """Begin at standstill."""
        self._heard_at, self._motion, self._over = now, (0.0, 0.0), ""

    def steer(self, v: float, w: float, now: float) -> None:
        """Drive at v (m/s) and turn at w (rad/s) until a moment from now."""
        self._heard_at, self._motion = now, (v, w)

    def end(self, reason: str) -> None:
        """End it for this reason; the robot stops."""
        self._motion, self._over = (0.0, 0.0), self._over or reason

    def over(self, now: float) -> str | None:
        """Return why nobody drives by hand any more; None while somebody does."""
        silent = self._config.safety.hand_silent
        if not self._over and not now - self._heard_at <= silent:
            self.end(f"who drove the robot by hand was silent for {silent:g} s")
        return self._over or None

    def wheels(self, now: float) -> Wheels:
        """Return the wheel speeds (m/s): zero unless somebody steers this very moment."""
        if not now - self._heard_at <= self._config.safety.hand_fresh:
            return 0.0, 0.0
        v, w = turning_at_most(*self._motion, self._config.safety.turn_teleop)
        return wheels(v, w, self._config.drive_train.axle_m)
