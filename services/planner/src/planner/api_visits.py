"""REST of visits: all that a guest may see and do, without other visits, robots or places; and the operators' list."""

from collections.abc import Callable
from typing import Any

from fog_contracts.messages import Id, Message
from fog_runtime import logs
from fog_runtime.admission import source_of
from fog_runtime.http import Answer, Body, Caller, ClientHost, Guest, HttpProblem, Operator, ProblemError, Routes
from planner.problems import PlannerProblem
from planner.visiting import Visiting
from planner.visits import Visit, VisitEnd, VisitError, VisitState

_REFUSALS = [
    PlannerProblem.VISITS_OFF, PlannerProblem.PLACE_NOT_PUBLIC, PlannerProblem.VISIT_SAME_PLACE,
    PlannerProblem.VISIT_OTHER, PlannerProblem.VISITS_FULL, PlannerProblem.VISITS_TOO_OFTEN,
    PlannerProblem.NO_VISIT, PlannerProblem.VISIT_NOT_READY,
]  # fmt: skip


_log = logs.get("planner")


class PublicPlace(Message, frozen=True, kw_only=True):
    """A place that visitors may choose."""

    id: Id
    label: str


class VisitBody(Message, frozen=True, kw_only=True):
    """Where the visitor stands, and where to go: ids of public places."""

    start: Id
    goal: Id


class VisitView(Message, frozen=True, kw_only=True):
    """A visit. `state`: waiting (for a robot), coming, ready (for "go"), leading, arrived; or ended: `end` says why.

    `ahead`: how many wait before. `distance_m`: what the robot still has to drive; `seconds`: for how long, or how long
    it still waits. Null: not known.
    """

    start: Id
    goal: Id
    state: VisitState
    end: VisitEnd | None
    ahead: int
    robot: Id | None
    distance_m: float | None
    seconds: float | None


class OpenVisit(VisitView, frozen=True, kw_only=True):
    """A visit that is not over, as operators see it: with its id, and whose token is on the code (`name`)."""

    id: str
    name: str


def _owner(caller: Caller) -> str:
    return f"{caller.name} {caller.session}"


def add_visits(routes: Routes, visiting: Callable[[], Visiting], standby: Callable[[], str]) -> None:
    """Add the routes; `visiting` returns the visits of the service that runs."""
    routes.raises(VisitError, _REFUSALS, _problem)

    def about(visit: Visit) -> dict[str, Any]:
        distance, seconds = visiting().rest(visit)
        return {
            "start": visit.start,
            "goal": visit.goal,
            "state": visit.state,
            "end": visit.end,
            "ahead": visiting().visits.ahead(visit) if visit.state == "waiting" else 0,
            "robot": visit.robot,
            "distance_m": distance,
            "seconds": seconds,
        }

    def view(visit: Visit) -> VisitView:
        return VisitView(**about(visit))

    @routes.get("/api/v1/visits/places")
    async def list_public_places(_caller: Guest) -> list[PublicPlace]:
        """List the places that visitors may choose."""
        return [PublicPlace(id=name, label=place.label) for name, place in sorted(visiting().places.items())]

    @routes.post("/api/v1/visits", status=(200, 201), raises=[VisitError])
    async def ask(body: Body[VisitBody], caller: Guest, client: ClientHost) -> Answer[VisitView]:
        """Let a robot come to a public place and lead to another one. The same request again changes nothing (200)."""
        runner, source = visiting(), source_of(client) if client else ""
        before = runner.visits.of(_owner(caller), runner.now())
        ends = (body.start, body.goal)
        visit = runner.visits.ask(_owner(caller), source, ends, runner.places, runner.now())
        runner.step()
        return Answer(view(visit), status=200 if visit is before else 201)

    @routes.get("/api/v1/visits/mine", raises=[VisitError], problems=[HttpProblem.STANDS_BY])
    async def get_visit(caller: Guest) -> VisitView:
        """Return the visit of this session. Who waits and does not ask for a minute gives up the place."""
        if reason := standby():
            raise ProblemError(HttpProblem.STANDS_BY, f"{reason}; send the request there")
        return view(visiting().visits.known(_owner(caller), visiting().now()))

    @routes.post("/api/v1/visits/mine/go", raises=[VisitError])
    async def follow(caller: Guest) -> VisitView:
        """Let the robot lead on: the visitor stands beside it."""
        visit = visiting().visits.go(_owner(caller), visiting().now())
        visiting().step()
        return view(visit)

    @routes.delete("/api/v1/visits/mine", raises=[VisitError])
    async def cancel(caller: Guest) -> None:
        """End the visit; its robot stops."""
        visiting().visits.cancel(_owner(caller), visiting().now())
        visiting().step()

    _add_operators(routes, visiting, standby, about)


def _add_operators(
    routes: Routes,
    visiting: Callable[[], Visiting],
    standby: Callable[[], str],
    about: Callable[[Visit], dict[str, Any]],
) -> None:
    @routes.get("/api/v1/visits", problems=[HttpProblem.STANDS_BY])
    async def list_visits(_caller: Operator) -> list[OpenVisit]:
        """List the visits that are not over, oldest first."""
        if reason := standby():
            raise ProblemError(HttpProblem.STANDS_BY, f"{reason}; send the request there")
        return [OpenVisit(**about(each), id=each.id, name=each.name) for each in visiting().visits.open]

    @routes.delete("/api/v1/visits/open/{visit}", raises=[VisitError], problems=[HttpProblem.STANDS_BY])
    async def end_visit(visit: str, caller: Operator) -> None:
        """End a visit; its robot stops, and the visitor reads that the staff need it."""
        if reason := standby():
            raise ProblemError(HttpProblem.STANDS_BY, f"{reason}; send the request there")
        visiting().visits.end(visit, caller.name, visiting().now())
        _log.info("visit_ended", visit=visit, who=caller.name)
        visiting().step()


def _problem(error: VisitError) -> ProblemError:
    headers = {"Retry-After": f"{max(1.0, error.retry_s):.0f}"} if error.retry_s else None
    return ProblemError(error.code, str(error), headers=headers)
