"""What an idle robot does about its battery: the way to the dock, and its rest. Pure.

To the dock: from an operator's command, or a low battery, to the pose in front of it. The planner gives the goal in
front of the dock to a robot that wants it, and the robot drives there like to any other. There it looks whether
anything is in between, and asks its safety gate to let the base look for the dock. Whatever disables it meanwhile ends
its wish: it never goes to its dock because of an older command. But a low battery sends it there again, when what has
kept it from its dock may be over.

At rest the lidar's motor stands still. A robot is idle while it stands, follows no mission and searches no pose. An
operator's command, a new goal or a maneuver wakes it; it is awake again after some whole scans, so that the head's
spin-up is no failure of the lidar.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import LETHAL
from fog_contracts.messages import Reason, ReasonCode, RefusalCode
from robot_agent.localization.pose import AbsoluteObservation, Pose2, wrap
from robot_agent.safety.maneuver import RULES

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.messages import Pose
    from fog_contracts.replica import Replica
    from robot_agent.agent.mission import Mission
    from robot_agent.config import AgentConfig
    from robot_agent.hardware import BaseStatus
    from robot_agent.localization.localizer import Localizer
    from robot_agent.safety.conditions import Localization, Request
    from robot_agent.safety.gate import SafetyState

GOAL_WITHIN_S: Final = 10.0
"""A planner that gives no goal in front of the dock for this long gives none."""
AGAIN_S: Final = 120.0
"""So long after it has failed a low battery sends the robot to its dock again: people pass, and a link returns."""
_ENDED: Final = f"{RULES['dock'].name} ended: "
_CANCELLED: Final = "its goal was cancelled"
_OTHER_GOAL: Final = "the robot has got another goal"
_SETTLED_S: Final = 1.0
_SAME_M: Final = 0.01
_STAGED_M: Final = 0.2
_STAGED_RAD: Final = 0.35
_SURROUNDINGS_M: Final = 0.5
"""While it looks for its dock, the robot may come this much farther away than it began."""
_ASIDE_M: Final = 0.05
"""The way to the dock is wider than the body by this, on each side."""
_DOCK_BEGINS_M: Final = 0.05
_DOCK_HALF_M: Final = 0.3
"""What the lidar sees from 5 cm before the docked robot's front on, within this half width, is the dock or its wall."""
_SIGMAS: Final = (0.03, 0.03, 0.05)
"""How exactly the dock's contacts tell the pose (m, m, rad)."""
_KNOWN_WITHIN_M: Final = 1.0
"""A pose farther from the dock than this was taken to another dock."""
_STEP_M: Final = 0.025


class Docking:
    """One robot's wish for its dock. `now` is s of the robot's monotonic clock."""

    def __init__(self, config: AgentConfig, localizer: Localizer) -> None:
        self._config = config
        self._localizer = localizer
        self._dock, self._staging = _pose2(config.dock), _pose2(config.staging)
        self._ordered_at: float | None = None
        self._goal_before: str | None = None
        self._given = self._arrived = False
        """Whether the planner has given the goal in front of the dock, and the robot has reached it."""
        self.ended: Reason | None = None
        """Why the base must not look for it any more, while it does."""
        self._again_at = -math.inf
        """When a low battery may send the robot there; if people ended a wish, only once it was disabled or docked."""
        self._observed = False
        self.given_up = ""
        """Why the robot does not go to its dock any more, until it is told to again."""

    @property
    def ordered(self) -> bool:
        """Whether the robot is on its way to its dock, or to be sent there."""
        return self._ordered_at is not None

    def order(self, state: SafetyState, mission: Mission, *, docked: bool, now: float) -> Reason | None:
        """Let the robot go to its dock; return why it does not, None if it does."""
        if self._staging is None:
            sentence = "the site gives this robot no dock: set `dock` of its [[robots]] entry in site.toml"
            return Reason(RefusalCode.NO_DOCK, sentence)
        if not self._config.finds_dock:
            return Reason(RefusalCode.NO_DOCK, "this base does not drive into a dock by itself")
        if docked:
            return Reason(ReasonCode.ON_DOCK, "the robot is on its dock")
        if not state.enabled or state.mode == "FAULT":
            return Reason(ReasonCode.NOT_ENABLED, "the robot drives to its dock: enable it first")
        self._ordered_at, self._goal_before, self.given_up = now, mission.goal_id, ""
        self._given = self._arrived = False
        self.ended = None
        if self._is_ours(mission):
            mission.resume()  # the planner does not send the robot where it sends it already
        return None

    def give_up(self, reason: str = "", again_at: float = math.inf) -> None:
        """End the wish; `reason` is told until the next one, which a low battery may have from `again_at` on."""
        if self._ordered_at is not None:
            self._ordered_at, self.given_up, self._again_at = None, reason, again_at

    def cancel(self, *, running: bool) -> bool:
        """End the wish, or what the base does by itself if it is `running`; return whether there was either."""
        if running:
            self.ended = Reason(ReasonCode.DOCKING_GIVEN_UP, _CANCELLED)
        wished = running or self.ordered
        self.give_up(_CANCELLED)
        return wished

    def order_if_low(self, status: BaseStatus, state: SafetyState, mission: Mission, now: float) -> None:
        """Send an enabled robot without a mission to its dock once its battery is low, if its settings say so."""
        if not state.enabled or status.docked:
            self._again_at = -math.inf
        if status.battery is None or status.charging or mission.active or state.latched or state.maneuver is not None:
            return
        if status.battery < self._config.dock_below and now >= self._again_at and self._ordered_at is None:
            self.order(state, mission, docked=False, now=now)

    def wants_goal(self, mission: Mission) -> bool:
        """Return whether the planner shall lead the robot to the front of its dock."""
        return self._ordered_at is not None and not (self._arrived or (mission.reached and self._is_ours(mission)))

    def is_due(self, state: SafetyState, mission: Mission, now: float, *, at_rest: bool) -> bool:
        """Return whether the robot has arrived in front of its dock, and stands; end the wish if it can't any more."""
        if self._ordered_at is None:
            return False
        if not state.enabled or state.latched or state.mode == "FAULT":
            self.give_up()
        elif self._is_ours(mission):
            self._given, self._arrived = True, mission.reached
            if not mission.reached and not mission.active:
                self.give_up(_CANCELLED)
        elif mission.active and mission.goal_id != self._goal_before:
            self.give_up(_OTHER_GOAL, now)
        elif self._given and not self._arrived:
            self.give_up(_CANCELLED)
        elif not self._arrived and now - self._ordered_at > GOAL_WITHIN_S:
            self.give_up("the planner gives it no goal in front of its dock", now + AGAIN_S)
        # The planner ends the goal as soon as it hears that it is reached: the robot need not stand by then.
        return self.ordered and self._arrived and at_rest

    def on_begun(self, refusal: str | None, now: float) -> None:
        """Record whether the safety gate lets the base look for its dock."""
        self.give_up(refusal or "", now + AGAIN_S)

    def on_ended(self, state: SafetyState, now: float) -> None:
        """Record that the base looks for its dock no more, in the state after it."""
        if state.enabled and state.maneuver_end:
            self.given_up = state.maneuver_end.removeprefix(_ENDED)
            self._again_at = math.inf if self.ended == _CANCELLED else now + AGAIN_S

    def heed_goal(self, mission: Mission) -> None:
        """Let another goal end what the base does by itself; the one in front of the dock was reached before."""
        if mission.active:
            self.ended = Reason(ReasonCode.DOCKING_GIVEN_UP, _OTHER_GOAL)

    def problem(self, replica: Replica, now: float, *, running: bool) -> Reason | None:
        """Return why the base must not drive into its dock from where it is; None when it may.

        running: it does so already.
        """
        pose, points = self._localizer.pose(now), self._localizer.points_in_map()
        if self._dock is None or self._staging is None or pose is None or points is None:
            return Reason(RefusalCode.DOCK_NOT_KNOWN, "the robot does not know where its dock is")
        ahead = math.hypot(pose.x - self._dock.x, pose.y - self._dock.y)
        if running:
            begun = math.hypot(self._staging.x - self._dock.x, self._staging.y - self._dock.y)
            if ahead > begun + _SURROUNDINGS_M:
                return Reason(RefusalCode.DOCK_FAR, "the robot moved away from its dock")
        else:
            off = pose.relative_to(self._staging)
            if math.hypot(off.x, off.y) > _STAGED_M or abs(off.theta) > _STAGED_RAD:
                return Reason(RefusalCode.DOCK_FAR, "the robot is not in front of its dock")
        if self._blocked_between(pose, ahead, replica):
            return Reason(RefusalCode.DOCK_BARRED, "the place between the robot and its dock is blocked")
        if self._is_between(pose, points):
            return Reason(RefusalCode.DOCK_BARRED, "the lidar sees something between the robot and its dock")
        return None

    def without_dock(self, points: NDArray[np.float64], pose: Pose2) -> NDArray[np.float64]:
        """Return the points (n, 2; m, in `base` of a robot at `pose`) without those of the dock."""
        if self._dock is None or len(points) == 0:
            return points
        seen = self._dock.inverse_transform(pose.transform(points))
        is_dock = (seen[:, 0] >= self._dock_begins) & (np.abs(seen[:, 1]) <= _DOCK_HALF_M)
        kept: NDArray[np.float64] = points[~is_dock]
        return kept

    def observation(self, docked_for: float | None, now: float) -> AbsoluteObservation | None:
        """Return the pose that the dock's contacts tell, once for each time that the robot comes to its dock."""
        if docked_for is None:
            self._observed = False
        if docked_for is None or docked_for < _SETTLED_S or self._observed or self._dock is None:
            return None
        self._observed = True
        pose = self._localizer.pose(now)
        if pose is not None and math.hypot(pose.x - self._dock.x, pose.y - self._dock.y) > _KNOWN_WITHIN_M:
            return None
        return AbsoluteObservation(self._dock, np.diag(np.square(_SIGMAS)), now)

    @property
    def _dock_begins(self) -> float:
        return self._config.radius - _DOCK_BEGINS_M

    def _is_ours(self, mission: Mission) -> bool:
        goal = None if mission.goal is None else mission.goal.pose
        staging = self._staging
        return goal is not None and staging is not None and math.dist((goal.x, goal.y), staging[:2]) <= _SAME_M

    def _blocked_between(self, pose: Pose2, ahead: float, replica: Replica) -> bool:
        geometry, dock = replica.geometry, self._dock
        if geometry is None or dock is None:
            return True
        for share in np.linspace(0.0, 1.0, 2 + int(ahead / _STEP_M)):
            cell = geometry.cell(pose.x + share * (dock.x - pose.x), pose.y + share * (dock.y - pose.y))
            if not geometry.contains_cell(*cell) or replica.cost[cell[1], cell[0]] == LETHAL:
                return True
        return False

    def _is_between(self, pose: Pose2, points: NDArray[np.float64]) -> bool:
        assert self._dock is not None
        seen, robot = self._dock.inverse_transform(points), pose.relative_to(self._dock)
        ahead = (seen[:, 0] > robot.x) & (seen[:, 0] < self._dock_begins)
        aside = np.abs(seen[:, 1]) <= self._config.radius + _ASIDE_M
        return bool((ahead & aside).any())


def _pose2(pose: Pose | None) -> Pose2 | None:
    return None if pose is None else Pose2(pose.x, pose.y, wrap(pose.theta))


SCANS_TO_WAKE: Final = 3
"""So many whole scans show that the head rotates evenly."""
WAKE_TIMEOUT_S: Final = 8.0
"""A lidar that has not woken after this long counts as silent."""
IDLE_SCANS: Final = 3
"""An idle robot that knows where it is looks at one of so many whole scans: two a second."""


class IdleScans:
    """Which whole scans count. An idle robot only looks for whether its pose still holds, after it was carried, say."""

    def __init__(self) -> None:
        self._skipped = 0

    def counts(self, *, idle: bool, status: Localization) -> bool:
        """Return whether to localize by the newest scan: by all of them, unless an idle robot knows where it is."""
        if idle and status == "good" and self._skipped < IDLE_SCANS - 1:
            self._skipped += 1
            return False
        self._skipped = 0
        return True


class RestPolicy:
    """The rest of one robot; `now` is s of its monotonic clock."""

    def __init__(self, rest_after: float) -> None:
        """Let it rest after so many seconds of idleness; 0: never."""
        self._rest_after = rest_after or math.inf
        self._idle_since = math.nan
        self._goal_id: str | None = None
        self._woken = False
        self._waking_since: float | None = None
        self._scans = 0
        self.lidar_on = True
        """Whether the lidar's motor has to turn."""

    def wake(self) -> None:
        """Wake the robot, or begin its idle time anew."""
        self._woken = True

    def on_request(self, request: Request) -> None:
        """Wake the robot for an operator's request, but not to stop it."""
        if request != "disable":
            self.wake()

    def on_scan(self) -> None:
        """Count a whole scan."""
        self._scans += 1

    def update(self, *, busy: bool, goal_id: str | None, now: float, base_ready: bool = True) -> None:
        """Decide anew; `busy`: the robot is not idle, `goal_id`: of its mission, `base_ready`: its base would drive."""
        if busy or self._woken or goal_id != self._goal_id or math.isnan(self._idle_since):
            self._idle_since = now
        self._woken, self._goal_id = False, goal_id
        idle = now - self._idle_since
        if not self.lidar_on:
            if idle == 0.0:
                self.lidar_on, self._waking_since, self._scans = True, now, 0
        elif self._waking_since is not None:
            awake = self._scans >= SCANS_TO_WAKE and base_ready
            if awake or now - self._waking_since > WAKE_TIMEOUT_S:
                self._waking_since = None
        elif idle >= self._rest_after:
            self.lidar_on = False

    @property
    def reason(self) -> str | None:
        """Why there are no scans now; None while the robot is awake."""
        if not self.lidar_on:
            return "at rest to save power, without its lidar: a goal or an operator's command wakes it"
        return None if self._waking_since is None else "waking up: its lidar starts"
