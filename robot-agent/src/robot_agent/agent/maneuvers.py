"""The robot's maneuvers: what the safety gate must know of the one that runs, and the command that drives it. Pure.

The way out of a blocked area is asked of the planner. The map's costs must not count there, so it is followed without
regard to them: turn in place towards it, then drive along it slowly (pure pursuit). Short ways straight ahead or back
(off the dock, from a bump, or to look around) and turns are measured by the wheels. The safety gate decides whether the
robot may move (`robot_agent.safety.maneuver`); the stop field guards each command.
"""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from fog_contracts.geometry import PATH_SPACING_M, sampled
from fog_contracts.messages import EgressRequest, Pose
from robot_agent.agent.hand_driving import HandDriving
from robot_agent.agent.power import Docking
from robot_agent.agent.safety_supervisor import ManeuverInputs
from robot_agent.hardware import Twist
from robot_agent.localization.pose import wrap
from robot_agent.motion.local_planner import turning_at_most, wheels
from robot_agent.motion.path_follower import PathFollower
from robot_agent.safety.gate import MANEUVERS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fog_contracts.messages import PlanReply, Reason
    from fog_contracts.replica import Replica
    from robot_agent.agent.motion_guard import MotionGuard
    from robot_agent.agent.path_driving import PathDriving
    from robot_agent.config import AgentConfig
    from robot_agent.guardian.link import BaseFeedback, WheelCommand
    from robot_agent.guardian.link import Maneuver as BaseManeuver
    from robot_agent.localization.localizer import Localizer
    from robot_agent.localization.pose import Pose2
    from robot_agent.safety.conditions import Request
    from robot_agent.safety.gate import SafetyOutputs, SafetyState
    from robot_agent.safety.maneuver import ManeuverKind
    from robot_agent.safety.stop_field import Wheels

_LOOKAHEAD_M: Final = 0.25
_TURN_FROM_RAD: Final = 0.35
"""With a larger error of its heading the robot turns in place."""
_TURN_MAX_RAD_S: Final = 0.8
_GAIN_PER_S: Final = 2.0


def follow_slowly(follower: PathFollower, pose: Pose2, speed: float) -> Twist:
    """Return the motion (m/s, rad/s) of a robot at `pose` (frame `map`) along the path, at most at `speed` (m/s)."""
    points, _ = follower.released_ahead(_LOOKAHEAD_M)
    x, y = points[-1]
    error = wrap(math.atan2(y - pose.y, x - pose.x) - pose.theta)
    w = min(max(_GAIN_PER_S * error, -_TURN_MAX_RAD_S), _TURN_MAX_RAD_S)
    if abs(error) > _TURN_FROM_RAD:
        return Twist(0.0, w)
    return Twist(speed * math.cos(error), w)


_ASK_AGAIN_S: Final = 1.0
"""Pause before the planner is asked again, after it gave no way out or did not answer."""
_FROM_HERE_M: Final = 0.25
"""A way out that was asked for within so much of where the robot is begins here: farther than its pose's noise and what
it still rolls, no farther than it looks ahead on the way."""


class Egress:
    """The way out, while the robot is on it. `now` is s of the robot's monotonic clock."""

    def __init__(self, config: AgentConfig) -> None:
        self._config = config
        self._follower: PathFollower | None = None
        self._problem: str | None = None
        self._ask_at = -math.inf
        self._asked: list[EgressRequest] = []

    def begin(self) -> None:
        """Forget the way out of an earlier egress, and what was asked for it: replies to that may still come."""
        self._follower = self._problem = None
        self._ask_at = -math.inf
        self._asked.clear()

    def request(self, pose: Pose2 | None, safety: SafetyOutputs, now: float) -> EgressRequest | None:
        """Return the query to send to the planner now; None when none is due."""
        if safety.mode != "EGRESS" or self._follower is not None or pose is None or now < self._ask_at:
            return None
        self._ask_at = now + _ASK_AGAIN_S
        request = EgressRequest(robot=self._config.robot, pose=Pose(x=pose.x, y=pose.y, theta=pose.theta))
        self._asked.append(request)
        return request

    def on_reply(self, request: EgressRequest, reply: PlanReply | None, pose: Pose2 | None, now: float) -> None:
        """Handle the planner's reply to a request; None when it did not answer.

        It may take seconds, in which the robot is moved, ends this egress and begins another. A way out that does not
        begin where the robot is now is not followed; the next request asks for one that does.
        """
        if self._follower is not None or request not in self._asked:
            return
        if reply is None:
            self._problem = "the planner does not answer"
        elif pose is None:
            self._problem = "the robot does not know where it is"
        elif (moved := math.hypot(pose.x - request.pose.x, pose.y - request.pose.y)) > _FROM_HERE_M:
            self._problem = f"the robot is {moved:.1f} m from where it asked the planner for a way out, and asks again"
        elif reply.refusal is not None:
            self._problem = reply.refusal.reason
        elif len(reply.points) > 1:
            self._problem = None
            corners = np.array(reply.points, dtype=np.float64)
            self._follower = PathFollower(sampled(corners, PATH_SPACING_M), math.inf)
            self._follower.advance(pose.x, pose.y, now)

    def advance(self, pose: Pose2 | None, now: float) -> None:
        """Update the robot's place on the way out."""
        if self._follower is not None and pose is not None:
            self._follower.advance(pose.x, pose.y, now)

    @property
    def remaining(self) -> float:
        """Metres to the end of the way out, by way of its nearest point; infinite while there is none."""
        follower = self._follower
        return math.inf if follower is None else follower.remaining + follower.distance

    def problem(self, limited: str | None) -> str | None:
        """Return what keeps the robot from the way out; `limited`: why its wheels are stopped."""
        return self._problem or limited

    def wheels(self, pose: Pose2 | None) -> Wheels:
        """Return the wheel speeds (m/s) along the way out; zero while there is none."""
        if self._follower is None or pose is None:
            return 0.0, 0.0
        motion = follow_slowly(self._follower, pose, self._config.safety.speed_egress)
        v, w = turning_at_most(motion.v, motion.w, self._config.motion.limits.w_max)
        return wheels(v, w, self._config.drive_train.axle_m)


ROLL_MAX_M: Final = 0.05
"""How far a robot may still roll the other way after it was told to stop: what it needs from 0.3 m/s."""


class Straight:
    """One such movement: how far (m, negative: back) and how fast (m/s)."""

    def __init__(self, distance: float, speed: float) -> None:
        self._distance = abs(distance)
        self._sign = math.copysign(1.0, distance)
        self._speed = speed
        self._begun_at: Pose2 | None = None
        self._rolled = 0.0

    def begin(self, odom: Pose2 | None) -> None:
        """Begin at this pose in `odom`; None: there is no odometry, and no way to measure it."""
        self._begun_at, self._rolled = odom, 0.0

    def advance(self, odom: Pose2 | None) -> None:
        """Let the way count from where the robot turns round, if it still rolls the other way when it begins."""
        if odom is None or self._begun_at is None:
            return
        rolled = -self._sign * odom.relative_to(self._begun_at).x
        if 0.0 < rolled <= ROLL_MAX_M - self._rolled:
            self._begun_at, self._rolled = odom, self._rolled + rolled

    def remaining(self, odom: Pose2 | None) -> float:
        """Return the way (m) that is left; infinite if it can't be measured."""
        if odom is None or self._begun_at is None:
            return math.inf
        return self._distance - self._sign * odom.relative_to(self._begun_at).x

    @property
    def wheels(self) -> Wheels:
        """The wheel speeds, m/s."""
        speed = self._sign * self._speed
        return speed, speed


_HEADINGS: Final = (0.7, -0.7, 0.0)
"""Headings (rad) to turn to, one after another, relative to the first: scans count 0.2 rad apart, and a lidar with a
mask sees other walls."""
_REACHED_RAD: Final = 0.04
_RATE_RAD_S: Final = 0.4
_SLOWEST_RAD_S: Final = 0.08


class Turning:
    """One such movement of a robot whose wheels are so far apart (m), and that may turn so fast (rad/s)."""

    def __init__(self, axle_m: float, rate_max: float) -> None:
        self._half = 0.5 * axle_m
        self._rate = min(_RATE_RAD_S, rate_max)
        self._first: float | None = None
        self._left: list[float] = []

    def begin(self, odom: Pose2 | None) -> None:
        """Begin at this pose in `odom`; None: there is no odometry, and no way to measure it."""
        self._first = None if odom is None else odom.theta
        self._left = list(_HEADINGS)

    def advance(self, odom: Pose2 | None) -> None:
        """Go on to the next heading when one is reached."""
        if self._left and abs(self._error(odom)) <= _REACHED_RAD:
            self._left.pop(0)

    def remaining(self, odom: Pose2 | None) -> float:
        """Return by how much (rad) the robot has to turn yet; 0 at the end, infinite if it can't be measured."""
        if odom is None or self._first is None:
            return math.inf
        between = sum(abs(after - before) for before, after in zip(self._left, self._left[1:], strict=False))
        return between + abs(self._error(odom))

    def wheels(self, odom: Pose2 | None) -> Wheels:
        """Return the wheel speeds, m/s."""
        error = self._error(odom)
        if error == 0.0:
            return 0.0, 0.0
        rate = math.copysign(min(self._rate, max(_SLOWEST_RAD_S, _GAIN_PER_S * abs(error))), error)
        return -rate * self._half, rate * self._half

    def _error(self, odom: Pose2 | None) -> float:
        """Return the angle (rad) to the present heading; 0 when there is none."""
        if odom is None or self._first is None or not self._left:
            return 0.0
        return wrap(self._first + self._left[0] - odom.theta)


UNDOCK_M: Final = 0.3
"""Off the dock the robot has room to turn."""
BACK_OFF_M: Final = 0.09
"""The guardian allows a centimetre more, and the wheels need some of it to come to rest."""
ADVANCE_M: Final = 0.4
"""Enough for two scans that tell places apart which look alike."""

_BY_GUARDIAN: Final[Mapping[ManeuverKind, BaseManeuver]] = {
    "dock": "seek_dock",
    "undock": "leave_dock",
    "back_off": "back_off",
}
"""Maneuvers for which the guardian has rules of its own, by their name there."""


class Maneuvers:
    """The maneuvers of one robot, of which at most one runs. `now` is s of the robot's monotonic clock."""

    def __init__(self, config: AgentConfig, localizer: Localizer, guard: MotionGuard) -> None:
        self._localizer = localizer
        self._guard = guard
        self._drive = config.drive_train
        self.egress = Egress(config)
        self.docking = Docking(config, localizer)
        self.hand = HandDriving(config)
        self._turning = Turning(config.drive_train.axle_m, config.motion.limits.w_max)
        self._straight: dict[ManeuverKind, Straight] = {
            "undock": Straight(-UNDOCK_M, config.safety.speed_egress),
            "back_off": Straight(-BACK_OFF_M, config.safety.speed_back_off),
            "advance": Straight(ADVANCE_M, config.safety.speed_egress),
        }
        self._kind: ManeuverKind | None = None

    def on_request(self, request: Request, state: SafetyState) -> None:
        """Prepare for an operator's request."""
        if request == "egress" and state.maneuver is None:
            self.egress.begin()
        if request in {"disable", "reset", "egress", "undock", "turn", "advance", "teleop"}:
            self.docking.give_up()

    def may_seek_dock(
        self, state: SafetyState, feedback: BaseFeedback | None, driving: PathDriving, now: float
    ) -> bool:
        """Return whether the robot has come to the front of its dock; a low battery may send it there."""
        if state.maneuver is not None and state.maneuver.kind == "dock":
            self.docking.heed_goal(driving.mission)
        if feedback is not None:
            self.docking.order_if_low(feedback.status, state, driving.mission, now)
        return self.docking.is_due(state, driving.mission, now, at_rest=driving.wheels.at_rest)

    def inputs(
        self, state: SafetyState, replica: Replica, trusted: Pose2 | None, now: float, request: Request | None = None
    ) -> ManeuverInputs:
        """Return how the maneuver goes; `trusted`: the robot's pose if that is good enough.

        request: of a maneuver that shall begin.
        """
        kind = None if state.maneuver is None else state.maneuver.kind
        # Just after a stop the twist still is that of the drive, and a pose that is extrapolated by it up to 2 cm too
        # far ahead: a way back from there would be too short by that. So maneuvers begin at a measured pose.
        odom, measured = self._localizer.odom_at(now), self._localizer.latest_odom()
        if kind != self._kind:
            if self._kind == "dock":
                self.docking.on_ended(state, now)
            self._kind = kind
            self._turning.begin(measured)
            for straight in self._straight.values():
                straight.begin(measured)
        match request:
            case "undock" | "back_off" if kind is None:
                return ManeuverInputs(blind_behind=self._guard.blindness(self._straight[request].wheels))
        if kind in self._straight:
            self._straight[kind].advance(measured)
            return ManeuverInputs(self._straight[kind].remaining(odom), self._guard.reason)
        if kind == "turn":
            self._turning.advance(odom)
            return ManeuverInputs(self._turning.remaining(odom), self._guard.reason)
        if kind == "dock" or self.docking.ordered:
            return ManeuverInputs(dock_problem=self._dock_problem(replica, now, running=kind == "dock"))
        if kind != "egress":
            # What is left of an earlier way out must not end a maneuver that begins now.
            return ManeuverInputs(hand_over=self.hand.over(now) if kind == "teleop" else None)
        self.egress.advance(trusted, now)
        return ManeuverInputs(self.egress.remaining, self.egress.problem(self._guard.reason))

    def way_ahead(self, request: Request | None, inputs: ManeuverInputs) -> float:
        """Return how far (m) an advance that runs, or is requested now, drives straight ahead; 0 without one."""
        if self._kind == "advance":
            return max(0.0, min(ADVANCE_M, inputs.remaining))
        return ADVANCE_M if request == "advance" else 0.0

    def command(
        self, state: SafetyState, safety: SafetyOutputs, driving: PathDriving, now: float
    ) -> WheelCommand | None:
        """Return the command of the maneuver that runs; None when none does."""
        if state.maneuver is None or safety.mode not in MANEUVERS:
            return None
        kind = state.maneuver.kind
        wheels = self._wheels(kind, now)
        guard = self._stand if kind == "teleop" and wheels == (0.0, 0.0) else self._guard.limit
        command = driving.command_directly(wheels, safety=safety, guard=guard, now=now)
        return msgspec.structs.replace(command, maneuver=_BY_GUARDIAN.get(kind))

    def _stand(self, _wheels: Wheels, now: float) -> Wheels:
        """Stand at once: who lets go of a key wants no gentle end."""
        return self._guard.limit((0.0, 0.0), now)

    def _wheels(self, kind: ManeuverKind, now: float) -> Wheels:
        match kind:
            case "egress":
                return self.egress.wheels(self._localizer.pose(now))
            case "dock":
                return 0.0, 0.0
            case "turn":
                return self._turning.wheels(self._localizer.odom_at(now))
            case "teleop":
                return self.hand.wheels(now)
            case _:
                return self._straight[kind].wheels

    def _dock_problem(self, replica: Replica, now: float, *, running: bool) -> Reason | None:
        problem = (self.docking.ended if running else None) or self.docking.problem(replica, now, running=running)
        pose = self._localizer.pose(now)
        if problem is not None or not running or pose is None:
            return problem
        return self._guard.hazard(self._measured_wheels(), partial(self.docking.without_dock, pose=pose), now)

    def _measured_wheels(self) -> Wheels:
        """Return the speeds (m/s) at which the base turns its wheels by itself."""
        v, w = self._localizer.twist()
        half = 0.5 * self._drive.axle_m * w
        return v - half, v + half
