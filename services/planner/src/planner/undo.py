"""Undoes an operator's order, by its entry in the audit trail: a mission given or cancelled, or a robot's service."""

import secrets
from collections.abc import Callable
from typing import Final

from msgspec import structs

from fog_contracts.messages import OutOfService, Refusal
from fog_runtime.http import Body, Operator, ProblemError, Routes
from fog_runtime.http.store_routes import UndoBody, Undone, add_undo_errors, undone
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import IdempotencyError
from fog_runtime.stores.undo import ACTION, UndoError, require_rest, values
from planner.problems import PlannerProblem
from planner.service import Service
from planner.stops import Order
from planner.store import NO_MISSION, MissionConflictError, OutOfServiceError, StoredGoal

_KINDS: Final = ("mission", "service")


def add_undo(routes: Routes, service: Service, check: Callable[[str], None]) -> None:
    """Add the route; `routes` knows the errors of missions and of the store; `check` raises for an unknown robot."""
    add_undo_errors(routes)

    @routes.post(
        "/api/v1/robots/{robot}/undo",
        raises=[UndoError, IdempotencyError, MissionConflictError, OutOfServiceError, StoreError],
        problems=[PlannerProblem.NO_ROBOT, PlannerProblem.GOAL_REFUSED],
    )
    async def undo_order(robot: str, body: Body[UndoBody], caller: Operator) -> Undone:
        """Undo an order to a robot, if it has no other one since. An undo can be undone, too.

        Only missions that were given or cancelled, and robots that were taken out of service or put back: commands
        (enable, reset, stop) can't be undone.
        """
        check(robot)
        entry = await service.undoable(body.entry, robot, _KINDS)
        if entry.kind == "service":
            was, now = values(entry, OutOfService)
            return undone("service", robot, await _undo_service(service, robot, was, now, caller.name))
        before, after = values(entry, StoredGoal)
        return undone("mission", robot, await _undo(service, robot, before, after, caller.name))


async def _undo_service(
    service: Service, robot: str, before: OutOfService | None, after: OutOfService | None, who: str
) -> OutOfService | None:
    """Put a robot back into service, or out of it as it was before; return why it is out of service now."""
    missions, expected = service.missions, "0" if after is None else after.id
    if before is None:
        done = await missions.put_back(robot, who, expected=expected, action=ACTION)
    else:
        if before.until is not None:
            require_rest(before.until, service.stamp(), f"that robot {robot} is out of service")
        done = await missions.take_out(robot, before, who, expected=expected, action=ACTION)
    if not done:
        raise UndoError("changed_since", f"somebody has changed meanwhile whether robot {robot} is in service")
    return before


async def _undo(
    service: Service, robot: str, before: StoredGoal | None, after: StoredGoal | None, who: str
) -> StoredGoal | None:
    """Give the robot the mission that it had before; return it, None if it has none now."""
    expected = NO_MISSION if after is None else after.goal.goal_id
    if before is None or before.goal.pose is None:
        if after is None:
            raise UndoError("not_undoable", "there was no mission before, and none after: there is nothing to undo")
        await service.missions.cancel(robot, who, expected, action=ACTION)
        return None
    if before.ride is not None:
        raise UndoError("not_undoable", f"it led to {before.ride.floor}: send the robot there again")
    goal = before.goal
    assert goal.pose is not None
    if before.tour is not None and before.tour.deadline is not None:
        require_rest(before.tour.deadline, service.stamp(), f"the mission of robot {robot}")
    # A new id: the robot may have reached or cancelled a leg of the old one. From leg 0 on its deadline is counted.
    tour = None if before.tour is None else structs.replace(before.tour, id=secrets.token_hex(8), leg=0)
    order = Order(
        robot, goal.pose, who, place=goal.place, any_heading=before.any_heading, expected=expected, action=ACTION,
        tour=tour, idle=goal.idle,
    )  # fmt: skip
    sent = await service.send(order)
    if isinstance(sent, Refusal):
        raise ProblemError(PlannerProblem.GOAL_REFUSED, sent.reason, refusal=sent.kind, code=sent.code, name=sent.name)
    return sent
