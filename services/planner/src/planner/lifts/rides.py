"""What a robot that rides to another floor does next, and what its lift is asked for, in Open-RMF's words. Pure."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from fog_contracts.messages import Berth, LiftRequest
from planner.problems import PlannerProblem

if TYPE_CHECKING:
    from collections.abc import Iterable

    from fog_contracts.messages import LiftState, Pose, RobotPose, RobotState
    from fog_contracts.site import LiftSite
    from planner.stops import Ride

CABIN_M: Final = 1.0
"""A robot that is nearer to the middle of a cabin may be in its door: the lift is not given away. Nor is it to one that
is nearer to there than to the place where it waits: in a deep cabin that is still inside."""
INSIDE_M: Final = 0.5
"""A robot that knows that it is so near to the middle of a cabin is inside, and may ride."""

Act = Literal["wait", "board", "leave"]
"""Wait for the lift, or drive on; drive into its cabin, whose door is open; be handed over to the other floor."""


class Facts(NamedTuple):
    """What a floor knows of a robot.

    `berth`: where it is, by this floor's record. `ride`: its mission to another floor, whose present goal it has
    reached if it is `at_goal`. `cabins`: the lifts in whose cabin or door it is, or may be. `inside`: those in whose
    cabin it certainly is. `silent`: it was not heard for so long that a lift no longer waits for it.
    """

    berth: Berth
    ride: Ride | None = None
    at_goal: bool = False
    cabins: frozenset[str] = frozenset()
    inside: frozenset[str] = frozenset()
    silent: bool = False


def session(robot: str, epoch: int) -> str:
    """Return the name of a robot's ride, which no other ride has: late requests for an earlier one change nothing."""
    return f"{robot}/{epoch}"


def next_act(robot: str, facts: Facts, lift: LiftState | None, floor: str) -> Act:
    """Return what a robot on this floor does next; `lift` is the state of its ride's lift, None if it is old."""
    ride = facts.ride
    if ride is None or not facts.at_goal or lift is None:
        return "wait"
    if not lift.serves(session(robot, facts.berth.epoch + 1), floor):
        return "wait"
    if not ride.boards:
        return "board"
    return "leave" if ride.lift in facts.inside else "wait"  # somebody may have driven or pushed it out


def request(  # noqa: PLR0911  # each part of a ride has its own answer
    name: str, robot: str, facts: Facts, lift: LiftState | None, floor: str
) -> LiftRequest | None:
    """Return what this floor asks of the lift `name` for a robot now; None: nothing.

    While the robot is on its way to the cabin, in it or in its door, the lift is called to this floor, with its door
    open. One that has left is sent to the other floor as long as the lift says that it is still that ride's, which the
    other floor asks for, too. Of a robot that has fallen silent in its cabin the lift is given back to people; it is
    called again once that robot is heard.
    """
    berth, ride = facts.berth, facts.ride
    own, following = session(robot, berth.epoch), session(robot, berth.epoch + 1)
    given = berth.came_by
    if berth.floor != floor:
        if given is None or given.lift != name or lift is None or lift.session_id != own:
            return None
        return None if lift.destination_floor == given.floor else _call(own, given.floor)
    if not facts.silent:
        if given is not None and given.lift == name:
            return _call(own, floor)
        before = lift is not None and lift.session_id == own  # its last ride, which ends first
        if ride is not None and ride.lift == name and (facts.at_goal or ride.boards) and not before:
            return _call(following, floor)
    if lift is None or lift.session_id not in (own, following):
        return None
    if name in facts.cabins and not facts.silent:
        return _call(lift.session_id, floor)
    return LiftRequest(session_id=lift.session_id, request_type="END_SESSION", destination_floor=floor)


def _call(name: str, floor: str) -> LiftRequest:
    return LiftRequest(session_id=name, request_type="AGV_MODE", destination_floor=floor)


def cannot_leave(robot: str, state: RobotState, floor: str, *, mission: bool) -> tuple[PlannerProblem, str] | None:
    """Return why a robot can't be handed over to a floor, with a mission or without; None if it can.

    Once its floor has recorded that it has left, there is no way back: a robot of before does not even recognize a
    hand-over with a mission, since its signature counts what that robot does not know.
    """
    if floor not in state.floors:
        known = ", ".join(state.floors) or "this floor only"
        return PlannerProblem.FLOOR_UNKNOWN, f"robot {robot} does not know {floor}; it knows: {known}"
    if mission and not state.carries_missions:
        why = f"robot {robot} can't take a mission along to {floor}: bring its software to this version"
        return PlannerProblem.ROBOT_OUTDATED, why
    return None


def lift_to(lifts: Iterable[LiftSite], floor: str, pose: RobotPose | None) -> LiftSite | None:
    """Return the lift to another floor that is nearest in a straight line; None if none leads there."""

    def away(lift: LiftSite) -> float:
        return 0.0 if pose is None else math.hypot(lift.wait.x - pose.x, lift.wait.y - pose.y)

    return min((lift for lift in lifts if floor in lift.floors), key=away, default=None)


def cabins_at(lifts: Iterable[LiftSite], berth: Berth, pose: RobotPose | None) -> frozenset[str]:
    """Return the lifts in whose cabin or door a robot may be: by its pose or, while that is unknown, by its ride.

    Without a ride it may be in each of them as long as nothing was heard of it.
    """
    if pose is None or not pose.localized:
        if berth.came_by is not None:
            return frozenset() if berth.came_by.lift is None else frozenset((berth.came_by.lift,))
        return frozenset(lift.id for lift in lifts) if pose is None else frozenset()
    return frozenset(lift.id for lift in lifts if _may_be_in(lift, pose))


def inside_of(lifts: Iterable[LiftSite], pose: RobotPose | None) -> frozenset[str]:
    """Return the lifts in whose cabin a robot certainly is."""
    if pose is None or not pose.localized:
        return frozenset()
    return frozenset(lift.id for lift in lifts if _away(lift.cabin, pose) < INSIDE_M)


def _may_be_in(lift: LiftSite, pose: RobotPose) -> bool:
    cabin, wait = _away(lift.cabin, pose), _away(lift.wait, pose)
    apart = math.hypot(lift.cabin.x - lift.wait.x, lift.cabin.y - lift.wait.y)
    return cabin < CABIN_M or cabin < min(wait, apart)


def _away(place: Pose, pose: RobotPose) -> float:
    return math.hypot(place.x - pose.x, place.y - pose.y)
