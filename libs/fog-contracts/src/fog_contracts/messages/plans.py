"""Missions, paths and refusals of the planner (zenoh, msgpack)."""

from typing import Annotated, Literal

from msgspec import Meta
from msgspec.structs import replace

from fog_contracts.messages.basics import Count, Id, Message, PointXY, Pose, Radians, Sent, Sentence, Stamp, Trace
from fog_contracts.messages.maps import Cause

PLAN_CODES = {
    0: "OK",
    203: "START_OUTSIDE_MAP",
    204: "GOAL_OUTSIDE_MAP",
    205: "START_OCCUPIED",
    206: "GOAL_OCCUPIED",
    207: "TIMEOUT",
    208: "NO_VALID_PATH",
}
"""Nav2's error codes of `ComputePathToPose`, with their names."""

PlanCode = Literal[0, 203, 204, 205, 206, 207, 208]
Points = Annotated[list[PointXY], Meta(max_length=100_000)]


class Refusal(Message, frozen=True, kw_only=True):
    """Why there is no path: Nav2's code, a sentence, what blocks the path, and the nearest reachable point."""

    code: PlanCode
    reason: Sentence
    causes: list[Cause] = []
    nearest: PointXY | None = None

    @property
    def name(self) -> str:
        """Nav2's name of the code."""
        return PLAN_CODES[self.code]


class PlanRequest(Message, frozen=True, kw_only=True):
    """Request for a path between two poses, without side effects."""

    start: Pose
    goal: Pose


class PlanReply(Message, frozen=True, kw_only=True):
    """A path (points at least 5 cm apart, frame `map`) with its length in metres, or the refusal.

    `retry_after`: the planner was too busy to look for a path; ask again after so many seconds.
    """

    points: Points = []
    length: Annotated[float, Meta(ge=0.0, le=1e6, extra={"unit": "m"})] = 0.0
    cost: Annotated[float, Meta(ge=0.0, le=1e12)] = 0.0
    map_epoch: Count = 0
    map_seq: Count = 0
    refusal: Refusal | None = None
    retry_after: Annotated[float, Meta(ge=0.0, le=3600.0, extra={"unit": "s"})] | None = None


class RobotGoal(Message, frozen=True, kw_only=True):
    """The mission of a robot; `pose` is null when it has none (cancelled or reached).

    `any_heading`: the robot may arrive with any heading, that of `pose` does not count.
    """

    goal_id: Annotated[str, Meta(max_length=64)]
    pose: Pose | None
    any_heading: bool = False
    place: Id | None = None
    stamp: Stamp = 0.0
    planner_epoch: Count = 0


class RobotRelease(Message, frozen=True, kw_only=True):
    """How much of a path the robot may drive (m), twice a second: the path is still good on this version of the map.

    It keeps the path of this plan alive, and no other: a robot that does not have it hears nothing from its planner.
    """

    plan_id: Count
    planner_epoch: Count
    released_length: Annotated[float, Meta(ge=0.0, le=1e6, extra={"unit": "m"})]
    map_epoch: Count
    map_seq: Count
    sent: Sent | None = None


class RobotPath(Message, frozen=True, kw_only=True):
    """The path to the goal, or why there is none; published once per plan, and again until the robot names its plan.

    To a robot whose `profile` lets it plan for itself it is not repeated. `points` are the corners, joined by straight
    lines (`fog_contracts.geometry.sampled` puts points between them). The robot may drive the first `released_length`
    metres without hearing from the planner again; `RobotRelease` extends that while all is well.
    """

    plan_id: Count
    planner_epoch: Count
    goal_id: Annotated[str, Meta(max_length=64)]
    points: Points
    map_epoch: Count
    map_seq: Count
    released_length: Annotated[float, Meta(ge=0.0, le=1e6, extra={"unit": "m"})]
    goal_theta: Radians | None = None
    refusal: Refusal | None = None
    traces: list[Trace] = []
    stamp: Stamp = 0.0
    sent: Sent | None = None

    def after(self, release: RobotRelease) -> "RobotPath":
        """Return the path with a release of its plan; that of another plan changes nothing."""
        if (release.planner_epoch, release.plan_id) != (self.planner_epoch, self.plan_id):
            return self
        return replace(
            self,
            released_length=release.released_length,
            map_epoch=release.map_epoch,
            map_seq=release.map_seq,
        )
