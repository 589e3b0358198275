"""What several services tell people of a map and of robots: answers of REST and events of the console, defined once."""

from fog_contracts.messages.basics import Message, Pose
from fog_contracts.messages.fleet import OutOfService
from fog_contracts.messages.maps import MapGeometry
from fog_contracts.messages.robots import BlockedWay, Refusal, RobotGoal, RobotPath, RobotState


class MapInfo(Message, frozen=True, kw_only=True):
    """The map's geometry and version; its images have the geometry's size, and their first row is the map's top."""

    site: str
    geometry: MapGeometry
    epoch: int
    seq: int


class GoalView(Message, frozen=True, kw_only=True):
    """A mission; `any_heading`: the robot may arrive with any heading. `idle`: it counts as none (`RobotGoal`)."""

    robot: str
    goal_id: str
    pose: Pose
    place: str | None
    any_heading: bool
    stamp: float
    idle: bool = False

    @classmethod
    def of(cls, robot: str, goal: RobotGoal | None) -> "GoalView | None":
        """Return a robot's mission; None without one."""
        if goal is None or goal.pose is None:
            return None
        return cls(
            robot=robot,
            goal_id=goal.goal_id,
            pose=goal.pose,
            place=goal.place,
            any_heading=goal.any_heading,
            stamp=goal.stamp,
            idle=goal.idle,
        )


class PlanView(Message, frozen=True, kw_only=True):
    """The current plan: version, number of corners, released length (m), or refusal; why it waits, or goes round.

    `waits_for`: the robot that it lets pass.
    """

    plan_id: int
    map_epoch: int
    map_seq: int
    points: int
    released_length: float
    refusal: Refusal | None
    blocked_way: BlockedWay | None = None
    waits_for: str | None = None

    @classmethod
    def of(cls, path: RobotPath | None) -> "PlanView | None":
        """Return a path without its corners; None without one."""
        if path is None:
            return None
        return cls(
            plan_id=path.plan_id,
            map_epoch=path.map_epoch,
            map_seq=path.map_seq,
            points=len(path.points),
            released_length=path.released_length,
            refusal=path.refusal,
            blocked_way=path.blocked_way,
            waits_for=path.waits_for,
        )


class Arrival(Message, frozen=True, kw_only=True):
    """In how many seconds a robot arrives: nine in ten drives lie from `earliest_s` to `latest_s`, by its last ones."""

    earliest_s: float
    expected_s: float
    latest_s: float


class RobotSummary(Message, frozen=True, kw_only=True):
    """A robot with its latest state, goal and plan; `out_of_service`: why it gets no goal.

    `start` and `dock` are where the site says that it begins, and stands on its dock; None: it says nothing.
    """

    id: str
    configured: bool
    state: RobotState | None
    goal: GoalView | None
    plan: PlanView | None
    out_of_service: OutOfService | None = None
    start: Pose | None = None
    dock: Pose | None = None
