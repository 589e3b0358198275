"""Lifts, in Open-RMF's words, and the hand-over of a robot, with its mission, from one floor to another."""

from typing import Annotated, Final, Literal

from msgspec import Meta

from fog_contracts.messages.basics import Author, Count, Id, Message, PointXY, Pose, Stamp, TimeToLive

Session = Annotated[str, Meta(max_length=64)]
LiftRequestType = Literal["END_SESSION", "AGV_MODE"]
DoorState = Literal["CLOSED", "MOVING", "OPEN"]
MotionState = Literal["STOPPED", "UP", "DOWN", "UNKNOWN"]
LiftMode = Literal["UNKNOWN", "HUMAN", "AGV", "FIRE", "OFFLINE", "EMERGENCY"]


class LiftRequest(Message, frozen=True, kw_only=True):
    """What a lift is to do for a session, a robot's ride: Open-RMF's `rmf_lift_msgs/LiftRequest`.

    Floors are named by their sites' ids (Open-RMF's `level_name`). A lift serves one session at a time, until its end,
    and ignores the others' requests meanwhile. The lift's id is in the channel's key.
    """

    session_id: Session
    request_type: LiftRequestType
    destination_floor: Id
    door_state: Literal["CLOSED", "OPEN"] = "OPEN"
    request_time: Stamp = 0.0


class LiftState(Message, frozen=True, kw_only=True):
    """Where a lift is, and whom it serves (`session_id`, empty: nobody): Open-RMF's `rmf_lift_msgs/LiftState`."""

    available_floors: Annotated[list[Id], Meta(max_length=200)]
    current_floor: Id
    destination_floor: Id
    door_state: DoorState
    motion_state: MotionState
    current_mode: LiftMode
    session_id: Session = ""
    lift_time: Stamp = 0.0

    def serves(self, session: str, floor: str) -> bool:
        """Whether it stands at a floor with its door open, for this session."""
        at_floor = self.current_floor == floor and self.motion_state == "STOPPED" and self.door_state == "OPEN"
        return at_floor and self.session_id == session and self.current_mode == "AGV"


class FloorGoal(Message, frozen=True, kw_only=True):
    """Where on its floor a robot is to go: one of that floor's places, or a pose on its map; `any_heading`: of it."""

    place: Id | None = None
    pose: Pose | None = None
    any_heading: bool = False


class Stop(FloorGoal, frozen=True, kw_only=True):
    """A stop of a mission, on its reader's floor unless it names another one, which knows where its places are."""

    floor: Id | None = None

    @property
    def goal(self) -> FloorGoal:
        """Where it is on its floor."""
        return FloorGoal(place=self.place, pose=self.pose, any_heading=self.any_heading)


class WhenCut(Message, frozen=True, kw_only=True):
    """What to do when every way to a stop is cut: wait, cancel the mission, or drive to the nearest reachable point.

    `limit_s`: after so long without a way to a stop, whatever refuses it, the mission ends all the same. It counts anew
    for each stop, and after a restart.
    """

    do: Literal["wait", "cancel", "nearest"] = "wait"
    limit_s: TimeToLive | None = None


Priority = Annotated[int, Meta(ge=0, le=9)]
STOPS_MAX: Final = 20
Stops = Annotated[tuple[Stop, ...], Meta(max_length=STOPS_MAX)]


class Tour(Message, frozen=True, kw_only=True):
    """A mission beside its present goal, which is leg number `leg` of it.

    `reached` and `ahead` are its stops before and behind the present one. `aside`: the present goal is only the
    reachable point nearest to this stop; `nearest`: the last such point. `deadline` (s since the epoch): it ends then.
    `who` ordered it.
    """

    id: Annotated[str, Meta(max_length=40)]
    leg: Count = 0
    reached: Stops = ()
    ahead: Stops = ()
    when_cut: WhenCut = WhenCut()
    priority: Priority = 0
    deadline: Stamp | None = None
    aside: Stop | None = None
    nearest: PointXY | None = None
    who: Author = ""

    @property
    def goal_id(self) -> str:
        """The id of the present goal: another one for each leg."""
        return f"{self.id}-{self.leg}"

    @property
    def goes_on(self) -> bool:
        """Whether another leg follows the present one."""
        return self.aside is not None or bool(self.ahead)


class HandOver(Message, frozen=True, kw_only=True):
    """A robot's way from the floor `origin` to `floor`, which it carries itself (ADR 76).

    `epoch`: the robot's count of hand-overs after this one. `lift`: by which it rides; None: people carry it. `goal`:
    where it goes then. `who`: who sent it. `id`: no other one's, whatever the epochs (they may be restored), and behind
    it that of the hand-over before; robots of before give it back empty. `mission`: what the robot goes on with there,
    whose present stop is the goal; its stops that name no floor are there. Only a robot that `carries_missions`
    understands it.
    """

    origin: Id
    floor: Id
    epoch: Count
    lift: Id | None = None
    goal: FloorGoal | None = None
    who: Author = ""
    id: Annotated[str, Meta(max_length=32)] = ""
    mission: Tour | None = None


class Berth(Message, frozen=True, kw_only=True):
    """The floor that a robot is on by its own durable record, the only one that counts, and its count of hand-overs.

    `came_by`: the last of them; None: it was never handed over.
    """

    floor: Id
    epoch: Count = 0
    came_by: HandOver | None = None
